"""Cross-view consistency: depth is believed where another view's depth map leads back to the same pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneexpander.frontend.dense_views import Array64, Image32, WorkView, relative_projection


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """What the other views say about one view's depth, each (height, width)."""

    agreeing: Image32  # number of other views whose depth agrees
    parallax: Image32  # largest motion in any other view, in pixels, when the depth grows by 10 %


def check_view(
    views: list[WorkView],
    depths: list[Image32 | None],
    view: int,
    *,
    reprojection_px: float,
    depth_tolerance: float,
) -> Agreement:
    """Agreement of ``depths[view]`` with every other matched view."""
    reference, depth = views[view], depths[view]
    if depth is None:
        raise ValueError(f"view {view} has no matched depth to check")
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5)
    agreeing = np.zeros(depth.shape, np.float32)
    parallax = np.zeros(depth.shape, np.float32)
    for other, other_depth in enumerate(depths):
        if other == view or other_depth is None:
            continue
        matrix, shift = relative_projection(reference, views[other])
        there_x, there_y, there_z = _transfer(matrix, shift, x, y, depth)
        further_x, further_y, further_z = _transfer(matrix, shift, x, y, depth * np.float32(1.1))
        seen = (there_x >= 0) & (there_x < width) & (there_y >= 0) & (there_y < height)
        seen &= (there_z > 0) & (further_z > 0)
        motion = np.hypot(further_x - there_x, further_y - there_y)
        np.maximum(parallax, np.where(seen, motion, 0), out=parallax)
        column, row = np.where(seen, there_x, 0).astype(np.int32), np.where(seen, there_y, 0).astype(np.int32)
        found = other_depth[row, column]
        back_matrix, back_shift = relative_projection(views[other], reference)
        centre_x, centre_y = column.astype(np.float32) + 0.5, row.astype(np.float32) + 0.5
        back_x, back_y, _ = _transfer(back_matrix, back_shift, centre_x, centre_y, found)
        # The other depth map is read at the nearest pixel centre, up to half a pixel from where the point falls.
        error = np.hypot(back_x - x, back_y - y)
        seen &= (error < reprojection_px) & (np.abs(found - there_z) < depth_tolerance * there_z)
        agreeing += seen
    return Agreement(agreeing=agreeing, parallax=parallax)


def _transfer(
    matrix: Array64, shift: Array64, x: Image32, y: Image32, depth: Image32
) -> tuple[Image32, Image32, Image32]:
    """(x, y, z) in the other view of pixels at the given depths; z <= 0 means behind it (x and y are then meaningless)."""
    m, t = matrix.astype(np.float32), shift.astype(np.float32)
    px, py, pz = (depth * (m[i, 0] * x + m[i, 1] * y + m[i, 2]) + t[i] for i in range(3))
    safe = np.where(pz > 1e-9, pz, 1)
    limit = np.float32(1e6)
    return np.clip(px / safe, -limit, limit), np.clip(py / safe, -limit, limit), np.where(pz > 1e-9, pz, -1)


def without_small_parts(mask: NDArray[np.bool_], min_pixels: int) -> NDArray[np.bool_]:
    """The mask without its 8-connected parts of fewer than ``min_pixels``."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= min_pixels
    large[0] = False
    return large[labels]
