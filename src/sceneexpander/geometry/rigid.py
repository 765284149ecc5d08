"""Rigid transforms and rotations.

A transform ``a_from_b`` maps points expressed in frame b to frame a: ``x_a = a_from_b @ x_b`` (4x4, last row 0 0 0 1).
Adjacent names cancel: ``a_from_c = a_from_b @ b_from_c``. Quaternions are scalar-first (``quat_wxyz``) unless a name says otherwise.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def rigid_inverse(a_from_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """``b_from_a`` of a rigid (rotation + translation) transform, without a general matrix inverse."""
    rotation_t = a_from_b[..., :3, :3].transpose(-1, -2)
    translation = -(rotation_t @ a_from_b[..., :3, 3:])
    return rigid_from_parts(rotation_t, translation[..., 0])


def rigid_from_parts(
    rotation: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Assemble a 4x4 transform from its rotation and translation."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def rigid_from_twist(twist: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
    """The rigid motion that a twist (turn in radians about x, y, z, then shift) generates: the exponential of se(3)."""
    x, y, z, a, b, c = twist.unbind()
    zero = torch.zeros_like(x)
    generator = torch.stack(
        [
            torch.stack([zero, -z, y, a]),
            torch.stack([z, zero, -x, b]),
            torch.stack([-y, x, zero, c]),
            torch.stack([zero, zero, zero, zero]),
        ]
    )
    return torch.linalg.matrix_exp(generator)


def transform_points(
    a_from_b: Float[Tensor, "*batch 4 4"], points_b: Float[Tensor, "*batch point 3"]
) -> Float[Tensor, "*batch point 3"]:
    """Express points given in frame b in frame a."""
    return points_b @ a_from_b[..., :3, :3].transpose(-1, -2) + a_from_b[..., None, :3, 3]


def rotation_from_quat_wxyz(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a quaternion of any non-zero length (scalar first)."""
    w, x, y, z = quat_wxyz.unbind(-1)
    s = 2.0 / (quat_wxyz * quat_wxyz).sum(-1)
    rows = [
        torch.stack([1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)], -1),
        torch.stack([s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)], -1),
        torch.stack([s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def quat_wxyz_from_rotation(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion (scalar first, w >= 0) of a rotation matrix; differentiable, stable for every angle."""
    m = rotation
    trace = torch.stack(
        [
            1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2],
            1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
        ],
        -1,
    )
    yz, zx, xy = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    sxy, sxz, syz = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = torch.stack(
        [
            torch.stack([trace[..., 0], yz, zx, xy], -1),
            torch.stack([yz, trace[..., 1], sxy, sxz], -1),
            torch.stack([zx, sxy, trace[..., 2], syz], -1),
            torch.stack([xy, sxz, syz, trace[..., 3]], -1),
        ],
        -2,
    )
    # The candidate with the largest trace term never divides by a small number.
    best = trace.argmax(-1)
    quat = torch.take_along_dim(candidates, best[..., None, None].expand(*best.shape, 1, 4), dim=-2)[..., 0, :]
    quat = torch.nn.functional.normalize(quat, dim=-1)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def rotation_angle_deg(
    rotation_a: Float[Tensor, "*batch 3 3"], rotation_b: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch"]:
    """Geodesic angle between two rotations, in degrees; accurate near 0 and near 180."""
    relative = rotation_a.transpose(-1, -2) @ rotation_b
    quat = quat_wxyz_from_rotation(relative)
    # atan2, not acos: acos has an infinite slope where the two rotations nearly agree.
    return torch.rad2deg(2 * torch.atan2(quat[..., 1:].norm(dim=-1), quat[..., 0].abs()))


def slerp_wxyz(
    quat_a: Float[Tensor, "*batch 4"], quat_b: Float[Tensor, "*batch 4"], fraction: Float[Tensor, "*batch"] | float
) -> Float[Tensor, "*batch 4"]:
    """Spherical interpolation between unit quaternions along the shorter arc; ``fraction`` 0 gives a, 1 gives b."""
    t = torch.as_tensor(fraction, dtype=quat_a.dtype, device=quat_a.device)
    dot = (quat_a * quat_b).sum(-1)
    quat_b = torch.where(dot[..., None] < 0, -quat_b, quat_b)
    angle = torch.acos(dot.abs().clamp(max=1.0))
    sine = torch.sin(angle)
    near = sine < 1e-6
    safe = torch.where(near, torch.ones_like(sine), sine)
    weight_a = torch.where(near, 1 - t, torch.sin((1 - t) * angle) / safe)
    weight_b = torch.where(near, t, torch.sin(t * angle) / safe)
    return torch.nn.functional.normalize(weight_a[..., None] * quat_a + weight_b[..., None] * quat_b, dim=-1)


def look_at(
    eye: Float[Tensor, "*#batch 3"], target: Float[Tensor, "*#batch 3"], up: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """``world_from_cam`` (OpenCV axes) of a camera at ``eye`` that looks at ``target``; ``up`` points up in the world."""
    forward = torch.nn.functional.normalize(target - eye, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=-1)
    down = torch.linalg.cross(forward, right)
    return rigid_from_parts(torch.stack([right, down, forward], dim=-1), eye)
