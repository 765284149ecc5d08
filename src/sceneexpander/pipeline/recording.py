"""When the last stage, which records runs with MLflow, has to run although none of its inputs changed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.store import read_json, read_typed
from sceneexpander.errors import UserError
from sceneexpander.pipeline.project import ROOT_ENV
from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.server import hide_credentials, where_runs_go
from sceneexpander.tracking.store import database_path

RECORDED = Path("mlflow") / "tracked.json"  # what the last stage leaves
_SCHEMA = "recorded/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedScene:
    """What of a scene is in MLflow.

    Attributes:
        configured: ``tracking.uri`` of the settings.
        store: where its runs are: that, or the server that the shell named. Both without passwords.
        runs: their identities, which are the same on every machine; None: they could not be recorded.
    """

    configured: str
    store: str
    runs: tuple[str, ...] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """What of every scene is in MLflow."""

    scenes: Mapping[str, RecordedScene]
    schema: str = _SCHEMA


def ask_for_recording() -> None:
    """Have the last stage run again if its recording did not succeed, or is not where runs go today: another server, a lost database.

    Its inputs are the same, so it would be left out.
    """
    if not RECORDED.is_file():
        return
    try:
        recorded = read_typed(Recorded, read_json(RECORDED), RECORDED)
        asked = any(_is_missing(scene) for scene in recorded.scenes.values())
    except UserError:  # of another version; or the shell names no server, which the stage will say
        asked = True
    if asked:
        RECORDED.unlink()


def _is_missing(scene: RecordedScene) -> bool:
    if scene.runs is None:
        return True
    store = scene.store
    if scene.configured == "local":
        store = hide_credentials(where_runs_go(TrackingConfig(), os.environ).uri)
    lost = store == "local" and bool(scene.runs) and not database_path(Path(os.environ.get(ROOT_ENV, "."))).is_file()
    return lost or store != scene.store
