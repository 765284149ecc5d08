"""Answers -> the paper's H-IS and H-RQ, with intervals, tests and everything that was left out."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sceneexpander.artifacts.store import to_plain, write_json_atomic
from sceneexpander.catalogue import Table
from sceneexpander.errors import UserError
from sceneexpander.files import write_bytes_atomic
from sceneexpander.study.document import ANSWERS_NAME, Participant, Study
from sceneexpander.study.spec import LETTERS, Criterion
from sceneexpander.study.statistics import (
    RESAMPLES,
    Friedman,
    Interval,
    Pair,
    bootstrap_means,
    compare_pairs,
    friedman_test,
    kendall_tau,
    kendalls_w,
    percentile_interval,
    scores_from_ranks,
)
from sceneexpander.study.store import Answer, Answers, read_answers

SCHEMA = "study results/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Exclusion:
    """Somebody whose answers are not in the results, and why."""

    participant: str
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodScore:
    """Mean score of a method over participants and scenes, from 1 to the number of methods; ``first_share``: how often it was best."""

    method: str
    mean: float
    interval: Interval | None
    first_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CriterionResult:
    """One of the two columns.

    Attributes:
        criterion: which.
        methods: in the study's order.
        friedman: None where the test means nothing (see `friedman_test`).
        scene_agreement: mean over scenes of Kendall's W of the participants' rankings of that scene; None with one participant.
        pairs: all pairs of methods.
        letter_scores: mean score by the place on the screen, A first: all equal if places do not matter.
        median_s: seconds per screen, from opening to sending.
    """

    criterion: Criterion
    methods: tuple[MethodScore, ...]
    friedman: Friedman | None
    scene_agreement: float | None
    pairs: tuple[Pair, ...]
    letter_scores: tuple[float, ...]
    median_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyResults:
    """Everything that `compute_results` found.

    Attributes:
        title: of the study.
        version: of the package that built it.
        study_sha256: digest of the study.
        invited: number of links.
        consented: of those who agreed to take part.
        included: names of those whose answers count.
        excluded: everybody else who agreed to take part, and why.
        scenes: names, catch scenes left out.
        resamples: of bootstrap and permutations.
        seed: of both.
        criteria: both.
    """

    title: str
    version: str
    study_sha256: str
    invited: int
    consented: int
    included: tuple[str, ...]
    excluded: tuple[Exclusion, ...]
    scenes: tuple[str, ...]
    resamples: int
    seed: int
    criteria: tuple[CriterionResult, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RankedStudy:
    """The rankings that count, complete: every participant ranked all methods of all scenes under both criteria.

    Attributes:
        participants: first axis.
        scenes: second axis.
        methods: third axis.
        scores: by criterion.
    """

    participants: tuple[str, ...]
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    scores: dict[Criterion, Float[ndarray, "participant scene method"]]


def exclusion_reason(study: Study, participant: Participant, answers: Answers) -> str | None:
    """Why somebody's answers do not count, or None: the rules are those of the study and were fixed before anybody answered."""
    if participant.name in answers.withdrawn:
        return "withdrew, answers erased"
    given = {answer.screen: answer for answer in answers.answers if answer.participant == participant.name}
    if len(given) < len(participant.screens):
        return f"did not finish ({len(given)} of {len(participant.screens)} screens)"
    taus = [_catch_tau(study, participant, answer) for answer in given.values()]
    failed = sum(tau is not None and tau < study.catch.minimum_tau - 1e-9 for tau in taus)
    if failed > study.catch.allowed_failures:
        return f"failed {failed} of {sum(tau is not None for tau in taus)} catch screens"
    return None


def _catch_tau(study: Study, participant: Participant, answer: Answer) -> float | None:
    screen = next(screen for screen in participant.screens if screen.name == answer.screen)
    scene = study.scene(screen.scene)
    if not scene.catch:
        return None
    given = [answer.ranks[video] for video in scene.videos.values()]
    return kendall_tau(given, list(range(len(given))))


