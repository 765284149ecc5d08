"""A finished round in front of the judge: every method by both criteria, and pairs of methods where that is configured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from sceneexpander.artifacts.judgement import (
    SCENE_CRITERIA,
    Comparison,
    Criterion,
    JudgedRound,
    MethodScore,
)
from sceneexpander.errors import UserError
from sceneexpander.judge.ask import Judge
from sceneexpander.judge.frames import Shown
from sceneexpander.services.chat import ChatQuestion
from sceneexpander.services.pictures import SentPicture

BEFORE = "captured"  # the scene before the insertion: it has nothing to be satisfied with


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """What is judged. ``unavailable``: why a method could not be run, by its name."""

    scene: str
    round: int
    target: SentPicture
    shown: Sequence[Shown]
    unavailable: dict[str, str] = field(default_factory=dict)

    def scores(self) -> Iterator[tuple[Shown, Criterion]]:
        """What gets a score."""
        for shown in self.shown:
            for criterion in SCENE_CRITERIA:
                if shown.method != BEFORE or criterion == "quality":
                    yield shown, criterion

    def pairs(self, judge: Judge) -> Iterator[tuple[Shown, Shown, Criterion]]:
        """What is compared. Raises `UserError` for a method to compare with that there is not."""
        name = judge.config.compare_with
        if name is None:
            return
        first = next((shown for shown in self.shown if shown.method == name), None)
        if first is None:
            if name in self.unavailable:
                return
            known = ", ".join(shown.method for shown in self.shown)
            raise UserError(f"is {name!r}, which is not rendered", where="judge.compare_with", fix=f"known: {known}")
        for second in self.shown:
            if second.method not in (name, BEFORE):
                for criterion in SCENE_CRITERIA:
                    yield first, second, criterion


def judge_round(judge: Judge, work: Work) -> JudgedRound:
    """Ask for everything that is not known yet.

    Raises:
        UserError: the judge cannot be asked, or the budget is spent; what came is kept, and the next run goes on from there.
    """
    scores = [
        MethodScore(
            method=shown.method,
            criterion=criterion,
            frames=shown.frames,
            samples=judge.score(
                judge.scene_question(criterion, work.target, shown.pictures),
                what=f"{work.scene}, round {work.round}, {shown.method}, {criterion}",
            ),
        )
        for shown, criterion in work.scores()
    ]
    comparisons = [
        Comparison(
            first=first.method,
            second=second.method,
            criterion=criterion,
            samples=judge.compare(
                judge.pair_question(criterion, work.target, first.pictures, second.pictures),
                judge.pair_question(criterion, work.target, second.pictures, first.pictures),
                what=f"{work.scene}, round {work.round}, {first.method} and {second.method}, {criterion}",
            ),
        )
        for first, second, criterion in work.pairs(judge)
    ]
    return JudgedRound(
        scene=work.scene,
        round=work.round,
        judge=judge.title,
        scores=tuple(scores),
        comparisons=tuple(comparisons),
        unavailable=work.unavailable,
    )


def questions_of(judge: Judge, work: Work) -> list[tuple[str, ChatQuestion]]:
    """What `judge_round` would ask, with a name for each. Sends nothing."""
    asked = [
        (f"{shown.method}_{criterion}", judge.scene_question(criterion, work.target, shown.pictures))
        for shown, criterion in work.scores()
    ]
    for first, second, criterion in work.pairs(judge):
        for a, b in ((first, second), (second, first)):
            question = judge.pair_question(criterion, work.target, a.pictures, b.pictures)
            asked.append((f"{a.method}_or_{b.method}_{criterion}", question))
    return asked
