"""Alternating attention: within each view, then over all views (worldmirror spec 4.3, omnivggt spec 5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.block import Block, run_checkpointed
from sceneexpander.models.layers.rope import RopeTable

Tokens = Float[Tensor, "batch view token dim"]


class AlternatingTrunk(nn.Module):
    """Pairs of a frame block and a global block. Models subclass it (or hold it) to keep the checkpoint's names.

    Args:
        dim: token width.
        depth: number of pairs.
        heads: attention heads of every block.
        mlp_ratio: of every block.
        qk_norm: see `Attention`.
        layer_scale: initial gain.
        collect: ascending indices of the pairs whose outputs are collected.
    """

    def __init__(
        self,
        dim: int,
        *,
        depth: int,
        heads: int,
        collect: Sequence[int],
        mlp_ratio: float = 4.0,
        qk_norm: bool = True,
        layer_scale: float = 0.01,
    ) -> None:
        super().__init__()
        if not collect or list(collect) != sorted(set(collect)) or collect[0] < 0 or collect[-1] >= depth:
            raise ValueError(f"collected block indices {tuple(collect)} are not ascending within 0..{depth - 1}")
        self.collect = tuple(collect)

        def blocks() -> nn.ModuleList:
            return nn.ModuleList(
                [Block(dim, heads, mlp_ratio=mlp_ratio, qk_norm=qk_norm, layer_scale=layer_scale) for _ in range(depth)]
            )

        self.frame_blocks = blocks()
        self.global_blocks = blocks()
        self.head_dim = dim // heads

    def alternate(
        self,
        tokens: Tokens,
        rope: RopeTable,
        *,
        after_frame: Callable[[int, Tokens], Tokens] | None = None,
        checkpoint: bool = False,
    ) -> list[Float[Tensor, "batch view token dim2"]]:
        """Run the blocks up to the last collected pair.

        Args:
            tokens: token sequences, one per view.
            rope: rotations of one view's tokens; every view has the same.
            after_frame: what to do to the tokens between frame block i and global block i (given i).
            checkpoint: recompute each block in the backward pass.

        Returns:
            For each collected pair the frame block's output and the global block's output, concatenated along channels.
        """
        batch, views, count, _ = tokens.shape
        rope_all = rope.repeat(views)
        collected: list[Tensor] = []
        pairs = zip(self.frame_blocks, self.global_blocks, strict=True)
        for index, (frame_block, global_block) in enumerate(pairs):
            if index > self.collect[-1]:
                break
            per_view: Tensor = run_checkpointed(frame_block, tokens.flatten(0, 1), rope, enabled=checkpoint)
            per_view = torch.unflatten(per_view, 0, (batch, views))
            if after_frame is not None:
                per_view = after_frame(index, per_view)
            tokens = run_checkpointed(global_block, per_view.flatten(1, 2), rope_all, enabled=checkpoint)
            tokens = torch.unflatten(tokens, 1, (views, count))
            if index in self.collect:
                collected.append(torch.cat([per_view, tokens], dim=-1))
        return collected


def per_view_tokens(
    token: Float[Tensor, "1 2 count dim"], batch: int, views: int
) -> Float[Tensor, "batch view count dim"]:
    """Learned tokens for every view: slot 0 for the first view, slot 1 for all others (worldmirror spec 4.1)."""
    first = token[:, :1].expand(batch, 1, -1, -1)
    others = token[:, 1:].expand(batch, views - 1, -1, -1)
    return torch.cat([first, others], dim=1)
