"""From the bytes of a picture file to upright 8-bit RGB pixels, and what the file says of its lens.

The first bytes decide what a file is, never its name. Every way in which a file can be unusable ends as a `UserError` that names it.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt
from PIL import Image

from sceneexpander.artifacts.store import sha256_of_bytes
from sceneexpander.artifacts.views import LensFacts
from sceneexpander.errors import UserError
from sceneexpander.ingest.formats import (
    DECODE_ERRORS,
    PILLOW_FORMATS,
    missing_decoder,
    name_of_content,
    sniff_format,
)
from sceneexpander.ingest.lens import read_lens
from sceneexpander.ingest.samples import Mask, Pixels, float_colour_tiff_size, read_float_colour_tiff, to_rgb
from sceneexpander.plainfiles import read_plain_file

LIMIT_BYTES = 512 * 2**20  # of a picture file
# Real photos have more bytes per pixel than a hundred times this. A file of few bytes that announces many pixels costs memory for nothing.
_LEAST_BYTES_PER_PIXEL = 0.002
_ALWAYS_DECODED_MEGAPIXELS = 16.0
_LARGEST_XMP = 2**20
_EXIF_ORIENTATION = 0x0112
_RAW_MARK = 0xC612  # "DNGVersion"
# How the pixels of a file have to be turned, by the value of its orientation.
_TURNS: dict[int, Callable[[npt.NDArray[Any]], npt.NDArray[Any]]] = {
    1: lambda p: p,
    2: lambda p: p[:, ::-1],
    3: lambda p: p[::-1, ::-1],
    4: lambda p: p[::-1],
    5: lambda p: p.swapaxes(0, 1),
    6: lambda p: np.rot90(p, -1),
    7: lambda p: np.rot90(p, 2).swapaxes(0, 1),
    8: lambda p: np.rot90(p, 1),
}
_open_lock = threading.Lock()


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A decoded picture. "Original" pixel coordinates everywhere are those of ``pixels``: orientation already applied."""

    name: str
    pixels: Pixels  # (H, W, 3) RGB
    sha256: str  # of the file's bytes
    file_format: str  # what the bytes are: "JPEG", "PNG", ...
    lens: LensFacts
    valid: Mask | None = None  # (H, W) pixels that show something; None: all
    xmp: str = ""
    notes: tuple[str, ...] = ()  # what was noticed, to be read after the picture's name

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.pixels.shape[0])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.pixels.shape[1])

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.height, self.width

    @property
    def facts(self) -> PictureFacts:
        """All but the pixels."""
        return PictureFacts(name=self.name, height=self.height, width=self.width, sha256=self.sha256, lens=self.lens)


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureFacts:
    """What is to be remembered of a decoded picture. Sizes are those of the upright picture, the digest is of the file's bytes."""

    name: str
    height: int
    width: int
    sha256: str
    lens: LensFacts

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.height, self.width


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureHeader:
    """What is known of a picture before its pixels are decoded. Sizes are those of the upright picture."""

    height: int
    width: int
    lens: LensFacts
    xmp: str


def read_picture(path: Path, *, max_megapixels: float = 200.0, upright: bool = True) -> Picture:
    """Read and decode one picture file (the first frame of an animated one).

    What becomes of samples, colours and transparency: see `sceneexpander.ingest.samples.to_rgb`. Without ``upright`` the rows stay as they
    are stored, whatever the file says of how the camera was held.

    Raises:
        UserError: the file is missing, empty, truncated, too large, or not a picture that can be decoded.
    """
    data = _read_bytes(path)
    return decode_picture(data, name=path.name, where=path, max_megapixels=max_megapixels, upright=upright)


def read_picture_header(path: Path, *, max_megapixels: float = 200.0, upright: bool = True) -> PictureHeader:
    """What the header of a picture file says. Raises as `read_picture` does."""
    return decode_picture_header(_read_bytes(path), where=path, max_megapixels=max_megapixels, upright=upright)


def decode_picture_header(
    data: bytes, *, where: str | Path, max_megapixels: float = 200.0, upright: bool = True
) -> PictureHeader:
    """`read_picture_header` for bytes; ``where`` is what error messages name."""
    file_format = _checked_format(data, where)
    with _quiet(file_format):
        size = _float_colour_size(data, file_format, where, max_megapixels)
        if size is not None:
            return PictureHeader(height=size[0], width=size[1], lens=LensFacts(), xmp="")
        image = _open(data, file_format, where, max_megapixels)
        orientation, lens, xmp, _ = _facts(image, upright=upright)
    height, width = _upright_size(image, orientation)
    return PictureHeader(height=height, width=width, lens=lens, xmp=xmp)


def read_picture_shape(path: Path, *, max_megapixels: float = 200.0) -> tuple[int, int]:
    """(height, width) of a picture file as it stands upright, from its header alone. Raises as `read_picture` does."""
    header = read_picture_header(path, max_megapixels=max_megapixels)
    return header.height, header.width


def _read_bytes(path: Path) -> bytes:
    return read_plain_file(path, limit_bytes=LIMIT_BYTES)


