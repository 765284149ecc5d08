"""The blocks that CUT3R adds to the shared ones: cross-attention and modulation (ttt3r spec 3)."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.attention import Attention
from sceneexpander.models.layers.block import Mlp
from sceneexpander.models.layers.rope import RopeTable, apply_rope

NORM_EPS = 1e-6  # of every LayerNorm in CUT3R


class CrossAttention(nn.Module):
    """Queries of one stream look at another stream."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        if dim % heads:
            raise ValueError(f"token width {dim} is not divisible by {heads} heads")
        self.head_shape = (heads, dim // heads)
        self.projq = nn.Linear(dim, dim)
        self.projk = nn.Linear(dim, dim)
        self.projv = nn.Linear(dim, dim)
        self.proj = nn.Linear(dim, dim)

    def forward(
        self,
        tokens: Float[Tensor, "batch token dim"],
        context: Float[Tensor, "batch other dim"],
        rope: RopeTable | None = None,
        context_rope: RopeTable | None = None,
    ) -> tuple[Float[Tensor, "batch token dim"], Float[Tensor, "batch token"]]:
        """(what is read, alignment): the alignment is the mean over heads and keys of ``q k / sqrt(width)``, before softmax."""
        query = self.projq(tokens).unflatten(-1, self.head_shape)
        key = self.projk(context).unflatten(-1, self.head_shape)
        value = self.projv(context).unflatten(-1, self.head_shape)
        if rope is not None and context_rope is not None:
            query, key = apply_rope(query, rope), apply_rope(key, context_rope)
        # The mean of the logits is the logit of the mean key: no table of queries times keys is needed for it.
        alignment = (query * key.mean(1, keepdim=True)).sum(-1).mean(-1) / self.head_shape[1] ** 0.5
        mixed = F.scaled_dot_product_attention(query.transpose(1, 2), key.transpose(1, 2), value.transpose(1, 2))
        return self.proj(mixed.transpose(1, 2).flatten(2)), alignment


class DecoderBlock(nn.Module):
    """Self-attention, cross-attention to the other stream, MLP; all pre-norm."""

    def __init__(self, dim: int, heads: int, *, mlp_ratio: float = 4.0) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=NORM_EPS)
        self.attn = Attention(dim, heads)
        self.norm2 = nn.LayerNorm(dim, eps=NORM_EPS)
        self.norm_y = nn.LayerNorm(dim, eps=NORM_EPS)
        self.cross_attn = CrossAttention(dim, heads)
        self.norm3 = nn.LayerNorm(dim, eps=NORM_EPS)
        self.mlp = Mlp(dim, int(dim * mlp_ratio), dim)

    def forward(
        self,
        tokens: Float[Tensor, "batch token dim"],
        context: Float[Tensor, "batch other dim"],
        rope: RopeTable | None = None,
        context_rope: RopeTable | None = None,
    ) -> tuple[Float[Tensor, "batch token dim"], Float[Tensor, "batch token"]]:
        """(tokens, alignment of their cross-attention); the context is read, not changed."""
        tokens = tokens + self.attn(self.norm1(tokens), rope)
        read, alignment = self.cross_attn(self.norm2(tokens), self.norm_y(context), rope, context_rope)
        tokens = tokens + read
        return tokens + self.mlp(self.norm3(tokens)), alignment


class ModulatedNorm(nn.Module):
    """``LN(x) (1 + scale(c)) + shift(c)``, one condition per sequence."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(dim, eps=NORM_EPS)
        self.mlp = nn.Sequential(nn.SiLU(), nn.Linear(dim, 2 * dim))

    def forward(
        self, tokens: Float[Tensor, "batch token dim"], condition: Float[Tensor, "batch 1 dim"]
    ) -> Float[Tensor, "batch token dim"]:
        shift, scale = self.mlp(condition).chunk(2, dim=-1)
        return self.norm(tokens) * (1 + scale) + shift


class ModulatedBlock(nn.Module):
    """A self-attention block whose norms follow the pose token."""

    def __init__(self, dim: int, heads: int, *, mlp_ratio: float = 4.0) -> None:
        super().__init__()
        self.norm1 = ModulatedNorm(dim)
        self.attn = Attention(dim, heads)
        self.norm2 = ModulatedNorm(dim)
        self.mlp = Mlp(dim, int(dim * mlp_ratio), dim)

    def forward(
        self, tokens: Float[Tensor, "batch token dim"], condition: Float[Tensor, "batch 1 dim"], rope: RopeTable
    ) -> Float[Tensor, "batch token dim"]:
        tokens = tokens + self.attn(self.norm1(tokens, condition), rope)
        return tokens + self.mlp(self.norm2(tokens, condition))
