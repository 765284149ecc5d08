"""Bringing a picture to a common frame, with the exact map from original to stored pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from sceneexpander.artifacts.views import Affine
from sceneexpander.ingest.config import Fit
from sceneexpander.ingest.decode import Pixels

PAD_GREY = 128


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSize:
    """The common frame: stored size and the size of the detail images, which show exactly the same framing."""

    height: int
    width: int
    detail_height: int
    detail_width: int

    def __post_init__(self) -> None:
        if self.detail_height * self.width != self.detail_width * self.height:
            raise ValueError(f"detail size is not the same framing: {self}")


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedPicture:
    """A picture in the common frame. ``kept`` is the share of the original's area that is still visible."""

    image: Pixels
    detail: Pixels
    stored_from_original: Affine
    kept: float


def common_frame(
    sizes: list[tuple[int, int]], *, long_side_px: int, multiple: int, detail_scale: int, fit: Fit = "crop"
) -> FrameSize:
    """The frame for originals of the given (height, width) sizes.

    Its aspect is that of the first original, each side rounded to a multiple of ``multiple``. Detail images are ``detail_scale`` times
    as large, or only as large as the best-resolved original fills (never below the stored size). The ratio is a multiple of
    1 / ``multiple``, so that both sizes are whole numbers of the very same framing.
    """
    if not sizes:
        raise ValueError("common_frame needs at least one size")
    first_height, first_width = sizes[0]
    scale = long_side_px / max(first_height, first_width)
    height, width = (max(1, round(side * scale / multiple)) * multiple for side in (first_height, first_width))
    finest = min(_scale(size, (height, width), fit) for size in sizes)  # stored pixels per original pixel
    numerator = max(multiple, min(detail_scale * multiple, math.floor(multiple / finest + 1e-9)))
    return FrameSize(
        height=height,
        width=width,
        detail_height=height * numerator // multiple,
        detail_width=width * numerator // multiple,
    )


def _scale(original: tuple[int, int], stored: tuple[int, int], fit: Fit) -> float:
    ratios = (stored[0] / original[0], stored[1] / original[1])
    return max(ratios) if fit == "crop" else min(ratios)


def fit_picture(pixels: Pixels, frame: FrameSize, fit: Fit = "crop") -> FittedPicture:
    """Scale (one factor for both axes, antialiased) and centre a picture in the frame.

    ``crop`` covers the frame and cuts off what protrudes; ``pad`` shows all of the picture on neutral grey. ``stored_from_original``
    maps corner-origin pixel coordinates exactly: the resampled window is placed at fractions of a pixel, nothing is rounded.
    """
    original_height, original_width = pixels.shape[:2]
    scale = _scale((original_height, original_width), (frame.height, frame.width), fit)
    window_height, window_width = frame.height / scale, frame.width / scale
    left, top = (original_width - window_width) / 2, (original_height - window_height) / 2
    canvas, offset_y, offset_x = _padded(pixels, top, left)
    box = (
        max(0.0, left + offset_x),
        max(0.0, top + offset_y),
        min(float(canvas.shape[1]), left + offset_x + window_width),
        min(float(canvas.shape[0]), top + offset_y + window_height),
    )
    source = Image.fromarray(canvas)
    visible = min(window_height, original_height) * min(window_width, original_width)
    return FittedPicture(
        image=_resampled(source, frame.width, frame.height, box),
        detail=_resampled(source, frame.detail_width, frame.detail_height, box),
        stored_from_original=((scale, 0.0, -left * scale), (0.0, scale, -top * scale)),
        kept=visible / (original_height * original_width),
    )


def _padded(pixels: Pixels, top: float, left: float) -> tuple[Pixels, int, int]:
    """The picture on a canvas that the (possibly protruding) window fits into, and where it lies on it."""
    offset_y, offset_x = (max(0, math.ceil(-start - 1e-9)) for start in (top, left))
    if not (offset_y or offset_x):
        return pixels, 0, 0
    height, width = pixels.shape[:2]
    canvas = np.full((height + 2 * offset_y, width + 2 * offset_x, 3), PAD_GREY, dtype=np.uint8)
    canvas[offset_y : offset_y + height, offset_x : offset_x + width] = pixels
    return canvas, offset_y, offset_x


def _resampled(source: Image.Image, width: int, height: int, box: tuple[float, float, float, float]) -> Pixels:
    return np.array(source.resize((width, height), resample=Image.Resampling.LANCZOS, box=box), dtype=np.uint8)
