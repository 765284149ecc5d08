"""A run of MLflow that grows while its work goes on, over as many resumes as it takes: the learning curve of a training."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path

from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.store import open_store, store_lock

CURVE_TAG = "curve"  # identity of the growing run: a resumed work goes on with the run it began


class CurveRun:
    """Metrics over steps, in one run for each ``identity``.

    Args:
        identity: what makes it the same work when it is resumed.
        name: as shown in lists.
        params: settings, dotted keys; those of the first start are kept.
        config: where MLflow is; ``off`` records nothing.
        root: the project folder, which holds the local store.

    Raises:
        UserError: the server cannot be reached or refuses.
    """

    def __init__(
        self, identity: str, *, name: str, params: Mapping[str, str], config: TrackingConfig, root: Path
    ) -> None:
        self._run_id: str | None = None
        if config.uri == "off":
            return
        with store_lock(root):
            self._client, experiment = open_store(config, root)
            found = self._client.search_runs([experiment], f"tags.{CURVE_TAG} = '{identity}'")
            if found:
                self._run_id = str(found[0].info.run_id)
                self._client.update_run(self._run_id, "RUNNING")
                return
            run = self._client.create_run(experiment, tags={CURVE_TAG: identity}, run_name=name)
            self._run_id = str(run.info.run_id)
            for key, value in sorted(params.items()):
                self._client.log_param(self._run_id, key, value)

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """One point of every curve in ``values``; what is not finite is left out."""
        if self._run_id is None:
            return
        from mlflow.entities import Metric

        now = int(1000 * time.time())
        points = [Metric(key, float(value), now, step) for key, value in sorted(values.items()) if math.isfinite(value)]
        self._client.log_batch(self._run_id, metrics=points)

    def finish(self) -> None:
        """The work is done."""
        if self._run_id is not None:
            self._client.set_terminated(self._run_id, "FINISHED")
