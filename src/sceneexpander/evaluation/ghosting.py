"""Ghosting: whether structure of a photo is where the other views' Gaussians paint it (leave one view out).

A picture-wide error says little about doubled contours: blur and exposure cost as much, and perceptual distances forgive shifts by design.
So structure is looked up piece by piece. A square piece of the photo is found *in place* if its normalised correlation with what the other
views show is at least 0.8 within half a per cent of the long side. Half-transparent double images correlate badly in every place, shifted
ones elsewhere; noise, emptiness and other pictures nowhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

_PIECE = 1 / 24  # of the long side, at least 9 pixels
_REACH = 1 / 32  # how far a piece is looked for, at least 4 pixels
_IN_PLACE = 1 / 200  # at least one pixel: half the step of the search cannot be told apart
_ALIKE = 0.8  # correlation
_TEXTURED = 0.02  # standard deviation of luma from which a piece has structure
_SHOWN = 0.9  # share of a piece's surroundings that the others must cover
_FEWEST = 8  # pieces


@dataclass(frozen=True, slots=True, kw_only=True)
class GhostingFound:
    """``ghosted``: share of pieces that are not in place; ``offset``: median distance to where they are, over the long side.

    Pieces found nowhere count as the whole reach away.
    """

    ghosted: float
    offset: float


def find_ghosting(
    photo: Float[Tensor, "3 height width"], seen: Float[Tensor, "3 height width"], shown: Bool[Tensor, "height width"]
) -> GhostingFound | None:
    """Look the photo's structure up in what the other views show of it.

    Args:
        photo: RGB in [0, 1].
        seen: what the other views' Gaussians show at its camera, colours without the background.
        shown: pixels that they cover and that count.

    Returns:
        None where fewer than eight pieces with structure are covered: there is nothing to compare.

    Raises:
        ValueError: sizes differ or values are not finite.
    """
    if photo.shape != seen.shape or photo.shape[1:] != shown.shape:
        raise ValueError(f"cannot compare images of {tuple(photo.shape)}, {tuple(seen.shape)}, {tuple(shown.shape)}")
    wanted, found = _luma(photo), _luma(seen)
    if not (np.isfinite(wanted).all() and np.isfinite(found).all()):
        raise ValueError("cannot look for ghosting in images that hold non-finite values")
    covered = shown.cpu().numpy()
    height, width = wanted.shape
    side = max(height, width)
    piece, reach = max(9, round(_PIECE * side)), max(4, round(_REACH * side))
    near = max(1.0, _IN_PLACE * side)
    ghosted, offsets = 0, []
    for top in range(reach, height - piece - reach + 1, piece):
        for left in range(reach, width - piece - reach + 1, piece):
            inner = np.s_[top : top + piece, left : left + piece]
            around = np.s_[top - reach : top + piece + reach, left - reach : left + piece + reach]
            if covered[around].mean() < _SHOWN or wanted[inner].std() < _TEXTURED:
                continue
            scores = _correlations(found[around], wanted[inner])
            row, column = np.unravel_index(int(scores.argmax()), scores.shape)
            offset = min(float(np.hypot(row - reach, column - reach)), float(reach))
            if scores[row, column] < _ALIKE:
                offset = float(reach)
            ghosted += offset > near
            offsets.append(offset / side)
    if len(offsets) < _FEWEST:
        return None
    return GhostingFound(ghosted=ghosted / len(offsets), offset=float(np.median(offsets)))


def _correlations(window: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Normalised correlation at every shift, -1 where the window has no structure."""
    if window.std() < _TEXTURED / 4:
        return np.full(np.subtract(window.shape, piece.shape) + 1, -1.0, np.float32)
    scores = cv2.matchTemplate(window, piece, cv2.TM_CCOEFF_NORMED)
    return np.where(np.isfinite(scores) & (np.abs(scores) <= 1.001), scores, -1.0)


def _luma(image: Tensor) -> np.ndarray:
    """Rec. 601, float32."""
    red, green, blue = image.detach().clamp(0, 1).float().cpu().numpy()
    return np.ascontiguousarray(0.299 * red + 0.587 * green + 0.114 * blue)
