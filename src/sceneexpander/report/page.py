"""One static page from the gathered scenes: no server, no network, no build step."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.metrics import MetricsRow, ViewMetrics
from sceneexpander.artifacts.quantities import Quantity
from sceneexpander.artifacts.store import read_json, write_bytes_atomic
from sceneexpander.report.cameras import FACTS, cameras_shown
from sceneexpander.report.collect import MAIN_METHOD
from sceneexpander.report.course import FITTED, fits, looks_shown, verdict, was_fitted
from sceneexpander.report.curve import curve_chart, objective_curves, smoothing_window
from sceneexpander.report.words import LAYERS, PICTURE_KINDS, TABLES, method_words

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
        "cameras": cameras_shown(facts["cameras"], _pictures(facts)),
        "rounds": [_round(item, facts, folder) for item in facts["rounds"]],
        "facts": _facts(facts),
        "timings": _timings(facts),
        "settings": [(key, value) for key, value in _flat(facts["config"])],
    }


def _round(facts: Mapping[str, Any], scene: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    methods = []
    rows = {method["name"]: MetricsRow.load(folder / method["metrics"]) for method in facts["methods"]}
    for method in facts["methods"]:
        words = method_words(method["name"], method["model"], rows[method["name"]].fit)
        poster = max(method["stills"], key=lambda still: -abs(still["frame"] - method["inserted_frame"]))["rgb"]
        goal = method["inserted_frame"] / max(method["frames"], 1)
        methods.append({**method, "label": words.label, "short": words.short, "poster": poster, "goal": goal})
    curves, steps = objective_curves(facts["series"]), len(facts["series"].get("loss", ()))
    return {
        **{
            key: facts[key]
            for key in ("number", "prompt", "full_prompt", "backend", "origin", "candidates", "inserted", "viewer")
        },
        "made": PICTURE_KINDS.get(facts["source_type"], "Picture"),
        "reasons": [f"candidate {score['candidate']}: {score['reason']}" for score in facts["ranking"]],
        "sheet": facts["sheet"] if facts["candidates"] > 1 else None,
        "overlay": facts["overlay"],
        "misalignment": facts["misalignment"],
        "warnings": facts["warnings"],
        "methods": methods,
        "main": MAIN_METHOD,
        "cameras": cameras_shown(facts["cameras"], _pictures(scene)),
        "tables": [found for title, shown in TABLES if (found := _table(title, shown, methods, rows)) is not None],
        "left_out": _left_out(rows, _names(scene)),
        "meanings": [(method["label"], _method_meaning(method)) for method in methods],
        "unavailable": [
            {**item, "label": method_words(item["name"], item["model"]).label} for item in facts["unavailable"]
        ],
        "curve": curve_chart(curves, steps),
        "curves": curves,
        "smoothed": max((smoothing_window(curve) for curve in curves), default=1) > 1,
        "steps": steps,
        "looks": looks_shown(facts["looks"]),
        "verdict": verdict(facts["acceptance"]),
        "fits": fits(facts["methods"]),
        "view_groups": _view_groups(facts, scene, methods, rows),
    }


def _table(
    title: str, quantities: Sequence[Quantity], methods: Sequence[Mapping[str, Any]], rows: Mapping[str, MetricsRow]
) -> dict[str, Any] | None:
    """One table of numbers, a line per method; None if nothing of it is known."""
    shown = [item for item in quantities if any(row.value(item.name) is not None for row in rows.values())]
    if not shown:
        return None
    return {
        "title": title,
        "columns": [
            {"title": c.title, "heading": c.heading, "meaning": c.meaning, "better": _ARROWS[c.better]} for c in shown
        ],
        "rows": [
            {"name": m["name"], "label": m["label"], "cells": [_cell(m["name"], rows, item) for item in shown]}
            for m in methods
        ],
    }


def _cell(method: str, rows: Mapping[str, MetricsRow], item: Quantity) -> dict[str, Any]:
    value, spread = rows[method].value(item.name), rows[method].spread.get(item.name)
    # The scene before the insertion is not a competitor, and numbers of fitted Gaussians are none for those of others: bold compares
    # methods that show the new view and were treated alike, as far as the printed digits go.
    equals = {name: row for name, row in rows.items() if name != "captured" and row.fit is rows[method].fit}
    known = {name: row.value(item.name) for name, row in equals.items()}
    rivals = {name: round(v, item.digits + 2 * (item.unit == "%")) for name, v in known.items() if v is not None}
    best = (max if item.better == "higher" else min)(rivals.values(), default=None)
    return {
        "text": item.text(value) + ("" if spread is None else f" \u00b1 {item.text(spread)}"),
        "unit": item.unit if item.unit != "%" and value is not None else "",
        "best": len(set(rivals.values())) > 1 and rivals.get(method) == best,
    }


def _method_meaning(method: Mapping[str, Any]) -> str:
    return method_words(method["name"], method["model"]).meaning + (f" {FITTED}" if was_fitted(method) else "")


def _left_out(rows: Mapping[str, MetricsRow], names: Mapping[str, str]) -> list[str]:
    """A sentence for every set of views that a mean is not over because they have no camera, with the methods it is about."""
    about: dict[tuple[int, int, tuple[str, ...]], list[str]] = {}
    for method, row in rows.items():
        lost = tuple(view.view_id for view in row.views if not view.generated and not view.posed)
        if lost:
            about.setdefault((row.captured_views_posed or 0, row.captured_views, lost), []).append(method)
    sentences = []
    for (posed, captured, lost), methods in about.items():
        who = "" if len(methods) == len(rows) else f" ({', '.join(methods)})"
        apart = ", ".join(names.get(view, view) for view in lost)
        sentences.append(
            f"Means are over the {posed} of {captured} photos that have a camera{who}; left out: {apart}."
            if posed
            else f"No photo has a camera{who}: the means are over placeholders and say little."
        )
    if any(view.generated and not view.posed for row in rows.values() for view in row.views):
        sentences.append("An inserted view without a camera has no numbers here.")
    return sentences


def _pictures(scene: Mapping[str, Any]) -> dict[str, str]:
    """Pictures of all views by id."""
    return {view["id"]: view["picture"] for view in scene["captured"]} | {
        item["inserted_id"]: item["inserted"] for item in scene["rounds"]
    }


def _names(scene: Mapping[str, Any]) -> dict[str, str]:
    """What people call the views: file names of photos, rounds of inserted pictures."""
    return {view["id"]: view["name"] for view in scene["captured"]} | {
        item["inserted_id"]: f"inserted view of round {item['number']}" for item in scene["rounds"]
    }


def _view_groups(
    facts: Mapping[str, Any],
    scene: Mapping[str, Any],
    methods: Sequence[Mapping[str, Any]],
    rows: Mapping[str, MetricsRow],
) -> list[dict[str, Any]]:
    """Every view at its own camera, with its PSNR; views that some method has no camera for are kept apart."""
    pictures, names = _pictures(scene), _names(scene)
    measured = {name: {view.view_id: view for view in row.views} for name, row in rows.items()}
    known: dict[str, bool] = {}
    for method in methods:
        known |= {view["id"]: view["generated"] for view in method["views"]}
    lost = {view["id"] for method in methods for view in method["views"] if not view["posed"]}
    entries = [
        {
            "id": view,
            "name": names.get(view, view),
            "generated": generated,
            "picture": pictures.get(view),
            "renders": [
                {
                    "label": method["label"],
                    "picture": method["view_pictures"].get(view),
                    "number": _view_number(measured[method["name"]].get(view)),
                }
                for method in methods
                if view in {item["id"] for item in method["views"]}
            ],
        }
        for view, generated in known.items()
    ]
    groups = [
        ("", [entry for entry in entries if entry["id"] not in lost]),
        ("Without a camera: at a placeholder, in no mean", [entry for entry in entries if entry["id"] in lost]),
    ]
    return [{"title": title, "views": views} for title, views in groups if views]


def _view_number(view: ViewMetrics | None) -> str:
    if view is None:
        return ""
    psnr = view.psnr_db if view.own is None or view.own.psnr_db is None else view.own.psnr_db
    return f"{psnr:.2f} dB" if view.posed else f"no camera ({psnr:.2f} dB at a placeholder)"


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
    visits = config["refine"]["visits"]
    if visits:
        rows.append(("Gaussians", f"fitted to their pictures, {visits} steps per view, in all rows marked + fit"))
    rows.append(
        ("All runs", "make ui opens MLflow with the numbers of this and other runs; its menu Views has the columns")
    )
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
