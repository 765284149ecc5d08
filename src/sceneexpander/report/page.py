"""What the page of one scene is filled with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.metrics import MetricsRow, ViewMetrics
from sceneexpander.artifacts.page import MethodPage, RoundPage, ScenePage, StageRun
from sceneexpander.catalogue import ARROWS, MAIN, Metric
from sceneexpander.catalogue.methods import CAPTURED, known_method
from sceneexpander.report.cameras import cameras_shown
from sceneexpander.report.course import FITTED, fits, looks_shown, verdict
from sceneexpander.report.curve import curve_chart, objective_curves, smoothing_window
from sceneexpander.report.judged import load_judged, page_table
from sceneexpander.report.media import poster_of
from sceneexpander.report.rounds import RoundsShown, rounds_shown
from sceneexpander.report.words import LAYERS, PICTURE_KINDS, method_label, number_tables

_Filled = dict[str, Any]  # what a part of the template is filled with


def fill_scene(page: ScenePage, folder: Path, *, media: str, walks: bool) -> _Filled:
    """What the template ``page.html.j2`` knows of a scene.

    Args:
        page: of the scene, with the names that its files have under ``media``.
        folder: made by `collect_scene`.
        media: where its files are, relative to the page.
        walks: whether the pages to walk through are there.
    """
    course = course_of(page, folder)
    return {
        "scene": page.scene,
        "anchor": folder.name,
        "media": media,
        "walks": walks,
        "timeline": timeline(page, course),
        "captured": page.captured,
        "cameras": cameras_shown(page.cameras, _pictures(page)),
        "rounds": [_round(item, page, folder) for item in page.rounds],
        "course": course,
        "proposals": page.rounds[-1].proposals if page.rounds else None,
        "facts": _facts(page),
        "timings": _timings(page),
        "settings": sorted(page.settings.items()),
    }


def timeline(page: ScenePage, course: RoundsShown | None) -> list[_Filled]:
    """The rounds in order: sentence, inserted picture, and the drift of earlier views."""
    drifts = {column.label: column.drift for column in course.columns} if course is not None else {}
    return [
        {
            "number": item.number,
            "prompt": item.prompt,
            "picture": item.inserted,
            "drift": f"{drift} dB" if (drift := drifts.get(f"round {item.number}", "")) else "",
        }
        for item in page.rounds
    ]


def course_of(page: ScenePage, folder: Path) -> RoundsShown | None:
    """What became of all regions over the rounds; None without more than one of them."""

    def row_of(item: RoundPage, name: str) -> MetricsRow | None:
        found = next((method for method in item.methods if method.name == name), None)
        return None if found is None else MetricsRow.load(folder / found.metrics)

    if not page.rounds:
        return None
    rows = [row_of(item, MAIN) for item in page.rounds]
    return rounds_shown(page.rounds, rows, row_of(page.rounds[0], CAPTURED), _names(page))


def _round(page: RoundPage, scene: ScenePage, folder: Path) -> _Filled:
    rows = {method.name: MetricsRow.load(folder / method.metrics) for method in page.methods}
    labels = {method.name: method_label(method.name, method.model, rows[method.name].fit) for method in page.methods}
    judged = load_judged(folder / f"round_{page.number}")
    loss = page.steps.values.get("loss", ())
    curves = objective_curves(page.steps.inserted if loss else (), loss)
    return {
        "page": page,
        "made": PICTURE_KINDS.get(page.source_type or "", "Picture"),
        "reasons": [f"candidate {score.candidate}: {score.reason}" for score in page.ranking],
        "overlay": page.overlay,
        "misalignment": page.misalignment,
        "sheet": page.sheet if page.candidates > 1 else None,
        "methods": [_shown_method(method, labels[method.name]) for method in page.methods],
        "layers": [item for item in LAYERS if any(item[0] in method.videos for method in page.methods)],
        "main": MAIN,
        "cameras": cameras_shown(page.cameras, _pictures(scene)),
        "tables": [
            *(found for title, shown in number_tables() if (found := _table(title, shown, labels, rows)) is not None),
            *([] if judged is None else [page_table(judged, labels)]),
        ],
        "left_out": _left_out(rows, _names(scene)),
        "meanings": [(labels[method.name], _method_meaning(method)) for method in page.methods],
        "unavailable": [
            {"name": item.name, "label": method_label(item.name, item.model), "reason": item.reason}
            for item in page.unavailable
        ],
        "curve": curve_chart(curves, len(loss)),
        "curves": curves,
        "smoothed": max((smoothing_window(curve) for curve in curves), default=1) > 1,
        "steps": len(loss),
        "looks": looks_shown(page.looks),
        "verdict": verdict(page.judgement),
        "fits": fits(page.methods),
        "held_out": _held_out_views(page, scene, labels, rows),
        "view_groups": _view_groups(page, scene, labels, rows),
    }


def _shown_method(method: MethodPage, label: str) -> _Filled:
    known = known_method(method.name)
    return {
        "page": method,
        "label": label,
        "short": "" if known is None else known.short,
        "poster": poster_of(method),
        "goal": method.inserted_frame / max(method.frames, 1),
    }


def _table(
    title: str, metrics: Sequence[Metric], labels: Mapping[str, str], rows: Mapping[str, MetricsRow]
) -> _Filled | None:
    """One table of numbers, a line per method; None if nothing of it is known."""
    shown = [metric for metric in metrics if any(row.value(metric.name) is not None for row in rows.values())]
    if not shown:
        return None
    return {
        "title": title,
        "columns": [
            {"title": c.title, "heading": c.heading, "meaning": c.meaning, "better": ARROWS[c.better]} for c in shown
        ],
        "rows": [
            {"name": name, "label": label, "cells": [_cell(name, rows, metric) for metric in shown]}
            for name, label in labels.items()
        ],
    }


def _cell(method: str, rows: Mapping[str, MetricsRow], metric: Metric) -> _Filled:
    value, spread = rows[method].value(metric.name), rows[method].spread.get(metric.name)
    # The scene before the insertion is not a competitor, and numbers of fitted Gaussians are none for those of others: bold compares
    # methods that show the new view and were treated alike, as far as the printed digits go.
    equals = {name: row for name, row in rows.items() if name != CAPTURED and row.fit is rows[method].fit}
    known = {name: row.value(metric.name) for name, row in equals.items()}
    rivals = {name: metric.bare(v) for name, v in known.items() if v is not None}
    best = (max if metric.better == "higher" else min)(rivals.values(), key=float, default=None)
    return {
        "text": metric.text(value) + ("" if spread is None else f" \u00b1 {metric.text(spread)}"),
        "unit": metric.unit if metric.unit != "%" and value is not None else "",
        "best": len(set(rivals.values())) > 1 and rivals.get(method) == best,
    }


def _method_meaning(method: MethodPage) -> str:
    known = known_method(method.name)
    fitted = method.refinement is not None and method.refinement.kept
    return ("" if known is None else known.explained(method.model)) + (f" {FITTED}" if fitted else "")


def _left_out(rows: Mapping[str, MetricsRow], names: Mapping[str, str]) -> list[str]:
    """A sentence for every set of views that a mean is not over because they have no camera, with the methods it is about."""
    about: dict[tuple[int, int, tuple[str, ...]], list[str]] = {}
    for method, row in rows.items():
        lost = tuple(view.view_id for view in row.views if not view.generated and not view.posed)
        if lost:
            about.setdefault((_count(row, "views_captured_posed"), _count(row, "views_captured"), lost), []).append(
                method
            )
    sentences = []
    for (posed, captured, lost), methods in about.items():
        who = "" if len(methods) == len(rows) else f" ({', '.join(methods)})"
        apart = ", ".join(names.get(view, view) for view in lost)
        sentences.append(
            f"Means are over the {posed} of {captured} photos that have a camera{who}; left out: {apart}."
            if posed
            else f"No photo has a camera{who}: the means are over placeholders and say little."
        )
    held_out = {view.view_id for row in rows.values() for view in row.held_out}
    if held_out:
        sentences.append(f"Held out, and in nothing but the numbers of held-out photos: {', '.join(sorted(held_out))}.")
    for method, row in rows.items():
        missed = [view.view_id for view in row.held_out if not view.posed]
        if missed:
            sentences.append(
                f"{method}: {', '.join(missed)} has no camera in its scene, so it has no numbers of held-out photos."
            )
    if any(view.generated and not view.posed for row in rows.values() for view in row.views):
        sentences.append("An inserted view without a camera has no numbers here.")
    return sentences


def _count(row: MetricsRow, name: str) -> int:
    return int(row.value(name) or 0)


def _pictures(scene: ScenePage) -> dict[str, str]:
    """Pictures of all views by id."""
    return {view.view_id: view.picture for view in scene.captured} | {
        item.inserted_id: item.inserted for item in scene.rounds
    }


def _names(scene: ScenePage) -> dict[str, str]:
    """What people call the views: file names of photos, rounds of inserted pictures."""
    return {view.view_id: view.name for view in scene.captured} | {
        item.inserted_id: f"inserted view of round {item.number}" for item in scene.rounds
    }


def _view_groups(
    page: RoundPage, scene: ScenePage, labels: Mapping[str, str], rows: Mapping[str, MetricsRow]
) -> list[_Filled]:
    """Every view at its own camera, with its PSNR; views that some method has no camera for are kept apart."""
    pictures, names = _pictures(scene), _names(scene)
    measured = {name: {view.view_id: view for view in row.views} for name, row in rows.items()}
    known = {view.view_id: view.generated for method in page.methods for view in method.views}
    lost = {view.view_id for method in page.methods for view in method.views if not view.posed}
    entries = [
        {
            "id": view,
            "name": names.get(view, view),
            "generated": generated,
            "picture": pictures.get(view),
            "renders": [
                {
                    "label": labels[method.name],
                    "picture": method.view_pictures.get(view),
                    "number": _view_number(measured[method.name].get(view)),
                }
                for method in page.methods
                if view in {item.view_id for item in method.views}
            ],
        }
        for view, generated in known.items()
    ]
    groups = [
        ("", [entry for entry in entries if entry["id"] not in lost]),
        ("Without a camera: at a placeholder, in no mean", [entry for entry in entries if entry["id"] in lost]),
    ]
    return [{"title": title, "views": views} for title, views in groups if views]


def _held_out_views(
    page: RoundPage, scene: ScenePage, labels: Mapping[str, str], rows: Mapping[str, MetricsRow]
) -> list[_Filled]:
    """Photos that nothing was made from, beside what each method's scene shows at the camera found for them in it."""
    measured = {name: {view.view_id: view for view in row.held_out} for name, row in rows.items()}
    entries = []
    for photo in scene.held_out:
        renders = [
            {
                "label": labels[method.name],
                "picture": method.held_out_pictures.get(photo.view_id),
                "number": _held_out_number(measured[method.name][photo.view_id]),
            }
            for method in page.methods
            if photo.view_id in measured[method.name]
        ]
        if renders:
            entries.append({"name": photo.name, "picture": photo.picture, "renders": renders})
    return entries


