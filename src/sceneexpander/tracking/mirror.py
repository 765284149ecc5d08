"""Runs to record, read from the folders that the report is made of."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from sceneexpander.artifacts.cameras import CameraReport
from sceneexpander.artifacts.judgement import FILE_NAME, JudgedRound
from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.page import MethodPage, MissingMethod, RoundPage, ScenePage
from sceneexpander.catalogue import MAIN
from sceneexpander.catalogue.methods import CAPTURED, known_method, method_title
from sceneexpander.evaluation.judged import with_judged
from sceneexpander.tracking.describe import CAMERAS_TAG, LEFT_OUT_TAG, NOTE_TAG, cut, run_note
from sceneexpander.tracking.record import RunRecord, run_key
from sceneexpander.tracking.store import LIVE_TAG
from sceneexpander.tracking.tracked import tracked_cost, tracked_look, tracked_row, tracked_step

_COMPARED_PHOTOS = 3
_NO_NAME = re.compile(r"[^A-Za-z0-9_. -]")  # what MLflow takes in no name of a picture


def variant_name(overrides: Sequence[str]) -> str:
    """How a configuration is called in lists: its overrides, or ``default``."""
    return " ".join(overrides) or "default"


def scene_runs(
    folder: Path, *, commit: str, extra: Callable[[int, str], Sequence[Path]] = lambda _number, _method: ()
) -> list[RunRecord]:
    """One run per round and method of a gathered scene.

    Args:
        folder: made by `sceneexpander.report.collect_scene`.
        commit: version of the sources, as a tag.
        extra: more files to keep with the run of a round and method, e.g. the Gaussians and the report page.
    """
    page = ScenePage.load(folder)
    return [
        _run(page, item, method, folder, commit, extra(item.number, method.name))
        for item in page.rounds
        for method in item.methods
    ] + [_unavailable(page, item, method, folder, commit) for item in page.rounds for method in item.unavailable]


def _run(
    page: ScenePage, item: RoundPage, method: MethodPage, folder: Path, commit: str, extra: Sequence[Path]
) -> RunRecord:
    judgement = folder / f"round_{item.number}"
    judged = JudgedRound.load(judgement) if (judgement / FILE_NAME).is_file() else None
    row = with_judged(MetricsRow.load(folder / method.metrics), judged)
    scene, number, name = folder.name, item.number, method.name
    variant = variant_name(page.overrides)
    stages = {stage: run for stage, run in item.statistics.items() if _belongs(stage, name)}
    adapted = name == MAIN
    cameras = page.cameras if name == CAPTURED else item.cameras
    return RunRecord(
        key=run_key(page.settings, page.overrides, row.numbers(), scene, number, name, row.weights_sha256),
        name=f"{scene} r{number} {name}{row.fit.mark}" + ("" if variant == "default" else f" [{variant}]"),
        params={
            "variant": variant,
            "scene_name": scene,
            "round": str(number),
            "method": name,
            "gaussians": row.fit.value,
            "reconstructor": row.model,
            "prompt": item.prompt,
            **page.settings,
        },
        metrics=tracked_row(row) | tracked_cost({stage.partition("-")[0]: run for stage, run in stages.items()}),
        curves=_curves(item) if adapted else {},
        artefacts=_artefacts(item, method, folder, extra) | (_look_pictures(item, folder) if adapted else {}),
        pictures=_compared_pictures(item, method, _held_out_pairs(page, method), folder, adapted=adapted),
        tags={
            "scene": scene,
            "round": str(number),
            "method": name,
            "gaussians": row.fit.value,
            "variant": variant,
            "reconstructor": row.model,
            "weights_sha256": row.weights_sha256,
            "base_weights_sha256": page.model.weights_sha256,
            "mlflow.source.git.commit": commit,
            NOTE_TAG: run_note(item.prompt, method_title(name, row.model) + row.fit.mark, row, cameras, item.warnings),
            **_camera_tags(cameras),
            **({"misalignment": cut(item.misalignment)} if item.misalignment else {}),
            **({LIVE_TAG: item.looks.identity} if adapted and item.looks else {}),
        },
        started_ms=int(1000 * min((run.started for run in stages.values()), default=0.0)),
        duration_ms=int(1000 * sum(run.wall_s for run in stages.values())),
    )


def _camera_tags(cameras: CameraReport | None) -> dict[str, str]:
    if cameras is None:
        return {}
    return {CAMERAS_TAG: cut(cameras.summary()), LEFT_OUT_TAG: str(len(cameras.views) - cameras.posed)}


def _curves(item: RoundPage) -> dict[str, list[tuple[int, float]]]:
    """Curves of the adaptation's steps, and of what its looks saw."""
    steps = [
        tracked_step({name: values[index] for name, values in item.steps.values.items()}, inserted=inserted)
        for index, inserted in enumerate(item.steps.inserted)
    ]
    points = list(enumerate(steps, 1))
    points += [(look.step, tracked_look(look.values, look.drift)) for look in (item.looks.looks if item.looks else ())]
    curves: dict[str, list[tuple[int, float]]] = {}
    for step, numbers in points:
        for name, value in numbers.items():
            curves.setdefault(name, []).append((step, value))
    return curves


