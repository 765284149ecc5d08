"""Random initialisation from an explicit generator."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def initialise_layers(module: nn.Module, *, generator: torch.Generator) -> None:
    """PyTorch's default initialisation of every linear, convolution and LayerNorm inside, drawn from ``generator``."""
    for part in module.modules():
        if isinstance(part, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            nn.init.kaiming_uniform_(part.weight, a=math.sqrt(5), generator=generator)
            if part.bias is not None:
                fan_in = part.weight[0].numel()
                bound = 1 / math.sqrt(fan_in)
                nn.init.uniform_(part.bias, -bound, bound, generator=generator)
        elif isinstance(part, nn.LayerNorm):
            nn.init.ones_(part.weight)
            nn.init.zeros_(part.bias)


def materialise(module: nn.Module, *, device: torch.device) -> None:
    """Give every parameter of a module built on the meta device memory of its own, not yet initialised.

    Same as ``Module.to_empty`` for modules without buffers, but without importing the symbolic-shape machinery (seconds).
    """
    for part in module.modules():
        for name, parameter in list(part.named_parameters(recurse=False)):
            empty = torch.empty(tuple(parameter.shape), dtype=parameter.dtype, device=device)
            part.register_parameter(name, nn.Parameter(empty, requires_grad=parameter.requires_grad))


def normal_(parameter: Tensor, std: float, *, generator: torch.Generator) -> None:
    """Fill with N(0, std^2)."""
    nn.init.normal_(parameter, std=std, generator=generator)
