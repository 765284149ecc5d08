"""What is written down of every step."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class StepRecord:
    """What one step did. Loss terms are weighted as they enter the objective (before lambda)."""

    step: int
    captured: int
    inserted: bool
    loss: float
    anchor_camera: float
    anchor_depth: float
    anchor_normal: float
    gen_camera: float
    gen_depth: float
    gen_normal: float
    drift: float  # L_reg before lambda_reg
    gradient_norm: float
    restored: int
    anchor_gaussian: float = 0.0  # beyond the paper, see `AdaptConfig.alpha_gaussian`
