"""How artefacts are held on disk: a folder of small facts and tensors, written whole (`sceneexpander.files`).

``artifact.json`` (small facts and the schema name) is the last file written into it and its presence marks the artefact.

torch is imported only where tensors are: stages that move small facts start in a tenth of the time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import shutil
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from safetensors import SafetensorError

from sceneexpander.errors import UserError
from sceneexpander.files import recover_directory, write_bytes_atomic
from sceneexpander.typed import REFUSALS, DecodeError, decode, decode_dataclass, describe, fields_of, shorten

if TYPE_CHECKING:
    from torch import Tensor

FACTS_NAME = "artifact.json"
TENSORS_NAME = "tensors.safetensors"
MAX_NAME_BYTES = 1024  # of a file inside an artefact, with its folders
MAX_PART_BYTES = 255  # of each of these: file systems know no longer ones
RERUN = "rerun the stage that makes it"
T = TypeVar("T")
_log = logging.getLogger(__name__)


class ArtifactError(UserError):
    """An artefact on disk is missing, damaged, or of another kind or schema version."""


def write_json_atomic(path: Path, content: object) -> None:
    """Write JSON (sorted keys, finite numbers only) atomically."""
    text = json.dumps(to_plain(content), indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False)
    write_bytes_atomic(path, (text + "\n").encode())


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises `ArtifactError` naming the file if it is missing, not a file, or malformed."""
    try:
        if path.exists() and not path.is_file():
            raise ArtifactError("is not a file", where=path, fix="delete it and rerun its stage")
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise ArtifactError("does not exist", where=path, fix="run the stage that makes it") from None
    except OSError as error:
        raise ArtifactError(f"cannot be read ({error.strerror})", where=path) from None
    except RecursionError:
        raise ArtifactError("is nested too deeply", where=path, fix="delete it and rerun its stage") from None
    except ValueError as error:  # malformed, not UTF-8, or a number of thousands of digits
        reason = shorten(str(error), 200)
        raise ArtifactError(f"is not valid JSON ({reason})", where=path, fix="delete it and rerun its stage") from None


def _refuse_constant(name: str) -> None:
    raise ValueError(f"it holds {name}")


def read_typed(schema: type[T], content: object, path: Path, *, fix: str = RERUN, extra: bool = False) -> T:
    """Plain values that ``path`` holds as a dataclass.

    Args:
        schema: a dataclass type.
        content: a mapping of plain values.
        path: where they come from, for messages.
        fix: what to do about a file that holds something else.
        extra: pass over keys that are no fields.

    Raises:
        ArtifactError: something is missing, unknown, or of another type; names the file and the key.
    """
    try:
        return decode_dataclass(schema, content, extra=extra)
    except DecodeError as error:
        raise ArtifactError(f"is invalid ({error.where}: {error.problem})", where=path, fix=fix) from None


