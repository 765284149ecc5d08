"""What turns a dense head's raw channels into depth, points, normals and confidences (worldmirror spec 7)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def positive_exp(logits: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``exp(x)``: depth."""
    return torch.exp(logits)


def signed_expm1(logits: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``sign(x) (exp|x| - 1)``, element-wise: point coordinates. Odd, with slope 1 at zero."""
    return torch.sign(logits) * torch.expm1(logits.abs())


def radial_expm1(logits: Float[Tensor, "*shape axis"]) -> Float[Tensor, "*shape axis"]:
    """``x / |x| (exp|x| - 1)`` over the last axis: points and translations of CUT3R (ttt3r spec 6)."""
    length = logits.norm(dim=-1, keepdim=True)
    return logits / length.clamp(min=1e-8) * torch.expm1(length)


def unit_vector(logits: Float[Tensor, "*shape axis"]) -> Float[Tensor, "*shape axis"]:
    """``x / |x|`` over the last axis, without an epsilon: normals."""
    return logits / logits.norm(dim=-1, keepdim=True)


def confidence(logits: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``1 + exp(c)``: always above 1."""
    return 1 + torch.exp(logits)
