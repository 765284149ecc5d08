"""Changing the world frame and the scale of cameras, depths and priors together: scale everything or nothing."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import quat_wxyz_from_rotation, rigid_inverse, rotation_from_quat_wxyz


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
