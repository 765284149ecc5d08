"""Runs to record, read from the folders that the report is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.store import read_json
from sceneexpander.tracking.follow import look_numbers
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
    metrics = dict(row.numbers())
    metrics |= {f"time/{stage.partition('-')[0]}_s": float(entry["wall_s"]) for stage, entry in stages.items()}
    if stages:
        metrics["memory/peak_rss_mb"] = max(float(entry["peak_rss_mb"]) for entry in stages.values())
    adapted = name == "sceneexpander"
    return RunRecord(
        key=run_key(facts["config"], facts["overrides"], row.numbers(), scene, number, name, row.weights_sha256),
        name=f"{scene} r{number} {name}" + ("" if variant == "default" else f" [{variant}]"),
        params={
            "variant": variant,
            "scene_name": scene,
            "round": str(number),
            "method": name,
            "reconstructor": row.model,
            "prompt": item["prompt"],
            **flatten(facts["config"]),
        },
        metrics=metrics,
        series={f"loss/{key}": tuple(values) for key, values in item["series"].items()} if adapted else {},
        sparse=_looks(item) if adapted else {},
        artefacts=_artefacts(item, method, folder, extra) | (_look_pictures(item, folder) if adapted else {}),
        tags={
            "scene": scene,
            "round": str(number),
            "method": name,
            "variant": variant,
            "reconstructor": row.model,
            "weights_sha256": row.weights_sha256,
            "base_weights_sha256": str(facts["model"]["weights_sha256"]),
            "mlflow.source.git.commit": commit,
            **({LIVE_TAG: item["looks"]["identity"]} if adapted and item["looks"] else {}),
        },
        started_ms=int(1000 * min((entry["started"] for entry in stages.values()), default=0.0)),
        duration_ms=int(1000 * sum(entry["wall_s"] for entry in stages.values())),
    )


def _looks(item: Mapping[str, Any]) -> dict[str, list[tuple[int, float]]]:
    """Curves of what the adaptation's looks saw."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for look in item["looks"]["entries"] if item["looks"] else ():
        for name, value in look_numbers(look).items():
            curves.setdefault(name, []).append((look["step"], value))
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
        tags={**identity, "scene": scene, "unavailable": method["reason"], "mlflow.source.git.commit": commit},
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
    for path in method["videos"].values():
        found["videos/" + Path(path).name] = folder / path
    for still in method["stills"]:
        found |= {"stills/" + Path(path).name: folder / path for layer, path in still.items() if layer != "frame"}
    found |= {"views/" + Path(path).name: folder / path for path in method["view_pictures"].values()}
    found["metrics.json"] = folder / method["metrics"]
    found |= {path.name: path for path in extra}
    return found