def collect_rankings(study: Study, answers: Answers) -> tuple[RankedStudy, tuple[Exclusion, ...]]:
    """What counts, and what does not.

    Raises:
        UserError: nobody is left.
    """
    reasons = {item.name: exclusion_reason(study, item, answers) for item in study.participants}
    excluded = tuple(
        Exclusion(participant=name, reason=reason)
        for name, reason in reasons.items()
        if reason is not None and name in answers.consented | answers.withdrawn
    )
    included = [item for item in study.participants if reasons[item.name] is None]
    if not included:
        raise UserError(
            f"nobody's answers count yet ({len(answers.consented)} began, {len(excluded)} are excluded)",
            where=study.title,
            fix="wait until somebody has finished",
        )
    given = {(answer.participant, answer.screen): answer.ranks for answer in answers.answers}
    scenes = tuple(scene for scene in study.scenes if not scene.catch)
    ranks = {
        criterion: np.zeros((len(included), len(scenes), len(study.methods)), dtype=np.int64) for criterion in Criterion
    }
    for row, participant in enumerate(included):
        for screen in participant.screens:
            column = next((index for index, scene in enumerate(scenes) if scene.name == screen.scene), None)
            if column is not None:
                by_video = given[participant.name, screen.name]
                ranks[screen.criterion][row, column] = [
                    by_video[scenes[column].videos[method]] for method in study.methods
                ]
    ranked = RankedStudy(
        participants=tuple(item.name for item in included),
        scenes=tuple(scene.name for scene in scenes),
        methods=study.methods,
        scores={criterion: scores_from_ranks(array) for criterion, array in ranks.items()},
    )
    return ranked, excluded


def compute_results(
    study: Study, answers: Answers, *, seed: int = 0, resamples: int = RESAMPLES
) -> tuple[StudyResults, RankedStudy]:
    """Scores, intervals and tests. Raises `UserError` if nobody's answers count."""
    ranked, excluded = collect_rankings(study, answers)
    criteria = tuple(_criterion_result(study, answers, ranked, item, seed, resamples) for item in Criterion)
    results = StudyResults(
        title=study.title,
        version=study.version,
        study_sha256=study.digest,
        invited=len(study.participants),
        consented=len(answers.consented),
        included=ranked.participants,
        excluded=excluded,
        scenes=ranked.scenes,
        resamples=resamples,
        seed=seed,
        criteria=criteria,
    )
    return results, ranked


def _criterion_result(
    study: Study, answers: Answers, ranked: RankedStudy, criterion: Criterion, seed: int, resamples: int
) -> CriterionResult:
    scores = ranked.scores[criterion]
    people, _, count = scores.shape
    by_person = scores.mean(1)
    means = bootstrap_means(scores, seed, resamples=resamples)
    agreement = [kendalls_w(scores[:, scene]) for scene in range(scores.shape[1])]
    by_letter, seconds = _screen_facts(study, answers, ranked, criterion)
    return CriterionResult(
        criterion=criterion,
        methods=tuple(
            MethodScore(
                method=method,
                mean=float(scores[..., index].mean()),
                interval=percentile_interval(means[:, index]) if people > 1 else None,
                first_share=float((scores[..., index] == count).mean()),
            )
            for index, method in enumerate(ranked.methods)
        ),
        friedman=friedman_test(by_person, seed, resamples=resamples),
        scene_agreement=float(np.mean(agreement)) if people > 1 else None,
        pairs=compare_pairs(by_person, means, ranked.methods, seed, resamples=resamples),
        letter_scores=tuple(float(value) for value in by_letter.mean(0)),
        median_s=float(np.median(seconds)),
    )


def _screen_facts(
    study: Study, answers: Answers, ranked: RankedStudy, criterion: Criterion
) -> tuple[Float[ndarray, "screen letter"], Float[ndarray, " screen"]]:
    """Scores by place on the screen, and seconds, of all screens that count."""
    given = {(answer.participant, answer.screen): answer for answer in answers.answers}
    by_letter, seconds = [], []
    for participant in study.participants:
        if participant.name not in ranked.participants:
            continue
        for screen in participant.screens:
            if screen.criterion is criterion and screen.scene in ranked.scenes:
                answer = given[participant.name, screen.name]
                by_letter.append([len(screen.videos) + 1 - answer.ranks[video] for video in screen.videos])
                seconds.append(answer.sent_s - answer.opened_s)
    return np.array(by_letter, dtype=np.float64), np.array(seconds, dtype=np.float64)


def score_table(results: StudyResults) -> Table:
    """One line per method: H-IS and H-RQ with 95 % intervals, and how often it was ranked first."""
    header = ["method"]
    for item in results.criteria:
        header += [f"{item.criterion.column} ↑", "95 %", "first"]
    lines = []
    for index, scored in enumerate(results.criteria[0].methods):
        line = [scored.method]
        for item in results.criteria:
            method = item.methods[index]
            line += [f"{method.mean:.2f}", _interval_text(method.interval), f"{100 * method.first_share:.0f} %"]
        lines.append(tuple(line))
    return Table(header=tuple(header), lines=tuple(lines))


