"""Several runs of one method with different seeds as one row: means, and how far the runs lie apart."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import fields, replace

from sceneexpander.artifacts.metrics import MetricsRow, TruthMetrics


def over_repeats(rows: Sequence[MetricsRow]) -> MetricsRow:
    """The row of a method that was run once per given row. A number that one run lacks is left out.

    Raises:
        ValueError: there are no rows, or they do not belong together.
    """
    if len({(row.scene, row.round, row.method) for row in rows}) != 1:
        raise ValueError("rows of one scene, round and method are needed")
    first = rows[0]
    if len(rows) == 1:
        return first
    names = [f.name for f in fields(MetricsRow) if f.type in ("float", "float | None")]
    truths = [] if first.truth is None else [f.name for f in fields(TruthMetrics)]
    found = {name: [row.value(name) for row in rows] for name in (*names, *(f"truth.{name}" for name in truths))}
    known = {name: [v for v in values if v is not None] for name, values in found.items() if None not in values}
    means = {name: statistics.fmean(values) for name, values in known.items()}
    truth = first.truth
    if truth is not None:
        truth = replace(truth, **{name: means.get(f"truth.{name}") for name in truths})
    return replace(
        first,
        repeats=len(rows),
        spread={name: statistics.stdev(values) for name, values in known.items()},
        truth=truth,
        **{name: means.get(name) for name in names},  # type: ignore[arg-type]
    )
