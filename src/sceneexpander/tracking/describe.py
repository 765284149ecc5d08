"""What an experiment and its runs say about themselves in MLflow, and the saved views of its table.

MLflow (3.17) keeps a person's choice of columns in the browser, where no program can put it. What it calls views is kept in tags of the
experiment: a name and the state of the page. They stand in the menu "Views", and an address opens one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sceneexpander.artifacts.cameras import CameraReport
from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.catalogue import GROUP_MEANINGS, LOOKS, OBJECTIVES, Group, Metric, Shown, measured_metrics
from sceneexpander.catalogue.course import DRIFT_ALL, PEAK_MEMORY, WALL_TIME
from sceneexpander.catalogue.metrics import metrics_named

NOTE_TAG = "mlflow.note.content"
KIND_TAG = "mlflow.experimentKind"
OWN_NOTE_TAG = (
    "sceneexpander.note"  # hash of the description that was written last: one that a person changed is left alone
)
VIEW_TAG = "mlflow.sharedViewState."
CAMERAS_TAG = "cameras.summary"
LEFT_OUT_TAG = "cameras.left_out"
_RUN_NAME = "attributes.`Run Name`"
_WHEN = {"runDateAndNestInfo": 130, "duration": 90}  # columns that are always there: after what was measured
_LONGEST = 4900  # characters of a tag; MLflow takes 5000
FIRST_VIEW = "quality"
_HEADLINE = metrics_named("psnr_at_photo_size_db", "psnr_at_picture_size_db", "camera_rotation_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedView:
    """Columns of the table of runs that belong together: parameters, the metrics to see at once, tags, and further metrics."""

    key: str
    name: str
    params: tuple[str, ...]
    first: tuple[Metric, ...]
    tags: tuple[str, ...] = ()
    further: tuple[Metric, ...] = ()

    def columns(self) -> list[str]:
        """The columns as MLflow calls them."""
        return [
            *(f"params.`{name}`" for name in self.params),
            *(f"metrics.`{item.tracked}`" for item in self.first),
            *(f"tags.`{name}`" for name in self.tags),
            *(f"metrics.`{item.tracked}`" for item in self.further),
        ]


def saved_views() -> tuple[SavedView, ...]:
    """The views of the table of runs; the first one is what links to the numbers open."""
    quality = measured_metrics(Group.QUALITY, shown=Shown.PAGE)
    insertion = measured_metrics(Group.INSERTION, shown=Shown.PAGE)
    first = tuple(metric for metric in _HEADLINE if metric in (*quality, *insertion))
    return (
        SavedView(
            key=FIRST_VIEW,
            name="Quality: photos and inserted view",
            params=("method", "gaussians"),
            first=first,
            tags=(CAMERAS_TAG,),
            further=tuple(metric for metric in (*quality, *insertion) if metric not in first),
        ),
        SavedView(
            key="geometry",
            name="Cameras and depth",
            params=("method",),
            first=measured_metrics(Group.GEOMETRY, shown=Shown.PAGE),
            tags=(LEFT_OUT_TAG, CAMERAS_TAG),
        ),
        SavedView(
            key="adaptation", name="Adaptation", params=("method", "adapt.steps"), first=(*LOOKS, *OBJECTIVES.values())
        ),
        SavedView(key="cost", name="Time and memory", params=("method", "device"), first=(WALL_TIME, PEAK_MEMORY)),
    )


def experiment_links(base: str, experiment: str) -> dict[str, str]:
    """Addresses to look at, by what they show. ``base`` is MLflow's own address. The numbers open with the columns of the first view."""
    runs = f"{base}/#/experiments/{experiment}/runs?workflowType=machine_learning"
    return {
        "numbers": f"{runs}&viewStateShareKey={FIRST_VIEW}",
        "charts": f"{runs}&compareRunsMode=CHART",
        "pictures": f"{runs}&compareRunsMode=ARTIFACT",
    }


