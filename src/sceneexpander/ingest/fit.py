"""Bringing a picture to a common frame, with the exact map from original to stored pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from sceneexpander.artifacts.views import Affine
from sceneexpander.ingest.config import Fit
from sceneexpander.ingest.samples import Mask, Pixels

PAD_GREY = 128
MAX_PHOTO_SIDE_PX = 1600  # of the pictures kept in the originals' own pixels: bounds memory, time and the size of a run
_REDUCING_GAP = 3.0
_SUPPORT = 4  # pixels of the result beyond a border that the resampling filter can reach (three for Lanczos)
_ROUNDING = 1e-9
_NEARLY_WHITE = 253


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
    """A picture in the common frame. ``kept`` is the share of the original's area that is still visible.

    ``photo`` shows the frame in the original's own pixels, or in fewer where its long side would exceed `MAX_PHOTO_SIDE_PX`.
    ``valid`` are the stored pixels that show the picture, and only such parts of it as show something; None: all.
    """

    image: Pixels
    detail: Pixels
    photo: Pixels
    stored_from_original: Affine
    kept: float
    valid: Mask | None = None


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


def fit_picture(pixels: Pixels, frame: FrameSize, fit: Fit = "crop", *, valid: Mask | None = None) -> FittedPicture:
    """Scale (one factor for both axes, antialiased) and centre a picture in the frame.

    ``crop`` covers the frame and cuts off what protrudes; ``pad`` shows all of the picture on neutral grey. ``stored_from_original``
    maps corner-origin pixel coordinates exactly: the resampled window is placed at fractions of a pixel, nothing is rounded.

    Args:
        pixels: (H, W, 3) of the original.
        frame: the common frame.
        fit: see above.
        valid: (H, W) which pixels of the original show something; None: all.
    """
    original_height, original_width = pixels.shape[:2]
    scale = _scale((original_height, original_width), (frame.height, frame.width), fit)
    window_height, window_width = frame.height / scale, frame.width / scale
    left, top = (original_width - window_width) / 2, (original_height - window_height) / 2
    visible = min(window_height, original_height) * min(window_width, original_width)
    source = Image.fromarray(pixels)
    place = _Place(frame=frame, scale=scale, left=left, top=top)
    border = left < -_ROUNDING or top < -_ROUNDING
    mask = valid
    if mask is None and border:
        mask = np.ones((original_height, original_width), dtype=np.bool_)
    return FittedPicture(
        image=_resampled(source, place, frame.height, frame.width, PAD_GREY),
        detail=_resampled(source, place, frame.detail_height, frame.detail_width, PAD_GREY),
        photo=_resampled(source, place, *_photo_size(window_height, window_width), PAD_GREY),
        stored_from_original=((scale, 0.0, -left * scale), (0.0, scale, -top * scale)),
        kept=visible / (original_height * original_width),
        valid=None if mask is None else _fitted_mask(mask, place),
    )


def _photo_size(window_height: float, window_width: float) -> tuple[int, int]:
    """(rows, columns) of the frame in the original's pixels: as whole numbers, so that all sizes show the very same framing."""
    share = min(1.0, MAX_PHOTO_SIDE_PX / max(window_height, window_width))
    return max(1, round(window_height * share)), max(1, round(window_width * share))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    """Where the frame lies on an original: its corner, in original pixels (negative: beside the picture), and stored per original pixel."""

    frame: FrameSize
    scale: float
    left: float
    top: float


def _fitted_mask(valid: Mask, place: _Place) -> Mask | None:
    grey = Image.fromarray(valid.astype(np.uint8) * 255)
    # A stored pixel is valid if next to nothing that it is made of is not.
    fitted = (
        _resampled(grey, place, place.frame.height, place.frame.width, 0, Image.Resampling.BILINEAR) >= _NEARLY_WHITE
    )
    return None if bool(fitted.all()) else fitted


def _resampled(
    source: Image.Image,
    place: _Place,
    height: int,
    width: int,
    ground: int,
    resample: Image.Resampling = Image.Resampling.LANCZOS,
) -> Pixels:
    """The frame's view of ``source`` at a size, with ``ground`` where there is no picture."""
    # Pixels of the result per original pixel; the two differ where a size had to be rounded.
    down, along = height / place.frame.height * place.scale, width / place.frame.width * place.scale
    rows = _covered(place.top, source.height, down, height)
    columns = _covered(place.left, source.width, along, width)
    box = (
        place.left + columns[0] / along,
        place.top + rows[0] / down,
        place.left + columns[1] / along,
        place.top + rows[1] / down,
    )
    canvas, offset = _padded(source, box, ground)
    shifted = (
        max(0.0, box[0] + offset[0]),
        max(0.0, box[1] + offset[1]),
        min(float(canvas.width), box[2] + offset[0]),
        min(float(canvas.height), box[3] + offset[1]),
    )
    # Far too large a picture is first reduced by whole numbers, to three times the size that is wanted or more: the result hardly differs.
    size = (columns[1] - columns[0], rows[1] - rows[0])
    part = canvas.resize(size, resample=resample, box=shifted, reducing_gap=_REDUCING_GAP)
    if rows == (0, height) and columns == (0, width):
        return np.array(part, dtype=np.uint8)
    shape = (height, width, 3) if len(source.getbands()) == 3 else (height, width)
    result = np.full(shape, ground, dtype=np.uint8)
    result[rows[0] : rows[1], columns[0] : columns[1]] = np.asarray(part)
    return result


def _covered(start: float, length: int, factor: float, size: int) -> tuple[int, int]:
    """The rows (or columns) of the result that the picture reaches, with the filter's support: the others are ground alone."""
    first = math.floor(-start * factor) - _SUPPORT
    last = math.ceil((length - start) * factor) + _SUPPORT
    return max(0, min(first, size - 1)), min(size, max(last, 1))


def _padded(
    source: Image.Image, box: tuple[float, float, float, float], ground: int
) -> tuple[Image.Image, tuple[int, int]]:
    """The picture on a canvas that the (possibly protruding) box fits into, and where it lies on it."""
    left, above = (max(0, math.ceil(-start - _ROUNDING)) for start in box[:2])
    right, below = (max(0, math.ceil(end - size - _ROUNDING)) for end, size in zip(box[2:], source.size, strict=True))
    if not any((left, above, right, below)):
        return source, (0, 0)
    size = (source.width + left + right, source.height + above + below)
    canvas = Image.new(source.mode, size, (ground,) * len(source.getbands()) if len(source.getbands()) > 1 else ground)
    canvas.paste(source, (left, above))
    return canvas, (left, above)
