"""A very small but honest reconstructor for tests of what surrounds one: differentiable, deterministic, views influence each other."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sceneexpander.geometry.camera import pose_from_camera_vector, unproject_to_world
from sceneexpander.geometry.gaussians import Gaussians, sh_from_rgb
from sceneexpander.geometry.priors import Priors
from sceneexpander.models.protocol import ALL_HEADS, Head, Prediction


class TinyReconstructor(nn.Module):
    """Convolutions per view plus the mean over views; counts how often each head ran."""

    name = "tiny"
    size_multiple = 2
    requires_priors = False

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.stem = nn.Conv2d(3, 8, 3, padding=1)
        self.depth_head = nn.Conv2d(8, 2, 1)
        self.normals_head = nn.Conv2d(8, 4, 1)
        self.camera_head = nn.Linear(8, 9)
        self.gaussian_head = nn.Conv2d(8, 1, 1)
        self.view_token = nn.Parameter(torch.zeros(2, 8))
        with torch.no_grad():
            for parameter in self.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.2)
        self.runs: dict[str, int] = {head.value: 0 for head in Head}

    def predict(
        self,
        images: Tensor,
        priors: Priors | None = None,
        *,
        heads: frozenset[Head] = ALL_HEADS,
        generated: Tensor | None = None,
    ) -> Prediction:
        views, _, height, width = images.shape
        for head in heads:
            self.runs[head.value] += 1
        token = torch.cat([self.view_token[:1], self.view_token[1:].expand(views - 1, 8)])
        features = torch.tanh(self.stem(images) + token[:, :, None, None])
        features = features + features.mean((0, 2, 3), keepdim=True)
        base = torch.tensor([0, 0, 0, 0, 0, 0, 1.0, 0.9, 0.9])
        camera = base + 0.1 * self.camera_head(features.mean((2, 3)))
        pose, intrinsics = pose_from_camera_vector(camera, height, width)
        raw = self.depth_head(features)
        depth = (raw[:, 0] * 0.3).exp()
        normals = self.normals_head(features)
        unit = nn.functional.normalize(normals[:, :3].movedim(1, -1) + torch.tensor([0, 0, -1.0]), dim=-1)
        gaussians = None
        if Head.GAUSSIANS in heads:
            count = views * height * width
            flags = torch.zeros(views, dtype=torch.bool) if generated is None else generated
            gaussians = Gaussians(
                means=unproject_to_world(depth, intrinsics, pose).reshape(count, 3),
                quat_wxyz=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
                scales=(depth / intrinsics[:, 0, 0, None, None] * 0.6).reshape(count, 1).expand(count, 3),
                opacities=torch.sigmoid(self.gaussian_head(features) + 2).reshape(count),
                sh=sh_from_rgb(images.movedim(1, -1).reshape(count, 1, 3)),
                source_view=torch.arange(views).repeat_interleave(height * width),
                generated=flags.repeat_interleave(height * width),
            )
        return Prediction(
            camera_vector=camera,
            world_from_cam=pose,
            intrinsics_px=intrinsics,
            depth=depth if Head.DEPTH in heads else None,
            depth_conf=1 + raw[:, 1].exp() if Head.DEPTH in heads else None,
            normals=unit if Head.NORMALS in heads else None,
            normals_conf=1 + normals[:, 3].exp() if Head.NORMALS in heads else None,
            gaussian_depth=depth if gaussians is not None else None,
            gaussians=gaussians,
        )


def tiny_images(views: int, height: int = 12, width: int = 16, seed: int = 1) -> Tensor:
    """Smooth random pictures."""
    coarse = torch.rand(views, 3, 4, 4, generator=torch.Generator().manual_seed(seed))
    return nn.functional.interpolate(coarse, size=(height, width), mode="bilinear", align_corners=True)
