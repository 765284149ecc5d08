"""Recorded runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sceneexpander.tracking import RunRecord, TrackingConfig
from sceneexpander.tracking.store import (
    quiet_environment,
    tracking_uri,
)

CONFIG = TrackingConfig(uri="local", experiment="tests")


def record(folder: Path, key: str) -> RunRecord:
    picture = folder / "picture.txt"
    picture.write_text("pixels")
    return RunRecord(
        key=key,
        name=f"run {key}",
        params={"adapt.steps": "4", "prompt": "x" * 7000},
        metrics={"psnr_db": 20.5},
        curves={"4_loss/loss_with_inserted": [(1, 3.0), (2, 2.0), (5, 1.0)]},
        artefacts={"pictures/picture.txt": picture},
        tags={"scene": "room"},
        started_ms=1_700_000_000_000,
        duration_ms=3000,
    )


def client(root: Path) -> Any:
    quiet_environment()
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=tracking_uri(CONFIG, root))


def runs(root: Path) -> list[Any]:
    store = client(root)
    return list(store.search_runs([store.get_experiment_by_name("tests").experiment_id]))
