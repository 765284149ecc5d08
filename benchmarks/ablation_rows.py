"""What six rows of the ablation cost on one scene and one worker, against one adaptation: preparing the scene is common to all rows.

    python benchmarks/ablation_rows.py [key=value ...]

The paper's table: the baseline (no adaptation) and five adapted rows. CPU seconds of the process, from a fresh cache: preparing scene,
cameras and inserted picture, the scene before the insertion, the baseline, then one row after the other, each with the measurement of its
result. "One adaptation" is all of that up to the first adapted row (`paper`), which is what somebody pays who wants that row alone.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from sceneexpander.ablation import make_plan
from sceneexpander.expandbench.run import CellResult, Settings, run
from sceneexpander.expandbench.studies import TABLE
from sceneexpander.pipeline.project import find_project

FIRST = "paper"
SCENE, GRADE = "room_1", "mixed_2"


def main() -> None:
    """Command line."""
    overrides = sys.argv[1:]
    rows = (FIRST, *(row for row in TABLE if row != FIRST))
    plan, shared = make_plan(find_project(), rows, [SCENE], [GRADE], ["0"], overrides)
    took: list[tuple[str, int, float]] = []

    def note(cell: CellResult) -> None:
        took.append((cell.row, cell.steps, time.process_time() - started))
        print(f"{cell.row}: {cell.steps} steps, {took[-1][2]:.1f} CPU s so far", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as cache:
        settings = Settings(
            model=shared.model,
            frontend=shared.frontend,
            warmup=shared.warmup,
            refine=shared.refine,
            cache=Path(cache),
        )
        started = time.process_time()
        run(plan, settings, on_cell=note)
    print("| row | steps | CPU s |\n|---|---|---|")
    before = 0.0
    for row, steps, at in took:
        print(f"| {row} | {steps} | {at - before:.1f} |")
        before = at
    one = next(at for row, _, at in took if row == FIRST)
    print(
        f"\n{SCENE}, {GRADE}, seed 0, {' '.join(overrides) or 'as in the studies'}: one adaptation {one:.1f} CPU s, ",
        end="",
    )
    print(f"six rows {before:.1f} CPU s, {before / one:.2f} times as much")


if __name__ == "__main__":
    main()
