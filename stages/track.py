"""track: mirror the pipeline's files into MLflow. Runs also when every other stage came from the cache; records nothing twice."""

from __future__ import annotations

import functools
import logging
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.store import to_plain, write_json_atomic
from sceneexpander.config.files import read_sections
from sceneexpander.errors import UserError, disk_full
from sceneexpander.pipeline.project import SWEEP_ENV
from sceneexpander.pipeline.recording import RECORDED, Recorded, RecordedScene
from sceneexpander.pipeline.selection import read_selection
from sceneexpander.tracking import RunRecord, TrackingConfig, record_runs, scene_runs
from sceneexpander.tracking.server import hide_credentials, where_runs_go
from stages import layout
from stages.runner import Cell, project_root, stage

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    tracking: TrackingConfig


def commit_of(folder: Path) -> str:
    """The commit of the sources, or ``unknown`` outside of version control."""
    try:
        done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, check=False)
    except OSError:  # no git
        return "unknown"
    return done.stdout.strip() if done.returncode == 0 else "unknown"


def _large_files(scene: str, number: int, method: str) -> list[Path]:
    return [layout.gaussians(scene, number, method)]


@stage()
def main(_: Cell) -> None:
    """Record what is missing, and note where it is.

    Recording is a copy of what the files say: where it fails, the run itself is as good as ever, and one line says so.
    """
    recorded: dict[str, RecordedScene] = {}
    root = project_root()
    selected = read_selection(Path()).scenes
    gathered = layout.gathered_scenes(selected)
    for scene in selected:
        if scene not in gathered:
            recorded[scene] = RecordedScene(configured="", store="", runs=None)  # the next start looks again
            continue
        sections = read_sections(layout.PAGES / scene / layout.PAGE_CONFIG, Sections)
        records = scene_runs(
            layout.PAGES / scene,
            commit=commit_of(root),
            extra=functools.partial(_large_files, scene),
        )
        store = _record(records, sections.tracking, root)
        recorded[scene] = RecordedScene(
            configured=hide_credentials(sections.tracking.uri),
            store=store or "",
            runs=tuple(record.key for record in records) if store else None,
        )
    write_json_atomic(RECORDED, to_plain(Recorded(scenes=recorded)))


def _record(records: Sequence[RunRecord], config: TrackingConfig, root: Path) -> str | None:
    """Where the runs are now, without passwords; None: they could not be recorded."""
    try:
        config = where_runs_go(config, os.environ)
        record_runs(records, config, root, sweep=os.environ.get(SWEEP_ENV))
    except Exception as error:  # noqa: BLE001 - MLflow raises whatever its database, its server and its disk raise
        known = disk_full(error) or error
        line = known.line() if isinstance(known, UserError) else str(known).strip().partition("\n")[0]
        _log.warning("not recorded in MLflow (%s); the same command tries again", line or type(error).__name__)
        return None
    return hide_credentials(config.uri)


if __name__ == "__main__":
    main()
