"""Normals of a depth map, and keeping any normal on the camera's side of its surface."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from sceneexpander.geometry.camera import pixel_centres


def viewing_rays(
    intrinsics_px: Float[Tensor, "view 3 3"], height: int, width: int
) -> Float[Tensor, "view height width 3"]:
    """Camera-frame rays (x/z, y/z, 1) through the pixel centres."""
    uv = pixel_centres(height, width, like=intrinsics_px)
    x = (uv[..., 0] - intrinsics_px[:, None, None, 0, 2]) / intrinsics_px[:, None, None, 0, 0]
    y = (uv[..., 1] - intrinsics_px[:, None, None, 1, 2]) / intrinsics_px[:, None, None, 1, 1]
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def normals_from_depth(
    depth: Float[Tensor, "view height width"],
    intrinsics_px: Float[Tensor, "view 3 3"],
    *,
    smoothing: int = 1,
) -> Float[Tensor, "view height width 3"]:
    """Unit normals (camera frame, facing the camera) by the cross product of central differences of the points.

    Args:
        depth: z-depth, > 0.
        intrinsics_px: pinhole intrinsics at the map's resolution.
        smoothing: how many times the unit normals are averaged over 3 x 3 pixels.
    """
    rays = viewing_rays(intrinsics_px, *depth.shape[-2:])
    points = rays.movedim(-1, 1).contiguous() * depth[:, None]
    padded = functional.pad(points, (1, 1, 1, 1), mode="replicate")
    along_x = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]
    along_y = padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    # x right, y down, z forward: y cross x points back to the camera.
    normal = functional.normalize(torch.linalg.cross(along_y, along_x, dim=1), dim=1, eps=1e-20)
    for _ in range(smoothing):
        normal = functional.avg_pool2d(functional.pad(normal, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    return face_camera(normal.movedim(1, -1), rays)


def face_camera(
    normals: Float[Tensor, "view height width 3"], rays: Float[Tensor, "view height width 3"]
) -> Float[Tensor, "view height width 3"]:
    """Unit normals with n . ray <= 0: those that look away are mirrored at the plane across the ray."""
    # Components apart: reductions over a last axis of three are slow on CPUs.
    x, y, z = normals.unbind(-1)
    ray_x, ray_y, ray_z = rays.unbind(-1)
    mirror = 2 * (x * ray_x + y * ray_y + z * ray_z).clamp(min=0) / (ray_x.square() + ray_y.square() + ray_z.square())
    # The tiny pull towards the camera gives a zero vector a direction.
    x, y, z = (c - (mirror + 1e-6) * ray for c, ray in ((x, ray_x), (y, ray_y), (z, ray_z)))
    length = (x.square() + y.square() + z.square()).sqrt()
    return torch.stack([x / length, y / length, z / length], dim=-1)
