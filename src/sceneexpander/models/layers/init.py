"""Random initialisation from an explicit generator."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sceneexpander.models.layers.block import LayerScale
from sceneexpander.models.layers.camera_head import CameraHead
from sceneexpander.models.layers.vit import DinoEncoder

TOKEN_STD = 1e-6
ENCODER_STD = 0.02


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


def initialise_backbone(
    model: nn.Module,
    encoder: DinoEncoder,
    camera_head: CameraHead,
    tokens: Sequence[nn.Parameter],
    *,
    generator: torch.Generator,
) -> None:
    """Draw what WorldMirror and OmniVGGT have in common anew (worldmirror spec 12.3): layers, gains, tokens, encoder.

    Args:
        model: the whole model.
        encoder: its image encoder.
        camera_head: its camera head.
        tokens: the trunk's own learned tokens.
        generator: source of every number.
    """
    initialise_layers(model, generator=generator)
    for part in model.modules():
        if isinstance(part, LayerScale):
            nn.init.constant_(part.gamma, part.init)
    for token in (*tokens, encoder.cls_token, encoder.register_tokens):
        normal_(token, TOKEN_STD, generator=generator)
    if hasattr(encoder, "mask_token"):
        nn.init.zeros_(encoder.mask_token)
    nn.init.trunc_normal_(encoder.pos_embed, std=ENCODER_STD, generator=generator)
    for part in encoder.modules():
        if isinstance(part, nn.Linear):
            nn.init.trunc_normal_(part.weight, std=ENCODER_STD, generator=generator)
            nn.init.zeros_(part.bias)
    nn.init.zeros_(camera_head.get_parameter(camera_head.names.init_token))


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
