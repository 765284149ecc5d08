"""Recording runs in MLflow: flat runs, each recorded once, however often the recording is repeated."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import logging
import os
import sqlite3
import time
import urllib.parse
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sceneexpander.errors import UserError
from sceneexpander.tracking.config import TrackingConfig
from sceneexpander.tracking.describe import describe_experiment
from sceneexpander.tracking.record import RunRecord
from sceneexpander.tracking.server import SHELL_URI, hide_credentials

_log = logging.getLogger(__name__)

KEY_TAG = "run_key"
LIVE_TAG = "adaptation"  # identity of the adaptation that a run mirrors or holds, see `sceneexpander.tracking.follow`
COMPLETE_TAG = "complete"  # set last: a recording that was killed half-way is done again
_BEGUN_TAG = "recording"  # when the recording began, in seconds since the epoch: of a half-recorded run, whether someone is still at it
_ABANDONED_S = 1800.0
NAMES = (
    "3"  # its value: the scheme of the metrics' names; a run that has other names gives way when it is recorded again
)
_PARAMS_PER_CALL = 100  # limits of MLflow's batch call
_METRICS_PER_CALL = 1000
_PARAM_LENGTH = 6000


# Of MLflow's variables those that say how to reach a server, not which one or what to record.
_SERVER_SETTINGS = ("MLFLOW_TRACKING_", "MLFLOW_HTTP_REQUEST_", "MLFLOW_S3_", "MLFLOW_GCS_")
_DECIDED = frozenset({SHELL_URI})  # see `sceneexpander.tracking.server`
_OURS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
}
_ATTEMPTS = 6  # to open a store that another process is making at the same moment
_BUSY = ("already exists", "database is locked", "is locked", "no such table")


def without_foreign_settings(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables of a shell without those that would send runs elsewhere or set MLflow up in another way.

    Where runs go is said by the settings and, by `sceneexpander.tracking.server`, by ``MLFLOW_TRACKING_URI``: MLflow itself need not
    see it. Names and passwords for a server stay.
    """
    kept = {
        name: value
        for name, value in environment.items()
        if not name.startswith(("MLFLOW_", "_MLFLOW_")) or (name.startswith(_SERVER_SETTINGS) and name not in _DECIDED)
    }
    kept.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")  # an unreachable server is told of in seconds, not minutes
    kept.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "30")
    return kept | _OURS


def quiet_environment() -> None:
    """No telemetry, no background job machinery, and nothing else of the user's shell; must run before MLflow is imported."""
    wanted = without_foreign_settings(os.environ)
    for name in set(os.environ) - set(wanted):
        del os.environ[name]
    os.environ.update(wanted)


def database_path(root: Path) -> Path:
    """The database of ``tracking.uri: local``."""
    return root / "mlflow" / "mlflow.db"


def tracking_uri(config: TrackingConfig, root: Path) -> str:
    """MLflow's address of the store. Absolute: MLflow would otherwise take it relative to the current folder.

    Raises:
        UserError: the folder has a name that no address can hold.
    """
    if config.uri != "local":
        return config.uri
    from sqlalchemy.engine import make_url

    path = str(database_path(root))
    # The second form is without slashes: MLflow makes the folder of what it sees there, before anything is decoded.
    for address in (f"sqlite:///{path}", f"sqlite:///{urllib.parse.quote(path, safe='')}"):
        url = make_url(address)
        if url.database == path and not url.query:
            return address
    raise UserError("cannot be written as an address", where=path, fix="rename the folder, or use tracking.uri=off")


def set_damaged_aside(root: Path) -> Path | None:
    """Rename a local database that cannot be read, so that a new one can be begun. Returns where it is now; None: it was fine."""
    path = database_path(root)
    if not path.is_file() or path.stat().st_size == 0:
        return None
    try:
        with contextlib.closing(sqlite3.connect(path)) as database:
            problem = str(database.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.OperationalError:
        return None  # locked, or out of reach: not for us to judge
    except sqlite3.DatabaseError as error:
        problem = str(error)
    if problem == "ok":
        return None
    number = next(n for n in itertools.count(1) if not path.with_name(f"{path.name}.damaged-{n}").exists())
    aside = path.with_name(f"{path.name}.damaged-{number}")
    path.rename(aside)
    for ending in ("-wal", "-shm", "-journal"):
        path.with_name(path.name + ending).unlink(missing_ok=True)
    _log.warning("%s was damaged (%s): it is %s now, and a new one is begun", path, problem.splitlines()[0], aside.name)
    return aside


@contextlib.contextmanager
def store_lock(root: Path) -> Iterator[None]:
    """One writer at a time: two processes that create the database at once destroy each other's schema."""
    path = root / "mlflow" / ".lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def record_runs(
    records: Sequence[RunRecord], config: TrackingConfig, root: Path, *, sweep: str | None = None
) -> tuple[int, int]:
    """Record what is not recorded yet. Returns (new runs, runs already there).

    Args:
        records: the runs.
        config: where they go; ``off`` records nothing.
        root: the project folder, which holds the local store.
        sweep: id of the sweep that asks; every run gets the tag ``sweep.<id>``, old ones too.

    Raises:
        UserError: the server cannot be reached or refuses.
    """
    if config.uri == "off" or not records:
        return 0, 0
    with store_lock(root):
        if config.uri == "local":
            set_damaged_aside(root)
        known = _complete_local(root, config) if config.uri == "local" else {}
        missing = [record for record in records if record.key not in known]
        if not missing and sweep is None:
            return 0, len(records)
        client, experiment = open_store(config, root)
        describe_experiment(client, experiment)
        alone = config.uri == "local"
        known |= _complete(client, experiment, {record.key for record in records}, alone=alone)
        missing = [record for record in records if record.key not in known]
        for record in missing:
            known[record.key] = _record(client, experiment, record)
            if not alone:
                known[record.key] = _keep_one(client, experiment, record.key)
            _remove_mirrored(client, experiment, record)
        if sweep is not None:
            for record in records:
                _set_tag(client, experiment, record.key, known[record.key], f"sweep.{sweep}")
    _log.info("recorded %d of %d runs (%s)", len(missing), len(records), hide_credentials(config.uri))
    return len(missing), len(records) - len(missing)


