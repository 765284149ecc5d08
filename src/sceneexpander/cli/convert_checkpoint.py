"""``sceneexpander convert IN.pt OUT.safetensors``: PyTorch checkpoints without running their code.

A ``.pt``/``.pth``/``.ckpt``/``.bin`` file is a zip archive with a pickle, and a pickle is a program. This reader never hands it to
``torch.load``: its own unpickler knows a closed list of names (tensor rebuilding, storages, ordered dictionaries), all of them bound to
functions of this module, and refuses every other name before anything is called. So no checkpoint can run code here.

Some checkpoints carry the settings of their training beside the weights (argparse or OmegaConf objects, NumPy scalars, paths). A
second closed list has their names; all of them stand for an object that holds nothing, does nothing and is left out of the result.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import pickle
import struct
import sys
import uuid
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, entry_point
from sceneexpander.typed import REFUSALS, describe, shorten

MAX_DIMENSIONS = 64  # of a tensor, as in PyTorch
MAX_GROWTH, SMALL_BYTES = (
    4,
    16 << 20,
)  # tensors that share a storage are written apart: at most so many times the checkpoint's size
MAX_PICKLE_BYTES = 64 << 20  # names and shapes only; the numbers live outside the pickle
STORAGE_DTYPES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
STATE_DICT_KEYS = ("state_dict", "model_state_dict", "model")  # where training scripts put the weights
WRAPPER = "module."
LITTLE = b"little"


class RefusedPickleError(Exception):
    """The pickle asks for something that is not on the list."""


class _Sealed:
    """An object that a pickle may hold and pass on, but not change."""

    def __setstate__(self, state: object) -> None:
        raise RefusedPickleError(f"it tries to change a {type(self).__name__.strip('_').lower()}")


class _StorageKind(_Sealed):
    """Stands for a storage class; not callable, so a pickle cannot construct anything from it."""

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype = dtype


class _Storage(_Sealed):
    """A flat run of numbers."""

    def __init__(self, values: Tensor) -> None:
        self.values = values


class _View(_Sealed):
    """A tensor that the pickle describes, with every index checked."""

    def __init__(self, values: Tensor) -> None:
        self.values = values


class _Entries(OrderedDict[object, object]):
    """The ordered dictionary of a state dict; module metadata that hangs on it is dropped."""

    def __init__(self, *arguments: object) -> None:
        super().__init__()
        if arguments and arguments != ((),) and arguments != ([],):
            raise RefusedPickleError("an ordered dictionary is not filled entry by entry")

    def __setstate__(self, state: object) -> None:
        return


class _Inert:
    """Stands for any object of a training script's settings: takes whatever a pickle gives it, keeps nothing."""

    __slots__ = ()

    def __new__(cls, *_arguments: object, **_named: object) -> _Inert:
        return super().__new__(cls)

    def __setstate__(self, state: object) -> None:
        return

    def __setitem__(self, key: object, value: object) -> None:
        return

    def extend(self, values: object) -> None:
        """Part of how pickles fill lists."""


class _Function(_Sealed):
    """A function under the name of the PyTorch function that it replaces."""

    def __init__(self, function: Callable[..., object]) -> None:
        self.function = function

    def __call__(self, *args: object) -> object:
        return self.function(*args)


class _Archive:
    """The storages of a checkpoint's zip archive."""

    def __init__(self, archive: zipfile.ZipFile, prefix: str) -> None:
        self.archive = archive
        self.prefix = prefix
        self.left = sum(entry.file_size for entry in archive.infolist() if entry.compress_type == zipfile.ZIP_STORED)
        self.storages: dict[str, _Storage] = {}

    def storage(self, dtype: torch.dtype, key: str, count: int) -> _Storage:
        """The storage of that key; read once, because tensors may share it."""
        if key in self.storages:
            return self.storages[key]
        try:
            entry = self.archive.getinfo(f"{self.prefix}data/{key}")
        except KeyError:
            raise RefusedPickleError(f"storage {key!r} is missing") from None
        item = torch.empty(0, dtype=dtype).element_size()
        # PyTorch stores uncompressed; a compressed entry would be a way to a bomb.
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != count * item:
            raise RefusedPickleError(
                f"storage {key!r} has {entry.file_size} bytes, expected {count * item} uncompressed"
            )
        # Two entries of an archive may lie on the same bytes, but not more of them than the file has.
        self.left -= entry.file_size
        if self.left < 0:
            raise RefusedPickleError("its storages overlap")
        raw = bytearray(self.archive.read(entry))
        values = torch.frombuffer(raw, dtype=dtype) if count else torch.empty(0, dtype=dtype)
        self.storages[key] = _Storage(values)
        return self.storages[key]


