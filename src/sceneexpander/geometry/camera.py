"""Pinhole cameras.

OpenCV axes (x right, y down, z forward). Pixel coordinates have their origin at the top-left corner of the top-left pixel, so
the first pixel centre is (0.5, 0.5). Intrinsics are in pixels of the stored image. Depth is z-depth.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.rigid import (
    quat_wxyz_from_rotation,
    rigid_from_parts,
    rigid_inverse,
    rotation_from_quat_wxyz,
    transform_points,
)


def pixel_centres(height: int, width: int, *, like: Tensor) -> Float[Tensor, "height width 2"]:
    """(x, y) of every pixel centre: the first is (0.5, 0.5). Dtype and device follow ``like``."""
    y = torch.arange(height, dtype=like.dtype, device=like.device) + 0.5
    x = torch.arange(width, dtype=like.dtype, device=like.device) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def intrinsics_from_fov(
    fov_x_rad: Float[Tensor, "*batch"], fov_y_rad: Float[Tensor, "*batch"], height: int, width: int
) -> Float[Tensor, "*batch 3 3"]:
    """Intrinsics (pixels) with the principal point at the image centre, from full fields of view in radians."""
    fx = (width / 2) / torch.tan(fov_x_rad / 2)
    fy = (height / 2) / torch.tan(fov_y_rad / 2)
    return intrinsics_from_parts(fx, fy, torch.full_like(fx, width / 2), torch.full_like(fy, height / 2))


def intrinsics_from_parts(
    fx: Float[Tensor, "*batch"], fy: Float[Tensor, "*batch"], cx: Float[Tensor, "*batch"], cy: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3 3"]:
    """[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels."""
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack(
        [torch.stack([fx, zero, cx], -1), torch.stack([zero, fy, cy], -1), torch.stack([zero, zero, one], -1)], -2
    )


def fov_rad_from_intrinsics(
    intrinsics_px: Float[Tensor, "*batch 3 3"], height: int, width: int
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Full (horizontal, vertical) fields of view in radians, as if the principal point were central."""
    fov_x = 2 * torch.atan((width / 2) / intrinsics_px[..., 0, 0])
    fov_y = 2 * torch.atan((height / 2) / intrinsics_px[..., 1, 1])
    return fov_x, fov_y


def resize_intrinsics(
    intrinsics_px: Float[Tensor, "*batch 3 3"], scale_x: float, scale_y: float
) -> Float[Tensor, "*batch 3 3"]:
    """Intrinsics after resizing the image by the given factors (corner-origin pixels, so no half-pixel terms)."""
    scale = intrinsics_px.new_tensor([scale_x, scale_y, 1.0])
    return intrinsics_px * scale[:, None]


def camera_vector_from_pose(
    world_from_cam: Float[Tensor, "*batch 4 4"], intrinsics_px: Float[Tensor, "*batch 3 3"], height: int, width: int
) -> Float[Tensor, "*batch 9"]:
    """The 9-vector (cam_from_world translation, quaternion **xyzw** with w >= 0, vertical fov, horizontal fov; radians).

    This is the camera parametrisation that WorldMirror regresses; every reconstructor here speaks it.
    """
    cam_from_world = rigid_inverse(world_from_cam)
    quat_wxyz = quat_wxyz_from_rotation(cam_from_world[..., :3, :3])
    fov_x, fov_y = fov_rad_from_intrinsics(intrinsics_px, height, width)
    quat_xyzw = torch.roll(quat_wxyz, -1, dims=-1)
    return torch.cat([cam_from_world[..., :3, 3], quat_xyzw, fov_y[..., None], fov_x[..., None]], dim=-1)


def pose_from_camera_vector(
    camera_vector: Float[Tensor, "*batch 9"], height: int, width: int
) -> tuple[Float[Tensor, "*batch 4 4"], Float[Tensor, "*batch 3 3"]]:
    """Inverse of `camera_vector_from_pose`: (world_from_cam, intrinsics_px). The quaternion need not be unit."""
    quat_wxyz = torch.roll(camera_vector[..., 3:7], 1, dims=-1)
    cam_from_world = rigid_from_parts(rotation_from_quat_wxyz(quat_wxyz), camera_vector[..., :3])
    intrinsics = intrinsics_from_fov(camera_vector[..., 8], camera_vector[..., 7], height, width)
    return rigid_inverse(cam_from_world), intrinsics


def unproject_depth(
    depth: Float[Tensor, "*batch height width"], intrinsics_px: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch height width 3"]:
    """Camera-frame points of a z-depth map, at pixel centres."""
    height, width = depth.shape[-2:]
    uv = pixel_centres(height, width, like=depth)
    fx, fy = intrinsics_px[..., 0, 0], intrinsics_px[..., 1, 1]
    cx, cy = intrinsics_px[..., 0, 2], intrinsics_px[..., 1, 2]
    x = (uv[..., 0] - cx[..., None, None]) / fx[..., None, None] * depth
    y = (uv[..., 1] - cy[..., None, None]) / fy[..., None, None] * depth
    return torch.stack([x, y, depth], dim=-1)


def unproject_to_world(
    depth: Float[Tensor, "*batch height width"],
    intrinsics_px: Float[Tensor, "*batch 3 3"],
    world_from_cam: Float[Tensor, "*batch 4 4"],
) -> Float[Tensor, "*batch height width 3"]:
    """World-frame points of a z-depth map, at pixel centres."""
    points_cam = unproject_depth(depth, intrinsics_px)
    flat = points_cam.flatten(-3, -2)
    return transform_points(world_from_cam, flat).reshape(points_cam.shape)


def project_points(
    points_world: Float[Tensor, "*batch point 3"],
    intrinsics_px: Float[Tensor, "*batch 3 3"],
    world_from_cam: Float[Tensor, "*batch 4 4"],
    *,
    min_depth: float = 1e-6,
) -> tuple[Float[Tensor, "*batch point 2"], Float[Tensor, "*batch point"]]:
    """(pixel coordinates, z-depth) of world points. Points with z <= ``min_depth`` get coordinates at that depth: mask by z."""
    points_cam = transform_points(rigid_inverse(world_from_cam), points_world)
    depth = points_cam[..., 2]
    homogeneous = points_cam @ intrinsics_px.transpose(-1, -2)
    return homogeneous[..., :2] / depth.clamp(min=min_depth)[..., None], depth
