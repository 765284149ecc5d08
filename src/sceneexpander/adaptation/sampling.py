"""Which views a step sees (Eq. batch)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from sceneexpander.adaptation.config import AdaptConfig, Gauge, SubsetRule
from sceneexpander.geometry.randomness import child_generator

MIN_SUBSET = 2  # one view alone carries no multi-view constraint


def subset_sizes(captured: int) -> tuple[int, ...]:
    """Sizes that a subset of n captured views may have: n-1, n-2, n-3, without those below 2; all views if none is left."""
    sizes = tuple(size for size in (captured - 1, captured - 2, captured - 3) if size >= MIN_SUBSET)
    return sizes or (captured,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """The views of one step: captured indices in ascending order, then the inserted view if ``inserted``."""

    captured: tuple[int, ...]
    inserted: bool


def sample_batch(captured: int, config: AdaptConfig, *, seed: int, step: int) -> Batch:
    """Draw the batch of a step. Depends only on the arguments, so a resumed run draws the same."""
    if captured < 1:
        raise ValueError(f"at least one captured view is needed, got {captured}")
    generator = child_generator(seed, f"adapt/batch/{step}")
    inserted = bool(torch.rand((), generator=generator) < config.insertion_probability)
    if config.subset is SubsetRule.ALL:
        return Batch(captured=tuple(range(captured)), inserted=inserted)
    sizes = subset_sizes(captured)
    size = sizes[int(torch.randint(len(sizes), (), generator=generator))]
    if config.gauge is Gauge.KEEP_FIRST:
        rest = torch.randperm(captured - 1, generator=generator)[: size - 1] + 1
        chosen = [0, *rest.tolist()]
    else:
        chosen = torch.randperm(captured, generator=generator)[:size].tolist()
    return Batch(captured=tuple(sorted(chosen)), inserted=inserted)
