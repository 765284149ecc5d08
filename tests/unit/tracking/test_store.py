"""Recording: once, completely, whatever happens in between."""

from __future__ import annotations

import os
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest

from sceneexpander.artifacts.page import flatten
from sceneexpander.errors import UserError
from sceneexpander.tracking import TrackingConfig, record_runs, run_key
from sceneexpander.tracking.store import (
    COMPLETE_TAG,
    database_path,
    open_store,
    set_damaged_aside,
    tracking_uri,
    without_foreign_settings,
)
from tests.worlds.runs import CONFIG, client, record, runs


def test_a_run_is_whole(root: Path) -> None:
    assert record_runs([record(root, "a")], CONFIG, root) == (1, 0)
    (run,) = runs(root)
    assert run.data.metrics["psnr_db"] == 20.5
    assert run.data.params["adapt.steps"] == "4"
    assert run.data.tags["scene"] == "room"
    assert run.info.status == "FINISHED"
    assert run.info.start_time == 1_700_000_000_000
    history = client(root).get_metric_history(run.info.run_id, "4_loss/loss_with_inserted")
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


@pytest.mark.parametrize(
    "name", ["a%20b", "what?", "a?b=c", "x#y", "100%", "{d} ${X}", "a:b@c", "写真", 'it\'s "q"', "a&b;c"]
)
def test_a_store_is_made_in_a_folder_of_any_name(name: str, tmp_path: Path) -> None:
    from sqlalchemy.engine import make_url

    folder = tmp_path / "in" / name
    url = make_url(tracking_uri(CONFIG, folder))
    assert (url.database, dict(url.query)) == (str(database_path(folder)), {})


def test_runs_are_recorded_in_a_folder_of_any_name(tmp_path: Path) -> None:
    name = "a%20b, what? #1 100% %(x)s {d} ${X}"  # all at once: making a store takes seconds
    folder = tmp_path / "in" / name
    folder.mkdir(parents=True)
    assert record_runs([record(folder, "a")], CONFIG, folder) == (1, 0)
    assert record_runs([record(folder, "a")], CONFIG, folder) == (0, 1)
    assert database_path(folder).is_file()
    (run,) = runs(folder)
    assert [item.path for item in client(folder).list_artifacts(run.info.run_id, "pictures")] == [
        "pictures/picture.txt"
    ]
    assert list((folder / "mlflow" / "artifacts").rglob("picture.txt"))
    assert [path.name for path in (tmp_path / "in").iterdir()] == [name], "nothing beside the project"


@pytest.mark.parametrize("damage", ["noise", "cut", "cut to a page", "overwritten"])
def test_a_damaged_database_is_set_aside(damage: str, root: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = database_path(root)
    data = path.read_bytes()
    damaged = {
        "noise": bytes(range(256)) * 40,
        "cut": data[: len(data) // 2 + 7],
        "cut to a page": data[: len(data) // 4096 // 2 * 4096],
        "overwritten": data[:4096] + b"\xff" * (len(data) // 2) + data[4096 + len(data) // 2 :],
    }[damage]
    path.write_bytes(damaged)
    aside = set_damaged_aside(root)
    assert aside == path.with_name("mlflow.db.damaged-1")
    assert aside.read_bytes() == damaged
    assert not path.exists()
    assert "a new one is begun" in caplog.text
    if damage == "noise":
        path.write_bytes(damaged)
        assert record_runs([record(root, "a")], CONFIG, root) == (1, 0)
        assert path.with_name("mlflow.db.damaged-2").exists()


def test_a_sound_database_stays(root: Path) -> None:
    assert set_damaged_aside(root) is None
    assert database_path(root).is_file()


@pytest.mark.parametrize("text", ["table experiments already exists", "database is locked"])
def test_first_writers_wait_for_each_other(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sqlalchemy.exc import OperationalError

    attempts = []

    def busy_at_first(*_: object) -> tuple[str, str]:
        attempts.append(1)
        if len(attempts) < 3:
            raise OperationalError("CREATE TABLE", {}, sqlite3.OperationalError(text))
        return "client", "1"

    monkeypatch.setattr("sceneexpander.tracking.store._open", busy_at_first)
    assert open_store(CONFIG, tmp_path) == ("client", "1")
    assert len(attempts) == 3


def test_what_does_not_pass_by_waiting_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise OSError("disk on fire")

    monkeypatch.setattr("sceneexpander.tracking.store._open", broken)
    with pytest.raises(UserError, match=r"tracking\.uri local: cannot be used \(disk on fire\)"):
        open_store(CONFIG, tmp_path)


def test_mlflow_itself_does_not_look_at_the_shell(root: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", elsewhere.as_uri())
    monkeypatch.setenv("MLFLOW_EXPERIMENT_NAME", "other")
    assert record_runs([record(root, "a")], CONFIG, root) == (1, 0)
    assert len(runs(root)) == 1
    assert not elsewhere.exists()
    assert "MLFLOW_TRACKING_URI" not in os.environ


def test_what_a_server_needs_stays() -> None:
    shell = {"MLFLOW_TRACKING_USERNAME": "t", "MLFLOW_TRACKING_URI": "x", "MLFLOW_BACKEND_STORE_URI": "x", "PATH": "p"}
    kept = without_foreign_settings(shell)
    assert kept["MLFLOW_TRACKING_USERNAME"] == "t"
    assert kept["PATH"] == "p"
    assert not {"MLFLOW_TRACKING_URI", "MLFLOW_BACKEND_STORE_URI"} & set(kept)
