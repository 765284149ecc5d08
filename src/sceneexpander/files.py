"""How files and folders reach the disk: whole or not at all.

What is written stands under a scratch name beside its target, is synced, and then renamed; a reader never sees half of it.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from sceneexpander.errors import UserError

_NOT_WRITABLE = {
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR, errno.EEXIST, errno.ELOOP, errno.ENAMETOOLONG,
}  # fmt: skip


@contextlib.contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """A scratch path beside ``path`` (ending in ``.part``); synced and renamed to ``path`` on success, removed otherwise.

    Raises:
        UserError: there is a folder of that name, or nothing can be written there.
    """
    if path.is_dir():
        raise UserError("is a folder, expected a file", where=path, fix="move it away, or choose another place")
    scratch = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.part")
    with _writable(path.parent, scratch):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield scratch
            _sync(scratch)
            scratch.replace(path)
        finally:
            scratch.unlink(missing_ok=True)


@contextlib.contextmanager
def _writable(folder: Path, scratch: Path) -> Iterator[None]:
    """A `UserError` in place of what the system says of a folder that cannot be made or written to; a full disk stays what it is."""
    try:
        yield
    except OSError as error:
        name = Path(os.fsdecode(error.filename)) if isinstance(error.filename, (str, bytes)) else None
        if error.errno not in _NOT_WRITABLE or name not in (scratch, folder, *folder.parents):
            raise
        problem = f"cannot be written to ({os.strerror(error.errno)})"
        raise UserError(problem, where=folder, fix="choose another place, or mend its rights") from None


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write a file so that readers see either the old bytes or all of the new ones."""
    with complete_file(path) as scratch:
        scratch.write_bytes(data)


@contextlib.contextmanager
def directory_being_written(target: Path) -> Iterator[Path]:
    """Yield a scratch directory that becomes ``target`` (replacing it) only if the block ends without an error.

    What a killed writer of the same target left is cleared first: a target has one writer at a time.

    Raises:
        UserError: there is a file of that name, or nothing can be written there.
    """
    if target.exists() and not target.is_dir():
        raise UserError("is a file, expected a folder", where=target, fix="move it away, or choose another place")
    scratch = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    with _writable(target.parent, scratch):
        target.parent.mkdir(parents=True, exist_ok=True)
        recover_directory(target)
        scratch.mkdir()
    try:
        yield scratch
        for path in sorted(scratch.rglob("*")):
            _sync(path)
        _sync(scratch)
        if target.exists():
            old = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.old")
            target.rename(old)
            scratch.rename(target)
            shutil.rmtree(old)
        else:
            scratch.rename(target)
        _sync(target.parent)
    finally:
        if scratch.exists():
            shutil.rmtree(scratch)


def recover_directory(folder: Path) -> None:
    """Clear what a killed writer left: half a new folder, or the old one already moved aside (which is whole)."""
    name = f".{glob.escape(folder.name)}.{'[0-9a-f]' * 8}"
    for old in folder.parent.glob(f"{name}.old"):
        if folder.exists():
            shutil.rmtree(old)
        else:
            old.rename(folder)
    for scratch in folder.parent.glob(f"{name}.part"):
        if scratch.is_dir():
            shutil.rmtree(scratch)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
