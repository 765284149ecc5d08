"""Opening what the user names: plain files are read up to a limit, everything else ends in one line.

A name can lead to a pipe that nobody writes to, a device that never ends, a link to nowhere or to itself, or to nothing that a file
system could hold. Whatever is read on behalf of a user goes through here.
"""

from __future__ import annotations

import codecs
import errno
import os
import stat
from pathlib import Path

from sceneexpander.errors import UserError

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe (FIFO)"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a character device"),
    (stat.S_ISBLK, "a block device"),
)


def kind_of(mode: int) -> str:
    """What a file mode stands for, in words: "a plain file", "a folder", "a named pipe (FIFO)", ..."""
    return next((words for test, words in _KINDS if test(mode)), "a plain file")


def require_plain_file(path: Path, *, where: str | Path | None = None) -> os.stat_result:
    """The facts of the plain file that ``path`` leads to, through links. ``where`` is what errors name instead of the path.

    Raises:
        UserError: there is no such file, it cannot be reached, or it is a folder, pipe, socket or device.
    """
    facts = _stat(path, where)
    if not stat.S_ISREG(facts.st_mode):
        raise UserError(f"is {kind_of(facts.st_mode)}, not a plain file", where=where or path)
    return facts


def require_folder(path: Path, *, where: str | Path | None = None, expected: str = "a folder") -> None:
    """Raise `UserError` unless ``path`` leads to a folder; ``expected`` says what should have been there."""
    facts = _stat(path, where)
    if not stat.S_ISDIR(facts.st_mode):
        kind = "a file" if stat.S_ISREG(facts.st_mode) else kind_of(facts.st_mode)
        raise UserError(f"is {kind}, expected {expected}", where=where or path)


def list_folder(path: Path, *, expected: str = "a folder") -> list[Path]:
    """Everything directly in a folder, sorted by name. Raises `UserError` if it is no folder or cannot be read."""
    require_folder(path, expected=expected)
    try:
        return sorted(path.iterdir())
    except OSError as error:
        raise _unreachable(path, error, None) from None


def read_plain_file(path: Path, *, limit_bytes: int, where: str | Path | None = None) -> bytes:
    """All bytes of a plain file.

    Raises:
        UserError: as `require_plain_file`; also if the file cannot be read or holds more than ``limit_bytes``.
    """
    require_plain_file(path, where=where)  # opening a device can already have an effect, so it is looked at first
    try:
        # What stands there may have changed since: without blocking, a pipe put in its place does not hold us up.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        with open(descriptor, "rb") as file:
            facts = os.fstat(descriptor)
            if not stat.S_ISREG(facts.st_mode):
                raise UserError(f"is {kind_of(facts.st_mode)}, not a plain file", where=where or path)
            if facts.st_size <= limit_bytes:
                data = file.read(limit_bytes + 1)
                if len(data) <= limit_bytes:
                    return data
    except OSError as error:
        raise _unreachable(path, error, where) from None
    raise UserError(f"is larger than the {_size(limit_bytes)} allowed", where=where or path)


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Text of another program's file: UTF-8, or UTF-16 where its mark comes first, as programs for Windows write it.

    Raises:
        UnicodeDecodeError: it is neither, and ``errors`` is ``strict``.
    """
    marked = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if marked else "utf-8-sig", errors)


def _stat(path: Path, where: str | Path | None) -> os.stat_result:
    try:
        return path.stat()
    except OSError as error:
        raise _unreachable(path, error, where) from None
    except ValueError:  # a NUL, or characters that no file name can hold
        raise UserError("cannot be the name of a file", where=where or path) from None


def _unreachable(path: Path, error: OSError, where: str | Path | None) -> UserError:
    where = where or path
    if error.errno == errno.ELOOP:
        return UserError("is a link that leads back to itself", where=where)
    if error.errno == errno.ENAMETOOLONG:
        name = os.fspath(where)
        shown = name if len(name) <= 80 else f"{name[:60]}..."
        return UserError("is too long for a file name", where=shown)
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        if path.is_symlink():
            return UserError(f"is a link to {os.readlink(path)}, which does not exist", where=where)
        return UserError("does not exist", where=where)
    return UserError(f"cannot be read ({error.strerror or error})", where=where)


def _size(limit_bytes: int) -> str:
    return f"{limit_bytes / 2**20:g} MiB" if limit_bytes >= 2**20 else f"{limit_bytes / 2**10:g} KiB"