def _rebuild_tensor(storage: object, offset: object, size: object, stride: object, *_ignored: object) -> _View:
    """A view of a storage; gradient flags and hooks are ignored."""
    if not isinstance(storage, _Storage) or not isinstance(size, tuple) or not isinstance(stride, tuple):
        raise RefusedPickleError("a tensor is not built from a storage")
    # Nothing of the pickle is written out before it is known to be numbers: a tuple can hold itself many times over.
    numbers = (offset, *size, *stride)
    if (
        len(size) != len(stride)
        or len(size) > MAX_DIMENSIONS
        or not all(type(n) is int and 0 <= n < 1 << 62 for n in numbers)
    ):
        raise RefusedPickleError("a tensor has an offset, size or stride that is none")
    assert isinstance(offset, int)  # noqa: S101 - checked with the others
    available, count = storage.values.numel(), math.prod(size)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    # The count too: with strides of 0 a small file could claim any amount of memory once copied.
    if count and (last >= available or count > available):
        raise RefusedPickleError(f"a tensor of size {size} reaches element {last} of a storage of {available}")
    return _View(torch.as_strided(storage.values, size, stride, offset))


def _rebuild_parameter(data: object, *_ignored: object) -> _View:
    if not isinstance(data, _View):
        raise RefusedPickleError("a parameter is not built from a tensor")
    return data


# Settings beside the weights, as CUT3R (argparse, OmegaConf) and other training scripts save them.
INERT = {
    "argparse": ("Namespace",),
    "omegaconf.dictconfig": ("DictConfig",),
    "omegaconf.listconfig": ("ListConfig",),
    "omegaconf.base": ("ContainerMetadata", "Metadata"),
    "omegaconf.nodes": ("AnyNode", "BooleanNode", "FloatNode", "IntegerNode", "StringNode"),
    "typing": ("Any",),
    "collections": ("defaultdict",),
    "pathlib": ("Path", "PosixPath", "PurePosixPath"),
    "numpy": ("dtype",),
    "numpy.core.multiarray": ("scalar",),
    "numpy._core.multiarray": ("scalar",),
    "_codecs": ("encode",),
    # What the types below are called in the older pickle format that PyTorch writes.
    "__builtin__": ("bool", "dict", "float", "int", "list", "set", "str", "tuple", "unicode"),
    "builtins": ("bool", "dict", "float", "int", "list", "set", "str", "tuple"),
}

ALLOWED: dict[tuple[str, str], object] = {
    **{(module, name): _Inert for module, names in INERT.items() for name in names},
    ("collections", "OrderedDict"): _Entries,
    ("torch._utils", "_rebuild_tensor_v2"): _Function(_rebuild_tensor),
    ("torch._utils", "_rebuild_parameter"): _Function(_rebuild_parameter),
    **{("torch", name): _StorageKind(dtype) for name, dtype in STORAGE_DTYPES.items()},
}


# The unpickler written in Python: the other one does not let anyone look at a key before it is hashed, which never ends for a tuple that
# holds another one twice, and that one another one twice, ... Its type is not declared.
_PurePython: Any = pickle._Unpickler  # type: ignore[attr-defined,unused-ignore]


