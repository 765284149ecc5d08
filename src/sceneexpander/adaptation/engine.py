"""How the steps of an adaptation are computed: memory against time, never other numbers."""

from __future__ import annotations

import torch

from sceneexpander.adaptation.config import AdaptConfig, Precision
from sceneexpander.errors import UserError
from sceneexpander.models.layers.block import Block
from sceneexpander.models.protocol import Reconstructor, SavesMemory, as_module


def set_up(model: Reconstructor, config: AdaptConfig) -> None:
    """Make a model compute as ``config.engine`` says.

    Raises:
        UserError: the model has no such option.
    """
    engine = config.engine
    if isinstance(model, SavesMemory):
        model.save_memory(checkpoint_activations=engine.checkpoint_activations, views_per_chunk=engine.views_per_chunk)
    elif engine.checkpoint_activations or engine.views_per_chunk:
        raise UserError(
            f"{model.name} can neither recompute activations nor work in chunks of views",
            where="adapt.engine",
            fix="set checkpoint_activations: false and views_per_chunk: 0",
        )
    if engine.compile:
        for module in as_module(model).modules():
            if isinstance(module, Block):
                # The number of views changes from step to step: shapes are symbols, or every count would compile anew.
                module.compile(dynamic=True)


def autocast(config: AdaptConfig, device: torch.device) -> torch.autocast:
    """The precision of a forward pass. Masters stay in float32.

    Low-precision copies of the weights are kept for the whole pass only where they are needed for the backward anyway.
    """
    return torch.autocast(
        device.type,
        dtype=torch.bfloat16,
        enabled=config.precision is Precision.BF16,
        cache_enabled=not config.engine.checkpoint_activations,
    )
