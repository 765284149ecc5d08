"""Comparison tables in the shape of the paper: one line per method, means over scenes, gaps shown as gaps.

Photos are compared at their own resolution first, and at the stored size that the methods were given beside it.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

from sceneexpander.artifacts.metrics import MetricsRow, Row, UnavailableRow
from sceneexpander.artifacts.quantities import METHOD_TITLES

MISSING = "missing"
NOT_APPLICABLE = "–"
BEFORE = "captured"  # the scene before the insertion: it shows nothing new


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One number of a `MetricsRow`. ``better`` is an arrow in the title. ``expansion``: without meaning for captured views alone."""

    name: str
    title: str
    better: str
    digits: int = 2
    expansion: bool = False


COLUMNS: tuple[Column, ...] = (
    Column(name="own.psnr_db", title="PSNR", better="↑"),
    Column(name="own.ssim", title="SSIM", better="↑", digits=3),
    Column(name="own.st_lpips", title="ST-LPIPS", better="↓", digits=4),
    Column(name="own.open_share", title="open", better="↓", digits=3),
    Column(name="psnr_db", title="PSNR, stored size", better="↑"),
    Column(name="ssim", title="SSIM, stored size", better="↑", digits=3),
    Column(name="st_lpips", title="ST-LPIPS, stored size", better="↓", digits=4),
    Column(name="half.psnr_db", title="PSNR, half size", better="↑"),
    Column(name="double.psnr_db", title="PSNR, twice", better="↑"),
    Column(name="quadruple.open_share", title="open, four times", better="↓", digits=3),
    Column(name="others_psnr_db", title="cross-view PSNR", better="↑"),
    Column(name="inserted_own.psnr_db", title="insertion PSNR, own size", better="↑", expansion=True),
    Column(name="inserted_psnr_db", title="insertion PSNR", better="↑", expansion=True),
    Column(name="inserted_ssim", title="insertion SSIM", better="↑", digits=3, expansion=True),
    Column(name="inserted_st_lpips", title="insertion ST-LPIPS", better="↓", digits=4, expansion=True),
    Column(name="navigation_coverage", title="coverage", better="↑", digits=3),
    Column(name="coverage_gained", title="coverage gained", better="↑", digits=3, expansion=True),
    Column(name="truth.camera_rotation_deg", title="camera rotation °", better="↓"),
    Column(name="truth.depth_abs_rel", title="depth AbsRel", better="↓", digits=3),
    Column(name="truth.inserted_rotation_deg", title="inserted rotation °", better="↓", expansion=True),
    Column(name="truth.new_region_abs_rel", title="new-region AbsRel", better="↓", digits=3, expansion=True),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A header and lines of text, equally long."""

    header: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """As a Markdown table; the first column is left-aligned."""
        rule = [":--"] + ["--:"] * (len(self.header) - 1)
        lines = [self.header, tuple(rule), *self.lines]
        return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"

    def csv(self) -> str:
        """As CSV (RFC 4180)."""
        buffer = io.StringIO()
        csv.writer(buffer).writerows([self.header, *self.lines])
        return buffer.getvalue()


Cell = tuple[str, int, int]  # scene, round, seed


def comparison_table(rows: Sequence[Row], columns: Sequence[Column] = COLUMNS) -> Table:
    """One line per method: the mean over all scene, round and seed cells that occur in ``rows`` for any method.

    A method that could be run in no cell has its reason in the first number's place.

    A mean over fewer cells than there are is followed by its count, e.g. ``21.40 (3/4)``; without any value the cell says ``missing``.
    Of methods that were run several times, the standard deviation over the runs follows (root mean square over the cells).
    Columns that no row has a value for are left out. Means of lines with different counts cannot be compared, nor lines whose Gaussians
    were treated differently (``Gaussians``, see `Fit`).

    Raises:
        ValueError: two rows have the same scene, round, seed and method.
    """
    by_key = _indexed(rows)
    cells = _cells(rows)
    shown = [column for column in columns if any(_value(by_key, *key, column) is not None for key in by_key)]
    lines = []
    for method in _methods(rows):
        done = str(sum((cell, method) in by_key for cell in cells))
        values = _cell_texts(rows, by_key, cells, method, shown)
        lines.append((METHOD_TITLES.get(method, method), _fits(by_key, cells, method), done, *values))
    header = ("method", "Gaussians", f"cells of {len(cells)}", *(f"{column.title} {column.better}" for column in shown))
    return Table(header=header, lines=tuple(lines))


def scene_table(rows: Sequence[Row], columns: Sequence[Column] = COLUMNS) -> Table:
    """One line per scene, round, seed and method, absent ones included as missing. Raises as `comparison_table`."""
    by_key = _indexed(rows)
    shown = [column for column in columns if any(_value(by_key, *key, column) is not None for key in by_key)]
    lines = []
    for cell in _cells(rows):
        for method in _methods(rows):
            values = _cell_texts(rows, by_key, [cell], method, shown)
            title, fit = METHOD_TITLES.get(method, method), _fits(by_key, [cell], method)
            lines.append((cell[0], str(cell[1]), str(cell[2]), title, fit, *values))
    header = ("scene", "round", "seed", "method", "Gaussians", *(f"{column.title} {column.better}" for column in shown))
    return Table(header=header, lines=tuple(lines))


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
    columns: Sequence[Column],
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
            return [*dict.fromkeys(reasons), *[NOT_APPLICABLE] * len(columns)][: len(columns)]
    return [_cell_text(by_key, cells, method, column) for column in columns]


def _fits(by_key: dict[tuple[Cell, str], MetricsRow], cells: Sequence[Cell], method: str) -> str:
    """What was done to the method's Gaussians; more than one word if it was not the same in all cells."""
    found = dict.fromkeys(by_key[cell, method].fit for cell in cells if (cell, method) in by_key)
    return ", ".join(found) or NOT_APPLICABLE


def _methods(rows: Sequence[Row]) -> list[str]:
    known = list(METHOD_TITLES)
    return sorted({row.method for row in rows}, key=lambda m: (known.index(m) if m in known else len(known), m))


def _value(by_key: dict[tuple[Cell, str], MetricsRow], cell: Cell, method: str, column: Column) -> float | None:
    row = by_key.get((cell, method))
    if row is None or (column.expansion and method == BEFORE):
        return None
    if column.name != "coverage_gained":
        return row.value(column.name)
    before = by_key.get((cell, BEFORE))
    after = row.navigation_coverage
    if before is None or before.navigation_coverage is None or after is None:
        return None
    return after - before.navigation_coverage


def _cell_text(by_key: dict[tuple[Cell, str], MetricsRow], cells: Sequence[Cell], method: str, column: Column) -> str:
    if column.expansion and method == BEFORE:
        return NOT_APPLICABLE
    values = [value for cell in cells if (value := _value(by_key, cell, method, column)) is not None]
    if not values:
        return MISSING
    text = f"{sum(values) / len(values):.{column.digits}f}"
    spreads = [
        row.spread[column.name] for cell in cells if (row := by_key.get((cell, method))) and column.name in row.spread
    ]
    if spreads:
        text += f" ± {math.sqrt(sum(value * value for value in spreads) / len(spreads)):.{column.digits}f}"
    return text if len(values) == len(cells) else f"{text} ({len(values)}/{len(cells)})"
