"""A judge's scores beside what was measured, under names of the catalogue."""

from __future__ import annotations

from dataclasses import replace

from sceneexpander.artifacts.judgement import SCENE_CRITERIA, JudgedRound
from sceneexpander.artifacts.metrics import MetricsRow


def judged_numbers(judged: JudgedRound, method: str) -> dict[str, float]:
    """Mean scores of a method by the catalogue's names; what the judge did not say is left out, never low."""
    scores = {criterion: judged.score(method, criterion) for criterion in SCENE_CRITERIA}
    return {
        f"judge_{criterion}": score.mean
        for criterion, score in scores.items()
        if score is not None and score.mean is not None
    }


def with_judged(row: MetricsRow, judged: JudgedRound | None) -> MetricsRow:
    """The row with the judge's numbers of its method in its round, if it was judged."""
    found = {} if judged is None else judged_numbers(judged, row.method)
    return replace(row, values={**row.values, **found}) if found else row
