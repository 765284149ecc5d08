"""What the dense matcher needs to know about the views before it matches: cameras, sparse depth, sources, depth range."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.frontend.sparse_points import SparsePoints
from sceneexpander.geometry.cameras import Cameras

Image32 = NDArray[np.float32]
Array64 = NDArray[np.float64]

_MIN_DEPTH = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkView:
    """One view at the working resolution (numpy, because OpenCV does the image work)."""

    rgb: Image32  # (height, width, 3) in [0, 1]
    grey: Image32  # (height, width) in [0, 1]
    intrinsics: Array64  # 3x3, pixels of the working resolution
    world_from_cam: Array64  # 4x4
    posed: bool
    seen_xy: Array64  # (point, 2) pixels of the sparse points that this view observed
    seen_depth: Array64  # (point,) their z-depth, > 0

    @property
    def cam_from_world(self) -> Array64:
        """4x4 inverse of the rigid pose."""
        inverse = np.eye(4)
        inverse[:3, :3] = self.world_from_cam[:3, :3].T
        inverse[:3, 3] = -self.world_from_cam[:3, :3].T @ self.world_from_cam[:3, 3]
        return inverse


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A view to match against: with inverse depth w, reference pixel (x, y, 1) falls at ``matrix @ (x, y, 1) + w * shift``."""

    view: int
    matrix: Array64  # K_source R K_reference^-1
    shift: Array64  # K_source t


def relative_projection(reference: WorkView, other: WorkView) -> tuple[Array64, Array64]:
    """(matrix, shift) of `Source` between two posed views."""
    other_from_reference = other.cam_from_world @ reference.world_from_cam
    matrix = other.intrinsics @ other_from_reference[:3, :3] @ np.linalg.inv(reference.intrinsics)
    return matrix, other.intrinsics @ other_from_reference[:3, 3]


def prepare_views(
    images: Float[Tensor, "view 3 height width"],
    cameras: Cameras,
    sparse: SparsePoints,
    posed: NDArray[np.bool_],
    *,
    size: tuple[int, int],
) -> list[WorkView]:
    """Views resized to ``size`` = (height, width), with the cleaned depths of the sparse points they observed."""
    height, width = images.shape[-2:]
    scale = np.array([size[1] / width, size[0] / height])
    work = cameras.double().resized(*size)
    points = sparse.points_world.detach().cpu().double().numpy()
    view_index, point_index = sparse.view_index.cpu().numpy(), sparse.point_index.cpu().numpy()
    pixel_xy = sparse.pixel_xy.detach().cpu().double().numpy()
    views = []
    for s in range(images.shape[0]):
        rgb = np.ascontiguousarray(images[s].detach().cpu().float().permute(1, 2, 0).numpy())
        if size != (height, width):
            rgb = cv2.resize(rgb, (size[1], size[0]), interpolation=cv2.INTER_AREA)
        pose = work.world_from_cam[s].detach().cpu().numpy()
        mine = view_index == s if posed[s] else np.zeros(len(view_index), bool)
        xy = pixel_xy[mine] * scale
        depth = (points[point_index[mine]] - pose[:3, 3]) @ pose[:3, 2]
        usable = (depth > _MIN_DEPTH) & np.isfinite(depth) & np.isfinite(xy).all(axis=1)
        usable &= (xy >= 0).all(axis=1) & (xy < [size[1], size[0]]).all(axis=1)
        xy, depth = xy[usable], depth[usable]
        keep = _not_isolated(xy, depth)
        views.append(
            WorkView(
                rgb=rgb,
                grey=cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
                intrinsics=work.intrinsics_px[s].detach().cpu().numpy(),
                world_from_cam=pose,
                posed=bool(posed[s]),
                seen_xy=xy[keep],
                seen_depth=depth[keep],
            )
        )
    return views


def _not_isolated(xy: Array64, depth: Array64, *, neighbours: int = 6, log_gap: float = 0.6) -> NDArray[np.bool_]:
    """Points whose log depth is within ``log_gap`` of at least two of their nearest neighbours in the image.

    Deliberately loose: a stricter test removes the true points at depth edges.
    """
    if len(depth) <= neighbours:
        return np.ones(len(depth), bool)
    from scipy.spatial import cKDTree

    nearest = cKDTree(xy).query(xy, k=neighbours + 1)[1]
    itself = nearest == np.arange(len(xy))[:, None]
    itself[~itself.any(axis=1), -1] = True  # among more points at one place than are asked for
    nearest = nearest[~itself].reshape(len(xy), neighbours)
    log_depth = np.log(depth)
    return (np.abs(log_depth[nearest] - log_depth[:, None]) < log_gap).sum(axis=1) >= 2


