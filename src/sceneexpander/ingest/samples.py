"""From the samples of a decoded picture to 8-bit RGB: their true depth, their colour profile, and what is transparent."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageCms, TiffImagePlugin

from sceneexpander.errors import UserError
from sceneexpander.ingest.formats import DECODE_ERRORS

Pixels = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

_ALPHA_MODES = {"LA", "La", "PA", "RGBA", "RGBa"}
_SENSOR_BITS = (8, 10, 12, 14)  # depths that are stored in 16 bits as they are
_TIFF_LARGEST_SAMPLE, _TIFF_PLANES = 281, 284
_TIFF_BITS, _TIFF_SAMPLES, _TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_SAMPLE_FORMAT = 258, 277, 256, 257, 339
_HALF_OPAQUE = 0.5  # of the most opaque pixel
_LEAST_VALID = 0.02  # of a picture's pixels
_FLOAT_BYTE_TOP = 255.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """8-bit RGB, which pixels show something (None: all), and what was noticed.

    ``upright`` says that the decoder has turned the picture already; else it lies as in the file.
    """

    pixels: Pixels
    valid: Mask | None
    upright: bool
    notes: tuple[str, ...]


def to_rgb(image: Image.Image, data: bytes, where: str | Path) -> Samples:
    """Samples of an opened and loaded picture.

    - Integers of more than 8 bits are scaled by the depth that they really use: cameras and converters store 10, 12 or 14 bits in 16.
    - Floats are 0 to 1, or 0 to 255.
    - Fully transparent pixels are not valid, and black. Other colours are taken as they are: what half transparent pixels would be on
      some ground is nobody's guess. "Fully" means less than half as opaque as the most opaque pixel.
    - An embedded colour profile is applied: the result is sRGB.

    Raises:
        UserError: samples out of range, or nothing but transparency.
    """
    notes: list[str] = []
    wide = _wide_samples(image, data, where)
    if wide is not None:
        pixels, alpha = _from_wide(wide, _declared_top(image, data), where, notes)
        profiled: Image.Image = Image.fromarray(pixels)
    else:
        profiled, alpha = _split_alpha(image)
    converted = _in_srgb(profiled, image.info.get("icc_profile"), notes)
    del profiled
    # `convert` copies even if there is nothing to do, and a large photo has few copies to spare.
    pixels = np.array(converted if converted.mode == "RGB" else converted.convert("RGB"), dtype=np.uint8)
    valid = None if alpha is None else _valid(alpha, where, notes)
    if valid is not None:
        pixels[~valid] = 0
    # Both decoders turn TIFF pictures while they load them, and only these.
    return Samples(pixels=pixels, valid=valid, upright=image.format == "TIFF", notes=tuple(notes))


def _split_alpha(image: Image.Image) -> tuple[Image.Image, npt.NDArray[Any] | None]:
    if image.mode not in _ALPHA_MODES and "transparency" not in image.info:
        return image, None
    with_alpha = image.convert("RGBA")
    alpha = np.asarray(with_alpha.getchannel("A"))
    grey = image.mode in ("LA", "La", "L")
    return with_alpha.convert("L" if grey else "RGB"), alpha


def _valid(alpha: npt.NDArray[Any], where: str | Path, notes: list[str]) -> Mask | None:
    top = float(alpha.max())
    valid = alpha >= max(top * _HALF_OPAQUE, 1e-9)
    share = float(valid.mean())
    if top <= 0 or share < _LEAST_VALID:
        raise UserError("is transparent nearly everywhere", where=where, fix="save it without an alpha channel")
    if share == 1:
        if top < np.iinfo(np.uint8).max and alpha.dtype == np.uint8:
            notes.append("is half transparent throughout: its colours are taken as they are")
        return None
    notes.append(f"{1 - share:.0%} of it is transparent and not used")
    return valid


def _wide_samples(image: Image.Image, data: bytes, where: str | Path) -> npt.NDArray[Any] | None:
    """Samples of more than 8 bits, (H, W) or (H, W, channel) in the order RGB(A); None if there are none."""
    if image.mode.startswith("I") or image.mode == "F":
        return np.asarray(image)
    if image.format not in ("PNG", "TIFF") or not _is_wide(image, data):
        return None
    if getattr(image, "tag_v2", {}).get(_TIFF_PLANES, 1) != 1:
        raise UserError(
            "holds its colours in separate planes of more than 8 bits, which cannot be read here",
            where=where,
            fix="save it as an 8-bit picture, or with interleaved colours",
        )
    return decode_wide(data, where)


def decode_wide(data: bytes, where: str | Path) -> npt.NDArray[Any]:
    """Colour samples of more than 8 bits, which Pillow would cut to 8, as OpenCV reads them, in the order RGB(A).

    Raises:
        UserError: they cannot be read.
    """
    if data.startswith(b"\x89PNG") and not _chunks_fit(data):
        raise UserError("is a damaged or truncated PNG", where=where, fix="copy it again or remove it")
    try:
        flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
        values = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        values = None
    if values is None:
        raise UserError("holds samples that cannot be read here", where=where, fix="save it as an 8-bit picture")
    if values.ndim == 3 and values.shape[2] >= 3:
        order = [2, 1, 0] + ([3] if values.shape[2] > 3 else [])
        values = values[:, :, order]
    return values


def _chunks_fit(data: bytes) -> bool:
    """Whether each chunk of a PNG lies within the file: OpenCV makes room for what a chunk announces before it looks for it."""
    start = 8
    while start + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[start : start + 8])
        start += 12 + length
        if start > len(data):
            return False
        if kind == b"IEND":
            return True
    return False


def _is_wide(image: Image.Image, data: bytes) -> bool:
    if image.format == "PNG":
        return len(data) > 24 and data[24] == 16  # bit depth in the header
    bits = getattr(image, "tag_v2", {}).get(_TIFF_BITS, (8,))
    return max(bits if isinstance(bits, tuple) else (bits,)) > 8


def _from_wide(
    values: npt.NDArray[Any], top: int | None, where: str | Path, notes: list[str]
) -> tuple[Pixels, npt.NDArray[Any] | None]:
    alpha = None
    if values.ndim == 3 and values.shape[2] in (2, 4):
        values, alpha = values[:, :, :-1], values[:, :, -1]
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    if np.issubdtype(values.dtype, np.floating):
        scaled = _from_floats(values, where, notes)
    else:
        scaled = _from_integers(values, top, where, notes)
    pixels = scaled if scaled.ndim == 3 else np.repeat(scaled[:, :, None], 3, axis=2)
    return np.ascontiguousarray(pixels), alpha


def _declared_top(image: Image.Image, data: bytes) -> int | None:
    """The largest sample, if the file says so."""
    if image.format == "TIFF":
        top = getattr(image, "tag_v2", {}).get(_TIFF_LARGEST_SAMPLE)
        top = max(top) if isinstance(top, tuple) and top else top
        return int(top) if isinstance(top, int) and 255 <= top <= 65535 else None
    start = data.find(b"sBIT", 0, 4096)
    if image.format == "PNG" and start > 4:
        length = struct.unpack(">I", data[start - 4 : start])[0]
        bits = max(data[start + 4 : start + 4 + min(length, 3)], default=0)
        # By the standard samples are scaled to the full range whatever depth they had; only 16 leaves no doubt.
        return 65535 if bits == 16 else None
    return None


def _from_integers(values: npt.NDArray[Any], top: int | None, where: str | Path, notes: list[str]) -> Pixels:
    low, high = int(values.min()), int(values.max())
    if values.dtype == np.uint8:
        return values.astype(np.uint8)
    if low < 0 or high > 65535:
        raise UserError(
            f"holds samples from {low} to {high}, expected 0 to 65535",
            where=where,
            fix="save it as an 8- or 16-bit picture",
        )
    if top is None or high > top:
        bits = next((bits for bits in _SENSOR_BITS if high < 2**bits), 16)
        top = 2**bits - 1
        if bits < 16 and high > 0:
            notes.append(f"its 16-bit samples end at {high}: taken as {bits}-bit")
    # In one pass over 16-bit values instead of through floats of the whole picture.
    table = np.minimum((np.arange(65536, dtype=np.float64) * 255 / top + 0.5), 255).astype(np.uint8)
    return table[values.astype(np.uint16, copy=False)]


def _from_floats(values: npt.NDArray[Any], where: str | Path, notes: list[str]) -> Pixels:
    low, high = float(values.min()), float(values.max())
    if not np.isfinite([low, high]).all():
        raise UserError(
            "holds floating-point samples that are no finite numbers (NaN or infinity)",
            where=where,
            fix="develop it to an 8- or 16-bit picture",
        )
    top = 1.0
    # A picture in bytes' range is bright somewhere; between 1 and 64 it would be a radiance map, which no fixed scale brings back.
    if 64 < high <= _FLOAT_BYTE_TOP + 0.5:
        top = _FLOAT_BYTE_TOP
        notes.append("its floating-point samples are taken as 0 to 255")
    if not (low >= -0.01 * top and high <= 1.01 * top):
        raise UserError(
            f"holds floating-point samples from {low:g} to {high:g}, expected 0 to 1",
            where=where,
            fix="develop it to an 8- or 16-bit picture",
        )
    return (np.clip(values / np.float32(top), 0, 1) * 255 + 0.5).astype(np.uint8)


def float_colour_tiff_size(data: bytes) -> tuple[int, int] | None:
    """(height, width) of a TIFF with floating-point colour samples, which Pillow does not open; None for any other."""
    try:
        directory = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
        file = io.BytesIO(data)
        file.seek(directory.next)
        directory.load(file)
        kinds, channels = directory.get(_TIFF_SAMPLE_FORMAT, (1,)), int(directory.get(_TIFF_SAMPLES, 1))
        height, width = int(directory[_TIFF_HEIGHT]), int(directory[_TIFF_WIDTH])
    except DECODE_ERRORS:
        return None
    floats = 3 in (kinds if isinstance(kinds, tuple) else (kinds,))
    return (height, width) if floats and channels >= 2 and min(height, width) > 0 else None


def read_float_colour_tiff(data: bytes, where: str | Path) -> Samples:
    """Samples of a TIFF that `float_colour_tiff_size` knows. Raises `UserError` if they cannot be read or are out of range."""
    notes: list[str] = []
    values = decode_wide(data, where)
    pixels, alpha = _from_wide(values, None, where, notes)
    valid = None if alpha is None else _valid(alpha, where, notes)
    if valid is not None:
        pixels[~valid] = 0
    return Samples(pixels=pixels, valid=valid, upright=True, notes=tuple(notes))


def _in_srgb(image: Image.Image, profile: object, notes: list[str]) -> Image.Image:
    if not isinstance(profile, bytes) or not profile:
        return image
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = source.profile.xcolor_space.strip()
        name = (source.profile.profile_description or "").casefold()
        if space == "RGB" and "srgb" in name and "linear" not in name:
            return image
        mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK", "Lab": "LAB"}.get(space)
        if mode is None or (mode != image.mode and not (mode == "RGB" and image.mode in ("P", "L", "1", "RGBX"))):
            notes.append(f"its colour profile is for {space}, the picture is {image.mode}: ignored")
            return image
        matched = image if image.mode == mode else image.convert(mode)
        converted = ImageCms.profileToProfile(matched, source, _srgb(), outputMode="RGB")
    except (ImageCms.PyCMSError, *DECODE_ERRORS):
        notes.append("its colour profile is damaged and was ignored")
        return image
    return image if converted is None else converted


def _srgb() -> ImageCms.ImageCmsProfile:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
