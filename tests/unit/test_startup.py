"""Stages import only what they use: a run starts some twenty of them, and torch alone takes seconds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sceneexpander.fingerprint import SourceTree

ROOT = Path(__file__).parents[2]
LIGHT = ("fingerprint", "rival", "optimise", "gaussian_splatting", "track")


@pytest.mark.parametrize("stage", LIGHT)
def test_stages_that_mostly_move_small_facts_start_without_torch(stage: str) -> None:
    script = f"import sys, stages.{stage}; print(sorted({{'torch', 'cv2', 'mlflow', 'hydra'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_code_that_is_imported_late_still_counts_as_the_stage_s_code() -> None:
    tree = SourceTree(packages={"sceneexpander": ROOT / "src" / "sceneexpander", "stages": ROOT / "stages"})
    assert "sceneexpander.inference.rivals" in tree.closure("stages.rival")
    assert "sceneexpander.optimisation.optimise" in tree.closure("stages.gaussian_splatting")
