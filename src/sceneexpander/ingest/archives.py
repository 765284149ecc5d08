"""ZIP archives of captures: unpacked into a folder of their own, bounded, and all or nothing.

Whoever packed an archive chose its names, sizes and links. What is written here are plain files and folders below the target, no more of
them and no larger than a capture is; anything else refuses the archive as a whole. Archives within are left as files.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.formats import read_head
from sceneexpander.ingest.sources import SOURCES
from sceneexpander.plainfiles import kind_of, require_plain_file

_STARTS = (b"PK\x03\x04", b"PK\x05\x06")  # the second: of an empty one
_MOST_MEMBERS = 20_000
_MOST_BYTES = 16 * 2**30
_MOST_RATIO = 100  # unpacked to packed; photos hardly shrink, text and tables do by ten
_NEVER_A_BOMB_BYTES = 64 * 2**20
_MOST_DIRECTORY_BYTES = _MOST_MEMBERS * 1024
_SPARE_BYTES = 64 * 2**20  # of the disk, left to others
_CHUNK_BYTES = 2**20
_ENCRYPTED = 0x1  # general purpose flag
_METHODS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_OTHER_METHODS = {9: "Deflate64", 12: "bzip2", 14: "LZMA", 93: "Zstandard", 95: "xz"}
_SYSTEM_FOLDER = "__MACOSX"
_UNPACK = "unpack it yourself and give the folder"
# What the module raises for damaged archives depends on where the damage is.
_DAMAGES = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, LookupError, RuntimeError)


def is_archive(place: Path) -> bool:
    """Whether the first bytes of a file are those of a ZIP archive."""
    return read_head(place).startswith(_STARTS)


def unpack_archive(archive: Path, target: Path) -> Path:
    """Unpack an archive into the new folder ``target``, which appears when it is complete, and return where in it the capture is.

    That is the folder itself, the one that holds everything where there is one such folder, or a single file that is a capture (a video).
    Hidden files and the copies that macOS adds are left out.

    Raises:
        UserError: it is damaged, encrypted, packed in an uncommon way or too large for a capture or this disk, or holds names that lead out
            of it, links, devices, or a name twice.
    """
    require_plain_file(archive)
    scratch = target.with_name(f"{target.name}.part")
    scratch.mkdir(parents=True)
    try:
        with _opened(archive) as packed:
            _write_members(packed, archive, scratch)
        scratch.rename(target)
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    return _innermost(target)


@contextlib.contextmanager
def _opened(archive: Path) -> Iterator[zipfile.ZipFile]:
    with archive.open("rb") as file:
        size = _directory_bytes(file)
        if size > _MOST_DIRECTORY_BYTES:
            raise UserError(f"lists its files in {size} bytes", where=archive, fix=_UNPACK)
        try:
            packed = zipfile.ZipFile(file)
        except _DAMAGES as error:
            raise _damaged(archive, error) from None
        with packed:
            yield packed


def _directory_bytes(file: BinaryIO) -> int:
    """How long the list of files is by its own account, which bounds what opening the archive takes; 0 if it does not say."""
    length = file.seek(0, os.SEEK_END)
    file.seek(max(0, length - (1 << 16) - 22))
    tail = file.read()
    end = tail.rfind(b"PK\x05\x06")
    if end < 0 or len(tail) < end + 22:
        return 0
    size = int.from_bytes(tail[end + 12 : end + 16], "little")
    large = tail.rfind(b"PK\x06\x06", 0, end)  # the record of archives beyond 4 GB comes before
    if large >= 0 and len(tail) >= large + 48:
        size = max(size, int.from_bytes(tail[large + 40 : large + 48], "little"))
    return min(size, length)


def _write_members(packed: zipfile.ZipFile, archive: Path, folder: Path) -> None:
    members = [info for info in packed.infolist() if not _is_companion(info.filename)]
    if len(members) > _MOST_MEMBERS:
        raise UserError(
            f"holds {len(members)} files, more than the {_MOST_MEMBERS} allowed", where=archive, fix=_UNPACK
        )
    for info in members:
        _check_member(info, archive)
    # Sizes are what the archive says; what comes out is counted again.
    most = min(_MOST_BYTES, max(_NEVER_A_BOMB_BYTES, _MOST_RATIO * archive.stat().st_size))
    announced = sum(info.file_size for info in members)
    if announced > most:
        raise _too_large(archive, announced, most)
    free = shutil.disk_usage(folder).free - _SPARE_BYTES
    if announced > free:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(folder))
    left = most
    for info in members:
        where = f"{archive}: {printable(info.filename[:80])}"
        path = folder.joinpath(*_parts(info.filename, archive))
        try:
            if info.is_dir():
                path.mkdir(parents=True, exist_ok=True)
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as file:
                for chunk in _chunks(packed, info, where):
                    left -= len(chunk)
                    if left < 0:
                        raise _too_large(archive, most + 1, most)
                    file.write(chunk)
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            raise UserError("is there twice", where=where, fix=_UNPACK) from None
        except OSError as error:
            if error.errno == errno.ENAMETOOLONG:
                raise UserError(
                    "is too long for a file name", where=f"{archive}: {printable(info.filename[:60])}"
                ) from None
            raise


def _check_member(info: zipfile.ZipInfo, archive: Path) -> None:
    where = f"{archive}: {printable(info.filename[:80])}"
    _parts(info.filename, archive)
    mode = info.external_attr >> 16
    if stat.S_IFMT(mode) and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        kind = "a link" if stat.S_ISLNK(mode) else kind_of(mode)
        raise UserError(f"is {kind}, not a plain file", where=where, fix="pack the files themselves")
    if info.flag_bits & _ENCRYPTED:
        raise UserError("is encrypted", where=where, fix=_UNPACK)
    if info.compress_type not in _METHODS:
        known = _OTHER_METHODS.get(info.compress_type, f"number {info.compress_type}")
        raise UserError(f"is packed by a method that is not read ({known})", where=where, fix=_UNPACK)


def _chunks(packed: zipfile.ZipFile, info: zipfile.ZipInfo, where: str) -> Iterator[bytes]:
    try:
        with packed.open(info) as file:
            while chunk := file.read(_CHUNK_BYTES):
                yield chunk
    except _DAMAGES as error:
        raise _damaged(where, error) from None


def _parts(name: str, archive: Path) -> list[str]:
    """The folders and the file of a member's name. Some programs write Windows' separator."""
    plain = name.replace("\\", "/")
    parts = [part for part in plain.split("/") if part not in ("", ".")]
    if not parts or plain.startswith("/") or ".." in parts or (len(parts[0]) == 2 and parts[0][1] == ":"):
        raise UserError(f"holds {printable(name[:80])!r}, which leads out of it", where=archive, fix="pack it again")
    return parts


def _is_companion(name: str) -> bool:
    parts = name.replace("\\", "/").split("/")
    return any(part == _SYSTEM_FOLDER or (part.startswith(".") and part.strip(".")) for part in parts)


def _innermost(folder: Path) -> Path:
    while True:
        entries = list(folder.iterdir())
        if len(entries) != 1:
            return folder
        if not entries[0].is_dir():
            return entries[0] if any(source.detect(entries[0]) for source in SOURCES.values()) else folder
        folder = entries[0]


def _damaged(where: str | Path, error: BaseException) -> UserError:
    reason = printable(" ".join(str(error).split())[:80]) or type(error).__name__
    return UserError(f"is a damaged or truncated ZIP archive ({reason})", where=where, fix="copy it again")


def _too_large(archive: Path, size: int, most: int) -> UserError:
    problem = (
        f"unpacks to {size / 2**20:.0f} MiB or more, {most / 2**20:.0f} MiB are allowed for an archive of its size"
    )
    return UserError(problem, where=archive, fix=_UNPACK)
