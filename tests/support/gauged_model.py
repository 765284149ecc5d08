"""A reconstructor with a gauge, as real ones have: its world is its first view's camera, its scale follows what it is told and sees."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sceneexpander.geometry.camera import camera_vector_from_pose, pose_from_camera_vector, unproject_to_world
from sceneexpander.geometry.gauge import poses_relative_to
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.normals import normals_from_depth
from sceneexpander.geometry.priors import Priors
from sceneexpander.models.protocol import ALL_HEADS, Head, Prediction


class GaugedReconstructor(nn.Module):
    """Returns its priors in the frame of the first view given; all lengths times a factor that the first picture decides."""

    name = "gauged"
    size_multiple = 2
    requires_priors = True

    def __init__(self) -> None:
        super().__init__()
        self.log_depth = nn.Parameter(torch.zeros(()))
        self.tilt = nn.Parameter(torch.zeros(3))
        self.shift = nn.Parameter(torch.zeros(9))

    def predict(
        self,
        images: Tensor,
        priors: Priors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Tensor | None = None,
    ) -> Prediction:
        if priors is None or priors.world_from_cam is None or priors.depth is None or priors.intrinsics_px is None:
            raise ValueError("gauged needs priors")
        views, _, height, width = images.shape
        scale = 0.5 + images[0].mean()
        poses = poses_relative_to(priors.world_from_cam, 0)
        poses = torch.cat([poses[:, :, :3], poses[:, :, 3:] * torch.tensor([1.0, 1, 1, 0])[:, None] * scale], dim=2)
        poses[:, 3, 3] = 1.0
        vector = camera_vector_from_pose(poses, priors.intrinsics_px, height, width) + self.shift
        pose, intrinsics = pose_from_camera_vector(vector, height, width)
        depth = priors.depth * scale * self.log_depth.exp()
        normals = nn.functional.normalize(normals_from_depth(priors.depth, priors.intrinsics_px) + self.tilt, dim=-1)
        gaussians = None
        if Head.GAUSSIANS in heads:
            count = views * height * width
            flags = torch.zeros(views, dtype=torch.bool) if generated is None else generated
            gaussians = Gaussians(
                means=unproject_to_world(depth, intrinsics, pose).reshape(count, 3),
                quat_wxyz=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
                scales=(depth / intrinsics[:, 0, 0, None, None] * 0.6).reshape(count, 1).expand(count, 3),
                opacities=torch.full((count,), 0.9),
                sh=sh_from_rgb(images.movedim(1, -1).reshape(count, 1, 3)),
                source_view=torch.arange(views).repeat_interleave(height * width),
                generated=flags.repeat_interleave(height * width),
            )
        return Prediction(
            camera_vector=vector,
            world_from_cam=pose,
            intrinsics_px=intrinsics,
            depth=depth,
            depth_conf=torch.full_like(depth, 2.0),
            normals=normals,
            normals_conf=torch.full_like(depth, 2.0),
            gaussian_depth=depth,
            gaussians=gaussians,
        )


def gauged_scene(views: int, height: int = 12, width: int = 16) -> tuple[Tensor, Priors]:
    """Pictures and priors of views of a bumpy wall; the first camera is the world."""
    draw = torch.Generator().manual_seed(3)
    images = torch.rand(views, 3, height, width, generator=draw)
    images = (
        images * torch.linspace(0.6, 1.0, views)[:, None, None, None]
    )  # first pictures of other means: other scales
    poses = torch.eye(4).repeat(views, 1, 1)
    angle = 0.15 * torch.arange(views)
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    poses[:, 0, 3] = -0.4 * torch.arange(views)
    intrinsics = torch.tensor([[14.0, 0, width / 2], [0, 14.0, height / 2], [0, 0, 1]]).repeat(views, 1, 1)
    depth = 2 + 0.3 * torch.rand(views, height, width, generator=draw)
    posed = torch.ones(views, dtype=torch.bool)
    return images, Priors(world_from_cam=poses, intrinsics_px=intrinsics, depth=depth, posed=posed)
