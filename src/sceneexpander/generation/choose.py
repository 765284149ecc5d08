"""One round's picture out of its candidates: check, fit, choose, and record why."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.agreement import CandidateScore
from sceneexpander.artifacts.candidates import Candidate
from sceneexpander.artifacts.inserted import InsertedView, Provenance
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.errors import UserError
from sceneexpander.generation.assess import Assessed, assess
from sceneexpander.generation.backends import make_generator
from sceneexpander.generation.backends.stored import ReplayConfig, own_picture
from sceneexpander.generation.config import AUTO, ChoiceConfig, GeneratorConfig
from sceneexpander.generation.misalignment import report_misalignment
from sceneexpander.generation.opinion import judge_candidates
from sceneexpander.generation.protocol import Forecast, GenerationContext, SceneSoFar
from sceneexpander.generation.rank import rank_candidates
from sceneexpander.generation.sheet import contact_sheet
from sceneexpander.ingest.load import view_from_fitted
from sceneexpander.judge.ask import Judge

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenView:
    """The inserted view, all candidates on one picture to choose by eye, and where the chosen one contradicts the scene (`Misaligned`)."""

    inserted: InsertedView
    sheet: Float[Tensor, "3 height width"]
    overlay: Float[Tensor, "3 overlay_height overlay_width"] | None


def choose_view(
    context: GenerationContext,
    candidates: Sequence[Candidate],
    so_far: SceneSoFar,
    choice: ChoiceConfig,
    *,
    seed: int,
    judge: Judge | None = None,
) -> ChosenView:
    """The picture that a round inserts, in the frame of the views so far.

    ``auto`` ranks the usable candidates, see `rank_candidates`; a single one needs no ranking. ``judge``, if there is one, has a say in it.

    Raises:
        UserError: there is no such candidate, or it is unusable.
    """
    assessed = [assess(item, so_far.views, choice.fit) for item in _with_own(context, candidates, choice)]
    ranking: tuple[CandidateScore, ...] = ()
    if choice.candidate == AUTO and sum(item.fitted is not None for item in assessed) > 1:
        pictures = [item.fitted for item in assessed]
        ranking = rank_candidates(pictures, so_far, seed=seed)
        if judge is not None and judge.config.candidates:
            ranking = judge_candidates(judge, ranking, pictures, context, so_far)
    chosen = ranking[0].candidate if ranking else _picked(assessed, choice, context)
    if ranking:
        logger.info("round %d: candidate %d: %s", context.round_number, chosen, ranking[0].reason)
    inserted = _inserted(context, assessed, chosen, len(so_far.views), ranking)
    fitted = assessed[chosen].fitted
    assert fitted is not None  # noqa: S101 - `_inserted` refuses what could not be fitted
    misaligned = report_misalignment(fitted, so_far, seed=seed)
    logger.info("round %d: %s", context.round_number, misaligned.report.words)
    inserted = replace(inserted, misalignment=misaligned.report, support=misaligned.support)
    warning = assessed[chosen].provenance.parameters.get("warning")
    if warning:
        logger.warning("round %d, %s: %s", context.round_number, assessed[chosen].name, warning)
    scores = {score.candidate: f"{score.total:.2f} " for score in ranking}
    tiles = [
        (f"{scores.get(index, '')}{item.name}", None if item.fitted is None else item.fitted.image)
        for index, item in enumerate(assessed)
    ]
    sheet = contact_sheet(so_far.views, tiles, chosen=chosen)
    return ChosenView(inserted=inserted, sheet=sheet, overlay=misaligned.overlay)


def check_round(
    context: GenerationContext, generator: GeneratorConfig, choice: ChoiceConfig
) -> tuple[Forecast, InsertedView | None]:
    """What can be known of a round before anything runs: free, offline, without a request.

    Returns:
        what the back-end would do; the view to be inserted where its picture is there already (of several that ``auto`` would choose
        from, the first usable one), else None.

    Raises:
        UserError: the back-end cannot serve the round, or the picture is unusable.
    """
    forecast = make_generator(generator).check(context)
    if not forecast.stored and choice.named_file(context.round_number) is None:
        return forecast, None
    assessed = [assess(item, context.captured, choice.fit) for item in _with_own(context, forecast.stored, choice)]
    chosen = _picked(assessed, choice, context)
    return forecast, _inserted(context, assessed, chosen, len(context.captured), ())


def _with_own(
    context: GenerationContext, candidates: Sequence[Candidate], choice: ChoiceConfig
) -> tuple[Candidate, ...]:
    """The candidates, followed by the user's own picture if that is the choice."""
    own = choice.named_file(context.round_number)
    return tuple(candidates) if own is None else (*candidates, own_picture(own, context, where="choose.candidate"))


def _picked(assessed: Sequence[Assessed], choice: ChoiceConfig, context: GenerationContext) -> int:
    if isinstance(choice.candidate, int):
        if choice.candidate >= len(assessed):
            raise UserError(
                f"is {choice.candidate}, but round {context.round_number} has {len(assessed)} candidate(s)",
                where="choose.candidate",
                fix=f"use 0 to {len(assessed) - 1}",
            )
        return choice.candidate
    if choice.candidate != AUTO:
        return len(assessed) - 1
    usable = [index for index, item in enumerate(assessed) if item.fitted is not None]
    return usable[0] if usable else 0


def _place_of(provenance: Provenance, context: GenerationContext) -> Path | str:
    """Where a picture lies: a recorded one in the scene's folder, so that whoever made that of a user's files can name those."""
    if provenance.backend != ReplayConfig().backend:
        return provenance.source
    return (context.scene_folder if context.recorded is None else context.recorded) / provenance.source


def _inserted(
    context: GenerationContext,
    assessed: Sequence[Assessed],
    chosen: int,
    views: int,
    ranking: tuple[CandidateScore, ...],
) -> InsertedView:
    item = assessed[chosen]
    if item.picture is None or item.fitted is None:
        raise UserError(item.provenance.refusal or "no picture", where=_place_of(item.provenance, context))
    view: ViewSet = view_from_fitted(
        item.picture.facts,
        item.fitted,
        view_id=f"{views:03d}_inserted_{context.round_number}",
        generated=True,
        round_number=context.round_number,
    )
    return InsertedView(
        round=context.round_number,
        view=view,
        chosen=chosen,
        provenance=tuple(item.provenance for item in assessed),
        ranking=ranking,
    )
