"""What a judge said, as tables. Where nobody was asked, they say so in the place of every number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.judgement import CRITERION_TITLES, FILE_NAME, SCENE_CRITERIA, JudgedRound
from sceneexpander.catalogue.methods import known_method
from sceneexpander.catalogue.table import Table

_MEANINGS = {
    "insertion": "Do the frames of the tour show what the inserted picture asks for? 1 (failed) to 5 (right in all frames), by a "
    "vision-language model that does not know whose frames they are.",
    "quality": "How well is the tour rendered, whatever it shows? 1 (of no use) to 5 (hardly an artefact), by the same model; ghosting "
    "counts most.",
}


def load_judged(folder: Path) -> JudgedRound | None:
    """The judgement in a round's folder of a gathered scene; None where none was gathered."""
    return JudgedRound.load(folder) if (folder / FILE_NAME).is_file() else None


def page_table(judged: JudgedRound, labels: Mapping[str, str]) -> dict[str, Any]:
    """The table of the page, in the form of the others. ``labels``: of the methods, by name."""
    who = judged.judge or "a vision-language model"
    return {
        "title": f"Judged by {who}",
        "columns": [
            {"title": title, "heading": title, "meaning": _MEANINGS[criterion], "better": "\u2191"}
            for criterion in SCENE_CRITERIA
            for title in (CRITERION_TITLES[criterion],)
        ],
        "rows": [
            {
                "name": name,
                "label": label,
                "cells": [
                    {"text": judged.text(name, criterion), "unit": "", "best": False} for criterion in SCENE_CRITERIA
                ],
            }
            for name, label in labels.items()
        ],
    }


def _title(method: str) -> str:
    known = known_method(method)
    return method if known is None else known.title


def judged_table(rounds: Sequence[JudgedRound], methods: Sequence[str]) -> Table:
    """One line per scene, round and method: mean and standard deviation over samples, and how many are missing."""
    lines = [
        (
            judged.scene,
            str(judged.round),
            _title(method),
            *(judged.text(method, criterion) for criterion in SCENE_CRITERIA),
        )
        for judged in rounds
        for method in methods
    ]
    return Table(
        header=("scene", "round", "method", *(f"{CRITERION_TITLES[criterion]} \u2191" for criterion in SCENE_CRITERIA)),
        lines=tuple(lines),
        left=3,
    )


def comparisons_table(rounds: Sequence[JudgedRound]) -> Table | None:
    """One line per comparison, what both orders agree on; None if nothing was compared."""
    lines = [
        (
            judged.scene,
            str(judged.round),
            _title(item.first),
            _title(item.second),
            CRITERION_TITLES[item.criterion],
            item.text,
        )
        for judged in rounds
        for item in judged.comparisons
    ]
    header = ("scene", "round", "first", "second", "criterion", "better in both orders")
    return Table(header=header, lines=tuple(lines), left=5) if lines else None
