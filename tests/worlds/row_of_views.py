"""Reconstructions whose cameras stand in a row."""

from __future__ import annotations

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.camera import camera_vector_from_pose
from sceneexpander.geometry.gaussians import Gaussians

HEIGHT, WIDTH = 21, 28


def reconstruction(method: str, centres: list[float], *, scale: float = 1.0, generated: int = 0) -> Reconstruction:
    """Cameras on a line that look along +z at a wall of Gaussians; the last ``generated`` views are generated."""
    views = len(centres)
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, 0, 3] = scale * torch.tensor(centres)
    intrinsics = torch.tensor([[25.0, 0, WIDTH / 2], [0, 25.0, HEIGHT / 2], [0, 0, 1]]).repeat(views, 1, 1)
    is_generated = torch.arange(views) >= views - generated
    x, y = torch.meshgrid(torch.linspace(-2, 3, 40), torch.linspace(-1, 1, 16), indexing="xy")
    means = scale * torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), 2.0)], -1)
    count = len(means)
    gaussians = Gaussians(
        means=means,
        quat_wxyz=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.full((count, 3), 0.08 * scale),
        opacities=torch.full((count,), 0.9),
        sh=torch.zeros(count, 1, 3),
        source_view=torch.zeros(count, dtype=torch.int64),
        generated=means[:, 0] > 1.5 * scale,
    )
    return Reconstruction(
        method=method,
        model="mini",
        weights_sha256="0" * 64,
        view_ids=tuple(f"v{i}" for i in range(views)),
        generated=is_generated,
        posed=torch.ones(views, dtype=torch.bool),
        camera_vector=camera_vector_from_pose(poses, intrinsics, HEIGHT, WIDTH),
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=torch.full((views, HEIGHT, WIDTH), 2.0 * scale),
        depth_conf=torch.full((views, HEIGHT, WIDTH), 2.0),
        normals=torch.tensor([0.0, 0, -1]).expand(views, HEIGHT, WIDTH, 3).clone(),
        normals_conf=torch.full((views, HEIGHT, WIDTH), 2.0),
        gaussians=gaussians,
    )
