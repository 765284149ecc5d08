"""Which weights adapt: all of them (the paper), the heads alone, or low-rank changes of the blocks' linear layers (LoRA).

Whatever was trained, theta* comes out under the names of the model itself, as a change of its weights.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.adaptation.config import AdaptConfig, Trainable
from sceneexpander.errors import UserError
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.models.layers.block import Block
from sceneexpander.models.protocol import HasTrunk, Reconstructor, as_module


class LowRankLinear(nn.Linear):
    """A frozen linear layer plus a trained change of low rank: ``x (W + B A)^T + b``. B starts at zero, so nothing changes at first.

    Args:
        layer: the layer, whose parameters are taken over.
        rank: of the change.
        generator: draws A.
    """

    def __init__(self, layer: nn.Linear, rank: int, generator: torch.Generator) -> None:
        with torch.device("meta"):
            super().__init__(layer.in_features, layer.out_features, bias=layer.bias is not None)
        self.weight, self.bias = layer.weight, layer.bias
        bound = 1 / math.sqrt(layer.in_features)
        drawn = (2 * torch.rand(rank, layer.in_features, generator=generator) - 1) * bound
        self.lora_a = nn.Parameter(drawn.to(self.weight))
        self.lora_b = nn.Parameter(self.weight.new_zeros(layer.out_features, rank))

    def forward(self, x: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch outputs"]:
        return super().forward(x) + F.linear(F.linear(x, self.lora_a), self.lora_b)

    @torch.no_grad()
    def merged(self) -> Tensor:
        """W + B A."""
        return self.weight + self.lora_b @ self.lora_a


@contextmanager
def trained_parts(model: Reconstructor, config: AdaptConfig, *, seed: int) -> Iterator[None]:
    """Inside, exactly the configured weights of ``model`` require a gradient; afterwards it is the plain model again, changes merged.

    Raises:
        UserError: the model has no trunk to freeze, or no blocks to change.
    """
    module = as_module(model)
    required = {name: p.requires_grad for name, p in module.named_parameters()}
    if config.trainable is Trainable.HEADS:
        if not isinstance(model, HasTrunk):
            raise UserError(f"{model.name} does not say what its trunk is", where="adapt.trainable", fix="use all")
        for name, parameter in module.named_parameters():
            parameter.requires_grad_(required[name] and not name.startswith(model.trunk_prefixes))
    elif config.trainable is Trainable.LORA:
        module.requires_grad_(False)
        if not _attach(module, config.lora_rank, child_generator(seed, "adapt/lora")):
            raise UserError(f"{model.name} has no transformer blocks", where="adapt.trainable", fix="use all")
    try:
        yield
    finally:
        _merge(module)
        for name, parameter in module.named_parameters():
            parameter.requires_grad_(required[name])


def plain_state(module: nn.Module) -> dict[str, Tensor]:
    """The state of a model under its own names, low-rank changes merged."""
    state = dict(module.state_dict())
    for name, layer in module.named_modules():
        if isinstance(layer, LowRankLinear):
            state[f"{name}.weight"] = layer.merged()
            del state[f"{name}.lora_a"], state[f"{name}.lora_b"]
    return state


def _attach(module: nn.Module, rank: int, generator: torch.Generator) -> int:
    """Give every linear layer of every block a low-rank change; returns how many there are."""
    count = 0
    for block in [m for m in module.modules() if isinstance(m, Block)]:
        for parent in list(block.modules()):
            for name, layer in list(parent.named_children()):
                if type(layer) is nn.Linear:
                    setattr(parent, name, LowRankLinear(layer, rank, generator))
                    count += 1
    return count


def _merge(module: nn.Module) -> None:
    for parent in list(module.modules()):
        for name, layer in list(parent.named_children()):
            if isinstance(layer, LowRankLinear):
                with torch.device("meta"):
                    plain = nn.Linear(layer.in_features, layer.out_features, bias=layer.bias is not None)
                plain.weight, plain.bias = nn.Parameter(layer.merged()), layer.bias
                setattr(parent, name, plain)
