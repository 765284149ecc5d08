"""Stages import only what they use: a run starts some twenty of them, and torch alone takes seconds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sceneexpander.pipeline.fingerprint import SourceTree

ROOT = Path(__file__).parents[2]
LIGHT = (
    "fingerprint",
    "correct",
    "rival",
    "optimise",
    "gaussian_splatting",
    "render",
    "pack",
    "evaluate",
    "judge",
    "track",
)


@pytest.mark.parametrize("stage", LIGHT)
def test_stages_that_mostly_move_small_facts_start_without_torch(stage: str) -> None:
    script = f"import sys, stages.{stage}; print(sorted({{'torch', 'cv2', 'mlflow', 'hydra'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(("name", "chosen"), [("OMP_WAIT_POLICY", "ACTIVE"), ("OPENBLAS_NUM_THREADS", "2")])
def test_idle_threads_of_a_stage_sleep_unless_the_user_says_otherwise(name: str, chosen: str) -> None:
    script = f"import os, stages; print(os.environ[{name!r}])"
    plain = {key: value for key, value in os.environ.items() if key != name}
    said = []
    for environment in (plain, {**plain, name: chosen}):
        command = [sys.executable, "-c", script]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
        said.append(done.stdout.strip())
    assert said[0] in {"PASSIVE", "1"}
    assert said[1] == chosen


def test_code_that_is_imported_late_still_counts_as_the_stage_s_code() -> None:
    tree = SourceTree(packages={"sceneexpander": ROOT / "src" / "sceneexpander", "stages": ROOT / "stages"})
    assert "sceneexpander.inference.rivals" in tree.closure("stages.rival")
    assert "sceneexpander.optimisation.optimise" in tree.closure("stages.gaussian_splatting")
