"""Gain and loss against misalignment, as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sceneexpander.catalogue import Metric
from sceneexpander.expandbench.grades import GRADES
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult
from sceneexpander.expandbench.table import COLUMNS, compare_rows, row_names

UNITS = {
    "rotation": "degrees, camera estimated",
    "told_rotation": "degrees, intended camera given",
    "translation": "% of scene size, camera estimated",
    "told_translation": "% of scene size, intended camera given",
    "warp": "local warp, % of width",
    "deform": "objects moved, % of scene size",
    "mixed": "everything, x a good generator's",
    "exposure": "exposure, tenths of a stop",
}


def curve(cells: Sequence[CellResult], row: str, axis: str, column: Metric) -> list[tuple[float, float]]:
    """(amount, mean difference to the pre-insertion scene) along an axis, the clean insertion at amount 0 if it was measured."""
    start = "told_clean" if axis.startswith("told_") else "clean"
    points = []
    for grade in [GRADES[start], *(grade for grade in GRADES.values() if grade.axis == axis)]:
        here = [cell for cell in cells if cell.row == CAPTURED or (cell.row == row and cell.grade == grade.name)]
        found = compare_rows(here, row, column, against=CAPTURED)
        if found is not None:
            points.append((0.0 if grade.name == start else grade.amount, column.factor * found.mean))
    return points


def plot(cells: Sequence[CellResult], path: Path, *, rows: Sequence[str] = (), column: Metric = COLUMNS[0]) -> bool:
    """Write an SVG with one panel per axis of which two or more amounts were measured; False if there is none."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams["svg.hashsalt"] = "expandbench"  # the same picture gives the same bytes
    shown = [row for row in row_names(cells) if row != CAPTURED and (not rows or row in rows or row == BASELINE)]
    axes = [axis for axis in UNITS if len(curve(cells, BASELINE, axis, column)) > 1]
    if not axes:
        return False
    figure = Figure(figsize=(3.6 * len(axes), 3.2), layout="constrained")
    panels = figure.subplots(1, len(axes), sharey=True, squeeze=False)[0]
    for panel, axis in zip(panels, axes, strict=True):
        for row in shown:
            points = curve(cells, row, axis, column)
            style = {"color": "black", "linestyle": "--"} if row == BASELINE else {}
            panel.plot([x for x, _ in points], [y for _, y in points], marker="o", markersize=3, label=row, **style)
        panel.axhline(0, color="grey", linewidth=0.8)
        panel.set_xlabel(UNITS[axis], fontsize=8)
        panel.tick_params(labelsize=8)
    panels[0].set_ylabel(f"{column.heading} minus pre-insertion", fontsize=8)
    panels[-1].legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="svg", metadata={"Date": None})
    return True
