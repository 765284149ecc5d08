"""Runs on a server: a real MLflow server process, with SQLite and a store for artefacts of its own."""

from __future__ import annotations

import os
import shutil
import socket
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sceneexpander.errors import UserError
from sceneexpander.pipeline.processes import kept
from sceneexpander.tracking import TrackingConfig, record_runs
from sceneexpander.tracking.server import hide_credentials, require_server, where_runs_go
from sceneexpander.tracking.store import (
    COMPLETE_TAG,
    KEY_TAG,
    database_path,
    quiet_environment,
    without_foreign_settings,
)
from tests.worlds.runs import record

WRITERS = 3


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture(scope="module")
def server(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TrackingConfig]:
    """A server with empty tables. SCENEEXPANDER_TEST_BACKEND names another database, e.g. ``postgresql://...``."""
    folder = tmp_path_factory.mktemp("server")
    shutil.copy(database_path(template), folder / "server.db")
    uri = f"http://127.0.0.1:{free_port()}"
    backend = os.environ.get("SCENEEXPANDER_TEST_BACKEND", f"sqlite:///{folder / 'server.db'}")
    command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", uri.rpartition(":")[2]]
    command += ["--workers", "1", "--backend-store-uri", backend]
    command += ["--artifacts-destination", str(folder / "files")]
    environment = without_foreign_settings(os.environ)
    with kept(command, cwd=folder, env=environment) as process:
        deadline = time.monotonic() + 300
        while True:
            try:
                with urllib.request.urlopen(f"{uri}/health", timeout=5):  # noqa: S310
                    break
            except OSError:
                assert process.poll() is None, "the server ended"
                assert time.monotonic() < deadline
                time.sleep(0.1)
        yield TrackingConfig(uri=uri, experiment="tests")


def client_of(config: TrackingConfig) -> Any:
    quiet_environment()
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=config.uri)


def runs_of(config: TrackingConfig) -> list[Any]:
    client = client_of(config)
    return list(client.search_runs([client.get_experiment_by_name(config.experiment).experiment_id]))


def test_parallel_writers_start_an_experiment_and_record_every_run_once(server: TrackingConfig, tmp_path: Path) -> None:
    config = replace(server, experiment="race")
    client_of(config)
    at_once = threading.Barrier(WRITERS)

    def write(number: int) -> None:
        root = tmp_path / str(number)  # machines share no lock files
        root.mkdir()
        records = [record(root, "shared"), record(root, f"own {number}")]
        at_once.wait()
        record_runs(records, config, root, sweep=f"s{number}")

    with ThreadPoolExecutor(WRITERS) as pool:
        list(pool.map(write, range(WRITERS)))
    recorded = runs_of(config)
    assert sorted(run.data.tags[KEY_TAG] for run in recorded) == [*(f"own {k}" for k in range(WRITERS)), "shared"]
    assert all(COMPLETE_TAG in run.data.tags for run in recorded)
    (shared,) = [run for run in recorded if run.data.tags[KEY_TAG] == "shared"]
    assert {tag for tag in shared.data.tags if tag.startswith("sweep.")} == {f"sweep.s{k}" for k in range(WRITERS)}


def test_runs_arrive_whole_and_twenty_repeats_add_none(server: TrackingConfig, tmp_path: Path) -> None:
    records = [record(tmp_path, "a"), record(tmp_path, "b")]
    assert record_runs(records, server, tmp_path) == (2, 0)
    first = {run.info.run_id for run in runs_of(server)}
    for _ in range(20):
        assert record_runs(records, server, tmp_path) == (0, 2)
    again = runs_of(server)
    assert {run.info.run_id for run in again} == first
    client = client_of(server)
    for run in again:
        assert run.info.status == "FINISHED"
        assert run.data.metrics["psnr_db"] == 20.5
        points = client.get_metric_history(run.info.run_id, "4_loss/loss_with_inserted")
        assert [(point.step, point.value) for point in points] == [(1, 3.0), (2, 2.0), (5, 1.0)]
        picture = client.download_artifacts(run.info.run_id, "pictures/picture.txt", str(tmp_path))
        assert Path(picture).read_text() == "pixels"
    assert not (tmp_path / "mlflow" / "artifacts").exists(), "files lie with the server"
    assert not (tmp_path / "mlflow" / "mlflow.db").exists()


def test_a_run_that_another_machine_is_recording_is_left_alone(server: TrackingConfig, tmp_path: Path) -> None:
    config = replace(server, experiment="half-recorded")
    record_runs([record(tmp_path, "theirs")], config, tmp_path)
    client = client_of(server)
    (theirs,) = runs_of(config)
    client.delete_tag(theirs.info.run_id, COMPLETE_TAG)  # as it is until they have finished
    record_runs([record(tmp_path, "ours")], config, tmp_path)
    assert theirs.info.run_id in {run.info.run_id for run in runs_of(config)}
    client.set_tag(theirs.info.run_id, "recording", "0")  # they were killed long ago
    record_runs([record(tmp_path, "ours as well")], config, tmp_path)
    assert theirs.info.run_id not in {run.info.run_id for run in runs_of(config)}


def test_a_server_that_is_there_is_required_without_a_word(server: TrackingConfig) -> None:
    require_server(server)
    require_server(TrackingConfig())
    require_server(TrackingConfig(uri="off"))


def test_a_server_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    uri = f"http://me:secret@127.0.0.1:{free_port()}"
    with pytest.raises(UserError) as caught:
        require_server(TrackingConfig(uri=uri))
    line = caught.value.line()
    assert line.startswith(f"tracking.uri {hide_credentials(uri)}: does not answer (Connection refused)")
    assert "\n" not in line
    assert "secret" not in line
    with pytest.raises(UserError, match="does not answer"):
        require_server(TrackingConfig(uri="http://no-such-host.invalid:5000"))


SERVER = "http://host:5000"


@pytest.mark.parametrize(
    ("configured", "shell", "uri"),
    [
        ("local", {}, "local"),
        ("local", {"MLFLOW_TRACKING_URI": ""}, "local"),
        ("local", {"MLFLOW_TRACKING_URI": SERVER}, SERVER),
        ("off", {"MLFLOW_TRACKING_URI": SERVER}, "off"),
        ("http://other", {"MLFLOW_TRACKING_URI": SERVER}, "http://other"),
        ("off", {"MLFLOW_TRACKING_URI": "./mlruns"}, "off"),
    ],
)
def test_the_shell_names_a_server_where_the_settings_name_none(
    configured: str, shell: dict[str, str], uri: str
) -> None:
    config = TrackingConfig(uri=configured, experiment="mine")
    assert where_runs_go(config, shell) == TrackingConfig(uri=uri, experiment="mine")


@pytest.mark.parametrize("named", ["./mlruns", "databricks", "sqlite:///x.db", "host:5000"])
def test_what_is_no_server_is_refused(named: str) -> None:
    with pytest.raises(UserError, match=r"MLFLOW_TRACKING_URI: is .* which is no server"):
        where_runs_go(TrackingConfig(), {"MLFLOW_TRACKING_URI": named})
