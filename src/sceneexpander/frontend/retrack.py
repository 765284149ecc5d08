"""Tracks measured in the pictures themselves, once cameras and depth are roughly known.

Every view is redrawn in the frame of every other one through that one's depth. What a window then still has to move there to
match (Lucas and Kanade, IJCAI 1981) is the error of cameras and depth, not a matter of viewpoint, so it is found to a small part
of a pixel where keypoints are off by half of one; and corners that no detector finds again in the other view serve, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from sceneexpander.frontend.dense_check import transfer
from sceneexpander.frontend.features import equalised
from sceneexpander.frontend.tracks import Tracks

# Lengths in pixels are for images of the reference long side and scale with them (``unit_px``).
_WINDOW_PX = 15.0
_MIN_WINDOW_PX = 9  # of the image itself: smaller ones hold too little to match
_SPACING_PX = 8.0  # between the corners of a view
_MAX_SHIFT_PX = 8.0  # farther from where cameras and depth put it a match is another corner
_ROUND_TRIP_PX = 0.5
_MAX_STRETCH_PX = 3.0  # the redrawn view is torn where neighbouring pixels come from places this far apart
_CORNER_QUALITY = 0.003  # of the strongest corner
_MIN_EIGENVALUE = 1e-3
_MIN_CORRELATION = 0.85  # of the windows at the match
_PYRAMID_LEVELS = 1
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)


def retrack(
    greys: Sequence[UInt8[np.ndarray, "height width"]],
    rotations: Float[np.ndarray, "view 3 3"],
    translations: Float[np.ndarray, "view 3"],
    intrinsics: Float[np.ndarray, "view 3 3"],
    depth: Float32[np.ndarray, "view rough_height rough_width"],
    usable: Bool[np.ndarray, " view"],
    *,
    points: int,
    unit_px: float,
) -> Tracks:
    """Corners of every usable view, found in the other usable views.

    Args:
        greys: of all views, one size.
        rotations, translations: ``cam_from_world``.
        intrinsics: in pixels of ``greys``.
        depth: z-depth in the scale of the cameras, at any resolution of the same framing.
        usable: views with a pose.
        points: most corners of a view.
        unit_px: pixels of ``greys`` per pixel of the reference size.
    """
    pictures = [equalised(grey) for grey in greys]
    views = np.flatnonzero(usable)
    tracks = [Tracks(pixel_xy=np.zeros((0, len(greys), 2)), seen=np.zeros((0, len(greys)), bool))]
    for view in views:
        corners = _corners(pictures[view], points, unit_px)
        pixel_xy = np.zeros((len(corners), len(greys), 2))
        seen = np.zeros((len(corners), len(greys)), bool)
        pixel_xy[:, view], seen[:, view] = corners + 0.5, True  # OpenCV puts the first pixel centre at 0
        own_depth = _resized(depth[view], pictures[view].shape)
        inverse = np.linalg.inv(intrinsics[view])
        for other in views:
            if other == view or not len(corners):
                continue
            rotation = rotations[other] @ rotations[view].T
            matrix = intrinsics[other] @ rotation @ inverse
            shift = intrinsics[other] @ (translations[other] - rotation @ translations[view])
            rows, found = _found_in(pictures[view], pictures[other], corners, own_depth, matrix, shift, unit_px)
            pixel_xy[rows, other], seen[rows, other] = found + 0.5, True
        shared = seen.sum(1) >= 2
        tracks.append(Tracks(pixel_xy=pixel_xy[shared], seen=seen[shared]))
    return Tracks.joined(tracks)


def _corners(
    picture: UInt8[np.ndarray, "height width"], points: int, unit_px: float
) -> Float32[np.ndarray, "corner 2"]:
    """Places with structure in both directions, strongest first (Shi and Tomasi, CVPR 1994)."""
    block = _odd(_WINDOW_PX / 2 * unit_px)
    found = cv2.goodFeaturesToTrack(picture, points, _CORNER_QUALITY, _SPACING_PX * unit_px, blockSize=block)
    return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)


def _resized(depth: Float32[np.ndarray, "..."], size: tuple[int, ...]) -> Float32[np.ndarray, "height width"]:
    """Depth at another resolution, in logarithms."""
    grown = cv2.resize(np.log(depth.astype(np.float32)), (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    return np.exp(grown).astype(np.float32)


def _found_in(
    picture: UInt8[np.ndarray, "height width"],
    other: UInt8[np.ndarray, "height width"],
    corners: Float32[np.ndarray, "corner 2"],
    depth: Float32[np.ndarray, "height width"],
    matrix: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, " 3"],
    unit_px: float,
) -> tuple[Int[np.ndarray, " row"], Float32[np.ndarray, "row 2"]]:
    """(rows of the corners that were found in the other view, their places there), first pixel centre at 0."""
    height, width = picture.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5)
    map_x, map_y, ahead = transfer(matrix, shift, x, y, depth)
    map_x, map_y = map_x - np.float32(0.5), map_y - np.float32(0.5)
    inside = (ahead > 0) & (map_x >= 0) & (map_x <= width - 1) & (map_y >= 0) & (map_y <= height - 1)
    window = max(_odd(_WINDOW_PX * unit_px), _MIN_WINDOW_PX)
    whole = cv2.erode(inside.astype(np.uint8), np.ones((window, window), np.uint8), borderValue=0) > 0
    column, row = np.rint(corners[:, 0]).astype(int), np.rint(corners[:, 1]).astype(int)
    rows = np.flatnonzero(whole[row, column])
    nothing = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
    if not len(rows):
        return nothing
    redrawn = cv2.remap(other, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    start = corners[rows]
    moved, there = _flow(picture, redrawn, start, window)
    back, again = _flow(redrawn, picture, moved, window)
    good = there & again & (np.linalg.norm(back - start, axis=1) < _ROUND_TRIP_PX * unit_px)
    good &= np.linalg.norm(moved - start, axis=1) < _MAX_SHIFT_PX * unit_px
    good &= (moved >= 1).all(1) & (moved[:, 0] < width - 2) & (moved[:, 1] < height - 2)
    rows, start, moved = rows[good], start[good], moved[good]
    if not len(rows):
        return nothing
    at = np.stack([_read(map_x, moved), _read(map_y, moved)], axis=1)
    column, row = np.rint(moved[:, 0]).astype(int), np.rint(moved[:, 1]).astype(int)
    torn = np.hypot(at[:, 0] - map_x[row, column], at[:, 1] - map_y[row, column]) > _MAX_STRETCH_PX * unit_px
    alike = _correlation(picture, redrawn, start, moved, window // 2) > _MIN_CORRELATION
    return rows[alike & ~torn], at[alike & ~torn]


def _flow(
    picture: UInt8[np.ndarray, "height width"],
    other: UInt8[np.ndarray, "height width"],
    start: Float32[np.ndarray, "point 2"],
    window: int,
) -> tuple[Float32[np.ndarray, "point 2"], Bool[np.ndarray, " point"]]:
    """(where windows of one picture lie in another of the same view, which were found), looked for around the same place."""
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        picture,
        other,
        start[:, None],
        start[:, None].copy(),
        winSize=(window, window),
        maxLevel=_PYRAMID_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_MIN_EIGENVALUE,
        criteria=_STOP,
    )
    return moved[:, 0], status[:, 0] > 0


def _read(
    values: Float32[np.ndarray, "height width"], xy: Float32[np.ndarray, "point 2"]
) -> Float32[np.ndarray, " point"]:
    """A map between its pixels."""
    return cv2.remap(values, xy[:, None, 0], xy[:, None, 1], cv2.INTER_LINEAR).reshape(-1)


def _correlation(
    picture: UInt8[np.ndarray, "height width"],
    other: UInt8[np.ndarray, "height width"],
    xy: Float32[np.ndarray, "point 2"],
    other_xy: Float32[np.ndarray, "point 2"],
    radius: int,
) -> Float32[np.ndarray, " point"]:
    """Normalised cross-correlation of windows; 0 where one of them has no contrast."""
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    dx, dy = (grid.reshape(1, -1) for grid in np.meshgrid(steps, steps))

    def windows(image: np.ndarray, at: np.ndarray) -> np.ndarray:
        read = cv2.remap(
            image, at[:, 0, None] + dx, at[:, 1, None] + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        read = read.astype(np.float32)
        return read - read.mean(1, keepdims=True)

    a, b = windows(picture, xy), windows(other, other_xy)
    return (a * b).sum(1) / np.sqrt(np.maximum((a * a).sum(1) * (b * b).sum(1), 1e-6))


def _odd(length: float) -> int:
    """The nearest odd number of pixels, at least 3."""
    return max(3, 2 * round((length - 1) / 2) + 1)
