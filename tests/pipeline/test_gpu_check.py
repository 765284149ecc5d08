"""The GPU check as it is called, on the CPU: the parts whose tests take longer. Limits are for a machine of one's own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sceneexpander.artifacts.store import read_json

pytestmark = [pytest.mark.pipeline, pytest.mark.slow, pytest.mark.timeout(1200)]

ROOT = Path(__file__).parents[2]


# The others: tests/unit/scripts. `pipeline` repeats `profile=smoke` on the bundled scene (six minutes) and is run by hand, see docs/gpu.md.
PARTS = ("adapt_paper", "adapt_plain", "options")


def test_the_parts_pass_and_the_report_says_so(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "gpu_check.py"), "--smoke", "--out", str(tmp_path)]
    done = subprocess.run(
        [*command, "--budget", "1000", "--patience", "4", "--only", *PARTS],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    outcomes = {outcome["part"]: outcome for outcome in read_json(tmp_path / "gpu_check.json")["outcomes"]}
    reasons = {part: outcome["reason"] for part, outcome in outcomes.items()}
    assert {part: outcomes[part]["status"] for part in PARTS} == dict.fromkeys(PARTS, "passed"), reasons
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "gpu_check.txt").read_text()
    assert "SMOKE MODE" in page
