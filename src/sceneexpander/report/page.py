"""One static page from the gathered scenes: no server, no network, no build step."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.metrics import MetricsRow
from sceneexpander.artifacts.store import read_json, write_bytes_atomic
from sceneexpander.report.collect import FACTS, MAIN_METHOD
from sceneexpander.report.course import FITTED, fits, looks_table, verdict, was_fitted
from sceneexpander.report.curve import loss_curve
from sceneexpander.report.words import COLUMNS, LAYERS, Column, method_words

_ARROWS = {"higher": "\u2191", "lower": "\u2193", "": ""}


def write_page(scenes: Sequence[Path], folder: Path) -> None:
    """Fill ``folder`` with ``index.html`` and ``media/<scene>/``.

    Args:
        scenes: folders made by `collect_scene`, in the order of the page.
        folder: an existing (scratch) folder.
    """
    import jinja2

    for scene in scenes:
        shutil.copytree(scene, folder / "media" / scene.name)
    templates = files("sceneexpander.report") / "templates"
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string((templates / "page.html.j2").read_text(encoding="utf-8"))
    from markupsafe import Markup

    # Only these two texts, which ship with the package, go in as they are.
    css, js = (Markup((templates / name).read_text(encoding="utf-8")) for name in ("page.css", "page.js"))  # noqa: S704
    html = template.render(
        scenes=[_scene(read_json(scene / FACTS), scene) for scene in scenes], layers=LAYERS, css=css, js=js
    )
    write_bytes_atomic(folder / "index.html", html.encode())


def _scene(facts: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    return {
        "scene": facts["scene"],
        "anchor": folder.name,
        "media": f"media/{folder.name}",
        "captured": facts["captured"],
        "rounds": [_round(item, facts, folder) for item in facts["rounds"]],
        "facts": _facts(facts),
        "timings": _timings(facts),
        "settings": [(key, value) for key, value in _flat(facts["config"])],
    }


def _round(facts: Mapping[str, Any], scene: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    methods = []
    for method in facts["methods"]:
        words = method_words(method["name"], method["model"])
        poster = max(method["stills"], key=lambda still: -abs(still["frame"] - method["inserted_frame"]))["rgb"]
        goal = method["inserted_frame"] / max(method["frames"], 1)
        methods.append({**method, "label": words.label, "short": words.short, "poster": poster, "goal": goal})
    rows = {method["name"]: MetricsRow.load(folder / method["metrics"]) for method in facts["methods"]}
    columns = [c for c in COLUMNS if any(row.value(c.name) is not None for row in rows.values())]
    series = facts["series"]
    return {
        **{
            key: facts[key]
            for key in ("number", "prompt", "full_prompt", "backend", "origin", "candidates", "inserted", "viewer")
        },
        "sheet": facts["sheet"] if facts["candidates"] > 1 else None,
        "warnings": facts["warnings"],
        "methods": methods,
        "main": MAIN_METHOD,
        "columns": [{"label": c.label, "meaning": c.meaning, "better": _ARROWS[c.better]} for c in columns],
        "table": [_table_row(method, rows, columns) for method in methods],
        "unavailable": [
            {**item, "label": method_words(item["name"], item["model"]).label} for item in facts["unavailable"]
        ],
        "curve": loss_curve(series["loss"]) if series.get("loss") else "",
        "steps": len(series.get("loss", ())),
        "looks": looks_table(facts["looks"]),
        "verdict": verdict(facts["acceptance"]),
        "fits": fits(facts["methods"]),
        "view_rows": _view_rows(facts, scene, methods),
    }


def _table_row(method: Mapping[str, Any], rows: Mapping[str, MetricsRow], columns: Sequence[Column]) -> dict[str, Any]:
    words = method_words(method["name"], method["model"])
    cells = []
    for column in columns:
        value = rows[method["name"]].value(column.name)
        # The ceiling of preservation is not a competitor: bold compares the methods that show the new view, as far as the printed
        # digits go.
        rivals = {name: round(v, column.digits + 2 * column.percent) for name, v in _known(rows, column).items()}
        best = (max if column.better == "higher" else min)(rivals.values(), default=None)
        wins = len(set(rivals.values())) > 1 and rivals.get(method["name"]) == best
        spread = rows[method["name"]].spread.get(column.name)
        text = column.text(value) + ("" if spread is None else f" \u00b1 {column.text(spread)}")
        cells.append({"text": text, "best": wins})
    fitted = f" {FITTED}" if was_fitted(method) else ""
    return {"name": method["name"], "label": words.label, "meaning": words.meaning + fitted, "cells": cells}


def _known(rows: Mapping[str, MetricsRow], column: Column) -> dict[str, float]:
    values = {name: row.value(column.name) for name, row in rows.items() if name != "captured"}
    return {name: value for name, value in values.items() if value is not None}


def _view_rows(
    facts: Mapping[str, Any], scene: Mapping[str, Any], methods: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    pictures = {view["id"]: view["picture"] for view in scene["captured"]}
    pictures |= {item["inserted_id"]: item["inserted"] for item in scene["rounds"]}
    known: dict[str, bool] = {}
    for method in methods:
        known |= {view["id"]: view["generated"] for view in method["views"]}
    return [
        {
            "id": view,
            "generated": generated,
            "picture": pictures.get(view),
            "renders": [method["view_pictures"].get(view) for method in methods],
        }
        for view, generated in known.items()
    ]


def _facts(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    model, config = facts["model"], facts["config"]
    hosts = [entry["host"] for entry in _all_statistics(facts).values() if "host" in entry]
    rows = [
        ("Reconstructor", str(model["model"])),
        ("Weights", f"{config['model']['weights']}, sha256 {model['weights_sha256'][:16]}"),
        ("Licence of the weights", str(model["licence"])),
        *_other_weights(facts),
        ("Seed", str(config["seed"])),
        ("Device", str(config["device"])),
        ("Overrides", ", ".join(facts["overrides"]) or "none"),
    ]
    if hosts:
        host = hosts[0]
        rows.append(("Machine", f"{host['machine']}, {host['cpus']} CPU cores; torch {host['torch']}"))
    if model.get("warmup"):
        warmup = model["warmup"]
        outcome = "kept" if warmup["accepted"] else "taken back: it did not help"
        rows.append(
            (
                "Warm-up",
                f"{warmup['steps']} steps, held-out error {warmup['before']:.4f} to {warmup['after']:.4f}, {outcome}",
            )
        )
    if config["refine"]["steps"]:
        steps = config["refine"]["steps"]
        rows.append(("Gaussians", f"in all rows of this reconstructor fitted to their pictures for {steps} steps"))
    return rows


def _other_weights(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Weights of methods that have a reconstructor of their own, with what their licences say."""
    others = {m["model"]: m for item in facts["rounds"] for m in item["methods"] if m["licence"] is not None}
    return [
        (f"Weights of {model}", f"sha256 {method['weights_sha256'][:16]}; {method['licence']}")
        for model, method in others.items()
    ]


def _all_statistics(facts: Mapping[str, Any]) -> dict[str, Any]:
    found = dict(facts["statistics"])
    for item in facts["rounds"]:
        found |= {f"round {item['number']}: {stage}": entry for stage, entry in item["statistics"].items()}
    return found


def _timings(facts: Mapping[str, Any]) -> list[dict[str, str]]:
    return [
        {"stage": stage, "wall": f"{entry['wall_s']:.1f} s", "memory": f"{entry['peak_rss_mb']:.0f} MB"}
        for stage, entry in _all_statistics(facts).items()
    ]


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", str(value)))
    return rows
