"""Small scenes for the splatting tests."""

from __future__ import annotations

import torch
from torch import Tensor

from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.rigid import look_at


def random_gaussians(
    count: int, *, seed: int = 0, sh_coefficients: int = 4, dtype: torch.dtype = torch.float32
) -> Gaussians:
    """A cloud around the origin, two units across, with anisotropic Gaussians and un-normalised quaternions."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    return Gaussians(
        means=(0.6 * normal(count, 3)).to(dtype),
        quat_wxyz=(normal(count, 4) * 2).to(dtype),
        scales=torch.exp(0.6 * normal(count, 3) - 2.5).to(dtype),
        opacities=torch.sigmoid(normal(count)).to(dtype),
        sh=(0.4 * normal(count, sh_coefficients, 3)).to(dtype),
        source_view=torch.arange(count) % 3,
        generated=torch.arange(count) % 3 == 2,
    )


def cameras(views: int = 2, *, dtype: torch.dtype = torch.float32) -> Tensor:
    """``world_from_cam`` of cameras that look at the origin from four units away, none along an axis."""
    angle = torch.linspace(0.3, 1.4, views, dtype=torch.float64)
    eye = 4 * torch.stack([torch.sin(angle), -0.3 + 0 * angle, -torch.cos(angle)], -1)
    pose = look_at(eye, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    return pose.to(dtype)


def intrinsics(views: int, height: int, width: int, *, dtype: torch.dtype = torch.float32) -> Tensor:
    """fx != fy and a principal point off centre."""
    k = torch.tensor([[1.1 * width, 0, 0.47 * width], [0, 1.05 * width, 0.55 * height], [0, 0, 1]], dtype=dtype)
    return k.expand(views, 3, 3)
