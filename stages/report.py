"""report: the page to look at, and the headline numbers as a small file for version control."""

from __future__ import annotations

import logging
from pathlib import Path

from sceneexpander.artifacts.judgement import JudgedRound
from sceneexpander.artifacts.metrics import MetricsRow, Row, UnavailableRow, load_row
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.errors import UserError
from sceneexpander.evaluation.judged import with_judged
from sceneexpander.evaluation.table import comparison_table, scene_table
from sceneexpander.files import directory_being_written, write_bytes_atomic
from sceneexpander.pipeline.selection import read_selection
from sceneexpander.report import write_page
from sceneexpander.report.judged import comparisons_table, judged_table
from stages import layout
from stages.runner import Cell, stage

RESULTS = Path("results/metrics.json")
LOST_SCENE = "missing: a stage of the scene failed"
_log = logging.getLogger(__name__)


def _digits(value: float) -> float:
    # Enough to compare, few enough that another machine's last bits do not show as a change.
    return float(f"{value:.5g}")


@stage()
def main(_: Cell) -> None:
    """Page, tables, numbers; scenes, rounds and methods as params.yaml lists them."""
    selected = read_selection(Path())
    rows: list[Row] = []
    judged: list[JudgedRound] = []
    numbers: dict[str, dict[str, dict[str, dict[str, float | str]]]] = {}
    scenes = layout.gathered_scenes(selected.scenes)
    for scene in scenes:
        for number in range(1, selected.rounds + 1):
            judged.append(JudgedRound.load(layout.PAGES / scene / f"round_{number}"))
            for method in selected.methods:
                row = load_row(layout.PAGES / scene / f"round_{number}" / method / "metrics.json")
                row = with_judged(row, judged[-1]) if isinstance(row, MetricsRow) else row
                rows.append(row)
                known: dict[str, float | str] = (
                    {name: _digits(value) for name, value in row.numbers().items()}
                    if isinstance(row, MetricsRow)
                    else {"unavailable": row.reason}
                )
                numbers.setdefault(scene, {}).setdefault(f"round_{number}", {})[method] = known
    if not rows:
        raise UserError("selects nothing to report", where="params.yaml", fix="name scenes, rounds and methods")
    missing = [scene for scene in selected.scenes if scene not in scenes]
    for scene in missing:
        _log.warning("scene %s is missing: a stage before failed", scene)
        for number in range(1, selected.rounds + 1):
            for method in selected.methods:
                model = next((known.model for known in rows if known.method == method), "")
                row = UnavailableRow(
                    scene=scene, round=number, method=method, model=model, seed=rows[0].seed, reason=LOST_SCENE
                )
                rows.append(row)
                numbers.setdefault(scene, {}).setdefault(f"round_{number}", {})[method] = {"unavailable": row.reason}
    with directory_being_written(layout.REPORT) as folder:
        write_page([layout.PAGES / scene for scene in scenes], folder, missing=missing)
        for name, table in (("comparison", comparison_table(rows)), ("scenes", scene_table(rows))):
            for ending, text in (("md", table.markdown()), ("csv", table.csv()), ("tex", table.latex())):
                write_bytes_atomic(folder / f"{name}.{ending}", text.encode())
        scores, comparisons = judged_table(judged, selected.methods), comparisons_table(judged)
        write_bytes_atomic(folder / "judged.csv", scores.csv().encode())
        if comparisons is not None:
            write_bytes_atomic(folder / "judged_pairs.csv", comparisons.csv().encode())
    write_json_atomic(RESULTS, numbers)


if __name__ == "__main__":
    main()
