"""From the bytes of a picture file to upright 8-bit RGB pixels.

The first bytes decide what a file is, never its name. Every way in which a file can be unusable ends as a `UserError` that names it.
"""

from __future__ import annotations

import io
import struct
import threading
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageOps

from sceneexpander.artifacts.store import sha256_of_bytes
from sceneexpander.errors import UserError
from sceneexpander.ingest.formats import PILLOW_FORMATS, missing_decoder, name_of_content, sniff_format
from sceneexpander.plainfiles import read_plain_file

Pixels = npt.NDArray[np.uint8]

_EXIF_ORIENTATION = 0x0112
_EXIF_IFD = 0x8769
_EXIF_FOCAL_35MM = 0xA405
_DIAGONAL_35MM = float(np.hypot(36.0, 24.0))
_ALPHA_MODES = {"LA", "La", "PA", "RGBA", "RGBa"}
LIMIT_BYTES = 512 * 2**20  # of a picture file
# What Pillow raises for damaged files depends on the format and on where the damage is.
_DECODE_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    LookupError,
    TypeError,
    ArithmeticError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)
_open_lock = threading.Lock()


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A decoded picture. "Original" pixel coordinates everywhere are those of ``pixels``: orientation already applied."""

    name: str
    pixels: Pixels  # (H, W, 3) RGB
    sha256: str  # of the file's bytes
    file_format: str  # what the bytes are: "JPEG", "PNG", ...
    exif_focal_px: float | None  # from the 35 mm equivalent focal length, in original pixels

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.pixels.shape[0])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.pixels.shape[1])


def read_picture(path: Path, *, max_megapixels: float = 200.0) -> Picture:
    """Read and decode one picture file (the first frame of an animated one).

    Transparent pictures are composited over black, which is also what the renderer shows where a scene has nothing. 16-bit samples
    are scaled from their full range to 8 bits; CMYK and palette pictures become RGB; embedded colour profiles are not applied.

    Raises:
        UserError: the file is missing, empty, truncated, too large, or not a picture that can be decoded.
    """
    return decode_picture(_read_bytes(path), name=path.name, where=path, max_megapixels=max_megapixels)


def read_picture_shape(path: Path, *, max_megapixels: float = 200.0) -> tuple[int, int]:
    """(height, width) of a picture file as it stands upright, from its header alone. Raises as `read_picture` does."""
    data = _read_bytes(path)
    image = _open(data, _checked_format(data, path), path, max_megapixels)
    turned = _orientation(image) >= 5  # the four orientations that swap the axes
    return (image.width, image.height) if turned else (image.height, image.width)


def _read_bytes(path: Path) -> bytes:
    return read_plain_file(path, limit_bytes=LIMIT_BYTES)


def decode_picture(data: bytes, *, name: str, where: str | Path, max_megapixels: float = 200.0) -> Picture:
    """`read_picture` for bytes; ``where`` is what error messages name."""
    file_format = _checked_format(data, where)
    image = _decode(data, file_format, where, max_megapixels)
    focal_35mm = _focal_35mm(image)
    pixels = _rgb_pixels(_upright(image), where)
    height, width = pixels.shape[:2]
    # The 35 mm equivalent is defined by the diagonal of the frame (CIPA DCG-001), whatever the aspect ratio.
    focal_px = None if focal_35mm is None else focal_35mm / _DIAGONAL_35MM * float(np.hypot(height, width))
    return Picture(
        name=name, pixels=pixels, sha256=sha256_of_bytes(data), file_format=file_format, exif_focal_px=focal_px
    )


def _checked_format(data: bytes, where: str | Path) -> str:
    if not data:
        raise UserError("is empty (0 bytes)", where=where, fix="copy the picture again or remove it")
    file_format = sniff_format(data[:64])
    if file_format is None:
        _refuse_unknown(data, where)
    missing = missing_decoder(file_format)
    if missing is not None:
        name = "HEIC/HEIF" if file_format == "HEIF" else file_format
        raise UserError(f"is a {name} picture, which cannot be decoded here", where=where, fix=missing)
    return file_format


def _refuse_unknown(data: bytes, where: str | Path) -> NoReturn:
    if data.startswith(b"version https://git-lfs"):
        raise UserError("is a Git LFS pointer, not the picture itself", where=where, fix="run 'git lfs pull'")
    if _looks_like_depth_dump(data):
        raise UserError(
            "is a raw float32 depth map (ETH3D names its ground-truth depth .JPG), not a picture",
            where=where,
            fix="point the scene at the folder of photos, not at ground_truth_depth",
        )
    name = name_of_content(data[:64])
    if name is not None:
        raise UserError(
            f"is not a picture but {name}", where=where, fix="use JPEG, PNG, WebP, BMP or TIFF, or remove the file"
        )
    raise UserError(
        f"is not a picture (its first bytes are {data[:8].hex(' ')})",
        where=where,
        fix="use JPEG, PNG, WebP, BMP or TIFF, or remove the file",
    )


def _looks_like_depth_dump(data: bytes) -> bool:
    if len(data) < 1024 or len(data) % 4:
        return False
    values = np.frombuffer(data, dtype="<f4")
    values = values[:: max(1, values.size // 65536)]
    plausible = np.isposinf(values) | ((values >= 0) & (values < 1e4))
    # Random bytes read as floats are negative half of the time; tiny denormals are what text and zero blocks look like.
    sensible = np.isfinite(values) & (values > 1e-3)
    return bool(plausible.all() and sensible.mean() > 0.01)


def _open(data: bytes, file_format: str, where: str | Path, max_megapixels: float) -> Image.Image:
    formats = PILLOW_FORMATS.get(file_format, [file_format])
    try:
        with _open_lock:
            # Pillow's own limit is a global and lower than ours; sizes are checked here, before any pixel is decoded.
            pillow_limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                image = Image.open(io.BytesIO(data), formats=formats)
            finally:
                Image.MAX_IMAGE_PIXELS = pillow_limit
    except _DECODE_ERRORS as error:
        _refuse_damaged(file_format, error, where)
    megapixels = image.width * image.height / 1e6
    if megapixels > max_megapixels:
        raise UserError(
            f"has {image.width} x {image.height} pixels ({megapixels:.0f} MP), more than the {max_megapixels:g} MP allowed",
            where=where,
            fix="scale it down or raise max_megapixels",
        )
    return image


def _decode(data: bytes, file_format: str, where: str | Path, max_megapixels: float) -> Image.Image:
    image = _open(data, file_format, where, max_megapixels)
    try:
        image.load()
    except _DECODE_ERRORS as error:
        _refuse_damaged(file_format, error, where)
    except MemoryError:
        raise UserError("needs more memory than there is", where=where, fix="scale it down") from None
    return image


def _refuse_damaged(file_format: str, error: BaseException, where: str | Path) -> NoReturn:
    reason = str(error).split("<_io")[0].strip() or type(error).__name__  # Pillow prints the address of its buffer
    raise UserError(
        f"is a damaged or truncated {file_format} ({reason})", where=where, fix="copy it again or remove it"
    ) from None


def _exif(image: Image.Image) -> Image.Exif | None:
    try:
        return image.getexif()
    except _DECODE_ERRORS:
        return None  # a damaged tag block says nothing about the pixels


def _orientation(image: Image.Image) -> int:
    exif = _exif(image)
    value = 1 if exif is None else exif.get(_EXIF_ORIENTATION, 1)
    return value if value in range(1, 9) else 1


def _upright(image: Image.Image) -> Image.Image:
    turned = ImageOps.exif_transpose(image) if _orientation(image) != 1 else None
    return image if turned is None else turned


def _focal_35mm(image: Image.Image) -> float | None:
    exif = _exif(image)
    if exif is None:
        return None
    try:
        value = float(exif.get_ifd(_EXIF_IFD).get(_EXIF_FOCAL_35MM, 0))
    except _DECODE_ERRORS:
        return None
    return value if 1.0 <= value <= 2000.0 else None  # 0 means unknown


def _rgb_pixels(image: Image.Image, where: str | Path) -> Pixels:
    if image.mode.startswith("I") or image.mode == "F":
        return _grey_from_wide(np.asarray(image), image.mode, where)
    if image.mode in _ALPHA_MODES or "transparency" in image.info:
        with_alpha = image.convert("RGBA")
        backdrop = Image.new("RGBA", with_alpha.size, (0, 0, 0, 255))
        image = Image.alpha_composite(backdrop, with_alpha)
    return np.array(image.convert("RGB"), dtype=np.uint8)


def _grey_from_wide(values: npt.NDArray[Any], mode: str, where: str | Path) -> Pixels:
    wide = values.astype(np.float64)
    top = 1.0 if mode == "F" else 65535.0
    low, high = float(wide.min()), float(wide.max())
    if not (low >= 0 and high <= top):  # also catches NaN
        raise UserError(
            f"holds samples from {low:g} to {high:g}, expected 0 to {top:g}",
            where=where,
            fix="save it as an 8- or 16-bit picture",
        )
    grey = np.floor(wide / top * 255 + 0.5).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)
