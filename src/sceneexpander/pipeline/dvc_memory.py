"""What DVC would read again at every command, remembered from the last one: the stages of ``dvc.lock`` and the hashes of folders.

Files of parameters are parsed once per command, not once per stage.

DVC parses its lock file in plain Python and lists, looks up and hashes every folder once for each stage that makes or reads it. With fifty
scenes (128,000 lines, 15,000 times a folder) both take most of the time of a command that finds nothing to do. Parsed stages are kept by
the hash of their text; a folder's hash by name, size, time and inode of every file in it, which is what DVC itself trusts for a file.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sceneexpander.files import write_bytes_atomic

MEMORY_FILE = Path(".dvc") / "tmp" / "remembered.json"
LOCK_HEAD = "schema: '2.0'\nstages:\n"
_PLAIN_KEY = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")
_STAGE_LINE = re.compile(r"^  (?=[^ ])", re.MULTILINE)
_FORM = 1  # of the memory's file


class Memory:
    """What is known of one pipeline folder. Nothing in it is needed: what is not known, or of another form, is read."""

    def __init__(self, path: Path, *, still: bool = False) -> None:
        """``still``: no folder changes while this is used, so each is looked at once, however many stages make or read it."""
        self._path = path
        self._still = still
        self._looks: dict[str, str] = {}
        self._stages: dict[str, Any] = {}
        self._folders: dict[str, list[Any]] = {}
        self._met: set[str] = set()
        self._changed = False
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError, RecursionError):
            known = json.loads(path.read_text(encoding="utf-8"))
            if known["form"] == _FORM:
                stages, folders = dict(known["stages"]), dict(known["folders"])
                self._stages = {key: stage for key, stage in stages.items() if isinstance(stage, dict)}
                self._folders = {key: one for key, one in folders.items() if isinstance(one, list) and len(one) == 4}

    def save(self) -> None:
        """Write what is new, without stages that no lock had since this was read. Where nothing can be written nothing is remembered."""
        if not self._changed:
            return
        stages = {key: data for key, data in self._stages.items() if key in self._met} if self._met else self._stages
        folders = {path: known for path, known in self._folders.items() if os.path.isdir(path)}
        content = json.dumps({"form": _FORM, "stages": stages, "folders": folders})
        with contextlib.suppress(OSError):
            write_bytes_atomic(self._path, content.encode())
            self._changed = False

    def find_stages(self, texts: Sequence[str]) -> list[dict[str, Any] | None]:
        """For the lines of each stage in a lock file the stage as parsed, by its name; None: not known."""
        keys = [_hash(text) for text in texts]
        self._met.update(keys)
        return [self._stages.get(key) for key in keys]

    def keep_stage(self, text: str, parsed: dict[str, Any]) -> None:
        """Keep a stage with its name, if JSON can hold it as it is."""
        with contextlib.suppress(TypeError, ValueError):
            if repr(json.loads(json.dumps(parsed))) == repr(parsed):
                self._stages[_hash(text)], self._changed = parsed, True

    def find_folder(self, path: str, ignored: str) -> tuple[tuple[Any, ...] | None, str]:
        """(hash, bytes and number of files of a folder as it is now, what it looks like); None if that is not known.

        ``ignored``: the rules for files that do not count. A look is empty for what cannot be told by it.
        """
        look = self._looks[path] if path in self._looks else _look_at(path, ignored)
        if self._still:
            self._looks[path] = look
        known = self._folders.get(path)
        return (tuple(known[1:]) if look and known is not None and known[0] == look else None), look

    def keep_folder(self, path: str, look: str, value: str, size: int, files: int) -> None:
        """Remember the hash, bytes and number of files that belong to a look of `find_folder`."""
        self._folders[path], self._changed = [look, value, size, files], True


def split_lock(path: Path) -> dict[str, str] | None:
    """The lines of every stage in a lock file, by name. None: there is no file yet, or it is of another form."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if not text.startswith(LOCK_HEAD) or not text.endswith("\n"):
        return None
    if "\n  ? " in text:  # names of more than 128 letters are written in another way
        return None
    head, *parts = _STAGE_LINE.split(text.removeprefix(LOCK_HEAD))
    if head or any(line[:1] != " " for line in text.removeprefix(LOCK_HEAD).splitlines()):
        return None
    named = {part.partition(":\n")[0]: f"  {part}" for part in parts}
    return named if len(named) == len(parts) else None


_NOTHING = object()


