"""When to stop early: the losses no longer fall.

Steps differ in their views, so their losses cannot be compared one by one. Averages over windows can: of the anchor loss per captured
view, and of the self-distillation loss over the steps that see the inserted view.
"""

from __future__ import annotations

from collections.abc import Sequence

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.records import StepRecord


def has_plateaued(records: Sequence[StepRecord], config: AdaptConfig) -> bool:
    """Whether the last window of steps is not better than the one before by the configured share. Asked once per window."""
    window = config.plateau.window
    if window == 0 or len(records) < 2 * window or len(records) % window:
        return False
    before, after = (_level(part, config) for part in (records[-2 * window : -window], records[-window:]))
    return before is not None and after is not None and after > (1 - config.plateau.tolerance) * before


def _level(records: Sequence[StepRecord], config: AdaptConfig) -> float | None:
    """The weighted mean loss of a window; None if it cannot be told because no step saw the inserted view."""
    anchor = [(r.anchor_camera + r.anchor_depth + r.anchor_normal) / r.captured for r in records]
    gen = [r.gen_camera + r.gen_depth + r.gen_normal for r in records if r.inserted]
    level = config.lambda_anchor * sum(anchor) / len(anchor)
    if config.insertion_probability == 0 or config.lambda_gen == 0:
        return level
    return level + config.lambda_gen * sum(gen) / len(gen) if gen else None
