"""The pre-norm transformer block of every released model here; submodule names are those of the checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from sceneexpander.models.layers.attention import Attention
from sceneexpander.models.layers.rope import RopeTable


class LayerScale(nn.Module):
    """Multiply every channel by a learned gain."""

    def __init__(self, dim: int, *, init: float) -> None:
        super().__init__()
        self.init = init
        self.gamma = nn.Parameter(torch.full((dim,), init))

    def forward(self, tokens: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        return tokens * self.gamma


class Mlp(nn.Module):
    """Linear, exact (erf) GELU, Linear."""

    def __init__(self, dim: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, out)

    def forward(self, tokens: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch out"]:
        return self.fc2(F.gelu(self.fc1(tokens)))


class Block(nn.Module):
    """``y = x + ls1(attn(norm1(x)))``, ``out = y + ls2(mlp(norm2(y)))`` (worldmirror spec 3).

    Args:
        dim: token width.
        heads: attention heads.
        mlp_ratio: hidden width of the MLP over ``dim``.
        norm_eps: epsilon of norm1 and norm2 (1e-6 in DINOv2, 1e-5 in trunks and camera heads).
        qk_norm: see `Attention`.
        layer_scale: initial gain of both LayerScales; None: there are none.
        half_rope: see `Attention`.
    """

    def __init__(
        self,
        dim: int,
        heads: int,
        *,
        mlp_ratio: float = 4.0,
        norm_eps: float = 1e-5,
        qk_norm: bool = False,
        layer_scale: float | None = 0.01,
        half_rope: bool = False,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=norm_eps)
        self.attn = Attention(dim, heads, qk_norm=qk_norm, half_rope=half_rope)
        self.ls1 = nn.Identity() if layer_scale is None else LayerScale(dim, init=layer_scale)
        self.norm2 = nn.LayerNorm(dim, eps=norm_eps)
        self.mlp = Mlp(dim, int(dim * mlp_ratio), dim)
        self.ls2 = nn.Identity() if layer_scale is None else LayerScale(dim, init=layer_scale)

    def forward(
        self, tokens: Float[Tensor, "batch token dim"], rope: RopeTable | None = None
    ) -> Float[Tensor, "batch token dim"]:
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens), rope))
        return tokens + self.ls2(self.mlp(self.norm2(tokens)))


def run_checkpointed(function: Callable[..., Any], *args: Any, enabled: bool) -> Any:
    """Call ``function(*args)``; if ``enabled`` and gradients are recorded, keep only its inputs and recompute in the backward.

    Values and gradients are the same either way. Independent of ``train()``/``eval()``: nothing here draws random numbers.
    """
    if enabled and torch.is_grad_enabled():
        return checkpoint(function, *args, use_reentrant=False, preserve_rng_state=False)
    return function(*args)
