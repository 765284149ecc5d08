"""Several runs of one method with different seeds as one row: means, and how far the runs lie apart."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import replace

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.catalogue.metrics import COUNTS


def over_repeats(rows: Sequence[MetricsRow]) -> MetricsRow:
    """The row of a method that was run once per given row. A number that one run lacks is left out; counts are the first run's.

    Raises:
        ValueError: there are no rows, or they do not belong together.
    """
    if len({(row.scene, row.round, row.method) for row in rows}) != 1:
        raise ValueError("rows of one scene, round and method are needed")
    first = rows[0]
    if len(rows) == 1:
        return first
    counts = {metric.name for metric in COUNTS}
    names = [name for name in first.values if name not in counts and all(name in row.values for row in rows)]
    runs = {name: [row.values[name] for row in rows] for name in names}
    means = {name: statistics.fmean(values) for name, values in runs.items()}
    return replace(
        first,
        repeats=len(rows),
        values={name: value for name, value in first.values.items() if name in counts} | means,
        spread={name: statistics.stdev(values) for name, values in runs.items()},
    )
