"""Runs to record, read from the folders that the report is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.quantities import tracked_cost, tracked_look, tracked_row, tracked_step
from sceneexpander.artifacts.store import read_json
from sceneexpander.tracking.describe import CAMERAS_TAG, LEFT_OUT_TAG, NOTE_TAG, cut, run_note
from sceneexpander.tracking.record import RunRecord, flatten, run_key
from sceneexpander.tracking.store import LIVE_TAG

FACTS = "page.json"


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
    facts = read_json(folder / FACTS)
    return [
        _run(facts, item, method, folder, commit, extra(item["number"], method["name"]))
        for item in facts["rounds"]
        for method in item["methods"]
    ] + [
        _unavailable(facts, item, method, folder, commit) for item in facts["rounds"] for method in item["unavailable"]
    ]


def _run(
    facts: Mapping[str, Any],
    item: Mapping[str, Any],
    method: Mapping[str, Any],
    folder: Path,
    commit: str,
    extra: Sequence[Path],
) -> RunRecord:
    row = MetricsRow.load(folder / method["metrics"])
    scene, number, name = folder.name, item["number"], method["name"]
    variant = variant_name(facts["overrides"])
    stages = {stage: entry for stage, entry in item["statistics"].items() if _belongs(stage, name)}
    adapted = name == "sceneexpander"
    cameras = _cameras(facts, item, name)
    return RunRecord(
        key=run_key(facts["config"], facts["overrides"], row.numbers(), scene, number, name, row.weights_sha256),
        name=f"{scene} r{number} {name}{row.fit.mark}" + ("" if variant == "default" else f" [{variant}]"),
        params={
            "variant": variant,
            "scene_name": scene,
            "round": str(number),
            "method": name,
            "gaussians": row.fit.value,
            "reconstructor": row.model,
            "prompt": item["prompt"],
            **flatten(facts["config"]),
        },
        metrics=tracked_row(row) | tracked_cost({stage.partition("-")[0]: entry for stage, entry in stages.items()}),
        curves=_curves(item) if adapted else {},
        artefacts=_artefacts(item, method, folder, extra) | (_look_pictures(item, folder) if adapted else {}),
        tags={
            "scene": scene,
            "round": str(number),
            "method": name,
            "gaussians": row.fit.value,
            "variant": variant,
            "reconstructor": row.model,
            "weights_sha256": row.weights_sha256,
            "base_weights_sha256": str(facts["model"]["weights_sha256"]),
            "mlflow.source.git.commit": commit,
            NOTE_TAG: run_note(item["prompt"], name, row, cameras, item["warnings"]),
            **_camera_tags(cameras),
            **({"misalignment": cut(item["misalignment"])} if item["misalignment"] else {}),
            **({LIVE_TAG: item["looks"]["identity"]} if adapted and item["looks"] else {}),
        },
        started_ms=int(1000 * min((entry["started"] for entry in stages.values()), default=0.0)),
        duration_ms=int(1000 * sum(entry["wall_s"] for entry in stages.values())),
    )


def _cameras(facts: Mapping[str, Any], item: Mapping[str, Any], method: str) -> Mapping[str, Any] | None:
    """What is known of the cameras that a method was given; None where nothing is."""
    given: Mapping[str, Any] | None = facts["cameras"] if method == "captured" else item["cameras"]
    return given


def _camera_tags(cameras: Mapping[str, Any] | None) -> dict[str, str]:
    if cameras is None:
        return {}
    return {CAMERAS_TAG: cut(cameras["summary"]), LEFT_OUT_TAG: str(len(cameras["views"]) - cameras["posed"])}


def _curves(item: Mapping[str, Any]) -> dict[str, list[tuple[int, float]]]:
    """Curves of the adaptation's steps, and of what its looks saw."""
    series = item["series"]
    steps = [dict(zip(series, values, strict=True)) for values in zip(*series.values(), strict=True)]
    points = [(number, tracked_step(step)) for number, step in enumerate(steps, 1)]
    points += [(look["step"], tracked_look(look)) for look in (item["looks"]["entries"] if item["looks"] else ())]
    curves: dict[str, list[tuple[int, float]]] = {}
    for step, numbers in points:
        for name, value in numbers.items():
            curves.setdefault(name, []).append((step, value))
    return curves


def _look_pictures(item: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    looks = item["looks"]["entries"] if item["looks"] else ()
    return {f"looks/{Path(path).name}": folder / path for look in looks for path in look["pictures"].values()}


def _unavailable(
    facts: Mapping[str, Any], item: Mapping[str, Any], method: Mapping[str, Any], folder: Path, commit: str
) -> RunRecord:
    """A run without a number: a comparison shows the gap and why it is there."""
    scene, number, name = folder.name, item["number"], method["name"]
    variant = variant_name(facts["overrides"])
    identity = {"variant": variant, "round": str(number), "method": name, "reconstructor": method["model"]}
    return RunRecord(
        key=run_key(facts["config"], facts["overrides"], method["reason"], scene, number, name),
        name=f"{scene} r{number} {name}: {method['reason']}" + ("" if variant == "default" else f" [{variant}]"),
        params={**identity, "scene_name": scene, "prompt": item["prompt"], **flatten(facts["config"])},
        metrics={},
        tags={
            **identity,
            "scene": scene,
            "unavailable": method["reason"],
            "mlflow.source.git.commit": commit,
            NOTE_TAG: run_note(item["prompt"], name, None, None, [method["reason"]]),
        },
    )


def _belongs(stage: str, method: str) -> bool:
    """Whether a stage's time counts for a method: its own renders and evaluation, and what made it."""
    makers = {"captured": "precompute_anchors", "backbone": "reconstruct_inserted", "sceneexpander": "adapt"}
    return stage.endswith(f"-{method}") or stage == makers.get(method, method)


def _artefacts(
    item: Mapping[str, Any], method: Mapping[str, Any], folder: Path, extra: Sequence[Path]
) -> dict[str, Path]:
    found = {"inserted/" + Path(item["inserted"]).name: folder / item["inserted"]}
    if item["sheet"]:
        found["inserted/" + Path(item["sheet"]).name] = folder / item["sheet"]
    if item["overlay"]:
        found["inserted/" + Path(item["overlay"]).name] = folder / item["overlay"]
    for path in method["videos"].values():
        found["videos/" + Path(path).name] = folder / path
    for still in method["stills"]:
        found |= {"stills/" + Path(path).name: folder / path for layer, path in still.items() if layer != "frame"}
    found |= {"views/" + Path(path).name: folder / path for path in method["view_pictures"].values()}
    found["metrics.json"] = folder / method["metrics"]
    if item["problems"]:
        found["cameras.txt"] = folder / item["problems"]
    found |= {path.name: path for path in extra}
    return found