def experiment_note() -> str:
    """What a run is, what to look at first, which columns: Markdown."""
    groups = "\n".join(f"- `{group}`: {meaning}" for group, meaning in GROUP_MEANINGS.items())
    first = ", ".join(f"`{item.tracked}` ({_arrow(item)})" for item in _HEADLINE)
    views = ", ".join(f"*{view.name}*" for view in saved_views())
    return "\n".join(
        [
            "Photos of a place and a sentence become a larger 3D scene. **A run is one method in one round of one scene**; runs of one "
            "scene and round differ in `method`, runs of one method in `variant` (what was configured).",
            "",
            f"Look first at {first}. The menu *Views* has the columns for it: {views}.",
            "",
            "Metrics are grouped, what matters first:",
            "",
            groups,
            "",
            "`captured` is the scene before the insertion, `backbone` the unadapted reconstructor with the inserted view, `corrected` "
            "what we change without a step of adaptation, `sceneexpander` the same with Algorithm 1: the last two differ by what the "
            "adaptation does.",
            "Only runs with the same `gaussians` (as predicted, fitted, optimised) can be compared in PSNR, SSIM and ST-LPIPS.",
            f"Views without a camera are in no mean; the tag `{CAMERAS_TAG}` and the file `cameras.txt` of a run name them.",
            "Shares are from 0 to 1.",
            "",
            f"Curves are those of `sceneexpander`: `{DRIFT_ALL.group}` and `{LOOKS[0].group}` have a point per look.",
        ]
    )


def _arrow(item: Metric) -> str:
    return f"{item.better} is better"


def run_note(
    prompt: str, title: str, row: MetricsRow | None, cameras: CameraReport | None, warnings: Sequence[str]
) -> str:
    """The sentence, the method, its result in a line, and everything that is not as it should be: Markdown."""
    parts = [
        "> " + " ".join(prompt.split()),
        f"{title}.",
    ]
    if row is not None:
        known = [(item, row.value(item.name)) for item in _HEADLINE]
        parts.append(
            "; ".join(f"{item.title} **{item.text_with_unit(v)}**" for item, v in known if v is not None) + "."
        )
    if cameras is not None:
        parts.append(f"Cameras: {cameras.summary()}.")
    problems = [*(cameras.problems() if cameras is not None else ()), *warnings]
    if problems:
        parts.append("\n".join(f"- {line}" for line in problems))
    return cut("\n\n".join(parts))


def cut(text: str) -> str:
    """A text that fits into a tag."""
    return text if len(text) <= _LONGEST else text[: _LONGEST - 2] + " \u2026"


def describe_experiment(client: Any, experiment: str) -> None:
    """Write the description, the saved views and the kind of work into the experiment's tags, as far as they are not there.

    A description that a person has changed stays as it is.
    """
    tags: Mapping[str, str] = client.get_experiment(experiment).tags
    views = saved_views()
    wanted = {f"{VIEW_TAG}{view.key}": _state(view, len(views) - place) for place, view in enumerate(views)}
    note = experiment_note()
    known = tags.get(NOTE_TAG)
    if known is None or _hash(known) == tags.get(OWN_NOTE_TAG):
        wanted |= {NOTE_TAG: note, OWN_NOTE_TAG: _hash(note)}
    if KIND_TAG not in tags:
        wanted[KIND_TAG] = "custom_model_development"  # MLflow shows runs first, not traces of language models
    for key, value in wanted.items():
        if tags.get(key) != value:
            _set_tag(client, experiment, key, value)


def _set_tag(client: Any, experiment: str, key: str, value: str) -> None:
    """Set a tag that another machine may be setting at the same moment: a server with PostgreSQL refuses the second one."""
    from mlflow.exceptions import MlflowException

    try:
        client.set_experiment_tag(experiment, key, value)
    except MlflowException:
        if client.get_experiment(experiment).tags.get(key) != value:
            raise


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _width(column: str) -> int:
    """Pixels that a column needs: for its name, or for what stands in it."""
    _, name, _ = column.split("`")
    if name in (CAMERAS_TAG, "method"):
        return {CAMERAS_TAG: 300, "method": 150}[name]
    return 40 + 13 * len(name) // 2


def _state(view: SavedView, made: int) -> str:
    """What MLflow keeps of a view; its menu shows the one with the largest ``made`` first."""
    widths = {"0": 73, _RUN_NAME: 330, **{column: _width(column) for column in view.columns()}, **_WHEN}
    state = {
        "selectedColumns": view.columns(),
        "columnOrder": list(widths),
        "columnWidths": widths,
        "runsHiddenMode": "SHOWALL",
    }
    return json.dumps({"name": view.name, "createdAt": made, "updatedAt": made, "state": json.dumps(state)})