def visible_depths(views: list[WorkView], view: int) -> Array64:
    """Depths, in ``view``, of its own sparse points and of every other view's points that fall inside its frame.

    The others may be hidden in this view, which does no harm where only a range of depths is wanted.
    """
    reference = views[view]
    height, width = reference.grey.shape
    depths = [reference.seen_depth]
    for index, other in enumerate(views):
        if index == view or not other.posed or not len(other.seen_depth):
            continue
        matrix, shift = relative_projection(other, reference)
        projected = _project(matrix, shift, other.seen_xy, other.seen_depth)
        inside = (projected[:, 2] > _MIN_DEPTH) & _in_frame(projected, height, width)
        depths.append(projected[inside, 2])
    return np.concatenate(depths)


def _project(matrix: Array64, shift: Array64, xy: Array64, depth: Array64) -> Array64:
    """(point, 3) pixel x, pixel y, z-depth in the other view."""
    ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ matrix.T
    point = ray * depth[:, None] + shift
    safe = np.where(np.abs(point[:, 2:]) > _MIN_DEPTH, point[:, 2:], _MIN_DEPTH)
    return np.concatenate([point[:, :2] / safe, point[:, 2:]], axis=1)


def _in_frame(projected: Array64, height: int, width: int) -> NDArray[np.bool_]:
    x, y = projected[:, 0], projected[:, 1]
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)


def inverse_depth_range(depths: Array64, *, near_factor: float, far_factor: float) -> tuple[float, float] | None:
    """(far, near) inverse depths that bracket the 2nd to 98th percentile of ``depths`` with a margin; None without depths."""
    if not len(depths):
        return None
    low, high = np.percentile(depths, [2, 98])
    return far_factor / float(high), near_factor / float(low)


def choose_sources(views: list[WorkView], view: int, *, limit: int, min_parallax_px: float) -> list[Source]:
    """The views that see most of what ``view`` sees from a usefully different place, best first.

    A candidate scores the share of a grid of this view's pixels, at the depth of the sparse points, that falls inside its
    frame, times a preference for parallaxes between about 1 and 8 pixels per 10 % of depth. Candidates under
    ``min_parallax_px`` (near-rotation: depth cannot be seen) are left out.
    """
    reference = views[view]
    if not reference.posed:
        return []
    depths = visible_depths(views, view)
    if not len(depths):
        return []
    height, width = reference.grey.shape
    grid = np.stack(np.meshgrid(np.linspace(0.1, 0.9, 6) * width, np.linspace(0.1, 0.9, 6) * height), -1).reshape(-1, 2)
    near, middle, far = np.percentile(depths, [20, 50, 80])
    xy = np.concatenate([grid, grid, grid, reference.seen_xy])
    depth = np.concatenate([np.repeat([near, middle, far], len(grid)), reference.seen_depth])
    scored = []
    for index, other in enumerate(views):
        if index == view or not other.posed:
            continue
        matrix, shift = relative_projection(reference, other)
        at = _project(matrix, shift, xy, depth)
        further = _project(matrix, shift, xy, depth * 1.1)
        inside = (at[:, 2] > _MIN_DEPTH) & (further[:, 2] > _MIN_DEPTH) & _in_frame(at, height, width)
        if inside.mean() < 0.02:
            continue
        parallax = float(np.median(np.linalg.norm(at[inside, :2] - further[inside, :2], axis=1)))
        if parallax < min_parallax_px:
            continue
        preference = min(parallax, 1.0) * min(1.0, 8.0 / parallax)
        scored.append((float(inside.mean()) * preference, Source(view=index, matrix=matrix, shift=shift)))
    scored.sort(key=lambda pair: -pair[0])
    return [source for _, source in scored[:limit]]


def plane_inverse_depths(
    reference: WorkView, sources: list[Source], far: float, near: float, *, most: int, step_px: float
) -> Array64:
    """Inverse depths, uniform, so dense that no source moves by more than ``step_px`` between two planes, but at most ``most``."""
    height, width = reference.grey.shape
    corners = np.array([[x, y] for x in (0.15, 0.5, 0.85) for y in (0.15, 0.5, 0.85)]) * [width, height]
    longest = 0.0
    for source in sources:
        ends = [_project(source.matrix, source.shift, corners, np.full(len(corners), 1 / w)) for w in (far, near)]
        ahead = (ends[0][:, 2] > _MIN_DEPTH) & (ends[1][:, 2] > _MIN_DEPTH)
        if ahead.any():
            lengths = np.linalg.norm(ends[0][ahead, :2] - ends[1][ahead, :2], axis=1)
            longest = max(longest, float(np.median(lengths)))
    count = int(np.clip(np.ceil(longest / step_px) + 1, min(8, most), most))
    return np.linspace(far, near, count)
