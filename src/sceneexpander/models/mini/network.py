"""The learned part of `Mini`: a convolutional stem, WorldMirror's alternating trunk, one fusion decoder, small heads."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.block import run_checkpointed
from sceneexpander.models.layers.camera_head import CameraHead
from sceneexpander.models.layers.dpt import DptConfig, DptHead
from sceneexpander.models.layers.rope import grid_rope
from sceneexpander.models.layers.trunk import AlternatingTrunk, per_view_tokens
from sceneexpander.models.mini.config import PATCH_PX, MiniConfig
from sceneexpander.models.mini.inputs import COARSE_CHANNELS, FINE_CHANNELS, WorkingViews
from sceneexpander.models.mini.splats import SPLAT_RESIDUALS

ROPE_BASE = 100.0
_GROUP_WIDTH = 16  # channels per normalisation group in the stem


@dataclass(frozen=True, slots=True, kw_only=True)
class Features:
    """What the heads read."""

    camera_tokens: Float[Tensor, "view dim"]
    dense: Float[Tensor, "view channel out_height out_width"]

    def float(self) -> Features:
        """The same in float32."""
        return Features(camera_tokens=self.camera_tokens.float(), dense=self.dense.float())


class Stem(nn.Module):
    """Images, base depth and evidence -> tokens of 16 x 16 pixels, and the maps at 1/2, 1/4 and 1/8 on the way."""

    def __init__(self, widths: tuple[int, int, int], dim: int) -> None:
        super().__init__()
        half, quarter, eighth = widths
        self.to_fine = nn.Sequential(nn.Conv2d(FINE_CHANNELS, half // 2, 3, stride=2, padding=1), nn.GELU())
        self.to_half = _conv(half // 2 + COARSE_CHANNELS, half)
        self.to_quarter = nn.Sequential(_conv(half, quarter, stride=2), _conv(quarter, quarter))
        self.to_eighth = nn.Sequential(_conv(quarter, eighth, stride=2), _conv(eighth, eighth))
        self.to_tokens = nn.Conv2d(eighth, dim, 3, stride=2, padding=1)

    def forward(self, inputs: WorkingViews) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(token map, maps at 1/2, 1/4 and 1/8)."""
        half = self.to_half(torch.cat([self.to_fine(inputs.fine), inputs.coarse], dim=1))
        quarter = self.to_quarter(half)
        eighth = self.to_eighth(quarter)
        return self.to_tokens(eighth), half, quarter, eighth


class MiniNetwork(nn.Module):
    """Features of all views and the heads on them. Every head's last layer starts at zero, so a new network adds nothing."""

    def __init__(self, config: MiniConfig) -> None:
        super().__init__()
        self.config = config
        self.checkpoint_activations = False
        half, quarter, eighth = config.stem_widths
        self.stem = Stem(config.stem_widths, config.width)
        self.camera_token = nn.Parameter(torch.randn(1, 2, 1, config.width) * 0.02)
        self.register_token = nn.Parameter(torch.randn(1, 2, config.register_tokens, config.width) * 0.02)
        self.trunk = AlternatingTrunk(
            config.width,
            depth=config.depth,
            heads=config.attention_heads,
            collect=range(config.depth - 4, config.depth),
            layer_scale=config.layer_scale,
        )
        self.camera_head = CameraHead(
            2 * config.width, depth=config.camera_blocks, heads=config.attention_heads, steps=config.camera_steps
        )
        sizes = DptConfig(features=config.features, out_channels=config.dpt_widths, hidden=config.head_width)
        # One decoder for all dense heads; each head has its own last layers.
        self.decoder = DptHead(2 * config.width, 1, sizes)
        self.decoder.get_submodule("scratch").output_conv2 = nn.Identity()
        self.skip_half = nn.Conv2d(half, config.features // 2, 1)
        self.skip_quarter = nn.Conv2d(quarter, config.features, 1)
        self.skip_eighth = nn.Conv2d(eighth, config.features, 1)
        # Log depth residual, confidence logit, and a logit of how far confident pixels keep to the base.
        self.depth_head = _dense_head(config, 3)
        self.normals_head = _dense_head(config, 4)  # normal residual, confidence logit
        self.gaussian_head = _dense_head(config, SPLAT_RESIDUALS)
        for head in (self.depth_head, self.normals_head, self.gaussian_head):
            _zero(head[-1])
        self.reset_camera_residual()

    def reset_camera_residual(self) -> None:
        """Make the camera head return the prior cameras (it stays adaptable: its last layer still receives gradients)."""
        _zero(self.camera_head.get_submodule(self.camera_head.names.predictor).get_submodule("fc2"))

    @torch.no_grad()
    def shrink_depth_residual(self, gain: float) -> None:
        """Multiply the depth residual by a gain, by way of its last layer: less correction, fewer scenes made worse."""
        last = self.depth_head[-1]
        for parameter in last.parameters():
            parameter[0] *= gain

    def features(self, inputs: WorkingViews) -> Features:
        """Run stem, trunk and decoder once for all heads."""
        config = self.config
        checkpoint = self.checkpoint_activations
        token_map, half, quarter, eighth = run_checkpointed(self.stem, inputs, enabled=checkpoint)
        views, _, rows, columns = token_map.shape
        specials = 1 + config.register_tokens
        tokens = torch.cat(
            [
                per_view_tokens(self.camera_token, 1, views),
                per_view_tokens(self.register_token, 1, views),
                token_map.flatten(2).transpose(1, 2)[None],
            ],
            dim=2,
        )
        rope = grid_rope(rows, columns, specials=specials, head_dim=self.trunk.head_dim, base=ROPE_BASE, like=token_map)
        collected = self.trunk.alternate(tokens, rope, checkpoint=checkpoint)
        levels = [level[0] for level in collected]
        grid, size = (rows, columns), (rows * PATCH_PX // 2, columns * PATCH_PX // 2)
        skips = [self.skip_quarter(quarter), self.skip_eighth(eighth), None, None]
        parts = []
        for chunk in self.decoder.chunks(views):
            chosen = [level[chunk] for level in levels], [None if skip is None else skip[chunk] for skip in skips]
            parts.append(
                run_checkpointed(self.decoder.features, chosen[0], specials, grid, size, chosen[1], enabled=checkpoint)
            )
        dense = parts[0] if len(parts) == 1 else torch.cat(parts)
        return Features(camera_tokens=levels[-1][:, 0], dense=dense + self.skip_half(half))


def _conv(inputs: int, outputs: int, *, stride: int = 1) -> nn.Sequential:
    """3 x 3 convolution, group normalisation (independent of the other views and of train/eval), GELU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False),
        nn.GroupNorm(max(outputs // _GROUP_WIDTH, 1), outputs),
        nn.GELU(),
    )


def _dense_head(config: MiniConfig, outputs: int) -> nn.Sequential:
    """The last two convolutions of a DPT head."""
    return nn.Sequential(
        nn.Conv2d(config.features // 2, config.head_width, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(config.head_width, outputs, 1),
    )


def _zero(layer: nn.Module) -> None:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
