"""What a judge says about candidates, beside what is measured about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sceneexpander.artifacts.agreement import CandidateScore
from sceneexpander.artifacts.judgement import HIGHEST_SCORE, LOWEST_SCORE
from sceneexpander.generation.prompt import split_words
from sceneexpander.generation.protocol import GenerationContext, SceneSoFar
from sceneexpander.generation.references import choose_references
from sceneexpander.ingest.fit import FittedPicture
from sceneexpander.judge.ask import Judge
from sceneexpander.services.pictures import SentPicture, encode_picture

_PHOTOS = 4  # that the judge is shown with a candidate: those nearest to where the motion leads


def judge_candidates(
    judge: Judge,
    scores: Sequence[CandidateScore],
    candidates: Sequence[FittedPicture | None],
    context: GenerationContext,
    so_far: SceneSoFar,
) -> tuple[CandidateScore, ...]:
    """The scores with the judge's opinion in their totals, the best first.

    ``total`` becomes the mean of itself and the judge's mean score, weighted as ``judge.candidate_weight`` says. Of a candidate that the
    judge did not score it stays as it is: what is missing is not low.

    Raises:
        UserError: the judge cannot be asked; what came is kept.
    """
    side = judge.config.picture_side_px
    words = ", ".join(part for part in split_words(context.spec) if part)
    photos = [
        SentPicture(png=item.png, pixels_sha256=item.pixels_sha256)
        for item in choose_references(context, so_far, limit=_PHOTOS, long_side_px=side)
    ]
    judged = []
    for score in scores:
        fitted = candidates[score.candidate]
        assert fitted is not None  # noqa: S101 - only usable candidates have scores
        question = judge.candidate_question(words, photos, encode_picture(fitted.detail, long_side_px=side))
        samples = judge.score(question, what=f"round {context.round_number}, candidate {score.candidate}")
        given = [sample.score for sample in samples if sample.score is not None]
        judged.append(_with_opinion(score, given, len(samples), judge.config.candidate_weight))
    return tuple(sorted(judged, key=lambda score: (-score.total, score.candidate)))


def _with_opinion(score: CandidateScore, given: Sequence[float], samples: int, weight: float) -> CandidateScore:
    if not given:
        return replace(score, reason=f"{score.reason}; the judge did not say")
    mean = sum(given) / len(given)
    share = (mean - LOWEST_SCORE) / (HIGHEST_SCORE - LOWEST_SCORE)
    counted = "" if len(given) == samples else f" ({len(given)}/{samples})"
    return replace(
        score,
        total=(1 - weight) * score.total + weight * share,
        judge=share,
        reason=f"{score.reason}; judged {mean:.2f} of {HIGHEST_SCORE:g}{counted}",
    )
