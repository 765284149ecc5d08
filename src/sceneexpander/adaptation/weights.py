"""Operations on the weights themselves: drift, EMA, restoration. Whole-model passes, no per-tensor Python in between.

All keep float32 masters: at a learning rate of 1e-5 a bfloat16 weight would never move.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sceneexpander.adaptation.config import DriftForm
from sceneexpander.geometry.randomness import child_generator


def drift_squared(weights: Sequence[Tensor], start: Sequence[Tensor], form: DriftForm) -> Tensor:
    """L_reg: sum (or mean) over all weights of (theta - theta_0)^2."""
    norms = torch._foreach_norm(torch._foreach_sub(list(weights), list(start)))
    total = torch.stack(norms).square().sum()
    return total if form is DriftForm.SUM else total / sum(w.numel() for w in weights)


def add_drift_gradient(
    weights: Sequence[Tensor], gradients: Sequence[Tensor], start: Sequence[Tensor], weight: float, form: DriftForm
) -> None:
    """Add the gradient of ``weight * L_reg``, 2 weight (theta - theta_0), to ``gradients`` in place.

    The gradient is exact and cheap, so it is applied here and not through autograd.
    """
    if weight == 0:
        return
    count = 1 if form is DriftForm.SUM else sum(w.numel() for w in weights)
    difference = torch._foreach_sub(list(weights), list(start))
    torch._foreach_add_(list(gradients), difference, alpha=2 * weight / count)


def ema_update(teacher: Sequence[Tensor], student: Sequence[Tensor], momentum: float) -> None:
    """Eq. (ema) in place: theta_G <- mu theta_G + (1 - mu) theta."""
    torch._foreach_lerp_(list(teacher), list(student), 1 - momentum)


def restore(weights: Sequence[Tensor], start: Sequence[Tensor], rate: float, *, seed: int, step: int) -> int:
    """Eq. (restore) in place: every element returns to theta_0 with probability ``rate``; returns how many did.

    Every adapted tensor takes part (tokens, LayerScale and tables included). Masks are drawn on the weights' device from a stream of
    their own, one tensor at a time, so memory stays at the largest tensor.
    """
    if rate == 0 or not weights:
        return 0
    generator = child_generator(seed, f"adapt/restore/{step}", weights[0].device)
    restored = torch.zeros((), dtype=torch.int64, device=weights[0].device)
    for weight, origin in zip(weights, start, strict=True):
        mask = torch.rand(weight.shape, generator=generator, device=weight.device) < rate
        torch.where(mask, origin, weight, out=weight)
        restored += mask.sum()  # stays on the device: one synchronisation at the end
    return int(restored)