def _look_pictures(item: RoundPage, folder: Path) -> dict[str, Path]:
    looks = item.looks.looks if item.looks else ()
    return {f"looks/{Path(path).name}": folder / path for look in looks for path in look.pictures.values()}


def _held_out_pairs(page: ScenePage, method: MethodPage) -> dict[str, str]:
    """Held-out photos and what the method's scene shows from there, by what each is called beside the other."""
    photos = {photo.view_id: photo.picture for photo in page.held_out}
    found = {}
    for view, picture in method.held_out_pictures.items():
        found[f"held-out {view}"] = picture
        if view in photos:
            found[f"held-out {view}, photo"] = photos[view]
    return found


def _compared_pictures(
    item: RoundPage, method: MethodPage, held_out: Mapping[str, str], folder: Path, *, adapted: bool
) -> dict[str, list[tuple[int, Path]]]:
    """What to look at side by side.

    The still nearest to the inserted view, held-out photos, some views at their own cameras, the looks of an adaptation.
    """
    still = min(method.stills, key=lambda still: abs(still.frame - method.inserted_frame))
    shown = [view.view_id for view in method.views if view.view_id in method.view_pictures]
    looks = item.looks.looks if adapted and item.looks else ()
    found = {
        "near the inserted view": [(0, still.pictures["rgb"])],
        **{name: [(0, place)] for name, place in held_out.items()},
        **{
            view: [(0, method.view_pictures[view])]
            for place, view in enumerate(shown)
            if place < _COMPARED_PHOTOS or view == item.inserted_id
        },
        "inserted view while adapting": [
            (look.step, look.pictures["inserted"]) for look in looks if "inserted" in look.pictures
        ],
    }
    return {
        f"0_pictures/{_NO_NAME.sub('_', name)}": [(step, folder / place) for step, place in shots]
        for name, shots in found.items()
        if shots
    }


def _unavailable(page: ScenePage, item: RoundPage, method: MissingMethod, folder: Path, commit: str) -> RunRecord:
    """A run without a number: a comparison shows the gap and why it is there."""
    scene, number, name = folder.name, item.number, method.name
    variant = variant_name(page.overrides)
    identity = {"variant": variant, "round": str(number), "method": name, "reconstructor": method.model}
    return RunRecord(
        key=run_key(page.settings, page.overrides, method.reason, scene, number, name),
        name=f"{scene} r{number} {name}: {method.reason}" + ("" if variant == "default" else f" [{variant}]"),
        params={**identity, "scene_name": scene, "prompt": item.prompt, **page.settings},
        metrics={},
        tags={
            **identity,
            "scene": scene,
            "unavailable": method.reason,
            "mlflow.source.git.commit": commit,
            NOTE_TAG: run_note(item.prompt, method_title(name, method.model), None, None, [method.reason]),
        },
    )


def _belongs(stage: str, method: str) -> bool:
    """Whether a stage's time counts for a method: its own renders and evaluation, and what made it."""
    known = known_method(method)
    return stage.endswith(f"-{method}") or stage == (method if known is None else known.stage)


def _artefacts(item: RoundPage, method: MethodPage, folder: Path, extra: Sequence[Path]) -> dict[str, Path]:
    places = {"inserted": [item.inserted, *(place for place in (item.sheet, item.overlay) if place)]}
    places["videos"] = list(method.videos.values())
    places["stills"] = [path for still in method.stills for path in still.pictures.values()]
    places["views"] = [*method.view_pictures.values(), *method.held_out_pictures.values()]
    found = {f"{kind}/{Path(path).name}": folder / path for kind, paths in places.items() for path in paths}
    found["metrics.json"] = folder / method.metrics
    if item.problems:
        found["cameras.txt"] = folder / item.problems
    return found | {path.name: path for path in extra}
