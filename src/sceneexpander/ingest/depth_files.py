"""Depth maps as capture software stores them: NumPy arrays, 16-bit PNG, ETH3D's raw floats."""

from __future__ import annotations

import contextlib
import io
import math
import struct
import tokenize
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32

from sceneexpander.errors import UserError
from sceneexpander.plainfiles import read_plain_file

_LIMIT_BYTES = 512 * 2**20
_FARTHEST = 1e6
_MOST_PIXELS = 200_000_000
# What NumPy raises for a header that is none: it takes it for Python's words.
_HEADER_ERRORS = (
    ValueError, EOFError, OSError, SyntaxError, TypeError, LookupError, RecursionError, MemoryError, tokenize.TokenError,
)  # fmt: skip
_PNG = b"\x89PNG\r\n\x1a\n"
_SIXTEEN_BIT_MISSING = 65535  # Kinect's and others' word for "nothing seen"


class DepthFormat(StrEnum):
    """What the bytes are."""

    NPY = "npy"
    PNG = "png"  # 16 bits
    RAW = "raw"  # little-endian float32, row by row, as large as the picture


DepthMap = Float32[np.ndarray, "height width"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFile:
    """Where a depth map is. ``unit`` is the length of its unit in the unit of the poses: 0.001 for millimetres beside metres.

    ``of_straightened``: it belongs to the picture after the lens's distortion was taken out.
    """

    path: Path
    format: DepthFormat
    unit: float = 1.0
    of_straightened: bool = False

    def read(self, picture_size: tuple[int, int]) -> DepthMap:
        """Z-depth in the unit of the poses; 0 where there is none. Any size of the picture's aspect ratio.

        Raises:
            UserError: it is damaged, or of another shape than the picture's (height, width).
        """
        data = read_plain_file(self.path, limit_bytes=_LIMIT_BYTES)
        depth = _READERS[self.format](data, self.path, picture_size)
        if depth.ndim != 2 or 0 in depth.shape:
            raise UserError(
                f"holds an array of shape {depth.shape}, expected rows and columns of depth", where=self.path
            )
        ratio = (depth.shape[0] / picture_size[0]) / (depth.shape[1] / picture_size[1])
        if abs(ratio - 1) > 0.02 + 1.0 / min(depth.shape):
            shapes = f"{depth.shape[1]} x {depth.shape[0]}, its picture {picture_size[1]} x {picture_size[0]}"
            raise UserError(f"has another shape than its picture ({shapes})", where=self.path)
        depth = depth.astype(np.float32) * np.float32(self.unit)
        return np.where(np.isfinite(depth) & (depth > 0) & (depth < _FARTHEST), depth, np.float32(0))


def depth_file(path: Path, *, unit: float, of_straightened: bool = False) -> DepthFile | None:
    """The depth file with that name, or None for an ending that no reader here knows. ``unit`` is that of 16-bit values."""
    ending = path.suffix.casefold()
    if ending == ".npy":
        return DepthFile(path=path, format=DepthFormat.NPY, of_straightened=of_straightened)
    if ending == ".png":
        return DepthFile(path=path, format=DepthFormat.PNG, unit=unit, of_straightened=of_straightened)
    return None


def _read_npy(data: bytes, path: Path, _: tuple[int, int]) -> np.ndarray:
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = header(file, max_header_size=2000)
    except _HEADER_ERRORS as error:
        reason = " ".join(str(error).split())[:80]
        raise UserError(f"is no NumPy array ({reason})", where=path) from None
    if dtype.kind not in "fiu":
        raise UserError(f"holds {dtype} values, expected numbers", where=path)
    values = data[file.tell() :]
    if any(side < 0 for side in shape) or len(values) != math.prod(shape) * dtype.itemsize:
        raise UserError("is a damaged or truncated NumPy array", where=path)
    depth = np.frombuffer(values, dtype).reshape(shape, order="F" if by_columns else "C")
    return depth.squeeze(-1) if depth.ndim == 3 and depth.shape[-1] == 1 else depth


def _read_png(data: bytes, path: Path, _: tuple[int, int]) -> np.ndarray:
    values = None
    if data.startswith(_PNG) and len(data) > 24:
        width, height = struct.unpack(">II", data[16:24])
        if width * height > _MOST_PIXELS:
            raise UserError(f"announces {width} x {height} pixels", where=path, fix="scale it down")
        with contextlib.suppress(cv2.error):
            values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.dtype != np.uint16:
        raise UserError("is no 16-bit PNG with depth", where=path)
    return np.where(values == _SIXTEEN_BIT_MISSING, 0, values)


def _read_raw(data: bytes, path: Path, picture_size: tuple[int, int]) -> np.ndarray:
    expected = 4 * picture_size[0] * picture_size[1]
    if len(data) != expected:
        raise UserError(f"holds {len(data)} bytes, a raw depth map of its picture {expected}", where=path)
    return np.frombuffer(data, "<f4").reshape(picture_size)


_READERS = {DepthFormat.NPY: _read_npy, DepthFormat.PNG: _read_png, DepthFormat.RAW: _read_raw}


def sampled_depth(
    depth: Float32[np.ndarray, "rows columns"],
    columns: Float[np.ndarray, "*#pixel"],
    rows: Float[np.ndarray, "*#pixel"],
) -> Float32[np.ndarray, "*pixel"]:
    """Depth at places given as shares (0 to 1) of the picture's sides, nearest sample; 0 outside.

    Args:
        depth: of the whole picture.
        columns: per wanted pixel the place along the width.
        rows: the same along the height.
    """
    height, width = depth.shape
    x, y = np.floor(columns * width).astype(np.int64), np.floor(rows * height).astype(np.int64)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return np.where(inside, depth[y.clip(0, height - 1), x.clip(0, width - 1)], np.float32(0))
