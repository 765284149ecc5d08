"""track: mirror the pipeline's files into MLflow. Runs also when every other stage came from the cache; records nothing twice."""

from __future__ import annotations

import functools
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.config.files import read_sections, read_yaml
from sceneexpander.project import SWEEP_ENV
from sceneexpander.tracking import TrackingConfig, record_runs, scene_runs
from stages import layout
from stages.runner import Cell, project_root, stage

MARKER = Path("mlflow/tracked.json")


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    tracking: TrackingConfig


def commit_of(folder: Path) -> str:
    """The commit of the sources, or ``unknown`` outside of version control."""
    done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else "unknown"


def _large_files(scene: str, number: int, method: str) -> list[Path]:
    return [layout.renders(scene, number, method) / "gaussians.ply"]


@stage()
def main(_: Cell) -> None:
    """Record what is missing; the marker holds the runs' identities, which are the same on every machine."""
    selected: dict[str, Any] = read_yaml(Path("params.yaml"))
    keys: dict[str, list[str]] = {}
    root = project_root()
    for scene in selected["scenes"]:
        sections = read_sections(layout.config(scene), Sections)
        records = scene_runs(
            layout.PAGES / scene,
            commit=commit_of(root),
            extra=functools.partial(_large_files, scene),
        )
        record_runs(records, sections.tracking, root, sweep=os.environ.get(SWEEP_ENV))
        keys[scene] = [record.key for record in records]
    write_json_atomic(MARKER, keys)


if __name__ == "__main__":
    main()