def decode_picture(
    data: bytes, *, name: str, where: str | Path, max_megapixels: float = 200.0, upright: bool = True
) -> Picture:
    """`read_picture` for bytes; ``where`` is what error messages name."""
    file_format = _checked_format(data, where)
    orientation, lens, xmp, notes = 1, LensFacts(), "", list[str]()
    with _quiet(file_format):
        try:
            if _float_colour_size(data, file_format, where, max_megapixels) is not None:
                samples = read_float_colour_tiff(data, where)
            else:
                image = _open(data, file_format, where, max_megapixels)
                if file_format == "TIFF":
                    orientation, lens, xmp, notes = _facts(image, upright=upright)
                image.load()
                if file_format != "TIFF":  # a PNG may have its tags at the end
                    orientation, lens, xmp, notes = _facts(image, upright=upright)
                samples = to_rgb(image, data, where)
                del image  # before the pixels are turned, which takes another copy
        except MemoryError:
            raise UserError("needs more memory than there is", where=where, fix="scale it down") from None
        except DECODE_ERRORS as error:
            _refuse_damaged(file_format, error, where)
    turn = _TURNS[1 if samples.upright else orientation]
    return Picture(
        name=name,
        pixels=np.ascontiguousarray(turn(samples.pixels)),
        valid=None if samples.valid is None else np.ascontiguousarray(turn(samples.valid)),
        sha256=sha256_of_bytes(data),
        file_format=file_format,
        lens=lens,
        xmp=xmp,
        notes=(*notes, *samples.notes),
    )


def _float_colour_size(
    data: bytes, file_format: str, where: str | Path, max_megapixels: float
) -> tuple[int, int] | None:
    size = float_colour_tiff_size(data) if file_format == "TIFF" else None
    if size is not None:
        _check_size(size, len(data), max_megapixels, where)
    return size


def pixel_digest(picture: Picture) -> str:
    """Digest of the upright pixels: the same photo saved with other metadata, or in another lossless format, is still the same photo."""
    digest = hashlib.sha256(f"{picture.height}x{picture.width}:".encode())
    digest.update(picture.pixels.data)
    return digest.hexdigest()


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
    except DECODE_ERRORS as error:
        _refuse_damaged(file_format, error, where)
    _check_size((image.height, image.width), len(data), max_megapixels, where)
    if _RAW_MARK in getattr(image, "tag_v2", ()):
        raise UserError("is a raw picture (DNG)", where=where, fix="develop it to JPEG or PNG, or remove it")
    return image


def _check_size(size: tuple[int, int], size_bytes: int, max_megapixels: float, where: str | Path) -> None:
    height, width = size
    pixels = width * height
    megapixels = pixels / 1e6
    if megapixels > max_megapixels:
        raise UserError(
            f"has {width} x {height} pixels ({megapixels:.0f} MP), more than the {max_megapixels:g} MP allowed",
            where=where,
            fix="scale it down or raise max_megapixels",
        )
    if megapixels > _ALWAYS_DECODED_MEGAPIXELS and size_bytes < pixels * _LEAST_BYTES_PER_PIXEL:
        raise UserError(
            f"announces {width} x {height} pixels in {size_bytes} bytes: no photo is like that",
            where=where,
            fix="scale it down or remove it",
        )


def _refuse_damaged(file_format: str, error: BaseException, where: str | Path) -> NoReturn:
    reason = str(error).split("<_io")[0].strip() or type(error).__name__  # Pillow prints the address of its buffer
    raise UserError(
        f"is a damaged or truncated {file_format} ({reason})", where=where, fix="copy it again or remove it"
    ) from None


def _exif(image: Image.Image) -> Image.Exif | None:
    try:
        return image.getexif()
    except DECODE_ERRORS:
        return None  # a damaged tag block says nothing about the pixels


def _facts(image: Image.Image, *, upright: bool) -> tuple[int, LensFacts, str, list[str]]:
    """Orientation (1 to 8; 1 unless the picture is to stand ``upright``), what is known of the lens, the XMP packet, and notes."""
    exif = _exif(image)
    value = 1 if exif is None else exif.get(_EXIF_ORIENTATION, 1)
    orientation = value if upright and isinstance(value, int) and value in _TURNS else 1
    packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    if isinstance(packet, bytes):
        packet = packet[:_LARGEST_XMP].decode("utf-8", "ignore")
    xmp = packet if isinstance(packet, str) else ""
    height, width = _upright_size(image, orientation)
    lens, notes = read_lens(exif, xmp, height=height, width=width, turned=orientation >= 5)
    return orientation, lens, xmp, notes


def _upright_size(image: Image.Image, orientation: int) -> tuple[int, int]:
    # The last four orientations swap the axes.
    return (image.width, image.height) if orientation >= 5 else (image.height, image.width)


@contextlib.contextmanager
def _no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def _no_messages() -> Iterator[None]:
    # The libraries behind Pillow and OpenCV write to the file descriptor, past Python.
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class _WhileAnyoneIsInside(contextlib.AbstractContextManager[None]):
    """A context of the whole process, entered by the first of several threads and left by the last.

    Each thread keeping and restoring such a state by itself would restore what another one has set.
    """

    def __init__(self, make: Callable[[], contextlib.AbstractContextManager[None]]) -> None:
        self._make = make
        self._lock = threading.Lock()
        self._inside = 0
        self._context: contextlib.AbstractContextManager[None] = contextlib.nullcontext()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._context = self._make()
                self._context.__enter__()
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._context.__exit__(None, None, None)


_warnings_off, _messages_off = _WhileAnyoneIsInside(_no_warnings), _WhileAnyoneIsInside(_no_messages)


@contextlib.contextmanager
def _quiet(file_format: str) -> Iterator[None]:
    """Keep decoders from printing: what is wrong with a file is said once, in one line."""
    with _warnings_off, _messages_off if file_format in ("TIFF", "PNG") else contextlib.nullcontext():
        yield
