"""An OmniVGGT of a few hundred thousand parameters with sizeable random values everywhere."""

from __future__ import annotations

from dataclasses import fields

import torch

from sceneexpander.models.omnivggt import OmniVGGT, OmniVGGTConfig
from tests.support.tiny_worldmirror import TINY as WORLDMIRROR
from tests.support.tiny_worldmirror import make_sizeable

TINY = OmniVGGTConfig(**{field.name: getattr(WORLDMIRROR, field.name) for field in fields(OmniVGGTConfig)})


def tiny_omnivggt(seed: int = 0, *, checkpoint_activations: bool = False) -> OmniVGGT:
    """A tiny model in which every prior has an effect, unlike in a fresh one."""
    generator = torch.Generator().manual_seed(seed)
    model = OmniVGGT.create(TINY, generator=generator, checkpoint_activations=checkpoint_activations)
    make_sizeable(model, generator=generator)
    with torch.no_grad():
        for parameter in (*model.aggregator.camera_adapters.parameters(), model.aggregator.depth_placeholder):
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=generator))
    return model
