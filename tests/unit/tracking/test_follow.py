"""Live curves: what a running adaptation writes appears in MLflow once, and gives way to the whole run."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sceneexpander.artifacts.live import LOG_NAME, LiveLog, LiveRun, LiveStep, read_live
from sceneexpander.tracking import record_runs
from sceneexpander.tracking.follow import STALE_S, Follower
from sceneexpander.tracking.store import LIVE_TAG, NAMES
from tests.worlds.runs import CONFIG, client, record, runs

FACTS = {"scene": "room", "round": 1, "steps": 3, "sections": {"adapt": {"steps": 3}}}
OBJECTIVE, LOOKED = "4_loss/loss_with_inserted", "5_look/captured_psnr"
LOOK = {"step": 0, "captured_psnr": 20.0, "inserted_psnr": 15.5, "drift": {"network.trunk": 0.25}}


def _log(project: Path, **facts: Any) -> LiveLog:
    return LiveLog(project / "live" / "abc", FACTS | facts)


def _step(number: int) -> dict[str, Any]:
    return {"step": number, "captured": 3, "inserted": True, "loss": 1.0 / number, "anchor_depth": 0.5}


def _history(root: Path, run: Any, key: str) -> list[tuple[int, float]]:
    return [(point.step, point.value) for point in client(root).get_metric_history(run.info.run_id, key)]


def test_a_log_is_readable_at_any_moment(tmp_path: Path) -> None:
    assert list(read_live(tmp_path)) == []
    log = LiveLog(tmp_path, FACTS)
    log.write("step", _step(1))
    with (tmp_path / LOG_NAME).open("a") as file:
        file.write('{"kind": "step", "st')  # as a killed run leaves it
    assert [type(line) for line in read_live(tmp_path)] == [LiveRun, LiveStep]


def test_a_running_adaptation_shows_and_is_finished(root: Path) -> None:
    log, follower = _log(root), Follower(root / "live", root, CONFIG)
    log.write("look", LOOK)
    log.write("step", _step(1))
    assert follower.poll() == 2
    assert follower.poll() == 0
    (run,) = runs(root)
    assert run.info.status == "RUNNING"
    assert run.data.params["adapt.steps"] == "3"
    assert _history(root, run, OBJECTIVE) == [(1, 1.0)]
    assert _history(root, run, "6_drift/network.trunk") == [(0, 0.25)]
    looks = root / "live" / "abc" / "looks"
    looks.mkdir()
    (looks / "inserted_0000.jpg").write_bytes(b"picture")
    log.write("step", _step(2))
    log.end({"warnings": []})
    follower.poll()
    (run,) = runs(root)
    assert run.info.status == "FINISHED"
    assert _history(root, run, OBJECTIVE) == [(1, 1.0), (2, 0.5)]
    assert [item.path for item in client(root).list_artifacts(run.info.run_id, "looks")] == ["looks/inserted_0000.jpg"]
    assert follower.poll() == 0


def test_a_resumed_adaptation_and_a_new_follower_start_the_run_anew(root: Path) -> None:
    follower = Follower(root / "live", root, CONFIG)
    _log(root).write("step", _step(1))
    follower.poll()
    time.sleep(0.01)
    log = _log(root)
    for number in (1, 2):
        log.write("step", _step(number))
    for one in (follower, Follower(root / "live", root, CONFIG)):
        one.poll()
        (run,) = runs(root)
        assert _history(root, run, OBJECTIVE) == [(1, 1.0), (2, 0.5)]


def test_the_whole_run_replaces_the_mirrored_one(root: Path) -> None:
    log, follower = _log(root), Follower(root / "live", root, CONFIG)
    log.write("step", _step(1))
    follower.poll()
    whole = replace(record(root, "a"), tags={LIVE_TAG: "abc"}, curves={LOOKED: [(0, 20.0), (3, 21.0)]})
    for _ in range(2):
        record_runs([whole], CONFIG, root)
        (run,) = runs(root)
        assert run.data.tags["complete"] == NAMES
        assert _history(root, run, LOOKED) == [(0, 20.0), (3, 21.0)]
        log.write("step", _step(2))
        for one in (follower, Follower(root / "live", root, CONFIG)):
            one.poll()
            one.poll()
        assert len(runs(root)) == 1


def test_a_killed_adaptation_is_marked_after_a_while(root: Path) -> None:
    _log(root).write("step", _step(1))
    follower = Follower(root / "live", root, CONFIG)
    follower.poll()
    old = time.time() - STALE_S - 1
    os.utime(root / "live" / "abc" / LOG_NAME, (old, old))
    follower.poll()
    (run,) = runs(root)
    assert run.info.status == "KILLED"


@pytest.mark.parametrize("uri", ["off", "local"])
def test_nothing_to_follow_is_no_error(tmp_path: Path, uri: str) -> None:
    assert Follower(tmp_path / "live", tmp_path, replace(CONFIG, uri=uri)).poll() == 0
    assert not (tmp_path / "mlflow").exists()
