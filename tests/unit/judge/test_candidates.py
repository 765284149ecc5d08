"""The judge's say in which candidate is taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sceneexpander.artifacts.agreement import CandidateScore
from sceneexpander.generation import GenerationContext, SceneSoFar
from sceneexpander.generation.assess import frame_of
from sceneexpander.generation.opinion import judge_candidates
from sceneexpander.ingest.fit import FittedPicture, fit_picture
from tests.support.loopback import Service
from tests.worlds.judged import judge_of, refusal, scored
from tests.worlds.rounds import HEIGHT, WIDTH


def candidate(seed: int, so_far: SceneSoFar) -> FittedPicture:
    pixels = np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return fit_picture(pixels, frame_of(so_far.views), "crop")


def measured(number: int, total: float) -> CandidateScore:
    return CandidateScore(
        candidate=number, total=total, registration=0.5, inliers=30, reprojection_px=1.0, appearance=0.5, sharpness=0.5,
        novelty=0.3, reason="measured",
    )  # fmt: skip


def test_a_score_counts_and_a_missing_one_does_not(
    service: Service, so_far: SceneSoFar, context: GenerationContext, tmp_path: Path
) -> None:
    judge = judge_of(service, tmp_path / "cache", samples=2, candidate_weight=0.5)
    pictures = [candidate(0, so_far), None, candidate(2, so_far), candidate(3, so_far)]
    scores = [measured(0, 0.6), measured(2, 0.5), measured(3, 0.4)]
    service.answers = [scored(1.0), scored(2.0), refusal(), refusal(), scored(5.0), refusal()]
    ranking = judge_candidates(judge, scores, pictures, context, so_far)
    assert [score.candidate for score in ranking] == [3, 2, 0]
    best, unsaid, worst = ranking
    assert best.judge == 1.0
    assert best.total == pytest.approx(0.7)
    assert (unsaid.judge, unsaid.total) == (None, 0.5), "what is missing is not low"
    assert worst.judge == 0.125
    assert worst.total == pytest.approx(0.3625)
    assert best.reason == "measured; judged 5.00 of 5 (1/2)"
    assert unsaid.reason == "measured; the judge did not say"
    assert b"move right 30 %, a bench" in service.asked[0].body
    judge_candidates(judge, scores, pictures, context, so_far)
    assert len(service.asked) == 6, "another choice later asks nobody again"
