"""The page of a sweep: its jobs side by side, scene by scene, with links into the report of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.page import MethodPage, RoundPage, ScenePage
from sceneexpander.catalogue import MAIN, Metric, Table
from sceneexpander.catalogue.methods import method_title
from sceneexpander.catalogue.metrics import DASH
from sceneexpander.files import write_bytes_atomic
from sceneexpander.report.media import poster_of
from sceneexpander.report.site import COMPARED, INDEX, render


@dataclass(frozen=True, slots=True, kw_only=True)
class SweptJob:
    """One job: what it is called, its folder beside the page, and why it has no result (empty: it has)."""

    label: str
    folder: str
    error: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Result:
    job: SweptJob
    scene: Path  # relative to the page
    round: RoundPage
    method: MethodPage
    row: MetricsRow


def write_sweep_page(jobs: Sequence[SweptJob], folder: Path, *, pages: str, report: str) -> Path:
    """Write ``index.html`` into the folder of a sweep and return its path; all links are relative.

    Args:
        jobs: in the order of the lines; the first is what others are compared with.
        folder: that holds a folder for each job.
        pages: in a job's folder, the gathered scenes.
        report: in a job's folder, its report.
    """
    groups: dict[tuple[str, int], list[_Result]] = {}
    for job in jobs:
        for place in sorted((folder / job.folder / pages).glob("*/")) if not job.error else ():
            page = ScenePage.load(place)
            for item in page.rounds:
                for method in (method for method in item.methods if method.name == MAIN):
                    row = MetricsRow.load(place / method.metrics)
                    scene = place.relative_to(folder)
                    result = _Result(job=job, scene=scene, round=item, method=method, row=row)
                    groups.setdefault((place.name, item.number), []).append(result)
    filled = {
        "title": f"{len(jobs)} jobs",
        "undone": [job for job in jobs if job.error],
        "groups": [_group(scene, number, found, report) for (scene, number), found in groups.items()],
    }
    write_bytes_atomic(folder / INDEX, render("sweep.html.j2", filled))
    return folder / INDEX


def _group(scene: str, number: int, results: Sequence[_Result], report: str) -> dict[str, Any]:
    shown = [metric for metric in COMPARED if any(item.row.value(metric.name) is not None for item in results)]
    first = results[0]
    lines = [(item.job.label, *(_cell(item, first, metric) for metric in shown)) for item in results]
    header = ("job", *(metric.column for metric in shown))
    return {
        "title": f"{scene}, round {number}",
        "method": method_title(MAIN, first.method.model),
        "table": Table(header=header, lines=tuple(lines)),
        "jobs": [
            {
                "label": item.job.label,
                "report": f"{item.job.folder}/{report}/{INDEX}",
                "poster": (item.scene / poster_of(item.method)).as_posix(),
            }
            for item in results
        ],
    }


def _cell(item: _Result, first: _Result, metric: Metric) -> str:
    value, before = item.row.value(metric.name), first.row.value(metric.name)
    if value is None:
        return DASH
    if item is first or before is None:
        return metric.bare(value)
    return f"{metric.bare(value)} ({metric.bare(value - before, sign=True)})"