def pair_table(results: StudyResults) -> Table:
    """All pairs under both criteria."""
    lines = [
        (
            item.criterion.column,
            pair.first,
            pair.second,
            f"{pair.difference:+.2f}",
            _interval_text(pair.interval),
            _p_text(pair.p),
            _p_text(pair.p_holm),
        )
        for item in results.criteria
        for pair in item.pairs
    ]
    return Table(header=("", "first", "second", "difference", "95 %", "p", "p (Holm)"), lines=tuple(lines))


def _interval_text(interval: Interval | None) -> str:
    return "–" if interval is None else f"{interval.low:.2f} to {interval.high:.2f}"


def _p_text(p: float) -> str:
    return f"{p:.4f}" if p >= 0.0001 else "< 0.0001"


def write_report(results: StudyResults) -> str:
    """Everything as Markdown."""
    count = len(results.criteria[0].methods)
    people, scenes = len(results.included), len(results.scenes)
    parts = [
        f"# {results.title}",
        "",
        f"{results.invited} invited, {results.consented} began, {people} included; {scenes} scenes, {count} methods. "
        f"Scores: {count} for the first place to 1 for the last; the scores of a screen add up to {count * (count + 1) // 2}. "
        f"Intervals: two-way cluster bootstrap over participants and scenes, {results.resamples} samples, seed {results.seed}.",
    ]
    if scenes == 1:
        parts += ["", "With one scene the intervals hold for other participants only, not for other scenes."]
    parts += ["", score_table(results).markdown()]
    for item in results.criteria:
        parts += [f"**{item.criterion.column}**: {_tests_text(item)}", ""]
    parts += [
        "## Pairs",
        "",
        "Paired permutation tests over participants, adjusted by Holm's method within a criterion.",
        "",
        pair_table(results).markdown(),
        "## Excluded",
        "",
    ]
    parts += [f"- {item.participant}: {item.reason}" for item in results.excluded] or ["Nobody."]
    return "\n".join([*parts, "", f"Study {results.study_sha256[:16]}, sceneexpander {results.version}.", ""])


def _tests_text(item: CriterionResult) -> str:
    found = []
    if item.friedman is None:
        found.append("Friedman's test needs two participants and three methods that somebody tells apart")
    else:
        test = item.friedman
        found.append(
            f"Friedman χ² = {test.statistic:.2f} over {test.participants} participants, permutation p {_equals(test.p_permutation)} "
            f"(asymptotic {_equals(test.p_chi2)}); Kendall's W = {test.kendalls_w:.2f}"
        )
    if item.scene_agreement is not None:
        found.append(f"W within single scenes {item.scene_agreement:.2f} on average")
    letters = ", ".join(f"{letter} {score:.2f}" for letter, score in zip(LETTERS, item.letter_scores, strict=False))
    return (
        "; ".join([*found, f"mean score by place on the screen: {letters}", f"median {item.median_s:.0f} s per screen"])
        + "."
    )


def _equals(p: float) -> str:
    return f"= {p:.4f}" if p >= 0.0001 else "< 0.0001"


def scores_csv(ranked: RankedStudy) -> str:
    """Every rank that counts, one per line, for other statistics programs."""
    text = io.StringIO()
    lines = csv.writer(text)
    lines.writerow(("participant", "scene", "criterion", "method", "rank", "score"))
    count = len(ranked.methods)
    for criterion, scores in ranked.scores.items():
        for (person, scene, method), score in np.ndenumerate(scores):
            names = ranked.participants[person], ranked.scenes[scene], criterion.value, ranked.methods[method]
            lines.writerow((*names, count + 1 - int(score), int(score)))
    return text.getvalue()


def save_results(results: StudyResults, ranked: RankedStudy, folder: Path) -> None:
    """Write ``results.json``, ``results.md``, ``table.csv`` and ``scores.csv``."""
    write_json_atomic(folder / "results.json", {**to_plain(results), "schema": SCHEMA})
    write_bytes_atomic(folder / "results.md", write_report(results).encode())
    write_bytes_atomic(folder / "table.csv", score_table(results).csv().encode())
    write_bytes_atomic(folder / "scores.csv", scores_csv(ranked).encode())


def load_rankings(folder: Path) -> tuple[Study, Answers]:
    """The study and its answers, checked. Raises `UserError` naming what was changed."""
    study = Study.load(folder)
    return study, read_answers(folder / ANSWERS_NAME, study)
