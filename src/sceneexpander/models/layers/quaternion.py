"""Rotation matrix -> quaternion exactly as the released prior encoders do it (worldmirror spec 5.1, omnivggt spec 4.1)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.camera import fov_rad_from_intrinsics


def raw_camera_vector(
    cam_from_world: Float[Tensor, "*batch 4 4"], intrinsics_px: Float[Tensor, "*batch 3 3"], height: int, width: int
) -> Float[Tensor, "*batch 9"]:
    """``[t, quat xyzw with w >= 0, vertical fov, horizontal fov]`` as the networks read it: quaternion not normalised."""
    fov_x, fov_y = fov_rad_from_intrinsics(intrinsics_px, height, width)
    quaternion = quat_xyzw_from_matrix(cam_from_world[..., :3, :3])
    return torch.cat([cam_from_world[..., :3, 3], quaternion, fov_y[..., None], fov_x[..., None]], dim=-1)


def quat_xyzw_from_matrix(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Scalar-last quaternion with w >= 0, **not** normalised: for a matrix that is not quite a rotation its length differs from 1.

    `sceneexpander.geometry.rigid.quat_wxyz_from_rotation` normalises; the networks were trained without.
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    squares = torch.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1)
    roots = squares.clamp(min=0).sqrt()
    candidates = torch.stack(
        [
            torch.stack([roots[..., 0] ** 2, m21 - m12, m02 - m20, m10 - m01], -1),
            torch.stack([m21 - m12, roots[..., 1] ** 2, m10 + m01, m02 + m20], -1),
            torch.stack([m02 - m20, m10 + m01, roots[..., 2] ** 2, m12 + m21], -1),
            torch.stack([m10 - m01, m20 + m02, m21 + m12, roots[..., 3] ** 2], -1),
        ],
        -2,
    )
    best = roots.argmax(-1, keepdim=True)
    rows = torch.take_along_dim(candidates, best[..., None].expand(*best.shape, 4), dim=-2)[..., 0, :]
    quat_wxyz = rows / (2 * torch.take_along_dim(roots, best, dim=-1).clamp(min=0.1))
    quat_wxyz = torch.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    return torch.roll(quat_wxyz, -1, dims=-1)
