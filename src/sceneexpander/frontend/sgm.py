"""Semi-global matching: aggregate a cost volume along image paths, then read off the best hypothesis.

Hirschmueller 2008, "Stereo processing by semiglobal matching and mutual information", eq. 13 and 14, with a first
penalty for neighbouring hypotheses and a second, contrast-dependent one for jumps. Costs are 16-bit integers and the
volume is laid out row, hypothesis, column, so that a whole row of pixels is updated by a handful of contiguous vector
operations; horizontal paths run on a transposed copy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Costs of 1.0 as an integer. Eight paths of at most (1.2 + 0.15 + 0.4) each stay below the int16 limit.
COST_SCALE = 2000
_OUTSIDE = np.int16(12000)  # a hypothesis beyond the first or last: never the cheapest, never overflows

Image32 = NDArray[np.float32]
Volume16 = NDArray[np.int16]


@dataclass(frozen=True, slots=True, kw_only=True)
class BestHypothesis:
    """The winner of an aggregated volume, per pixel, each of shape (height, width)."""

    index: NDArray[np.intp]  # cheapest hypothesis
    offset: Image32  # sub-hypothesis offset in [-0.5, 0.5] from a parabola through the neighbours
    ambiguity: Image32  # share of hypotheses nearly as cheap as the winner, in [0, 1]


def aggregate(
    cost: Volume16, guide: Image32, *, penalty_near: float, penalty_jump: float, contrast: float, diagonals: bool
) -> Volume16:
    """Sum of the path costs of eight (or, without ``diagonals``, four) directions.

    Args:
        cost: (height, hypothesis, width), costs times `COST_SCALE`.
        guide: (height, width) grey image in [0, 1]; jumps are cheap across its edges.
        penalty_near: added when a path moves to a neighbouring hypothesis.
        penalty_jump: added when it jumps further, divided by ``1 + contrast * |grey difference|``.
    """
    near = round(penalty_near * COST_SCALE)
    shifts = (0, 1, -1) if diagonals else (0,)
    total = np.zeros_like(cost)
    for step in (1, -1):
        _sweep_rows(cost[::step], guide[::step], total[::step], shifts, near, penalty_jump, contrast)
    # Width becomes the row axis: (width, hypothesis, height), copied so that every step is contiguous.
    turned = np.ascontiguousarray(cost.transpose(2, 1, 0))
    turned_total = np.zeros_like(turned)
    turned_guide = np.ascontiguousarray(guide.T)
    for step in (1, -1):
        _sweep_rows(turned[::step], turned_guide[::step], turned_total[::step], (0,), near, penalty_jump, contrast)
    total += turned_total.transpose(2, 1, 0)
    return total


def _sweep_rows(
    cost: Volume16,
    guide: Image32,
    total: Volume16,
    shifts: tuple[int, ...],
    near: int,
    penalty_jump: float,
    contrast: float,
) -> None:
    """Add the path costs of the directions (1 row down, ``shift`` columns right) to ``total``."""
    height, hypotheses, width = cost.shape
    jump = _jump_penalties(guide, shifts, penalty_jump, contrast)
    # Path costs of the previous row, already moved to the column that continues them; a path starts at cost zero.
    before = np.zeros((len(shifts), hypotheses + 2, width), np.int16)
    before[:, 0] = before[:, -1] = _OUTSIDE
    inner = before[:, 1:-1]
    path = np.empty_like(inner, order="C")
    for y in range(height):
        cheapest = inner.min(axis=1)
        np.minimum(before[:, :-2], before[:, 2:], out=path)
        path += np.int16(near)
        np.minimum(path, inner, out=path)
        np.minimum(path, (cheapest + jump[y])[:, None], out=path)
        path -= cheapest[:, None]
        path += cost[y]
        for k, shift in enumerate(shifts):
            total[y] += path[k]
            if shift == 0:
                inner[k] = path[k]
            elif shift > 0:
                inner[k, :, 1:] = path[k, :, :-1]
            else:
                inner[k, :, :-1] = path[k, :, 1:]


def _jump_penalties(guide: Image32, shifts: tuple[int, ...], penalty_jump: float, contrast: float) -> Volume16:
    """(height, direction, width) penalty of a jump between each pixel and its predecessor on the path."""
    height, width = guide.shape
    jump = np.full((height, len(shifts), width), penalty_jump, np.float32)
    for k, shift in enumerate(shifts):
        here = slice(max(shift, 0), width + min(shift, 0))
        there = slice(max(-shift, 0), width - max(shift, 0))
        difference = np.abs(guide[1:, here] - guide[:-1, there])
        jump[1:, k, here] = penalty_jump / (1 + contrast * difference)
    return np.rint(jump * COST_SCALE).astype(np.int16)


def best_hypothesis(total: Volume16, *, margin: float) -> BestHypothesis:
    """Cheapest hypothesis of an aggregated volume (height, hypothesis, width), refined by a parabola.

    ``margin`` is the aggregated cost, in units of 1.0, within which another hypothesis counts as nearly as cheap.
    """
    height, hypotheses, width = total.shape
    lowest = total[:, 0].copy()
    index = np.zeros((height, width), np.int16)
    for k in range(1, hypotheses):
        layer = total[:, k]
        index[layer < lowest] = k
        np.minimum(lowest, layer, out=lowest)
    bound = lowest + np.int16(round(margin * COST_SCALE))
    close = np.zeros((height, width), np.int16)
    for k in range(hypotheses):
        close += total[:, k] <= bound
    winner = index.astype(np.intp)

    def layer_at(which: NDArray[np.intp]) -> Image32:
        clipped = np.clip(which, 0, hypotheses - 1)
        return np.take_along_axis(total, clipped[:, None], axis=1)[:, 0].astype(np.float32)

    below, above, at = layer_at(winner - 1), layer_at(winner + 1), lowest.astype(np.float32)
    bend = below + above - 2 * at
    offset = np.where(bend > 0, 0.5 * (below - above) / np.maximum(bend, 1), 0)
    offset[(winner == 0) | (winner == hypotheses - 1)] = 0
    return BestHypothesis(
        index=winner,
        offset=np.clip(offset, -0.5, 0.5).astype(np.float32),
        ambiguity=(close / np.float32(hypotheses)).astype(np.float32),
    )
