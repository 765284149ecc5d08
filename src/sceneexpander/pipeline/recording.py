"""When the last stage, which records runs with MLflow, has to run although none of its inputs changed."""

from __future__ import annotations

import json
import os
from pathlib import Path

from sceneexpander.config.files import read_yaml
from sceneexpander.pipeline.project import ROOT_ENV
from sceneexpander.tracking.store import database_path

RECORDED = Path("mlflow") / "tracked.json"  # what the last stage leaves: of every scene which runs are recorded


def ask_for_recording() -> None:
    """Have the last stage run again if its recording did not succeed, or the local database with it is lost.

    Its inputs are the same, so it would be left out.
    """
    try:
        recorded = json.loads(RECORDED.read_text(encoding="utf-8"))
        asked = None in recorded.values() or any(_database_is_lost(scene) for scene, keys in recorded.items() if keys)
    except (OSError, ValueError, AttributeError):
        return
    if asked:
        RECORDED.unlink()


def _database_is_lost(scene: str) -> bool:
    path = Path("outputs") / scene / "config.yaml"
    if not path.is_file() or database_path(Path(os.environ.get(ROOT_ENV, "."))).is_file():
        return False
    tracking = read_yaml(path)["tracking"]
    return tracking["uri"] == "local"
