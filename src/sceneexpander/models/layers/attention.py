"""Multi-head self-attention with optional query/key normalisation and rotary positions."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sceneexpander.models.layers.rope import RopeTable, apply_rope


class Attention(nn.Module):
    """Self-attention with a fused qkv projection (worldmirror spec 3, "Transformer block").

    Args:
        dim: token width C, divisible by ``heads``.
        heads: number of heads.
        qk_norm: LayerNorm over the head width on q and k, before the rotation, shared by all heads.
        qk_norm_eps: its epsilon.
        half_rope: round q and k to float16 before and after their rotation (ttt3r spec 2).
    """

    def __init__(
        self, dim: int, heads: int, *, qk_norm: bool = False, qk_norm_eps: float = 1e-5, half_rope: bool = False
    ) -> None:
        super().__init__()
        if dim % heads:
            raise ValueError(f"token width {dim} is not divisible by {heads} heads")
        self.heads = heads
        self.head_dim = dim // heads
        self.half_rope = half_rope
        self.qkv = nn.Linear(dim, 3 * dim)
        self.q_norm = nn.LayerNorm(self.head_dim, eps=qk_norm_eps) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(self.head_dim, eps=qk_norm_eps) if qk_norm else nn.Identity()
        self.proj = nn.Linear(dim, dim)

    def forward(
        self, tokens: Float[Tensor, "batch token dim"], rope: RopeTable | None = None
    ) -> Float[Tensor, "batch token dim"]:
        """Attend within each sequence; ``rope`` holds one rotation per token, the same for all sequences."""
        query, key, value = self.qkv(tokens).unflatten(-1, (3, self.heads, self.head_dim)).unbind(2)
        query, key = self.q_norm(query), self.k_norm(key)
        if rope is not None:
            query, key = (apply_rope(x, rope, half=self.half_rope) for x in (query, key))
        # Under autocast the normalised q and k are float32 while v is not.
        query, key = query.to(value.dtype), key.to(value.dtype)
        mixed = F.scaled_dot_product_attention(query.transpose(1, 2), key.transpose(1, 2), value.transpose(1, 2))
        return self.proj(mixed.transpose(1, 2).flatten(2))
