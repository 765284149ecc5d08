"""Initialisation from scratch (worldmirror spec 12.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn

from sceneexpander.models.layers.init import initialise_backbone
from sceneexpander.models.protocol import Head

if TYPE_CHECKING:
    from sceneexpander.models.worldmirror.model import WorldMirror

# (channels, Xavier gain, bias) of the Gaussian channels, in order: quaternion, scales, opacity, residual SH, weight.
GAUSSIAN_INIT = ((4, 1.0, 0.0), (3, 3e-5, -7.0), (1, 1.0, -2.0), (3, 1.0, 0.0), (1, 1.0, -2.0))


@torch.no_grad()
def initialise(model: WorldMirror, *, generator: torch.Generator) -> None:
    """Draw every parameter of the model anew from ``generator``."""
    trunk = model.visual_geometry_transformer
    tokens = (trunk.cam_token, trunk.reg_token)
    initialise_backbone(model, trunk.patch_embed, model.cam_head, tokens, generator=generator)
    if Head.GAUSSIANS in model.config.heads:
        _initialise_gaussians(model.gs_renderer.gs_head[2], generator=generator)


def _initialise_gaussians(layer: nn.Module, *, generator: torch.Generator) -> None:
    weight, bias = layer.get_parameter("weight"), layer.get_parameter("bias")
    begin = 0
    for channels, gain, offset in GAUSSIAN_INIT:
        nn.init.xavier_uniform_(weight[begin : begin + channels], gain=gain, generator=generator)
        nn.init.constant_(bias[begin : begin + channels], offset)
        begin += channels
