"""Pictures that no lens of a pinhole camera took: panoramas and strips."""

from __future__ import annotations

import re

import numpy as np

from sceneexpander.artifacts.views import has_panorama_shape
from sceneexpander.ingest.samples import Pixels

_LONGEST_STRIP = 3.0  # sides
_ROUND_ASPECT = 1.95  # 360 x 180 degrees, or a narrower band all around
_THUMBNAIL = (64, 128)
_SEAM = 0.6  # of how much columns differ that are as far apart as one lies from the next
_POLE = 0.35  # of how much the picture varies along a row in the middle
_FIX = "cut ordinary views out of it, or take it out of the folder"
MARKED_PANORAMA = f"is marked as a panorama; {_FIX}"


def is_marked_panorama(xmp: str) -> bool:
    """Whether a picture's XMP says that it is a panorama (Google's photo spheres, and what phones and 360° cameras write)."""
    return bool(re.search(r"GPano:(ProjectionType|FullPanoWidthPixels|UsePanoramaViewer\s*=\s*[\"'>]?True)", xmp))


def strip_reason(height: int, width: int) -> str | None:
    """Why a picture of this shape cannot be a photo, or None."""
    longest = max(height, width) / max(1, min(height, width))
    if longest <= _LONGEST_STRIP:
        return None
    return f"is a strip of {width} x {height} pixels (a panorama, or a part of a picture); {_FIX}"


def panorama_reason(pixels: Pixels, xmp: str, *, has_lens: bool) -> str | None:
    """Why a picture is a panorama, in one line with what to do about it, or None.

    Without marks, a picture at least twice as wide as high and without a word about its lens is one if it is equirectangular: its left
    border continues at its right border, and each pole is one point stretched over a whole row.
    """
    height, width = pixels.shape[:2]
    if is_marked_panorama(xmp):
        return MARKED_PANORAMA
    if width < _ROUND_ASPECT * height or has_lens:
        return None
    return f"is a panorama all around (360°); {_FIX}" if _is_equirectangular(pixels) else None


def doubtful_shape(height: int, width: int, *, has_lens: bool) -> str | None:
    """A note about a picture that has the shape of a panorama all around, but could be a photo; or None."""
    if has_lens or not has_panorama_shape(height, width):
        return None
    return "is exactly twice as wide as high and its file names no lens: if it is a panorama, take it out, the cameras would be wrong"


def _is_equirectangular(pixels: Pixels) -> bool:
    rows, columns = _THUMBNAIL
    height, width = pixels.shape[:2]
    if height < rows or width < columns:
        return False
    # Means over cells; the last rows and columns that fill no cell are left out.
    cell_y, cell_x = height // rows, width // columns
    grey = pixels[: rows * cell_y, : columns * cell_x].mean(axis=2, dtype=np.float32)
    small = grey.reshape(rows, cell_y, columns, cell_x).mean(axis=(1, 3))
    variation = float(small[rows // 4 : -rows // 4].std(axis=1).mean())
    if variation < 2:
        return False  # nothing to see
    edge = pixels[:, [0, -1]].mean(axis=2, dtype=np.float32)
    seam = float(np.abs(edge[:, 0] - edge[:, 1]).mean())
    apart = float(np.abs(small - np.roll(small, columns // 4, axis=1)).mean())
    poles = [float(row.mean(axis=1, dtype=np.float32).std()) for row in (pixels[0], pixels[-1])]
    return seam < _SEAM * apart and max(poles) < _POLE * variation