def _complete_local(root: Path, config: TrackingConfig) -> dict[str, str]:
    """Run ids by key, read straight from the database: 0.01 s instead of importing MLflow."""
    path = database_path(root)
    if not path.is_file():
        return {}
    query = """
        SELECT key.value, runs.run_uuid FROM runs
        JOIN tags AS key ON key.run_uuid = runs.run_uuid AND key.key = ?
        JOIN tags AS done ON done.run_uuid = runs.run_uuid AND done.key = ?
        JOIN experiments ON experiments.experiment_id = runs.experiment_id
        WHERE runs.lifecycle_stage = 'active' AND done.value = ? AND experiments.name = ?
    """
    try:
        with contextlib.closing(sqlite3.connect(path)) as database:
            return dict(database.execute(query, (KEY_TAG, COMPLETE_TAG, NAMES, config.experiment)).fetchall())
    except sqlite3.DatabaseError:
        return {}  # an empty or half-made file: MLflow will say what it thinks of it


def open_store(config: TrackingConfig, root: Path) -> tuple[Any, str]:
    """(client, id of the experiment), made if there is none.

    Raises:
        UserError: the server cannot be reached or refuses, or the database cannot be used.
    """
    quiet_environment()
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    with _making_lock(root) if config.uri == "local" else contextlib.nullcontext():
        for attempt in range(_ATTEMPTS):
            try:
                return _open(config, root)
            except (MlflowException, SQLAlchemyError, OSError, ValueError) as error:
                # Others may be writing the first tables just now, e.g. an `mlflow ui` that nobody can ask to wait.
                first = str(error).strip().partition("\n")[0] or type(error).__name__
                if attempt == _ATTEMPTS - 1 or not any(text in str(error) for text in _BUSY):
                    raise UserError(
                        f"cannot be used ({first})", where=f"tracking.uri {hide_credentials(config.uri)}"
                    ) from None
                time.sleep(0.1 * 2**attempt)
    raise AssertionError("the last attempt returns or raises")


@contextlib.contextmanager
def _making_lock(root: Path) -> Iterator[None]:
    """One process at a time makes the tables; apart from `store_lock`, which its caller may hold."""
    path = root / "mlflow" / ".making"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _open(config: TrackingConfig, root: Path) -> tuple[Any, str]:
    from mlflow.tracking import MlflowClient

    # After the import, which sets its own levels: making the tables is not worth twenty lines.
    for name in ("alembic", "mlflow"):
        logging.getLogger(name).setLevel(logging.WARNING)
    client = MlflowClient(tracking_uri=tracking_uri(config, root))
    experiment = client.get_experiment_by_name(config.experiment)
    if experiment is not None:
        return client, experiment.experiment_id
    location = (root / "mlflow" / "artifacts").as_uri() if config.uri == "local" else None
    return client, client.create_experiment(config.experiment, artifact_location=location)


def last_experiment(root: Path) -> str:
    """Id of the local store's experiment with the pipeline's latest run, straight from the database.

    Runs of the pipeline have a key, or the mark of a running adaptation; a training or anything else that uses the store has neither.
    Without any, the experiment with the pipeline's default name, or the first one that is made.
    """
    latest = """
        SELECT runs.experiment_id FROM runs
        JOIN tags ON tags.run_uuid = runs.run_uuid AND tags.key IN (?, ?)
        WHERE runs.lifecycle_stage = 'active' ORDER BY runs.start_time DESC LIMIT 1
    """
    named = "SELECT experiment_id FROM experiments WHERE name = ?"
    try:
        with contextlib.closing(sqlite3.connect(database_path(root))) as database:
            found = database.execute(latest, (KEY_TAG, LIVE_TAG)).fetchone()
            found = found or database.execute(named, (TrackingConfig().experiment,)).fetchone()
    except sqlite3.DatabaseError:
        found = None
    return "1" if found is None else str(found[0])  # 0 is MLflow's own default