def to_plain(value: object) -> Any:
    """Dataclasses, enums, tuples and paths as JSON-ready values."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        items = sorted(value) if isinstance(value, (set, frozenset)) else value
        return [to_plain(item) for item in items]
    if isinstance(value, Path):
        return str(value)
    return value


def save_artifact(folder: Path, schema: str, facts: Mapping[str, object], tensors: Mapping[str, Tensor]) -> None:
    """Fill an existing (scratch) folder with tensors and, last, the facts."""
    folder.mkdir(parents=True, exist_ok=True)
    if tensors:
        # A view into a larger storage would be written whole: contiguous copies only.
        whole = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
        # The format holds each storage once: a tensor under two names is written twice.
        first_name = {t.data_ptr(): name for name, t in reversed(whole.items())}
        whole = {name: t if first_name[t.data_ptr()] == name else t.clone() for name, t in whole.items()}
        from safetensors.torch import save_file

        save_file(whole, str(folder / TENSORS_NAME))
    write_json_atomic(folder / FACTS_NAME, {**to_plain(facts), "schema": schema})


def check_inside(name: str, folder: Path) -> None:
    """Raise `ArtifactError` if a file name that an artefact holds leads out of its folder, or can be none."""
    parts = Path(name).parts
    long = len(name.encode()) > MAX_NAME_BYTES or any(len(part.encode()) > MAX_PART_BYTES for part in parts)
    if not parts or Path(name).is_absolute() or ".." in parts or "\0" in name or long:
        raise ArtifactError(f"names a file {shorten(name)!a}, which is not inside it", where=folder, fix=RERUN)


@contextlib.contextmanager
def refusing(folder: Path) -> Iterator[None]:
    """Turn what a dataclass says about values that do not go together into an `ArtifactError` about the folder they came from."""
    try:
        yield
    except DecodeError as error:
        raise ArtifactError(f"is invalid ({error.where}: {error.problem})", where=folder, fix=RERUN) from None
    except UserError:
        raise
    except REFUSALS as error:
        raise ArtifactError(f"is invalid ({shorten(str(error), 300)})", where=folder, fix=RERUN) from None


def load_fields(
    schema: type,
    facts: Mapping[str, object],
    tensors: Mapping[str, Tensor],
    folder: Path,
    *,
    prefix: str = "",
    given: Collection[str] = (),
) -> dict[str, Any]:
    """Arguments of a dataclass out of an artefact: tensors for the fields that are annotated as such, facts for all others.

    Args:
        schema: the dataclass.
        facts: plain values by field, all of which must be fields.
        tensors: by name.
        folder: of the artefact, for messages.
        prefix: of the tensors' names.
        given: fields that come from elsewhere.

    Raises:
        ArtifactError: something without a default is missing, or of another type, rank or number type.
    """
    hints, required = fields_of(schema)
    unknown = sorted(facts.keys() - (hints.keys() - set(given)))
    if unknown:
        raise ArtifactError(f"is invalid ({shorten(unknown[0])}: unknown key)", where=folder / FACTS_NAME, fix=RERUN)
    found: dict[str, Any] = {}
    for name, hint in hints.items():
        if name in given:
            continue
        if name in facts:
            try:
                found[name] = decode(hint, facts[name], where=name)
            except DecodeError as error:
                problem = f"is invalid ({error.where}: {error.problem})"
                raise ArtifactError(problem, where=folder / FACTS_NAME, fix=RERUN) from None
        elif kinds := _tensor_kinds(hint):
            if prefix + name in tensors:
                value = tensors[prefix + name]
                if not isinstance(value, kinds):
                    shape = f"{tuple(value.shape)} of {str(value.dtype).removeprefix('torch.')}"
                    problem = f"tensor {prefix + name!r} is {shape}, expected {kinds[0].__name__}"
                    raise ArtifactError(problem, where=folder / TENSORS_NAME, fix=RERUN)
                found[name] = value
            elif name in required:
                require_tensor(tensors, prefix + name, folder)
        elif name in required:
            raise ArtifactError(f"is invalid ({name}: missing key)", where=folder / FACTS_NAME, fix=RERUN)
    return found


def _tensor_kinds(hint: Any) -> tuple[type, ...]:
    """The annotated tensor types among the alternatives of a type."""
    options = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
    return tuple(option for option in options if hasattr(option, "array_type"))


def load_artifact(folder: Path, schema: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """(facts without the schema, tensors) of a folder written by `save_artifact`, refusing other schemas."""
    facts = read_json(folder / FACTS_NAME)
    found = facts.pop("schema", None) if isinstance(facts, dict) else type(facts).__name__
    if found != schema:
        shown = repr(shorten(found)) if isinstance(found, str) else describe(found)
        raise ArtifactError(f"holds {shown}, expected {schema!r}", where=folder, fix=RERUN)
    path = folder / TENSORS_NAME
    if not path.exists():
        return facts, {}
    from safetensors.torch import load_file

    try:
        return facts, load_file(str(path))
    except (SafetensorError, OSError) as error:
        raise ArtifactError(
            f"cannot be read ({error})", where=path, fix="delete the folder and rerun its stage"
        ) from None


def load_resume_point(
    folder: Path, schema: str, run_key: str, build: Callable[[dict[str, Any], dict[str, Tensor]], T]
) -> T | None:
    """What ``build`` makes of an artefact whose fact ``run_key`` is the given one, or None; what else lies there is reported and ignored.

    Args:
        folder: of the artefact.
        schema: of the artefact.
        run_key: of the run that is to go on.
        build: from facts and tensors; whatever it says about values that are none makes the artefact a damaged one.
    """
    recover_directory(folder)
    if not folder.exists():
        return None
    try:
        facts, tensors = load_artifact(folder, schema)
        if facts.get("run_key") != run_key:
            _log.warning("ignoring a checkpoint of another run in %s", folder)
            return None
        with refusing(folder):
            return build(facts, tensors)
    except ArtifactError as error:
        _log.warning("ignoring a damaged checkpoint: %s", error.line())
        return None


def keep_newest(folder: Path, count: int, *, beside: Path | None = None) -> None:
    """Delete all but the ``count`` sub-folders that were changed last; ``beside``, one of them, stays and does not count."""
    if not folder.is_dir():
        return
    others = [path for path in folder.iterdir() if path.is_dir() and path != beside]
    for path in sorted(others, key=lambda path: path.stat().st_mtime, reverse=True)[count:]:
        shutil.rmtree(path, ignore_errors=True)


def require_tensor(tensors: Mapping[str, Tensor], name: str, folder: Path) -> Tensor:
    """The named tensor, or an `ArtifactError` naming what is missing."""
    if name not in tensors:
        raise ArtifactError(f"tensor {name!r} is missing", where=folder / TENSORS_NAME, fix="rerun its stage")
    return tensors[name]


def sha256_of_bytes(data: bytes) -> str:
    """Hex digest."""
    return hashlib.sha256(data).hexdigest()


def sha256_of_file(path: Path) -> str:
    """Hex digest of a file, read in blocks."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def sha256_of_tensors(tensors: Mapping[str, Tensor]) -> str:
    """Hex digest of names, shapes, dtypes and values, independent of the mapping's order."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name}:{tuple(tensor.shape)}:{tensor.dtype}".encode())
        digest.update(tensor.flatten().view(dtype=_byte_dtype()).numpy().tobytes())
    return digest.hexdigest()


def _byte_dtype() -> Any:
    import torch

    return torch.uint8
