"""Stand-ins for the sparse front-end on scenes with known depth: noisy points and noisy poses.

For training and for measuring the dense matcher on its own, without running structure from motion.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneexpander.frontend.sparse_points import SparsePoints
from sceneexpander.geometry.camera import project_points
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rigid_from_parts, rotation_from_quat_wxyz, transform_points


def sample_sparse_points(
    images: Float[Tensor, "view 3 height width"],
    depth: Float[Tensor, "view height width"],
    valid: Bool[Tensor, "view height width"],
    cameras: Cameras,
    generator: torch.Generator,
    *,
    per_view: tuple[int, int] = (50, 150),
    depth_noise: float = 0.03,
    outliers: float = 0.03,
    visibility_tolerance: float = 0.03,
) -> SparsePoints:
    """Points such as structure from motion would find, drawn from true depth.

    Pixels are drawn with a probability that grows with the image gradient. A point's depth along its ray is multiplied by
    ``exp(depth_noise * normal)``; a share ``outliers`` gets a factor log-uniform in [1/3, 3] instead. Every other view in
    whose frame the *true* point falls unoccluded (depth within ``visibility_tolerance``) observes it too, at the exact pixel.

    Args:
        valid: where ``depth`` is known; nothing is drawn elsewhere.
        cameras: those of ``images``.
        per_view: least and greatest number of points drawn from one view (uniform, one number for the scene).
    """
    views, width = len(cameras), cameras.width
    world_from_cam, intrinsics_px = cameras.world_from_cam, cameras.intrinsics_px
    count = int(torch.randint(per_view[0], per_view[1] + 1, (), generator=generator))
    chance = _gradient(images) * valid.float()
    points, view_index, point_index, pixels = [], [], [], []
    total = 0
    for s in range(views):
        drawable = int((chance[s] > 0).sum())
        if not drawable:
            continue
        flat = torch.multinomial(chance[s].flatten(), min(count, drawable), generator=generator)
        row, column = flat // width, flat % width
        jitter = torch.rand(len(flat), 2, generator=generator)
        xy = torch.stack([column, row], -1) + jitter
        true_depth = depth[s][row, column]
        ray = torch.cat([xy, torch.ones(len(flat), 1)], -1) @ torch.linalg.inv(intrinsics_px[s]).T
        factor = torch.exp(depth_noise * torch.randn(len(flat), generator=generator))
        wrong = torch.rand(len(flat), generator=generator) < outliers
        wild = 3 ** (2 * torch.rand(len(flat), generator=generator) - 1)
        factor = torch.where(wrong, wild, factor)
        true_world = transform_points(world_from_cam[s], ray * true_depth[:, None])
        points.append(transform_points(world_from_cam[s], ray * (true_depth * factor)[:, None]))
        index = torch.arange(len(flat)) + total
        total += len(flat)
        view_index.append(torch.full_like(index, s))
        point_index.append(index)
        pixels.append(xy)
        for other in range(views):
            if other == s:
                continue
            other_xy, z = project_points(true_world, intrinsics_px[other], world_from_cam[other])
            seen = _seen(other_xy, z, depth[other], valid[other], visibility_tolerance)
            view_index.append(torch.full_like(index[seen], other))
            point_index.append(index[seen])
            pixels.append(other_xy[seen])
    if not points:
        return SparsePoints.empty()
    return SparsePoints(
        points_world=torch.cat(points),
        view_index=torch.cat(view_index),
        point_index=torch.cat(point_index),
        pixel_xy=torch.cat(pixels),
    )


def _gradient(images: Float[Tensor, "view 3 height width"]) -> Float[Tensor, "view height width"]:
    """Grey-level gradient magnitude plus a small constant, so that plain images can be drawn from as well."""
    grey = images.mean(dim=1)
    gradient = torch.full_like(grey, 1e-3)
    gradient[:, :, 1:-1] += (grey[:, :, 2:] - grey[:, :, :-2]).abs()
    gradient[:, 1:-1] += (grey[:, 2:] - grey[:, :-2]).abs()
    return gradient


def _seen(
    xy: Float[Tensor, "point 2"],
    z: Float[Tensor, "point"],
    depth: Float[Tensor, "height width"],
    valid: Bool[Tensor, "height width"],
    tolerance: float,
) -> Int[Tensor, "seen"]:
    """Indices of the points that are in the frame and not behind the visible surface."""
    height, width = depth.shape
    column, row = xy[:, 0].floor().long(), xy[:, 1].floor().long()
    inside = (z > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    surface = depth[row, column]
    return torch.nonzero(inside & valid[row, column] & ((z - surface).abs() < tolerance * surface))[:, 0]


def perturb_poses(
    world_from_cam: Float[Tensor, "view 4 4"],
    rotation_deg: float,
    baseline_fraction: float,
    generator: torch.Generator,
) -> Float[Tensor, "view 4 4"]:
    """Poses as an imperfect front-end would estimate them; the first view, which defines the world, stays.

    Each other camera turns about a random axis by a normal angle of standard deviation ``rotation_deg``, and its centre
    moves by a normal step whose root-mean-square length is ``baseline_fraction`` of the mean distance between cameras.
    """
    views = world_from_cam.shape[0]
    axis = torch.nn.functional.normalize(torch.randn(views, 3, generator=generator), dim=-1)
    half_angle = torch.deg2rad(rotation_deg * torch.randn(views, generator=generator)) / 2
    turn = rotation_from_quat_wxyz(torch.cat([half_angle.cos()[:, None], half_angle.sin()[:, None] * axis], -1))
    centres = world_from_cam[:, :3, 3]
    baseline = torch.pdist(centres.double()).mean().float() if views > 1 else centres.new_zeros(())
    step = torch.randn(views, 3, generator=generator) * (baseline_fraction * baseline / 3**0.5)
    moved = rigid_from_parts(world_from_cam[:, :3, :3] @ turn.to(world_from_cam), centres + step.to(centres))
    return torch.cat([world_from_cam[:1], moved[1:]])