class _Unpickler(_PurePython):  # type: ignore[misc]
    """Looks names up in `ALLOWED` and nowhere else: no module is ever imported for a pickle. Keys are texts or numbers."""

    dispatch: ClassVar[dict[int, Any]] = dict(_PurePython.dispatch)

    def __init__(self, data: bytes, archive: _Archive) -> None:
        super().__init__(io.BytesIO(data))
        self.archive = archive

    def load_setitem(self) -> None:
        self._check_keys(self.stack[-2:-1])
        _PurePython.load_setitem(self)

    def load_setitems(self) -> None:
        self._check_keys(self.stack[::2])
        _PurePython.load_setitems(self)

    def load_dict(self) -> None:
        self._check_keys(self.stack[::2])
        _PurePython.load_dict(self)

    def refuse_set(self) -> None:
        raise RefusedPickleError("it holds a set")

    def _check_keys(self, keys: Sequence[object]) -> None:
        if not all(isinstance(key, (str, int)) for key in keys):
            raise RefusedPickleError("a dictionary has a key that is no text")

    dispatch[pickle.SETITEM[0]] = load_setitem
    dispatch[pickle.SETITEMS[0]] = load_setitems
    dispatch[pickle.DICT[0]] = load_dict
    for _opcode in (pickle.EMPTY_SET, pickle.ADDITEMS, pickle.FROZENSET):
        dispatch[_opcode[0]] = refuse_set

    def find_class(self, module: str, name: str) -> Any:
        try:
            return ALLOWED[module, name]
        except KeyError:
            raise RefusedPickleError(f"it asks for {module}.{name}, which is not allowed") from None

    def persistent_load(self, pid: object) -> _Storage:
        match pid:
            case ("storage", _StorageKind() as kind, str(key), str(), int(count)) if count >= 0:
                return self.archive.storage(kind.dtype, key, count)
        raise RefusedPickleError("it holds a reference that is not a storage")


