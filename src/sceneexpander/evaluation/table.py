"""Comparison tables in the shape of the paper: one line per method, means over scenes, gaps shown as gaps.

Photos are compared at their own resolution first, and at the stored size that the methods were given beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from sceneexpander.artifacts.metrics import MetricsRow, Row, UnavailableRow
from sceneexpander.catalogue import Group, Metric, Shown, Table, measured_metrics
from sceneexpander.catalogue.methods import CAPTURED, method_order, method_title
from sceneexpander.catalogue.metrics import DASH

MISSING = "missing"
NO_COMMON_CELL = "no common cell"
_GAINED = "tour_covered_gained"  # a difference of two rows


def compared_metrics() -> tuple[Metric, ...]:
    """What the comparison tables show."""
    return measured_metrics(Group.QUALITY, Group.INSERTION, Group.GEOMETRY, shown=Shown.TABLE)


Cell = tuple[str, int, int]  # scene, round, seed


def comparison_table(rows: Sequence[Row], metrics: Sequence[Metric] | None = None) -> Table:
    """One line per method: means over scene, round and seed cells.

    The means of a column are over the same cells: those in which all methods that have the number anywhere have it. If these are fewer
    than occur in ``rows``, their count follows, e.g. ``21.40 (3/4)``; a method without the number says ``missing``, and
    ``no common cell`` stands where the methods share none. A method that could be run in no cell has its reason in the first number's
    place, and narrows no column.

    Of methods that were run several times, the standard deviation over the runs follows (root mean square over the cells).
    Columns that no row has a value for are left out. Lines whose Gaussians were treated differently cannot be compared (``Gaussians``,
    see `Fit`).

    Args:
        rows: of any scenes, rounds, methods and seeds.
        metrics: the columns; None: `compared_metrics`.

    Raises:
        ValueError: two rows have the same scene, round, seed and method.
    """
    by_key = _indexed(rows)
    cells = _cells(rows)
    shown = _shown(by_key, metrics)
    common = {metric.name: _common_cells(by_key, cells, _methods(rows), metric) for metric in shown}
    lines = []
    for method in _methods(rows):
        done = str(sum((cell, method) in by_key for cell in cells))
        values = _cell_texts(rows, by_key, cells, method, shown, common)
        lines.append((_title(rows, method), _fits(by_key, cells, method), done, *values))
    header = ("method", "Gaussians", f"cells of {len(cells)}", *(metric.column for metric in shown))
    return Table(header=header, lines=tuple(lines), left=2)


def scene_table(rows: Sequence[Row], metrics: Sequence[Metric] | None = None) -> Table:
    """One line per scene, round, seed and method, absent ones included as missing. Raises as `comparison_table`."""
    by_key = _indexed(rows)
    shown = _shown(by_key, metrics)
    lines = []
    for cell in _cells(rows):
        for method in _methods(rows):
            own = {metric.name: [cell] for metric in shown}
            values = _cell_texts(rows, by_key, [cell], method, shown, own)
            title, fit = _title(rows, method), _fits(by_key, [cell], method)
            lines.append((cell[0], str(cell[1]), str(cell[2]), title, fit, *values))
    header = ("scene", "round", "seed", "method", "Gaussians", *(metric.column for metric in shown))
    return Table(header=header, lines=tuple(lines), left=5)


def _shown(by_key: dict[tuple[Cell, str], MetricsRow], metrics: Sequence[Metric] | None) -> list[Metric]:
    chosen = compared_metrics() if metrics is None else metrics
    return [metric for metric in chosen if any(_value(by_key, *key, metric) is not None for key in by_key)]


def _title(rows: Sequence[Row], method: str) -> str:
    """The method's title with the reconstructors' names of its rows."""
    models = dict.fromkeys(row.model for row in rows if row.method == method)
    return method_title(method, " / ".join(models))


def _cells(rows: Sequence[Row]) -> list[Cell]:
    return sorted({(row.scene, row.round, row.seed) for row in rows})


def _indexed(rows: Sequence[Row]) -> dict[tuple[Cell, str], MetricsRow]:
    """Rows with numbers by cell and method."""
    seen: set[tuple[Cell, str]] = set()
    found: dict[tuple[Cell, str], MetricsRow] = {}
    for row in rows:
        key = ((row.scene, row.round, row.seed), row.method)
        if key in seen:
            raise ValueError(f"two rows for scene {row.scene!r}, round {row.round}, seed {row.seed}, {row.method!r}")
        seen.add(key)
        if isinstance(row, MetricsRow):
            found[key] = row
    return found


def _cell_texts(
    rows: Sequence[Row],
    by_key: dict[tuple[Cell, str], MetricsRow],
    cells: Sequence[Cell],
    method: str,
    metrics: Sequence[Metric],
    common: Mapping[str, Sequence[Cell]],
) -> list[str]:
    """The line's numbers; where the method could be run in none of the cells: why, then gaps."""
    if not any((cell, method) in by_key for cell in cells):
        reasons = [
            row.reason
            for row in rows
            if isinstance(row, UnavailableRow)
            and row.method == method
            and (row.scene, row.round, row.seed) in set(cells)
        ]
        if reasons:
            return [*dict.fromkeys(reasons), *[DASH] * len(metrics)][: len(metrics)]
    return [_cell_text(by_key, cells, common[metric.name], method, metric) for metric in metrics]


def _common_cells(
    by_key: dict[tuple[Cell, str], MetricsRow], cells: Sequence[Cell], methods: Sequence[str], metric: Metric
) -> list[Cell]:
    """Cells that all methods have which have the number in any."""
    known = [{cell for cell in cells if _value(by_key, cell, method, metric) is not None} for method in methods]
    return [cell for cell in cells if all(cell in own for own in known if own)]


def _fits(by_key: dict[tuple[Cell, str], MetricsRow], cells: Sequence[Cell], method: str) -> str:
    """What was done to the method's Gaussians; more than one word if it was not the same in all cells."""
    found = dict.fromkeys(by_key[cell, method].fit for cell in cells if (cell, method) in by_key)
    return ", ".join(found) or DASH


def _methods(rows: Sequence[Row]) -> list[str]:
    return sorted({row.method for row in rows}, key=method_order)


def _value(by_key: dict[tuple[Cell, str], MetricsRow], cell: Cell, method: str, metric: Metric) -> float | None:
    row = by_key.get((cell, method))
    if row is None or (metric.scope.of_insertion and method == CAPTURED):
        return None
    if metric.name != _GAINED:
        return row.value(metric.name)
    before = by_key.get((cell, CAPTURED))
    covered = None if before is None else before.value("tour_covered")
    after = row.value("tour_covered")
    return None if covered is None or after is None else after - covered


def _cell_text(
    by_key: dict[tuple[Cell, str], MetricsRow],
    cells: Sequence[Cell],
    common: Sequence[Cell],
    method: str,
    metric: Metric,
) -> str:
    if metric.scope.of_insertion and method == CAPTURED:
        return DASH
    if all(_value(by_key, cell, method, metric) is None for cell in cells):
        return MISSING
    values = [value for cell in common if (value := _value(by_key, cell, method, metric)) is not None]
    if not values:
        return NO_COMMON_CELL
    text = metric.bare(sum(values) / len(values))
    spreads = [
        row.spread[metric.name] for cell in common if (row := by_key.get((cell, method))) and metric.name in row.spread
    ]
    if spreads:
        text += f" \u00b1 {metric.bare(math.sqrt(sum(value * value for value in spreads) / len(spreads)))}"
    return text if len(common) == len(cells) else f"{text} ({len(common)}/{len(cells)})"
