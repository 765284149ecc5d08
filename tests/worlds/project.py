"""A whole project that the pipeline runs in, at a size for tests."""

from __future__ import annotations

import os
import re
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from sceneexpander.catalogue import METHODS as KNOWN
from sceneexpander.catalogue.methods import CORRECTED
from sceneexpander.pipeline.selection import Selection
from sceneexpander.pipeline.workspace import make_workspace, workspace_environment

ROOT = Path(__file__).parents[2]


SMOKE = ("profile=smoke", "frontend.sfm.max_features=800")


METHODS = (*(method.name for method in KNOWN if method.always_made), CORRECTED)


def textured(seed: int, side: int = 320) -> np.ndarray:
    """Smooth blobs at several scales: corners everywhere, at any resolution."""
    generator = np.random.default_rng(seed)
    picture = np.zeros((side, side, 3))
    for cells in (8, 24, 64):
        coarse = Image.fromarray(generator.integers(0, 256, (cells, cells, 3), dtype=np.uint8))
        picture += np.asarray(coarse.resize((side, side), Image.Resampling.BICUBIC), dtype=np.float64) / 3
    return picture


def parallax_view(shift: float, height: int = 96, width: int = 128) -> Image.Image:
    """A near square in front of a far wall, seen from a camera that moved sideways by ``shift``."""
    wall, square = textured(1), textured(2)
    far, near = round(40 + 6 * shift), round(30 + 18 * shift)
    picture = wall[40 : 40 + height, far : far + width].copy()
    left = 48 - round(12 * shift)
    picture[28:76, left : left + 44] = square[28:76, near + left : near + left + 44]
    return Image.fromarray(picture.clip(0, 255).astype(np.uint8))


def make_scene(folder: Path) -> Path:
    """Three photos and a picture from further to the side."""
    (folder / "captured").mkdir(parents=True)
    (folder / "inserted").mkdir()
    for index in range(3):
        parallax_view(0.6 * index).save(folder / "captured" / f"photo_{index}.png")
    parallax_view(2.4).save(folder / "inserted" / "round_1.png")
    (folder / "scene.yaml").write_text(
        'name: room\nrounds:\n  - prompt: "To the right is more of the wall."\n    inserted: inserted/round_1.png\n'
    )
    return folder


class Project:
    """A project folder of its own: the sources, one scene, and nothing of the developer's outputs."""

    def __init__(self, folder: Path, overrides: tuple[str, ...] = SMOKE) -> None:
        self.folder = folder
        scene = make_scene(folder.parent / f"{folder.name}-scene")
        selection = Selection(scenes=("room",), rounds=1, methods=METHODS, overrides=overrides)
        make_workspace(folder, selection, project=ROOT, scenes={"room": scene})
        (folder / ".dvc" / "config.local").write_text("[core]\n    no_scm = true\n")
        self.opened = folder.parent / f"{folder.name}-opened"  # of every stage: the files that it has read
        self.opened.mkdir()
        environment = workspace_environment(folder, folder)
        path = os.pathsep.join([str(ROOT / "tests" / "support" / "opened"), environment["PYTHONPATH"]])
        self.environment = {**environment, "PYTHONPATH": path, "OPENED_FOLDER": str(self.opened)}

    def run(self, *command: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [sys.executable, *command],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert not check or done.returncode == 0, done.stdout + done.stderr
        return done

    def repro(self, *, plain: bool = False) -> list[str]:
        """Run the pipeline as `make repro` does, or as plain ``dvc repro``; returns the stages that were executed."""
        command = ("-m", "dvc", "repro") if plain else ("-m", "sceneexpander.pipeline")
        return re.findall(r"Running stage '([^']+)'", self.run(*command).stdout)

    def runs(self) -> int:
        with sqlite3.connect(self.folder / "mlflow" / "mlflow.db") as database:
            return int(database.execute("SELECT count(*) FROM runs WHERE lifecycle_stage = 'active'").fetchone()[0])