def describe_experiments(config: TrackingConfig, root: Path) -> None:
    """Bring descriptions and saved views of the experiments that are there up to date: of all in the local store, of the named one else.

    Raises:
        UserError: the server cannot be reached or refuses.
    """
    if config.uri == "off" or (config.uri == "local" and not database_path(root).is_file()):
        return
    client, named = open_store(config, root)
    local = [item.experiment_id for item in client.search_experiments()] if config.uri == "local" else []
    for experiment in {named, *local} - {"0"}:
        describe_experiment(client, experiment)


def _complete(client: Any, experiment: str, wanted: Collection[str], *, alone: bool) -> dict[str, str]:
    """Run ids by key. Half-recorded runs are deleted on the way, and those of ``wanted`` that have the names of an earlier version.

    ``alone``: nobody else can be recording at this moment. Elsewhere a half-recorded run may be another machine's work.
    """
    found: dict[str, str] = {}
    token = None
    while True:
        page = client.search_runs([experiment], max_results=1000, page_token=token)
        for run in page:
            key = run.data.tags.get(KEY_TAG)
            names = run.data.tags.get(COMPLETE_TAG)
            if key is not None and names == NAMES:
                found[key] = run.info.run_id
            elif key is not None and (_is_abandoned(run, alone) if names is None else key in wanted):
                _delete(client, run.info.run_id)
        token = page.token
        if not token:
            return found


def _is_abandoned(run: Any, alone: bool) -> bool:
    return alone or time.time() - float(run.data.tags.get(_BEGUN_TAG, 0.0)) > _ABANDONED_S


def _keep_one(client: Any, experiment: str, key: str) -> str:
    """Id of the one run with this key that stays, if several machines have recorded it at once: all of them choose the same."""
    runs = client.search_runs([experiment], f"tags.{KEY_TAG} = '{key}' and tags.{COMPLETE_TAG} = '{NAMES}'")
    kept, *others = sorted(runs, key=lambda run: run.info.run_id)
    for run in others:
        _delete(client, run.info.run_id)
        # Read after it is gone: from then on others mark the one that stays.
        for tag in client.get_run(run.info.run_id).data.tags:
            if tag.startswith("sweep."):
                client.set_tag(kept.info.run_id, tag, "1")
    return str(kept.info.run_id)


def _set_tag(client: Any, experiment: str, key: str, run_id: str, tag: str) -> None:
    from mlflow.exceptions import MlflowException

    try:
        client.set_tag(run_id, tag, "1")
    except MlflowException:  # another machine has recorded the same meanwhile, and taken this one away
        client.set_tag(_keep_one(client, experiment, key), tag, "1")


def _delete(client: Any, run_id: str) -> None:
    """Delete a run that another machine may be deleting as well."""
    from mlflow.exceptions import MlflowException

    try:
        client.delete_run(run_id)
    except MlflowException:
        if client.get_run(run_id).info.lifecycle_stage != "deleted":
            raise


def _remove_mirrored(client: Any, experiment: str, record: RunRecord) -> None:
    """Delete the run that mirrored this one while it was running."""
    identity = record.tags.get(LIVE_TAG)
    if identity is None:
        return
    for run in client.search_runs([experiment], f"tags.{LIVE_TAG} = '{identity}'"):
        if KEY_TAG not in run.data.tags:
            client.delete_run(run.info.run_id)


def _record(client: Any, experiment: str, record: RunRecord) -> str:
    from mlflow.entities import Metric, Param
    from PIL import Image

    tags = {**record.tags, KEY_TAG: record.key, _BEGUN_TAG: str(int(time.time())), "mlflow.runName": record.name}
    run = client.create_run(experiment, start_time=record.started_ms, tags=tags, run_name=record.name)
    run_id = str(run.info.run_id)
    params = [Param(key, str(value)[:_PARAM_LENGTH]) for key, value in sorted(record.params.items())]
    end = record.started_ms + record.duration_ms
    metrics = [Metric(key, value, end, 0) for key, value in sorted(record.metrics.items())]
    for key, points in sorted(record.curves.items()):
        # Steps are spread over the run's time: MLflow orders equal times arbitrarily.
        pace = record.duration_ms / max(max((step for step, _ in points), default=1), 1)
        metrics += [Metric(key, v, record.started_ms + int(step * pace), step) for step, v in points]
    for start in range(0, len(params), _PARAMS_PER_CALL):
        client.log_batch(run_id, params=params[start : start + _PARAMS_PER_CALL])
    for start in range(0, len(metrics), _METRICS_PER_CALL):
        client.log_batch(run_id, metrics=metrics[start : start + _METRICS_PER_CALL])
    for place, path in sorted(record.artefacts.items()):
        folder, _, _ = place.rpartition("/")
        client.log_artifact(run_id, str(path), folder or None)
    for name, shots in sorted(record.pictures.items()):
        for step, path in shots:
            with Image.open(path) as picture:
                client.log_image(run_id, picture.convert("RGB"), key=name, step=step, synchronous=True)
    client.set_terminated(run_id, end_time=end)
    client.set_tag(run_id, COMPLETE_TAG, NAMES)
    return run_id