def _held_out_number(view: ViewMetrics) -> str:
    if not view.posed:
        return "no camera in its scene"
    psnr = view.values.get("psnr_held_out_db")
    return "" if psnr is None else f"{psnr:.2f} dB"


def _view_number(view: ViewMetrics | None) -> str:
    if view is None:
        return ""
    # In the picture's own pixels if it was compared there.
    names = ("psnr_at_picture_size_db", "psnr_inserted_db", "psnr_at_photo_size_db", "psnr_captured_db")
    psnr = next((view.values[name] for name in names if name in view.values), None)
    if psnr is None:
        return ""
    return f"{psnr:.2f} dB" if view.posed else f"no camera ({psnr:.2f} dB at a placeholder)"


def _facts(page: ScenePage) -> list[tuple[str, str]]:
    model, settings = page.model, page.settings
    hosts = [run.host for run in _all_statistics(page).values() if run.host is not None]
    rows = [
        ("Reconstructor", model.model),
        ("Weights", f"{settings['model.weights']}, sha256 {model.weights_sha256[:16]}"),
        ("Licence of the weights", model.licence),
        *_other_weights(page),
        ("Seed", settings["seed"]),
        ("Device", settings["device"]),
        ("Overrides", ", ".join(page.overrides) or "none"),
    ]
    if hosts:
        rows.append(("Machine", f"{hosts[0].machine}, {hosts[0].cpus} CPU cores; torch {hosts[0].torch}"))
    warmup = model.warmup
    if warmup is not None:
        outcome = "kept" if warmup.accepted else "taken back: it did not help"
        rows.append(
            (
                "Warm-up",
                f"{warmup.steps} steps, held-out error {warmup.before:.4f} to {warmup.after:.4f}, {outcome}",
            )
        )
    visits = int(settings["refine.visits"])
    if visits:
        rows.append(("Gaussians", f"fitted to their pictures, {visits} steps per view, in all rows marked + fit"))
    rows.append(
        ("All runs", "make ui opens MLflow with the numbers of this and other runs; its menu Views has the columns")
    )
    return rows


def _other_weights(page: ScenePage) -> list[tuple[str, str]]:
    """Weights of methods that have a reconstructor of their own, with what their licences say."""
    others = {m.model: m for item in page.rounds for m in item.methods if m.licence is not None}
    return [
        (f"Weights of {model}", f"sha256 {method.weights_sha256[:16]}; {method.licence}")
        for model, method in others.items()
    ]


def _all_statistics(page: ScenePage) -> dict[str, StageRun]:
    found = dict(page.statistics)
    for item in page.rounds:
        found |= {f"round {item.number}: {stage}": run for stage, run in item.statistics.items()}
    return found


def _timings(page: ScenePage) -> list[dict[str, str]]:
    return [
        {"stage": stage, "wall": f"{run.wall_s:.1f} s", "memory": f"{run.peak_rss_mb:.0f} MB"}
        for stage, run in _all_statistics(page).items()
    ]
