"""The table of what the stages of a run take."""

from __future__ import annotations

from pathlib import Path

import pytest
from stage_costs import table

from sceneexpander.artifacts.store import write_json_atomic


def leave(scene: Path, name: str, started: float, cpu_s: float, peak: float) -> None:
    path = scene / "round_1" / "stats" / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json_atomic(path, {"started": started, "cpu_s": cpu_s, "wall_s": 2 * cpu_s, "peak_rss_mb": peak, "host": {}})


def test_runs_of_a_stage_are_added_up_in_the_order_of_the_run(tmp_path: Path) -> None:
    leave(tmp_path, "render-sceneexpander", 30.0, 4.0, 100.0)
    leave(tmp_path, "render-captured", 20.0, 3.0, 300.0)
    leave(tmp_path, "adapt", 10.0, 50.0, 200.0)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table(tmp_path).splitlines()[2:]]
    assert rows == [
        ["adapt", "1", "50.0", "100.0", "200"],
        ["render", "2", "7.0", "14.0", "300"],
        ["together", "3", "57.0", "114.0", "300"],
    ]


def test_a_scene_that_never_ran_is_said(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="holds no statistics"):
        table(tmp_path)
