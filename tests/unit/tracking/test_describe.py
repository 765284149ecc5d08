"""What experiment and runs say about themselves."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sceneexpander.artifacts.cameras import CameraReport, ViewCamera
from sceneexpander.catalogue import Group, measured_metrics
from sceneexpander.catalogue.course import COURSE
from sceneexpander.tracking import TrackingConfig, record_runs
from sceneexpander.tracking.describe import (
    NOTE_TAG,
    describe_experiment,
    experiment_links,
    experiment_note,
    run_note,
    saved_views,
)
from sceneexpander.tracking.store import NAMES, database_path, describe_experiments, last_experiment
from tests.worlds.runs import CONFIG, client, record, runs


def tags(root: Path) -> dict[str, str]:
    return dict(client(root).get_experiment_by_name(CONFIG.experiment).tags)


def test_an_experiment_describes_itself_and_has_views_of_its_table(root: Path) -> None:
    record_runs([record(root, "a")], CONFIG, root)
    found = tags(root)
    assert found[NOTE_TAG] == experiment_note()
    for group in Group:
        assert f"`{group}`" in found[NOTE_TAG]
    known = {item.tracked for item in (*measured_metrics(), *COURSE)}
    for view in saved_views():
        saved = json.loads(found[f"mlflow.sharedViewState.{view.key}"])
        assert saved["name"] == view.name
        columns = json.loads(saved["state"])["selectedColumns"]
        metrics = [column.split("`")[1] for column in columns if column.startswith("metrics.")]
        assert metrics
        assert set(metrics) <= known
    made = [json.loads(found[f"mlflow.sharedViewState.{view.key}"])["createdAt"] for view in saved_views()]
    assert made == sorted(made, reverse=True), "the menu shows the newest first"
    assert max(map(len, found.values())) < 5000


def test_the_links_open_a_view_that_there_is() -> None:
    links = experiment_links("http://127.0.0.1:5000", "7")
    assert links["numbers"].startswith("http://127.0.0.1:5000/#/experiments/7/runs?")
    assert links["numbers"].rpartition("=")[2] in {view.key for view in saved_views()}
    assert set(links) == {"numbers", "charts", "pictures"}


@pytest.mark.parametrize("written_by", ["us", "a person"])
def test_a_description_is_brought_up_to_date_unless_a_person_wrote_it(
    root: Path, written_by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    record_runs([record(root, "a")], CONFIG, root)
    if written_by == "a person":
        store = client(root)
        experiment = store.get_experiment_by_name(CONFIG.experiment).experiment_id
        store.set_experiment_tag(experiment, NOTE_TAG, "our own words")
    monkeypatch.setattr("sceneexpander.tracking.describe.experiment_note", lambda: "a later version")
    record_runs([record(root, "b")], CONFIG, root)
    assert tags(root)[NOTE_TAG] == ("a later version" if written_by == "us" else "our own words")


def test_a_store_from_before_gets_its_views(root: Path) -> None:
    record_runs([record(root, "a")], CONFIG, root)
    with sqlite3.connect(database_path(root)) as database:
        database.execute("DELETE FROM experiment_tags")
    describe_experiments(TrackingConfig(), root)
    assert f"mlflow.sharedViewState.{saved_views()[0].key}" in tags(root)
    assert NOTE_TAG not in client(root).get_experiment("0").tags, "MLflow's own is left alone"


@pytest.mark.parametrize("uri", ["off", "local"])
def test_nothing_to_describe_makes_nothing(tmp_path: Path, uri: str) -> None:
    describe_experiments(TrackingConfig(uri=uri), tmp_path)
    assert not (tmp_path / "mlflow").exists()


def test_links_lead_to_the_experiment_of_the_latest_run(root: Path) -> None:
    record_runs([replace(record(root, "a"), started_ms=2_000_000_000_000)], CONFIG, root)
    assert last_experiment(root) == client(root).get_experiment_by_name(CONFIG.experiment).experiment_id
    record_runs([record(root, "b")], replace(CONFIG, experiment="another"), root)
    assert last_experiment(root) == client(root).get_experiment_by_name(CONFIG.experiment).experiment_id


def test_links_of_a_store_that_cannot_be_read_lead_somewhere(tmp_path: Path) -> None:
    database_path(tmp_path).parent.mkdir()
    for content in (b"", b"no database"):
        database_path(tmp_path).write_bytes(content)
        assert last_experiment(tmp_path) == "1"


def test_runs_with_the_names_of_an_earlier_version_are_recorded_again(root: Path) -> None:
    record_runs([record(root, "a"), record(root, "b")], CONFIG, root)
    with sqlite3.connect(database_path(root)) as database:
        database.execute("UPDATE tags SET value = '1' WHERE key = 'complete'")
    before = {run.data.tags["run_key"]: run.info.run_id for run in runs(root)}
    assert record_runs([record(root, "a")], CONFIG, root) == (1, 0)
    after = {run.data.tags["run_key"]: run for run in runs(root)}
    assert after["a"].info.run_id != before["a"]
    assert after["a"].data.tags["complete"] == NAMES
    assert after["b"].info.run_id == before["b"], "what is not recorded again is not lost"
    assert record_runs([record(root, "a")], CONFIG, root) == (0, 1)


def test_a_run_says_what_it_is_in_what_fits_into_a_tag() -> None:
    used = ViewCamera(
        view_id="a", name="a.jpg", generated=False, posed=True, rough=False, reason="", warnings=(), focal_ratio=0.8,
        focal_source="exif", distortion=(0.0, 0.0), inliers=20, error_px=None,
    )  # fmt: skip
    lost = replace(used, view_id="b", name="b.jpg", posed=False, reason="x" * 6000)
    cameras = CameraReport(views=(used, lost), notes=())
    note = run_note("Behind the\n# table", "captured", None, cameras, ["is blurred"])
    assert note.startswith("> Behind the # table\n"), "a sentence stays a sentence"
    assert "1 of 2 photos used" in note
    assert len(note) < 5000
    assert "- is blurred" in run_note("p", "captured", None, None, ["is blurred"])


def test_who_comes_second_with_a_description_is_content_with_it() -> None:
    """As a server with PostgreSQL answers two first writers: the tag is there, and setting it is refused."""
    from mlflow.exceptions import MlflowException

    class Store:
        """The other writer is faster with every tag; ``theirs``: what it writes."""

        def __init__(self, theirs: str | None) -> None:
            self.theirs = theirs
            self.tags: dict[str, str] = {}

        def get_experiment(self, experiment: str) -> Any:
            return SimpleNamespace(tags=dict(self.tags))

        def set_experiment_tag(self, experiment: str, key: str, value: str) -> None:
            self.tags[key] = value if self.theirs is None else self.theirs
            raise MlflowException("duplicate key value violates unique constraint")

    describe_experiment(Store(None), "1")
    with pytest.raises(MlflowException):
        describe_experiment(Store("another"), "1")
