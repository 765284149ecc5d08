"""A WorldMirror of a few hundred thousand parameters with sizeable random values everywhere."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sceneexpander.models.layers.dpt import DptConfig
from sceneexpander.models.worldmirror import WorldMirror, WorldMirrorConfig
from sceneexpander.models.worldmirror.config import GaussianConfig

TINY = WorldMirrorConfig(
    image_size=42,
    dim=32,
    encoder_depth=1,
    encoder_heads=2,
    trunk_depth=4,
    trunk_heads=2,
    collect=(0, 1, 2, 3),
    camera_depth=1,
    camera_heads=4,
    dpt=DptConfig(features=16, out_channels=(8, 8, 8, 8), hidden=8),
    gaussian_dpt=DptConfig(features=16, out_channels=(8, 8, 8, 8), hidden=8),
    gaussian=GaussianConfig(hidden=8, voxel_size=0.05),
)


def tiny_worldmirror(
    seed: int = 0, config: WorldMirrorConfig = TINY, *, checkpoint_activations: bool = False
) -> WorldMirror:
    """A tiny model whose tokens and gains are not the near-zero values of a fresh one, so that every part matters."""
    generator = torch.Generator().manual_seed(seed)
    model = WorldMirror.create(config, generator=generator, checkpoint_activations=checkpoint_activations)
    make_sizeable(model, generator=generator)
    return model


@torch.no_grad()
def make_sizeable(model: nn.Module, *, generator: torch.Generator) -> None:
    """Enlarge what is nearly zero in a fresh model: otherwise the residual stream hardly notices its blocks."""
    for name, parameter in model.named_parameters():
        if name.endswith("gamma") or "token" in name or "pos_embed" in name:
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator))
        elif name.endswith(("qkv.weight", "fc2.weight", "proj.weight")):
            parameter.mul_(4)


def random_images(views: int, height: int = 28, width: int = 42, seed: int = 1) -> Tensor:
    """RGB noise in [0, 1]."""
    return torch.rand(views, 3, height, width, generator=torch.Generator().manual_seed(seed))
