"""From the outputs of a stream to cameras: poses, focal lengths, resets (ttt3r spec 7, 8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.camera import intrinsics_from_parts
from sceneexpander.geometry.rigid import rigid_from_parts, rotation_from_quat_wxyz

REWEIGHTINGS = 10
MIN_FOCAL = (
    0.05  # of the longer side: 168 degrees of view; only a pointmap that is no picture of anything asks for less
)


def world_from_camera_pose(camera_pose: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 4 4"]:
    """Matrix of a predicted camera (translation, quaternion wxyz)."""
    return rigid_from_parts(rotation_from_quat_wxyz(camera_pose[..., 3:]), camera_pose[..., :3])


def focal_from_points(points_self: Float[Tensor, "view height width 3"]) -> Float[Tensor, "view"]:
    """Focal length in pixels (>= 0) that best explains camera-frame pointmaps, robust to outliers (Weiszfeld's method).

    Pixels are integers here and the principal point is (width // 2, height // 2).
    """
    height, width = points_self.shape[1:3]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    offsets = torch.stack([columns - width // 2, rows - height // 2], dim=-1).to(points_self).flatten(0, 1)
    xy, z = points_self[..., :2].flatten(1, 2), points_self[..., 2:].flatten(1, 2)
    safe_z = torch.where(z == 0, torch.ones_like(z), z)
    rays = torch.where(z == 0, torch.zeros_like(xy), xy / safe_z).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    along, square = (rays * offsets).sum(-1), rays.square().sum(-1)
    focal = along.mean(-1) / square.mean(-1)
    for _ in range(REWEIGHTINGS):
        weight = 1 / (offsets - focal[:, None, None] * rays).norm(dim=-1).clamp(min=1e-8)
        focal = (weight * along).mean(-1) / (weight * square).mean(-1)
    return focal.clamp(min=0)


def intrinsics_from_points(points_self: Float[Tensor, "view height width 3"]) -> Float[Tensor, "view 3 3"]:
    """Intrinsics of camera-frame pointmaps, one focal length for both axes.

    The method's principal point is the centre of the pixel (width // 2, height // 2), half a pixel right of and below the middle.
    """
    height, width = points_self.shape[1:3]
    focal = focal_from_points(points_self).clamp(min=MIN_FOCAL * max(height, width))
    cx, cy = torch.full_like(focal, width // 2 + 0.5), torch.full_like(focal, height // 2 + 0.5)
    return intrinsics_from_parts(focal, focal, cx, cy)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedStep:
    """One step of a stream with resets."""

    view: int
    reset: bool
    kept: bool  # False: the second reading of a view after a reset, which only starts the next chunk


def plan_steps(views: int, reset_every: int | None) -> list[PlannedStep]:
    """The order of reading: with resets, the view that ends a chunk is read again to start the next one."""
    steps = []
    for view in range(views):
        reset = reset_every is not None and (view + 1) % reset_every == 0
        steps.append(PlannedStep(view=view, reset=reset, kept=True))
        if reset:
            steps.append(PlannedStep(view=view, reset=False, kept=False))
    return steps


def chain_resets(
    world_from_cam: Float[Tensor, "view 4 4"], reset: Sequence[bool] | Tensor
) -> Float[Tensor, "view 4 4"]:
    """Poses of all chunks in the first one's frame: every reset view is the origin of those after it. No scale is aligned.

    Args:
        world_from_cam: one pose per kept view, in its own chunk's frame.
        reset: whether the state was reset after the view.
    """
    chained, world_from_chunk = [], torch.eye(4).to(world_from_cam)
    for pose, ends in zip(world_from_cam, reset, strict=True):
        chained.append(world_from_chunk @ pose)
        if ends:
            world_from_chunk = chained[-1]
    return torch.stack(chained)
