"""Several runs of one method with different seeds as one row: means, and how far the runs lie apart."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import fields, replace

from sceneexpander.artifacts.metrics import PARTS, MetricsRow


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
    parts = {part: getattr(first, part) for part in PARTS if getattr(first, part) is not None}
    nested = {part: [f.name for f in fields(held)] for part, held in parts.items()}
    of_parts = [f"{part}.{name}" for part, inside in nested.items() for name in inside]
    found = {name: [row.value(name) for row in rows] for name in (*names, *of_parts)}
    known = {name: [v for v in values if v is not None] for name, values in found.items() if None not in values}
    means = {name: statistics.fmean(values) for name, values in known.items()}
    merged = {
        part: replace(held, **{name: means.get(f"{part}.{name}") for name in nested[part]})
        for part, held in parts.items()
    }
    return replace(
        first,
        repeats=len(rows),
        spread={name: statistics.stdev(values) for name, values in known.items()},
        **merged,
        **{name: means.get(name) for name in names},  # type: ignore[arg-type]
    )
