"""What tables say about a judge: numbers with their spread, what is missing, and that there was none."""

from __future__ import annotations

from sceneexpander.artifacts.judgement import Answered, JudgedRound, MethodScore, ScoreSample
from sceneexpander.report.judged import comparisons_table, judged_table, page_table

METHODS = ("captured", "backbone", "omnivggt")


def sample(score: float | None) -> ScoreSample:
    answered = Answered(
        request="r", number=0, model="m", created="2026-01-01", said="", missing="refused" if score is None else None
    )
    return ScoreSample(answered=answered, score=score, confidence=None if score is None else 0.5)


def score(criterion: str, *scores: float | None) -> MethodScore:
    return MethodScore(
        method="backbone",
        criterion=criterion,  # type: ignore[arg-type]
        frames=(0,),
        samples=tuple(map(sample, scores)),
    )


def test_columns_without_a_judge_say_so() -> None:
    table = judged_table([JudgedRound(scene="s", round=1)], METHODS)
    assert [line[3:] for line in table.lines] == [("no judge", "no judge")] * 3
    assert comparisons_table([JudgedRound(scene="s", round=1)]) is None
    shown = page_table(JudgedRound(scene="s", round=1), {"backbone": "B"})
    assert [cell["text"] for cell in shown["rows"][0]["cells"]] == ["no judge", "no judge"]


def test_what_is_missing_is_counted_and_in_no_mean() -> None:
    judged = JudgedRound(
        scene="s",
        round=1,
        judge="m",
        scores=(score("insertion", 5.0, None, 4.0), score("quality", None, None)),
        unavailable={"omnivggt": "needs the public checkpoint"},
    )
    table = judged_table([judged], METHODS)
    assert [line[3:] for line in table.lines] == [
        ("–", "–"),
        ("4.50 ± 0.71 (2/3)", "missing (2 refused)"),
        ("needs the public checkpoint", "needs the public checkpoint"),
    ]
