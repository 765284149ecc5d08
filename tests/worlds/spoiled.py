"""A scene and what it looks like spoiled."""

from __future__ import annotations

from dataclasses import replace

import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from tests.worlds.wall import made_reconstruction, own_pictures

TRUTH = made_reconstruction()


VIEWS = own_pictures(TRUTH)


def spoiled() -> Reconstruction:
    """Grey Gaussians, too small, somewhat out of place."""
    gaussians, generator = TRUTH.gaussians, torch.Generator().manual_seed(0)
    means = gaussians.means + 0.02 * torch.randn(gaussians.means.shape, generator=generator)
    return replace(TRUTH, gaussians=replace(gaussians, means=means, scales=0.6 * gaussians.scales, sh=0 * gaussians.sh))
