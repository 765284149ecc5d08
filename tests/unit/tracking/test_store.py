"""Recording: once, completely, whatever happens in between."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sceneexpander.errors import UserError
from sceneexpander.tracking import RunRecord, TrackingConfig, flatten, record_runs, run_key
from sceneexpander.tracking.store import COMPLETE_TAG, database_path, quiet_environment, tracking_uri

CONFIG = TrackingConfig(uri="local", experiment="tests")


def record(folder: Path, key: str) -> RunRecord:
    picture = folder / "picture.txt"
    picture.write_text("pixels")
    return RunRecord(
        key=key,
        name=f"run {key}",
        params={"adapt.steps": "4", "prompt": "x" * 7000},
        metrics={"psnr_db": 20.5},
        curves={"4_loss/objective_with_inserted": [(1, 3.0), (2, 2.0), (5, 1.0)]},
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


def test_a_run_is_whole(root: Path) -> None:
    assert record_runs([record(root, "a")], CONFIG, root) == (1, 0)
    (run,) = runs(root)
    assert run.data.metrics["psnr_db"] == 20.5
    assert run.data.params["adapt.steps"] == "4"
    assert run.data.tags["scene"] == "room"
    assert run.info.status == "FINISHED"
    assert run.info.start_time == 1_700_000_000_000
    history = client(root).get_metric_history(run.info.run_id, "4_loss/objective_with_inserted")
    assert [(point.step, point.value) for point in history] == [(1, 3.0), (2, 2.0), (5, 1.0)]
    assert [item.path for item in client(root).list_artifacts(run.info.run_id, "pictures")] == ["pictures/picture.txt"]
    assert run.info.artifact_uri.startswith((root / "mlflow" / "artifacts").as_uri())


def test_recording_again_adds_nothing(root: Path) -> None:
    record_runs([record(root, "a")], CONFIG, root)
    assert record_runs([record(root, "a"), record(root, "b")], CONFIG, root) == (1, 1)
    assert record_runs([record(root, "a"), record(root, "b")], CONFIG, root) == (0, 2)
    assert len(runs(root)) == 2


def test_a_half_recorded_run_is_replaced(root: Path) -> None:
    record_runs([record(root, "a")], CONFIG, root)
    (run,) = runs(root)
    with sqlite3.connect(database_path(root)) as database:  # as if the process had died before the last tag
        database.execute("DELETE FROM tags WHERE key = ? AND run_uuid = ?", (COMPLETE_TAG, run.info.run_id))
    assert record_runs([record(root, "a")], CONFIG, root) == (1, 0)
    (again,) = runs(root)
    assert again.info.run_id != run.info.run_id


def test_a_sweep_marks_old_runs_too(root: Path) -> None:
    record_runs([record(root, "a")], CONFIG, root)
    assert record_runs([record(root, "a")], CONFIG, root, sweep="s1") == (0, 1)
    assert runs(root)[0].data.tags["sweep.s1"] == "1"


def test_off_makes_nothing(tmp_path: Path) -> None:
    assert record_runs([record(tmp_path, "a")], replace(CONFIG, uri="off"), tmp_path) == (0, 0)
    assert not (tmp_path / "mlflow").exists()


def test_an_address_must_be_one() -> None:
    with pytest.raises(UserError, match="use local, off, or http"):
        TrackingConfig(uri="mlruns")


def test_keys_are_identities() -> None:
    assert run_key({"a": 1, "b": 2}, "x") == run_key({"b": 2, "a": 1}, "x")
    assert run_key({"a": 1}, "x") != run_key({"a": 2}, "x")


def test_flatten_writes_dotted_keys() -> None:
    assert flatten({"adapt": {"steps": 4, "augment": {"grid": 3}}, "device": "cpu", "file": None}) == {
        "adapt.steps": "4",
        "adapt.augment.grid": "3",
        "device": "cpu",
        "file": "null",
    }
