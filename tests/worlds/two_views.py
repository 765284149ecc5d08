"""A photo and a generated picture, each with a depth map and one Gaussian per pixel: what corrections of a scene are tried on."""

from __future__ import annotations

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.models.pixel_aligned import pixel_aligned

INTRINSICS = torch.tensor([[40.0, 0, 20], [0, 40, 16], [0, 0, 1]])
HEIGHT, WIDTH = 32, 40


def photo_and_generated(
    images: torch.Tensor,
    depths: torch.Tensor,
    poses: torch.Tensor,
    *,
    normals: torch.Tensor | None = None,
    posed: tuple[bool, bool] = (True, True),
) -> Reconstruction:
    """What a model that is sure of these depths makes: the photo first, then the generated view; ``posed``: which have a camera."""
    generated = torch.tensor([False, True])
    intrinsics, confidence = INTRINSICS.repeat(2, 1, 1), torch.full_like(depths, 10.0)
    gaussians = pixel_aligned(
        images=images,
        depth=depths,
        depth_conf=confidence,
        cameras=Cameras(poses, intrinsics, HEIGHT, WIDTH),
        normals=normals,
        generated=generated,
    )
    return Reconstruction(
        method="m",
        model="m",
        weights_sha256="0",
        view_ids=("a", "b"),
        generated=generated,
        posed=torch.tensor(posed),
        camera_vector=torch.zeros(2, 9),
        world_from_cam=poses,
        intrinsics_px=intrinsics,
        depth=depths,
        depth_conf=confidence,
        normals=torch.zeros(2, HEIGHT, WIDTH, 3) if normals is None else normals,
        normals_conf=confidence,
        gaussians=gaussians,
    )