def read_checkpoint(path: Path, *, key: str | None = None) -> dict[str, Tensor]:
    """Tensors by name, from a zip-format PyTorch checkpoint.

    Args:
        path: the checkpoint.
        key: entry of the top-level dictionary that holds the weights; by default the dictionary itself if it holds tensors,
            otherwise the first of ``state_dict``, ``model_state_dict``, ``model``.

    Raises:
        UserError: not a zip-format checkpoint, truncated, or a pickle that asks for anything but plain tensors.
    """
    if not os.path.isfile(path):
        there = os.path.exists(path)
        raise UserError(
            "is not a file" if there else "does not exist", where=shorten(str(path), 300), fix="check the path"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            content = _unpickle(archive)
    except zipfile.BadZipFile:
        fix = "re-save checkpoints of the old (non-zip) format with a current PyTorch, on a machine you can spare"
        raise UserError("is not a zip-format PyTorch checkpoint, or is truncated", where=path, fix=fix) from None
    except RefusedPickleError as error:
        fix = "only checkpoints of plain tensors are converted; ask its author for safetensors"
        raise UserError(f"is refused: {error}", where=path, fix=fix) from None
    except (pickle.UnpicklingError, EOFError, OSError, MemoryError, RuntimeError, struct.error, zlib.error) as error:
        reason = shorten(str(error) or type(error).__name__, 200)
        raise UserError(f"is damaged ({reason})", where=path, fix="fetch it again") from None
    except (*REFUSALS, AssertionError) as error:
        # What a hand-made pickle provokes inside the unpickler; the list above is what a broken file does. The text of such an error
        # may be that of an object of the pickle, and endless.
        raise UserError(f"holds a malformed pickle ({type(error).__name__})", where=path) from None
    tensors = _weights_of(content, path, key)
    _check_growth(tensors, path)
    return tensors


def _check_growth(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Refuse names that are none, and few bytes under so many names that writing them out would fill a disk."""
    for name in tensors:
        if name == "__metadata__" or any("\ud800" <= letter <= "\udfff" for letter in name):
            raise UserError(f"has a tensor named {shorten(name)!a}, which safetensors cannot hold", where=path)
    total, size = sum(tensor.nbytes for tensor in tensors.values()), path.stat().st_size
    if total > max(SMALL_BYTES, MAX_GROWTH * size):
        raise UserError(
            f"holds {size} bytes under so many names that they would become {total}",
            where=path,
            fix="name a part with --key",
        )


def _unpickle(archive: zipfile.ZipFile) -> object:
    names = [name for name in archive.namelist() if name == "data.pkl" or name.endswith("/data.pkl")]
    if len(names) != 1:
        raise RefusedPickleError(f"it has {len(names)} data.pkl entries, expected 1")
    prefix = names[0].removesuffix("data.pkl")
    order = f"{prefix}byteorder"
    # Its size first: a compressed entry of a few bytes may hold gigabytes.
    if order in archive.namelist() and (
        archive.getinfo(order).file_size != len(LITTLE) or archive.read(order) != LITTLE
    ):
        raise RefusedPickleError("its numbers are not little-endian")
    entry = archive.getinfo(names[0])
    if entry.file_size > MAX_PICKLE_BYTES:
        raise RefusedPickleError(f"its pickle is larger than {MAX_PICKLE_BYTES} bytes")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise RefusedPickleError("its pickle is compressed in a way that PyTorch does not use")
    return _Unpickler(archive.read(names[0]), _Archive(archive, prefix)).load()


def _weights_of(content: object, path: Path, key: str | None) -> dict[str, Tensor]:
    if isinstance(content, dict):
        keys: Sequence[str | None] = [key] if key is not None else [None, *STATE_DICT_KEYS]
        for candidate in keys:
            found = content if candidate is None else content.get(candidate)
            if isinstance(found, dict):
                tensors = {
                    n: view.values for n, view in found.items() if isinstance(n, str) and isinstance(view, _View)
                }
                if tensors:
                    return _without_wrapper(tensors)
        there = ", ".join(shorten(name) if isinstance(name, str) else describe(name) for name in list(content)[:5])
        raise UserError(f"has no dictionary of tensors (its entries: {there})", where=path, fix="name it with --key")
    raise UserError(f"holds a {type(content).__name__.strip('_').lower()}, not a dictionary of tensors", where=path)


def _without_wrapper(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Without the prefix that training on several devices gives every name."""
    if all(name.startswith(WRAPPER) for name in tensors):
        return {name.removeprefix(WRAPPER): tensor for name, tensor in tensors.items()}
    return tensors


def convert(source: Path, target: Path, *, key: str | None = None) -> int:
    """Write the checkpoint's tensors as safetensors, atomically; returns how many.

    Raises:
        UserError: see `read_checkpoint`, or if the target has another suffix or cannot be written.
    """
    if target.suffix != ".safetensors":
        raise UserError("must end in .safetensors", where=shorten(str(target), 300), fix="choose another output name")
    if os.path.isdir(target):
        raise UserError("is a folder", where=target, fix="choose another output name")
    # Before the checkpoint is read, which may take minutes: can a file have this name?
    with _writing(target), contextlib.suppress(FileNotFoundError):
        target.lstat()
    tensors = read_checkpoint(source, key=key)
    scratch = target.parent / f".{uuid.uuid4().hex}.part"
    with _writing(target):
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            # Clones: safetensors refuses tensors that share memory.
            whole = {name: tensor.clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()}
            save_file(whole, scratch)
            with scratch.open("rb") as file:
                os.fsync(file.fileno())
            scratch.replace(target)
        finally:
            with contextlib.suppress(OSError):
                scratch.unlink()
    return len(tensors)


@contextlib.contextmanager
def _writing(target: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, SafetensorError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        problem = f"cannot be written ({shorten(reason, 200)})"
        raise UserError(problem, where=shorten(str(target), 300), fix="choose another output name") from None


def make_parser() -> CommandParser:
    """The options of the command."""
    parser = CommandParser(
        "convert",
        "Convert a PyTorch checkpoint of plain tensors to safetensors without running any code in it.",
        examples=["model.pt model.safetensors", "checkpoint.pth model.safetensors --key model"],
    )
    parser.add_argument("source", type=Path, help=".pt, .pth, .ckpt or .bin file")
    parser.add_argument("target", type=Path, help=".safetensors file to write")
    parser.add_argument("--key", help="entry of the checkpoint that holds the weights (default: found automatically)")
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> int:
    """Convert one file."""
    options = make_parser().parse_args(arguments)
    count = convert(options.source, options.target, key=options.key)
    print(f"{count} tensors -> {options.target}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
