"""Which files of a folder are its pictures, in which order, and under which safe names."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

from sceneexpander.errors import UserError

PICTURE_EXTENSIONS = frozenset({"jpg", "jpeg", "png", "webp", "bmp", "tif", "tiff"})
# Listed although they cannot be decoded, so that they are refused with a reason and not passed over in silence.
_REFUSED_EXTENSIONS = frozenset({"heic", "heif"})
_SAFE_LENGTH = 48


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key in which numbers compare as numbers: ``view_2`` comes before ``view_10``. Letter case does not matter."""
    parts = re.split(r"([0-9]+)", name.casefold())
    key = tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part)
    return (*key, (-1, 0, name))  # names that differ only in case or leading zeros keep one order everywhere


def list_pictures(folder: Path, *, inside: Path | None = None) -> list[Path]:
    """The picture files directly in ``folder``, in natural order.

    Extensions are compared without case. Hidden files (also ``._`` companions), folders and files of other kinds are left out.

    Args:
        folder: where to look.
        inside: files that resolve (through symbolic links) to a place outside this folder are refused; default ``folder``.

    Raises:
        UserError: the folder does not exist, holds no pictures, or links out of ``inside``.
    """
    if not folder.is_dir():
        problem = "is a file, expected a folder of pictures" if folder.exists() else "does not exist"
        raise UserError(problem, where=folder)
    wanted = PICTURE_EXTENSIONS | _REFUSED_EXTENSIONS
    found = [
        path
        for path in folder.iterdir()
        if not path.name.startswith(".") and path.suffix[1:].casefold() in wanted and not path.is_dir()
    ]
    if not found:
        raise UserError(
            "holds no pictures", where=folder, fix=f"expected files named .{', .'.join(sorted(PICTURE_EXTENSIONS))}"
        )
    root = folder if inside is None else inside
    return [require_inside(path, root) for path in sorted(found, key=lambda path: natural_key(path.name))]


def require_inside(path: Path, folder: Path, *, where: str | None = None) -> Path:
    """``path`` itself, unless it resolves to a place outside ``folder`` (by ``..`` or a symbolic link).

    ``where`` is what the error names instead of the path.
    """
    if not path.resolve().is_relative_to(folder.resolve()):
        how = "is a link that leads" if path.is_symlink() else "leads"
        if where is not None:
            how = f"{path.name} {how}"
        raise UserError(f"{how} out of {folder}", where=where or path, fix="copy the file into the scene folder")
    return path


def safe_name(text: str, *, fallback: str = "view") -> str:
    """``text`` reduced to letters, digits, ``.``, ``_`` and ``-`` (ASCII), not starting with a dot or a dash."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    slug = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9._-]", "_", plain)).strip("._-")
    return slug[:_SAFE_LENGTH].rstrip("._-") or fallback
