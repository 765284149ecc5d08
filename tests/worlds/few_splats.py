"""A handful of splats."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.optimisation.config import DensityConfig, RatesConfig
from sceneexpander.optimisation.density import Seen
from sceneexpander.optimisation.splats import Splats
from tests.worlds.random_gaussians import random_gaussians


def splats_of(gaussians: Gaussians, sh_degree: int = 1) -> Splats:
    return Splats.of(gaussians, RatesConfig(), extent=1.0, sh_degree=sh_degree)


def moved(splats: Splats) -> None:
    """One optimiser step on an arbitrary loss, so that every row has momentum of its own."""
    total = torch.zeros(())
    for name in splats.optimisers:
        value = splats.params[name]
        total = total + (value * torch.arange(1, len(value) + 1).reshape(-1, *[1] * (value.ndim - 1))).sum()
    total.backward()
    splats.step()


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def seen(pull: Tensor, visible: Tensor | None = None) -> Seen:
    """Pulls given in half images; the image is 20 x 20 pixels."""
    gradient = torch.stack([pull / 10, torch.zeros_like(pull)], -1)
    radius = torch.ones_like(pull) if visible is None else visible
    return Seen(centre_gradient=gradient, radius_px=radius, height=20, width=20)


CONFIG = DensityConfig(start=0.0, stop=1.0, every=1, gradient=0.1, split_above=0.1, min_opacity=0.1)


def five() -> Gaussians:
    """Pulled small, pulled large, calm, nearly transparent, and pulled small but never seen."""
    gaussians = random_gaussians(5)
    return replace(
        gaussians,
        scales=torch.tensor([0.05, 0.5, 0.05, 0.05, 0.05])[:, None].expand(5, 3).clone(),
        opacities=torch.tensor([0.8, 0.8, 0.8, 0.05, 0.8]),
        source_view=torch.arange(5),
        generated=torch.tensor([True, True, False, False, False]),
    )
