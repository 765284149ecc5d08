"""Growing runs in a real store."""

from __future__ import annotations

import math
from pathlib import Path

from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.curve import CurveRun
from sceneexpander.tracking.store import open_store

CONFIG = TrackingConfig(experiment="curves")


def _begin(root: Path, identity: str) -> CurveRun:
    return CurveRun(identity, name="a training", params={"seed": "3"}, config=CONFIG, root=root)


def test_a_resumed_work_goes_on_with_its_run(tmp_path: Path) -> None:
    _begin(tmp_path, "a").add(10, {"loss": 2.0, "nothing": math.nan})
    _begin(tmp_path, "b").add(10, {"loss": 7.0})
    again = _begin(tmp_path, "a")
    again.add(20, {"loss": 1.0})
    again.finish()
    client, experiment = open_store(CONFIG, tmp_path)
    runs = {run.data.tags["curve"]: run for run in client.search_runs([experiment])}
    assert sorted(runs) == ["a", "b"]
    history = client.get_metric_history(runs["a"].info.run_id, "loss")
    assert [(point.step, point.value) for point in history] == [(10, 2.0), (20, 1.0)]
    assert "nothing" not in runs["a"].data.metrics
    assert runs["a"].data.params == {"seed": "3"}
    assert runs["a"].info.status == "FINISHED"


def test_off_records_nothing(tmp_path: Path) -> None:
    curve = CurveRun("a", name="n", params={}, config=TrackingConfig(uri="off"), root=tmp_path)
    curve.add(1, {"loss": 1.0})
    curve.finish()
    assert not list(tmp_path.iterdir())
