"""Live curves: the logs of running adaptations mirrored into MLflow, by a process of its own.

Stages never talk to MLflow, since a stage that comes from the cache executes nothing. A mirrored run has the tag `LIVE_TAG`, the
identity of the adaptation. The pipeline's last stage records the whole run under the same tag, and takes the mirrored one away.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.live import LOG_NAME, LiveEnd, LiveLine, LiveLook, LiveRun, LiveStep, read_live
from sceneexpander.catalogue import MAIN
from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.describe import describe_experiment
from sceneexpander.tracking.store import COMPLETE_TAG, LIVE_TAG, open_store, store_lock
from sceneexpander.tracking.tracked import tracked_look, tracked_step

_log = logging.getLogger(__name__)

STALE_S = 600.0  # a log without an end that nobody wrote to for so long belongs to a killed run


@dataclass(slots=True)
class _Mirrored:
    """How far a log has been mirrored."""

    run_id: str
    started: float  # of the adaptation: a resumed one starts its log anew
    lines: int = 1
    pictures: set[str] = field(default_factory=set)


class Follower:
    """Mirrors all logs below ``live``.

    Args:
        live: folder of the logs, one folder each, named by the adaptation's identity.
        root: the project folder, which holds the local store.
        config: where MLflow is; ``off`` mirrors nothing.
    """

    def __init__(self, live: Path, root: Path, config: TrackingConfig) -> None:
        self.live, self.root, self.config = live, root, config
        self._known: dict[str, _Mirrored] = {}
        self._done: dict[str, float] = {}  # identity -> start of the attempt that needs no more mirroring

    def poll(self) -> int:
        """Mirror what is new; returns how many lines that were."""
        if self.config.uri == "off" or not self.live.is_dir():
            return 0
        return sum(self._follow(path.parent) for path in sorted(self.live.glob(f"*/{LOG_NAME}")))

    def _follow(self, folder: Path) -> int:
        from mlflow.exceptions import MlflowException

        lines = list(read_live(folder))
        identity = folder.name
        if not lines or not isinstance(lines[0], LiveRun) or self._done.get(identity) == lines[0].started:
            return 0
        client, experiment = open_store(self.config, self.root)
        known = self._known.get(identity)
        if known is None or known.started != lines[0].started:
            known = self._begin(client, experiment, identity, lines[0])
            if known is None:
                return 0
            self._known[identity] = known
        new = lines[known.lines :]
        try:
            self._send(client, known, folder, new)
        except MlflowException as error:
            # The pipeline has recorded the whole run meanwhile and took this one away.
            _log.info("%s is no longer mirrored (%s)", identity[:12], str(error).splitlines()[0])
            del self._known[identity]
            return 0
        known.lines = len(lines)
        if isinstance(lines[-1], LiveEnd):
            client.set_terminated(known.run_id, "FINISHED")
            self._done[identity] = known.started
        elif not new and time.time() - (folder / LOG_NAME).stat().st_mtime > STALE_S:
            client.set_terminated(known.run_id, "KILLED")
            self._done[identity] = known.started
        return len(new)

    def _begin(self, client: Any, experiment: str, identity: str, begun: LiveRun) -> _Mirrored | None:
        """A fresh run for a log; None if the whole run is recorded already."""
        with store_lock(self.root):
            for run in client.search_runs([experiment], f"tags.{LIVE_TAG} = '{identity}'"):
                if COMPLETE_TAG in run.data.tags:
                    self._done[identity] = begun.started
                    return None
                client.delete_run(run.info.run_id)
            describe_experiment(client, experiment)
            name = f"{begun.scene} r{begun.round} {MAIN}, running"
            tags = {LIVE_TAG: identity, "scene": begun.scene, "round": str(begun.round), "mlflow.runName": name}
            started_ms = int(1000 * begun.started)
            run = client.create_run(experiment, start_time=started_ms, tags=tags, run_name=name)
        for key, value in begun.settings.items():
            client.log_param(run.info.run_id, key, value)
        return _Mirrored(run_id=run.info.run_id, started=begun.started)

    def _send(self, client: Any, known: _Mirrored, folder: Path, lines: Sequence[LiveLine]) -> None:
        from mlflow.entities import Metric

        now = int(1000 * time.time())
        points = [(line.step, _numbers(line)) for line in lines if isinstance(line, LiveStep | LiveLook)]
        metrics = [Metric(key, value, now, step) for step, numbers in points for key, value in numbers.items()]
        for begin in range(0, len(metrics), 1000):
            client.log_batch(known.run_id, metrics=metrics[begin : begin + 1000])
        for picture in sorted((folder / "looks").glob("*.jpg")):
            if picture.name not in known.pictures:
                client.log_artifact(known.run_id, str(picture), "looks")
                known.pictures.add(picture.name)


def _numbers(line: LiveStep | LiveLook) -> dict[str, float]:
    """Curves of a line, named as in a whole run."""
    if isinstance(line, LiveStep):
        return tracked_step(line.values, inserted=line.inserted)
    return tracked_look(line.values, line.drift)
