"""Changing the world frame and the scale of cameras, depths and priors together: scale everything or nothing."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import quat_wxyz_from_rotation, rigid_inverse, rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import align_views

_SAME_SCALE = 1e-6  # ratios nearer to 1 than this are rounding


def poses_relative_to(world_from_cam: Float[Tensor, "view 4 4"], reference: int) -> Float[Tensor, "view 4 4"]:
    """The same poses in the world frame that is the camera frame of view ``reference``."""
    return rigid_inverse(world_from_cam[reference]) @ world_from_cam


def camera_vectors_relative_to(camera_vector: Float[Tensor, "view 9"], reference: int) -> Float[Tensor, "view 9"]:
    """Camera 9-vectors (cam_from_world t, quaternion xyzw, fovs) re-expressed in the frame of view ``reference``.

    Quaternions come back with unit length; fields of view are untouched.
    """
    rotation = rotation_from_quat_wxyz(torch.roll(camera_vector[:, 3:7], 1, dims=-1))
    relative = rotation @ rotation[reference].transpose(-1, -2)
    # x_cam = R x_world + t and x_world = R_r^T (x_ref - t_r):  t' = t - R R_r^T t_r
    translation = camera_vector[:, :3] - (relative @ camera_vector[reference, :3])
    quat_xyzw = torch.roll(quat_wxyz_from_rotation(relative), -1, dims=-1)
    return torch.cat([translation, quat_xyzw, camera_vector[:, 7:]], dim=-1)


def scale_camera_vectors(camera_vector: Float[Tensor, "view 9"], scale: float | Tensor) -> Float[Tensor, "view 9"]:
    """Camera 9-vectors after multiplying all lengths by ``scale``."""
    return torch.cat([camera_vector[:, :3] * scale, camera_vector[:, 3:]], dim=-1)


def priors_relative_to(priors: Priors, reference: int) -> Priors:
    """Priors in the frame of view ``reference``; the scale is unchanged."""
    if priors.world_from_cam is None:
        return priors
    return replace(priors, world_from_cam=poses_relative_to(priors.world_from_cam, reference))


def posed_in_both(first: Priors, second: Priors, count: int) -> Bool[Tensor, "view"]:
    """Which of the first ``count`` views have an estimated camera in both; those that do not say are taken to."""
    both = torch.ones(count, dtype=torch.bool)
    for posed in (first.posed, second.posed):
        if posed is not None:
            both = both.to(posed.device) & posed[:count]
    return both


def in_gauge_of(reference: Priors, priors: Priors) -> Priors:
    """``priors`` in the frame and the scale of ``reference``, which describes the first of the same views.

    The scale is the median ratio of depths, for poses and depths together. Both frames are the first view's camera; only where that
    one is a placeholder on either side do the frames differ, and are aligned on the other views' cameras. Placeholders take no part
    and are replaced by what ``reference`` has for the view. Without poses or depths on either side nothing is to be compared, and
    ``priors`` itself is returned; so it is if it has that gauge already.
    """
    poses, depth, target, target_depth = (
        priors.world_from_cam,
        priors.depth,
        reference.world_from_cam,
        reference.depth,
    )
    if poses is None or depth is None or target is None or target_depth is None:
        return priors
    count = len(target)
    both = posed_in_both(reference, priors, count)
    found = align_views(poses[:count], depth[:count], target, target_depth, posed=both)
    if bool(both[0]):
        if abs(found.scale - 1) < _SAME_SCALE:
            return priors
        moved = poses.clone()
        moved[:, :3, 3] *= found.scale
    else:
        moved = found.poses(poses)
    if priors.posed is not None:
        moved[:count] = torch.where(priors.posed[:count, None, None], moved[:count], target)
    return replace(priors, world_from_cam=moved, depth=depth * found.scale)
