"""What the pictures themselves say about matches: do the places look alike, lie still, or lie mirrored?"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from sceneexpander.frontend.features import Features, detect_features
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.twoview import PairMatches, match_and_verify

_PATCH_PX, _PATCH_STEP = 8, 2  # half the side of a compared patch, and the distance of its samples, in pixels
_PATCH_BLUR = 1.5

_STILL_PX = 0.75  # at 768 px: a match that moves less lies still
_STILL_MATCHES = (
    12  # as many, in every pair of views: chance and far away things give fewer or move with the camera's turn
)
_MOVING_PX = 6.0  # how far the others must move (median) for the still ones to be no part of the place
_MOST_STILL = 0.75  # a larger share lies still where the camera did

_ALIKE_PX = 2.0  # at 768 px: median motion of the matches of two views that count as one
_ALIKE_MATCHES = 30

_MIRROR_MATCHES = 30
_MIRROR_GAIN = 2.0  # times as many as unmirrored


def patch_agreement(
    grey_a: UInt8[np.ndarray, "height width"],
    grey_b: UInt8[np.ndarray, "height width"],
    xy_a: Float[np.ndarray, "match 2"],
    xy_b: Float[np.ndarray, "match 2"],
) -> float:
    """Mean normalised correlation of upright patches around matches; 0 without any.

    Right matches of photos with a wide baseline have .5 and more. A learned matcher finds structure in pure noise, with .25.
    """
    if len(xy_a) == 0:
        return 0.0
    return float((_patches(grey_a, xy_a) * _patches(grey_b, xy_b)).sum(1).mean())


def _patches(grey: np.ndarray, xy: np.ndarray) -> np.ndarray:
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _PATCH_BLUR)
    steps = np.arange(-_PATCH_PX, _PATCH_PX + 1, _PATCH_STEP)
    offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    at = (xy[:, None] + offsets - 0.5).astype(np.float32)
    values = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    centred = values - values.mean(1, keepdims=True)
    return centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-3)


def find_overlay(
    features: Sequence[Features], pairs: Sequence[PairMatches], unit_px: float
) -> Float[np.ndarray, "spot 2"] | None:
    """Where something lies still while the pictures move: a watermark, a logo, a clock. None if there is nothing of the kind.

    Args:
        features: of all views; pixels of one common frame.
        pairs: their matches, the loose ones included: a geometry that explains the place drops still matches.
        unit_px: pixels per pixel at 768.
    """
    still_xy: list[np.ndarray] = []
    for pair in pairs:
        a, b = features[pair.view_a], features[pair.view_b]
        xy_a, xy_b = a.pixel_xy[pair.loose.index_a], b.pixel_xy[pair.loose.index_b]
        motion = np.linalg.norm(xy_a - xy_b, axis=1) / unit_px
        still = motion < _STILL_PX
        # Of the rest, wrong matches move far as well: that the others move is asked of verified ones where there are any.
        verified = pair.verified if pair.verified.count else pair.loose
        moves = np.linalg.norm(a.pixel_xy[verified.index_a] - b.pixel_xy[verified.index_b], axis=1) / unit_px
        moving = moves[moves >= _STILL_PX]
        if still.sum() < _STILL_MATCHES or still.mean() > _MOST_STILL:
            return None
        if len(moving) == 0 or np.median(moving) < _MOVING_PX:
            return None
        still_xy.append(xy_a[still])
    return np.concatenate(still_xy) if still_xy else None


def group_alike(features: Sequence[Features], pairs: Sequence[PairMatches], unit_px: float) -> list[list[int]]:
    """Groups of two or more views that show the same from the same place: bursts, and copies of one picture."""
    group = list(range(len(features)))
    for pair in pairs:
        a, b = features[pair.view_a], features[pair.view_b]
        matches = pair.verified
        if matches.count < _ALIKE_MATCHES:
            continue
        moves = np.linalg.norm(a.pixel_xy[matches.index_a] - b.pixel_xy[matches.index_b], axis=1)
        if np.median(moves) < _ALIKE_PX * unit_px:
            low, high = sorted((group[pair.view_a], group[pair.view_b]))
            group = [low if mine == high else mine for mine in group]
    members = [[view for view, mine in enumerate(group) if mine == number] for number in sorted(set(group))]
    return [views for views in members if len(views) > 1]


def looks_mirrored(
    view: int,
    against: Sequence[int],
    greys: Sequence[UInt8[np.ndarray, "height width"]],
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    config: SfmConfig,
    *,
    unit_px: float,
    seed: int,
) -> bool:
    """Whether a view matches the views ``against`` much better when it is flipped left to right."""
    others = set(against) - {view}
    as_it_is = [
        pair.verified.count
        for pair in pairs
        if view in (pair.view_a, pair.view_b) and others & {pair.view_a, pair.view_b}
    ]
    flipped = detect_features(np.ascontiguousarray(greys[view][:, ::-1]), config)
    mirrored = [
        match_and_verify(0, 1, [flipped, features[other]], config, unit_px=unit_px, seed=seed).verified.count
        for other in sorted(others)
    ]
    return max(mirrored, default=0) >= max(_MIRROR_MATCHES, _MIRROR_GAIN * max(as_it_is, default=0))
