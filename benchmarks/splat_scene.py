"""Made scenes of pixel-aligned Gaussians, as a feed-forward reconstruction of two views gives them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sceneexpander.geometry.rigid import look_at, rigid_inverse

SCENES = {
    "S": (256, 192, 256, 192),
    "M": (448, 336, 512, 384),
    "T": (96, 72, 96, 72),
}  # source, target width and height
FOV_RAD = math.radians(60)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Tensors in gsplat's conventions, one view."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colours: Tensor
    viewmat: Tensor
    intrinsics: Tensor
    width: int
    height: int
    target: Tensor

    def leaves(self) -> list[Tensor]:
        """Fresh leaf tensors that ask for gradients; of the same memory, as whoever is timed should not be timed copying."""
        return [
            t.detach().requires_grad_() for t in (self.means, self.quats, self.scales, self.opacities, self.colours)
        ]


def _intrinsics(width: int, height: int) -> Tensor:
    focal = width / 2 / math.tan(FOV_RAD / 2)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def make_scene(name: str) -> Scene:
    """One Gaussian per source pixel: sigma 0.8 pixel with log-normal spread 0.25, opacity sigmoid(N(0.8, 1.2))."""
    source_w, source_h, width, height = SCENES[name]
    generator = torch.Generator().manual_seed(5)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator)

    k = _intrinsics(source_w, source_h)
    v, u = torch.meshgrid(torch.arange(source_h) + 0.5, torch.arange(source_w) + 0.5, indexing="ij")
    rays = torch.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)], -1).reshape(-1, 3)
    up, target = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([0.0, 0.0, 4.0])
    means, pixel = [], []
    for x in (-0.4, 0.4):
        pose = look_at(torch.tensor([x, 0.0, 0.0]), target, up)
        directions = rays @ pose[:3, :3].T
        wall = (4.0 - pose[2, 3]) / directions[:, 2]
        at = pose[:3, 3] + directions * wall[:, None]
        depth = wall * (1 + 0.06 * torch.sin(2.5 * at[:, 0]) * torch.cos(3.1 * at[:, 1]))
        disc = (2.2 - pose[2, 3]) / directions[:, 2]
        hit = (pose[:3, 3] + directions * disc[:, None])[:, :2].norm(dim=-1) < 0.45
        depth = torch.where(hit, disc, depth)
        means.append(pose[:3, 3] + directions * depth[:, None])
        pixel.append(depth / k[0, 0])
    points, size = torch.cat(means), torch.cat(pixel)
    count = len(points)
    viewmat = rigid_inverse(look_at(torch.tensor([0.1, -0.1, -0.05]), target, up))
    return Scene(
        means=points,
        quats=normal(count, 4),
        scales=0.8 * size[:, None] * torch.exp(0.25 * normal(count, 3)),
        opacities=torch.sigmoid(0.8 + 1.2 * normal(count)),
        colours=torch.rand(count, 3, generator=generator),
        viewmat=viewmat,
        intrinsics=_intrinsics(width, height),
        width=width,
        height=height,
        target=torch.rand(height, width, 3, generator=generator),
    )
