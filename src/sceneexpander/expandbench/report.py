"""A plan's result as one Markdown text."""

from __future__ import annotations

from collections.abc import Sequence

from sceneexpander.catalogue import metric_named
from sceneexpander.expandbench.document import powerless, references_of
from sceneexpander.expandbench.run import BASELINE, CAPTURED, CellResult, Plan
from sceneexpander.expandbench.scenes import DEVELOPMENT, TEST
from sceneexpander.expandbench.table import (
    COLUMNS,
    acceptance_table,
    alone_table,
    components_table,
    curve_table,
    main_table,
    paired_table,
)


def report(cells: Sequence[CellResult], plan: Plan, *, model: str, visits: int) -> str:
    """All tables, with what they are means over.

    Args:
        cells: what was measured.
        plan: what was to be measured.
        model: name of the reconstructor.
        visits: of the fit of the Gaussians, per view; 0: as predicted.
    """
    steps = sorted({cell.steps for cell in cells if cell.row not in (CAPTURED, BASELINE)})
    seconds = [cell.seconds for cell in cells if cell.steps]
    cost = f"{sum(seconds) / len(seconds):.0f} s per adaptation" if seconds else "nothing adapted"
    codes = len({cell.code for cell in cells})
    mixed = f" **Results of {codes} versions of the code.**" if codes > 1 else ""
    kinds = [
        f"{count} {kind}"
        for kind, names in (("development", DEVELOPMENT), ("test", TEST))
        if (count := sum(scene in names for scene in plan.scenes))
    ]
    fit = f"Gaussians fitted, {visits} visits per view" if visits else "Gaussians as predicted"
    parts = [
        f"Reconstructor: {model}. {' and '.join(kinds)} scenes, grades {', '.join(plan.grades)}, seeds "
        f"{', '.join(map(str, plan.seeds))}, {', '.join(map(str, steps)) or 'no'} steps, {cost}; {fit}.{mixed}",
        "## Rows\n\nMeans over scenes and grades; ± is the standard deviation over seeds of that mean. `captured` is the "
        "pre-insertion scene, `baseline` the same weights given the inserted view.\n\n" + main_table(cells),
        "## Differences to the baseline\n\nSame scene, grade and seed; mean over scenes, ± over seeds, the worst scene, and how many "
        "scenes are better.\n\n" + paired_table(cells),
        "## Component by component\n\n"
        + components_table(cells, references_of(plan.rows), powerless(plan.rows), COLUMNS),
        "## Control: the adapted weights without the inserted view\n\nThe same weights given the captured views alone. What a "
        "row gains here is not repair of an insertion.\n\n" + alone_table(cells),
        "## Against misalignment\n\n" + curve_table(cells, list(plan.rows)),
        curve_table(cells, list(plan.rows), metric_named("psnr_new_region_db")),
        "## Judging candidates before inserting them\n\n" + acceptance_table(cells),
    ]
    return "\n\n".join(part.rstrip() for part in parts) + "\n"
