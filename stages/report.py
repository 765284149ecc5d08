"""report: the page to look at, and the headline numbers as a small file for version control."""

from __future__ import annotations

from pathlib import Path

from sceneexpander.artifacts.judgement import JudgedRound
from sceneexpander.artifacts.metrics import MetricsRow, Row, load_row
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
    for scene in selected.scenes:
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
    with directory_being_written(layout.REPORT) as folder:
        write_page([layout.PAGES / scene for scene in selected.scenes], folder)
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