def _find(node: Any, dotted: str) -> Any:
    for part in dotted.split("."):
        if not isinstance(node, dict) or part not in node:
            return _NOTHING
        node = node[part]
    return node


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _look_at(path: str, ignored: str) -> str:
    seen = hashlib.sha256(ignored.encode())
    try:
        for line in _lines(path, ""):
            seen.update(line.encode("utf-8", "surrogateescape"))
    except (OSError, _UntoldError):
        return ""
    return seen.hexdigest()[:32]


class _UntoldError(Exception):
    """A folder whose look does not tell its content."""


def _lines(path: str, below: str) -> Iterator[str]:
    with os.scandir(path) as found:
        entries = sorted(found, key=lambda entry: entry.name)
    for entry in entries:
        if entry.is_dir():
            if entry.is_symlink():
                raise _UntoldError
            yield from _lines(entry.path, f"{below}{entry.name}/")
        else:
            status = entry.stat()
            yield f"{below}{entry.name}\0{status.st_size} {status.st_mtime_ns} {status.st_ino}\n"


@contextlib.contextmanager
def remembering(memory: Memory, ignored: str) -> Iterator[None]:
    """Let DVC use and fill ``memory`` within the block; it is saved at the end. ``ignored``: the content of ``.dvcignore``.

    Does nothing with a version of DVC that looks otherwise.
    """
    from dvc.dependency import param
    from dvc.dvcfile import Lockfile
    from dvc.output import Output
    from dvc.utils.serialize import parse_yaml
    from dvc_data.hashfile.hash_info import HashInfo
    from dvc_data.hashfile.meta import Meta

    known = hasattr(Lockfile, "_load_yaml"), hasattr(Output, "_get_hash_meta"), hasattr(param, "read_param_file")
    if not all(known):
        yield
        return
    load, hash_meta, read_parameters, module = (
        Lockfile._load_yaml,
        Output._get_hash_meta,
        param.read_param_file,
        vars(param),
    )
    read: dict[str, tuple[tuple[int, ...], Any]] = {}

    def load_yaml(self: Any, **kwargs: Any) -> Any:
        path = Path(self.path)
        texts = None if kwargs.get("round_trip") else split_lock(path)
        if texts is None:
            return load(self, **kwargs)
        stages = memory.find_stages(list(texts.values()))
        new = [text for text, stage in zip(texts.values(), stages, strict=True) if stage is None]
        if new:
            parsed = parse_yaml(LOCK_HEAD + "".join(new), self.path)
            self.validate(parsed, fname=self.relpath)
            named = [{name: data} for name, data in parsed["stages"].items()]
            if len(named) != len(new):
                return load(self, **kwargs)
            for text, stage in zip(new, named, strict=True):
                memory.keep_stage(text, stage)
            left = iter(named)
            stages = [next(left) if stage is None else stage for stage in stages]
        found = {name: data for stage in stages if stage is not None for name, data in stage.items()}
        return {"schema": "2.0", "stages": found}, path.read_text(encoding="utf-8")

    def get_hash_meta(self: Any) -> Any:
        if self.fs.protocol != "local" or self.hash_name != "md5" or not os.path.isdir(self.fs_path):
            return hash_meta(self)
        known, look = memory.find_folder(self.fs_path, ignored)
        if known is not None:
            value, size, files = known
            return Meta(size=size, nfiles=files, isdir=True), HashInfo("md5", value)
        meta, info = hash_meta(self)
        if look and info.isdir:
            memory.keep_folder(self.fs_path, look, info.value, meta.size, meta.nfiles)
        return meta, info

    def read_param_file(fs: Any, path: str, key_paths: Any = None, flatten: bool = False, **kwargs: Any) -> Any:
        keys = list(key_paths or ())
        if fs.protocol != "local" or not flatten or not keys or kwargs or not all(map(_PLAIN_KEY.fullmatch, keys)):
            return read_parameters(fs, path, key_paths, flatten, **kwargs)
        status = os.stat(path)
        look = status.st_mtime_ns, status.st_size, status.st_ino
        if path not in read or read[path][0] != look:
            read[path] = look, read_parameters(fs, path, None, flatten)
        values = ((key, _find(read[path][1], key)) for key in keys)
        return {key: copy.deepcopy(value) for key, value in values if value is not _NOTHING}

    inherited = "_load_yaml" not in vars(Lockfile)
    Lockfile._load_yaml, Output._get_hash_meta = load_yaml, get_hash_meta
    module["read_param_file"] = read_param_file
    try:
        yield
    finally:
        if inherited:
            del Lockfile._load_yaml
        else:
            Lockfile._load_yaml = load
        Output._get_hash_meta, module["read_param_file"] = hash_meta, read_parameters
        memory.save()
