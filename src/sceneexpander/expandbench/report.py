"""The benchmark's result as one Markdown text."""

from __future__ import annotations

from collections.abc import Sequence

from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult, Plan
from sceneexpander.expandbench.table import (
    COLUMNS,
    acceptance_table,
    alone_table,
    curve_table,
    main_table,
    paired_table,
)


def report(cells: Sequence[CellResult], plan: Plan, *, model: str) -> str:
    """All tables, with what they are means over."""
    steps = sorted({cell.steps for cell in cells if cell.row not in (CAPTURED, BASELINE)})
    seconds = [cell.seconds for cell in cells if cell.steps]
    cost = f"{sum(seconds) / len(seconds):.0f} s per adaptation" if seconds else "nothing adapted"
    codes = len({cell.code for cell in cells})
    mixed = f" **Results of {codes} versions of the code.**" if codes > 1 else ""
    parts = [
        f"Reconstructor: {model}. {len(plan.scenes)} scenes, grades {', '.join(plan.grades)}, seeds "
        f"{', '.join(map(str, plan.seeds))}, {', '.join(map(str, steps)) or 'no'} steps, {cost}.{mixed}",
        "## Rows\n\nMeans over scenes and grades; ± is the standard deviation over seeds of that mean. `captured` is the "
        "pre-insertion scene, `baseline` the same weights given the inserted view.\n\n" + main_table(cells),
        "## Differences to the baseline\n\nSame scene and grade; mean over scenes, the worst scene, and how many scenes are "
        "better.\n\n" + paired_table(cells),
        "## Control: the adapted weights without the inserted view\n\nThe same weights given the captured views alone. What a "
        "row gains here is not repair of an insertion.\n\n" + alone_table(cells),
        "## Against misalignment\n\n" + curve_table(cells, list(plan.rows)),
        curve_table(cells, list(plan.rows), next(column for column in COLUMNS if column.name == "new_psnr_db")),
        "## Judging candidates before inserting them\n\n" + acceptance_table(cells),
    ]
    return "\n\n".join(part.rstrip() for part in parts) + "\n"
