"""Gaussians of new space reach their neighbours, so that it stays closed when the camera moves (beyond the paper).

A pixel-aligned Gaussian is as large as its pixel. Seen from elsewhere, neighbours on a slanted or rippled surface move apart and black
shows between them. Where several photos see a surface they fill each other's gaps; what only an inserted view shows has no one to do it.
There, and only there, each Gaussian is widened along the directions to its neighbours in its own view's grid, up to the next edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.rigid import quat_wxyz_from_rotation, rotation_from_quat_wxyz
from sceneexpander.insertion.contradiction import filled_by_captured
from sceneexpander.insertion.protocol import RoundContext, RoundInputs
from sceneexpander.ranges import Range, check_ranges

_EDGE = 0.15  # difference of neighbours' log depths from which on they lie on two surfaces
_FARTHEST_PX = 6.0  # distance in pixels of the view beyond which a neighbour is not reached for
_NONE = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class GapFilling:
    """How far generated Gaussians of new space reach, in distances between neighbours, see `close_gaps`; 0: they stay as made."""

    reach: Annotated[float, Range(0, 100)] = 0.0

    def __post_init__(self) -> None:
        check_ranges(self)

    def correct_scene(self, scene: Reconstruction, inputs: RoundInputs, context: RoundContext) -> Reconstruction:
        """See `close_gaps`."""
        return close_gaps(scene, self.reach)


@torch.no_grad()
def close_gaps(reconstruction: Reconstruction, reach: float) -> Reconstruction:
    """The same reconstruction, its generated Gaussians where no captured one fills their pixel widened to their neighbours.

    Along the rows and the columns of its own view's pixels, a Gaussian gets a standard deviation of at least ``reach`` times the
    distance between neighbours on the same surface; it is never made smaller. Views without a camera are left alone.

    Args:
        reconstruction: with Gaussians that tell their view.
        reach: at 0.7 a floor that was seen at a slant is 0.99 opaque between its Gaussians from above (0.5: 0.86); 0 changes nothing.
    """
    generated = torch.nonzero(reconstruction.generated & reconstruction.posed)[:, 0].tolist()
    if reach <= 0 or not generated:
        return reconstruction
    gaussians = reconstruction.gaussians
    cameras = reconstruction.cameras
    filled = filled_by_captured(gaussians, cameras, reconstruction.generated)
    scales, quats = gaussians.scales.clone(), gaussians.quat_wxyz.clone()
    for view in generated:
        own = torch.nonzero(gaussians.source_view == view)[:, 0]
        part = gaussians.select(own)
        grid, depth = _grid(part, cameras[view])
        focal = float((cameras.intrinsics_px[view, 0, 0] * cameras.intrinsics_px[view, 1, 1]).sqrt())
        covariance = _covariance(part)
        missing = torch.zeros_like(covariance)
        for dim in (0, 1):
            step, known = _to_neighbours(part.means.double(), depth, grid, dim)
            length = step.norm(dim=-1)
            direction = step / length.clamp(min=1e-12)[:, None]
            length = length.minimum(_FARTHEST_PX * depth / focal)
            there = torch.einsum("ni,nij,nj->n", direction, covariance, direction)
            lack = ((reach * length).square() - there).clamp(min=0) * known * (1 - filled[own])
            missing += lack[:, None, None] * direction[:, :, None] * direction[:, None, :]
        changed = missing.diagonal(dim1=1, dim2=2).sum(-1) > 0
        scales[own[changed]], quats[own[changed]] = _shape((covariance + missing)[changed])
    return replace(reconstruction, gaussians=replace(gaussians, scales=scales, quat_wxyz=quats))


def _grid(gaussians: Gaussians, camera: Cameras) -> tuple[Int[Tensor, "height width"], Float[Tensor, "gaussian"]]:
    """(which Gaussian of one view lies in which of its pixels, the last one of several and -1 without one; their z-depths)."""
    found = camera.project(gaussians.means)
    height, width = camera.height, camera.width
    size = found.grid.new_tensor([width, height])
    column, row = ((found.grid[0] + 1) / 2 * size).floor().long().unbind(-1)
    index = torch.arange(len(gaussians), device=size.device)
    grid = torch.full((height * width,), _NONE, dtype=torch.long, device=size.device)
    inside = found.in_frame[0]
    grid.scatter_reduce_(0, (row * width + column)[inside], index[inside], "amax")
    return grid.view(height, width), found.depth[0]


def _to_neighbours(
    means: Float[Tensor, "gaussian 3"],
    depth: Float[Tensor, "gaussian"],
    grid: Int[Tensor, "height width"],
    dim: int,
) -> tuple[Float[Tensor, "gaussian 3"], Bool[Tensor, "gaussian"]]:
    """(mean step to the next and from the previous Gaussian along a dimension of the grid, whether there is one on this surface)."""
    count = grid.shape[dim]
    here, after = grid.narrow(dim, 0, count - 1).flatten(), grid.narrow(dim, 1, count - 1).flatten()
    both = (here != _NONE) & (after != _NONE)
    here, after = here[both], after[both]
    joined = (depth[after] / depth[here]).log().abs() < _EDGE
    here, after = here[joined], after[joined]
    step = means[after] - means[here]
    total, steps = torch.zeros_like(means), torch.zeros_like(means[:, 0])
    for end in (here, after):
        total.index_add_(0, end, step)
        steps.index_add_(0, end, torch.ones_like(step[:, 0]))
    return total / steps.clamp(min=1)[:, None], steps > 0


def _covariance(gaussians: Gaussians) -> Float[Tensor, "gaussian 3 3"]:
    """In double precision: thin ones are flat to a thousandth."""
    axes = rotation_from_quat_wxyz(gaussians.quat_wxyz.double()) * gaussians.scales.double()[:, None, :]
    return axes @ axes.transpose(1, 2)


def _shape(
    covariance: Float[Tensor, "gaussian 3 3"],
) -> tuple[Float[Tensor, "gaussian 3"], Float[Tensor, "gaussian 4"]]:
    """(standard deviations, quaternions wxyz) of covariances."""
    variance, axes = torch.linalg.eigh(covariance)
    proper = torch.where((torch.linalg.det(axes) < 0)[:, None, None], -axes, axes)
    return variance.clamp(min=1e-18).sqrt().float(), quat_wxyz_from_rotation(proper).float()
