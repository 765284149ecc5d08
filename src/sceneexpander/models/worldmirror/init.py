"""Initialisation from scratch (worldmirror spec 12.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn

from sceneexpander.models.layers.block import LayerScale
from sceneexpander.models.layers.init import initialise_layers, normal_
from sceneexpander.models.protocol import Head

if TYPE_CHECKING:
    from sceneexpander.models.worldmirror.model import WorldMirror

TOKEN_STD = 1e-6
# (channels, Xavier gain, bias) of the Gaussian channels, in order: quaternion, scales, opacity, residual SH, weight.
GAUSSIAN_INIT = ((4, 1.0, 0.0), (3, 3e-5, -7.0), (1, 1.0, -2.0), (3, 1.0, 0.0), (1, 1.0, -2.0))


@torch.no_grad()
def initialise(model: WorldMirror, *, generator: torch.Generator) -> None:
    """Draw every parameter of the model anew from ``generator``."""
    initialise_layers(model, generator=generator)
    for part in model.modules():
        if isinstance(part, LayerScale):
            nn.init.constant_(part.gamma, part.init)
    trunk = model.visual_geometry_transformer
    encoder = trunk.patch_embed
    for token in (trunk.cam_token, trunk.reg_token, encoder.cls_token, encoder.register_tokens):
        normal_(token, TOKEN_STD, generator=generator)
    nn.init.zeros_(encoder.mask_token)
    nn.init.trunc_normal_(encoder.pos_embed, std=0.02, generator=generator)
    for part in encoder.modules():
        if isinstance(part, nn.Linear):
            nn.init.trunc_normal_(part.weight, std=0.02, generator=generator)
            nn.init.zeros_(part.bias)
    nn.init.zeros_(model.cam_head.get_parameter(model.cam_head.names.init_token))
    if Head.GAUSSIANS in model.config.heads:
        _initialise_gaussians(model.gs_renderer.gs_head[2], generator=generator)


def _initialise_gaussians(layer: nn.Module, *, generator: torch.Generator) -> None:
    weight, bias = layer.get_parameter("weight"), layer.get_parameter("bias")
    begin = 0
    for channels, gain, offset in GAUSSIAN_INIT:
        nn.init.xavier_uniform_(weight[begin : begin + channels], gain=gain, generator=generator)
        nn.init.constant_(bias[begin : begin + channels], offset)
        begin += channels
