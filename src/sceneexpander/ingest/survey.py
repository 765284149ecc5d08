"""What is in a folder of photos: its pictures in order, and a word about every other file."""

from __future__ import annotations

import re
import stat
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.formats import PICTURE_EXTENSIONS, kind_of_file, read_head, sniff_format
from sceneexpander.ingest.links import require_inside
from sceneexpander.plainfiles import kind_of, list_folder, require_plain_file

MASKS_FOLDER = "masks"  # beside pictures: which of their pixels are to be used
_MOST_LISTED = 8  # names in one line
_MOST_LOOKED_AT = 2000  # files of sub-folders, when there is no picture in the folder itself
_DEEPEST = 3
_COMPANIONS = frozenset({"thumbs.db", "desktop.ini", "icon\r"})
_COMPANION_EXTENSIONS = frozenset(
    {"xmp", "aae", "thm", "dvc", "pp3", "dop"}
)  # settings and previews that belong to a photo


class NoPicturesError(UserError):
    """A folder holds no pictures itself; what lies below it may be more than pictures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """The pictures of a folder in natural order, and what was noticed: which of its files are not among them."""

    pictures: tuple[Path, ...]
    notes: tuple[str, ...] = ()


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key in which numbers compare as numbers: ``view_2`` comes before ``view_10``. Letter case does not matter."""
    parts = re.split(r"([0-9]{1,300})", name.casefold())
    key = tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part)
    return (*key, (-1, 0, name))  # names that differ only in case or leading zeros keep one order everywhere


def list_pictures(folder: Path, *, inside: Path | None = None) -> list[Path]:
    """The pictures of `survey_pictures`."""
    return list(survey_pictures(folder, inside=inside).pictures)


def survey_pictures(folder: Path, *, inside: Path | None = None) -> Survey:
    """The picture files directly in ``folder``, in natural order, and a note about the files that are none.

    A file is taken for a picture if its first bytes are those of one, or if its name says so: such a file is then refused with a reason
    when it is read, and not passed over. Raw pictures and videos are left out, as are hidden files and companions (``._a.jpg``,
    ``Thumbs.db``, ``a.xmp``), which no note mentions one by one.

    Args:
        folder: where to look.
        inside: a scene folder, whose names and links must stay in it (see `sceneexpander.ingest.links`); by default links may lead
            anywhere, as long as they lead to plain files.

    Raises:
        UserError: the folder does not exist or holds no pictures; a picture's name leads to something else than a plain file, out of
            ``inside``, or is not valid text.
    """
    pictures: list[Path] = []
    skipped: list[tuple[str, str]] = []
    companions = 0
    for path in list_folder(folder, expected="a folder of pictures"):
        if _is_companion(path.name) or (path.name == MASKS_FOLDER and path.is_dir()):
            companions += 1
            continue
        kind = _kind(path, inside)
        if kind == "":
            pictures.append(path)
        else:
            skipped.append((path.name, kind))
    if not pictures:
        raise _no_pictures(folder, skipped)
    pictures.sort(key=lambda path: natural_key(path.name))
    skipped.sort(key=lambda item: natural_key(item[0]))
    return Survey(pictures=tuple(pictures), notes=_notes(len(pictures), skipped, companions))


def _kind(path: Path, inside: Path | None) -> str:
    """Empty for a picture, else what to call the file. Raises `UserError` for a picture by name that is nothing to read."""
    extension = path.suffix[1:].casefold()
    named = extension in PICTURE_EXTENSIONS
    try:
        mode = path.stat().st_mode
    except OSError:
        if not named:
            return "cannot be read"
        if inside is not None:
            require_inside(path, inside)
        require_plain_file(path)  # says what is wrong
        raise
    if stat.S_ISDIR(mode):
        return "a folder"
    if not stat.S_ISREG(mode):
        if named:
            require_plain_file(path)
        return kind_of(mode)
    kind = kind_of_file(extension)
    if not named and (kind or sniff_format(read_head(path)) is None):
        return kind or "not a picture"
    require_text_name(path)
    if inside is not None:
        require_inside(path, inside)
    return ""


def require_text_name(path: Path) -> None:
    """Raise `UserError` for a file whose name is not text: it could be written into no record, and into no file of ours."""
    try:
        path.name.encode()
    except UnicodeEncodeError:
        raise UserError("has a name that is not valid text (UTF-8)", where=path, fix="rename the file") from None


def _is_companion(name: str) -> bool:
    extension = name.rpartition(".")[2].casefold()
    return name.startswith(".") or name.casefold() in _COMPANIONS or extension in _COMPANION_EXTENSIONS


def _notes(count: int, skipped: list[tuple[str, str]], companions: int) -> tuple[str, ...]:
    if not skipped:
        return ()
    total = count + len(skipped) + companions
    named = [printable(name) if kind == "not a picture" else f"{printable(name)} ({kind})" for name, kind in skipped]
    rest = len(named) - _MOST_LISTED
    listed = ", ".join(named[:_MOST_LISTED]) + (f" and {rest} more" if rest > 0 else "")
    beside = f"; {companions} companion file{'s' * (companions != 1)} of the system or of photos" if companions else ""
    verb = "is a photo" if count == 1 else "are photos"
    return (f"{count} of {total} files {verb}; {len(skipped)} skipped: {listed}{beside}",)


def _no_pictures(folder: Path, skipped: list[tuple[str, str]]) -> NoPicturesError:
    counted = Counter(kind for _, kind in skipped if kind != "a folder")
    there = ", ".join(f"{kind} ({count} times)" if count > 1 else kind for kind, count in counted.most_common(4))
    found = _pictures_below(folder)
    if found:
        offered = ", ".join(f"{printable(name)}/ holds {count}" for name, count in found[:4])
        return NoPicturesError(
            f"holds no pictures itself; {offered}",
            where=folder,
            fix="pass that folder" if len(found) == 1 else "pass one of these folders",
        )
    videos = [name for name, kind in skipped if kind == "a video"]
    if videos:
        return NoPicturesError(
            f"holds no pictures, only: {there}", where=folder, fix=f"pass {printable(videos[0])} itself"
        )
    return NoPicturesError(
        f"holds no pictures{f', only: {there}' if there else ''}",
        where=folder,
        fix=f"expected files named .{', .'.join(sorted(PICTURE_EXTENSIONS))}",
    )


def _pictures_below(folder: Path) -> list[tuple[str, int]]:
    """Sub-folders (names relative to ``folder``) that hold pictures by name, and how many; a bounded look, links not followed."""
    counts: Counter[str] = Counter()
    looked_at = 0
    waiting = [(folder, 0)]
    while waiting and looked_at < _MOST_LOOKED_AT:
        current, depth = waiting.pop(0)
        try:
            entries = sorted(current.iterdir())
        except OSError:
            continue
        for path in entries:
            looked_at += 1
            if _is_companion(path.name) or path.is_symlink():
                continue
            if path.is_dir():
                if depth < _DEEPEST:
                    waiting.append((path, depth + 1))
            elif depth and path.suffix[1:].casefold() in PICTURE_EXTENSIONS:
                counts[current.relative_to(folder).as_posix()] += 1
    return counts.most_common()
