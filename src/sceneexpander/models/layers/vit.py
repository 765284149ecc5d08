"""DINOv2 vision transformer with registers, as the image encoder of WorldMirror and OmniVGGT (worldmirror spec 3)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.block import Block, run_checkpointed

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def normalise_rgb(images: Float[Tensor, "*batch 3 height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """ImageNet statistics: ``(rgb - mean) / std``."""
    mean = torch.tensor(IMAGENET_MEAN, dtype=images.dtype, device=images.device)[:, None, None]
    std = torch.tensor(IMAGENET_STD, dtype=images.dtype, device=images.device)[:, None, None]
    return (images - mean) / std


class PatchConv(nn.Module):
    """Non-overlapping patches by one strided convolution; rows of the result are patches in row-major order."""

    def __init__(self, patch: int, dim: int, channels: int = 3) -> None:
        super().__init__()
        self.proj = nn.Conv2d(channels, dim, patch, stride=patch)

    def forward(self, images: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch patch dim"]:
        return self.proj(images).flatten(2).transpose(1, 2)


class DinoEncoder(nn.Module):
    """Normalised images -> normalised patch tokens.

    Args:
        dim: token width.
        depth: blocks.
        heads: attention heads.
        image_size: side in pixels of the square that the position table was made for.
        patch: patch side in pixels.
        registers: register tokens.
        mlp_ratio: of the blocks.
        mask_token: whether the checkpoint carries the (never used) mask token.
    """

    def __init__(
        self,
        dim: int,
        *,
        depth: int,
        heads: int,
        image_size: int,
        patch: int = 14,
        registers: int = 4,
        mlp_ratio: float = 4.0,
        mask_token: bool = True,
    ) -> None:
        super().__init__()
        self.patch = patch
        self.registers = registers
        self.table_side = image_size // patch
        self.patch_embed = PatchConv(patch, dim)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + self.table_side**2, dim))
        self.register_tokens = nn.Parameter(torch.zeros(1, registers, dim))
        if mask_token:
            self.mask_token = nn.Parameter(torch.zeros(1, dim))
        self.blocks = nn.ModuleList(
            [Block(dim, heads, mlp_ratio=mlp_ratio, norm_eps=1e-6, layer_scale=1.0) for _ in range(depth)]
        )
        self.norm = nn.LayerNorm(dim, eps=1e-6)

    def forward(
        self, images: Float[Tensor, "batch 3 height width"], *, checkpoint: bool = False
    ) -> Float[Tensor, "batch patch dim"]:
        """Patch tokens, row-major; the class and register tokens stay inside."""
        rows, columns = images.shape[-2] // self.patch, images.shape[-1] // self.patch
        patches = self.patch_embed(images)
        count = patches.shape[0]
        tokens = torch.cat([self.cls_token.expand(count, -1, -1), patches], dim=1)
        tokens = tokens + self.position_table(rows, columns).to(tokens.dtype)
        registers = self.register_tokens.expand(count, -1, -1).to(tokens.dtype)
        tokens = torch.cat([tokens[:, :1], registers, tokens[:, 1:]], dim=1)
        for block in self.blocks:
            tokens = run_checkpointed(block, tokens, enabled=checkpoint)
        return self.norm(tokens[:, 1 + self.registers :])

    def position_table(self, rows: int, columns: int) -> Float[Tensor, "1 token dim"]:
        """The learned table for a grid of patches, class entry first; resized by target size, antialiased, in float32."""
        side = self.table_side
        if rows == columns == side:
            return self.pos_embed
        table = self.pos_embed.float()
        grid = torch.unflatten(table[:, 1:], 1, (side, side)).permute(0, 3, 1, 2)
        grid = F.interpolate(grid, size=(rows, columns), mode="bicubic", antialias=True, align_corners=False)
        return torch.cat([table[:, :1], grid.flatten(2).transpose(1, 2)], dim=1)
