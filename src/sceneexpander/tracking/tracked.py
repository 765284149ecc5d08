"""Numbers under their names in MLflow: the group of the catalogue's entry, a slash, its name."""

from __future__ import annotations

from collections.abc import Mapping

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.page import StageRun
from sceneexpander.catalogue import LOOKS, OBJECTIVES, STEPS, Group, measured_metrics
from sceneexpander.catalogue.course import DRIFT_ALL, INSERTED_TERMS, PEAK_MEMORY, WALL_TIME, drift_of_all


def tracked_row(row: MetricsRow) -> dict[str, float]:
    """What is known of a row, and how far repeated runs lie apart."""
    found = {item.tracked: value for item in measured_metrics() if (value := row.value(item.name)) is not None}
    found |= {f"{Group.SPREAD}/{name}": value for name, value in row.spread.items()}
    # Tables of MLflow print every digit: six say more than enough, the row's file has all.
    return {name: value if value.is_integer() else float(f"{value:.6g}") for name, value in found.items()}


def tracked_step(values: Mapping[str, float], *, inserted: bool) -> dict[str, float]:
    """Numbers of one step of an adaptation.

    Args:
        values: as logged; what is not in the catalogue is passed over.
        inserted: whether the step saw the inserted view: its objective is another one, and some terms are only then there.
    """
    shown = {item.name: item for item in STEPS if inserted or item.name not in INSERTED_TERMS}
    shown["loss"] = OBJECTIVES[inserted]
    return {item.tracked: float(values[name]) for name, item in shown.items() if name in values}


def tracked_look(values: Mapping[str, float], drift: Mapping[str, float]) -> dict[str, float]:
    """Numbers of one look, and the drift of every module and of all."""
    numbers = {
        item.tracked: float(values[item.name]) for item in LOOKS if item is not DRIFT_ALL and item.name in values
    }
    moved = {f"{Group.DRIFT}/{module}": float(value) for module, value in drift.items()}
    return numbers | moved | ({DRIFT_ALL.tracked: drift_of_all(drift)} if moved else {})


def tracked_cost(stages: Mapping[str, StageRun]) -> dict[str, float]:
    """Time of each stage and of all, and the highest peak of memory."""
    if not stages:
        return {}
    times = {f"{Group.COST}/time_{stage}_s": run.wall_s for stage, run in stages.items()}
    return {
        **times,
        WALL_TIME.tracked: sum(times.values()),
        PEAK_MEMORY.tracked: max(run.peak_rss_mb for run in stages.values()),
    }
