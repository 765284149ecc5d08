"""The GPU check's own process and its pipeline, on the CPU: the parts whose tests take longer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sceneexpander.artifacts.store import read_json

pytestmark = pytest.mark.pipeline

ROOT = Path(__file__).parents[2]
PARTS = ("adapt_paper", "options", "adapt_plain", "pipeline")  # the others: tests/unit/scripts


def test_the_bundled_scene_runs_end_to_end_and_the_report_says_so(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "gpu_check.py"), "--smoke", "--out", str(tmp_path)]
    # Limits are for a machine of one's own.
    done = subprocess.run(
        [*command, "--budget", "900", "--patience", "3", "--only", *PARTS],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    outcomes = read_json(tmp_path / "gpu_check.json")["outcomes"]
    status = {outcome["part"]: outcome["status"] for outcome in outcomes}
    reasons = {outcome["part"]: outcome["reason"] for outcome in outcomes}
    assert status == {**dict.fromkeys(PARTS, "passed"), "gsplat_build": "skipped"}, reasons
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "gpu_check.txt").read_text()
    assert "SMOKE MODE" in page
    assert "the report is there: True" in page
