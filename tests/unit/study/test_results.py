"""From answers to scores: numbers by hand, exclusions, and agreement with measures."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from sceneexpander.errors import UserError
from sceneexpander.study.__main__ import main
from sceneexpander.study.agreement import (
    Measured,
    agreement_table,
    compute_agreement,
    read_measures,
    save_agreement,
)
from sceneexpander.study.document import ANSWERS_NAME, Participant, Screen, Study
from sceneexpander.study.results import (
    RankedStudy,
    collect_rankings,
    compute_results,
    save_results,
    score_table,
    write_report,
)
from sceneexpander.study.spec import Criterion
from sceneexpander.study.statistics import scores_from_ranks
from sceneexpander.study.store import Answer, Answers
from tests.support.participants import bare_study
from tests.worlds.rows import row

Opinion = Callable[[Participant, Screen], Sequence[str]]


def best_first(study: Study, screen: Screen, order: Sequence[str]) -> dict[str, int]:
    videos = study.scene(screen.scene).videos
    return {videos[method]: place for place, method in enumerate(order, start=1)}


def answered(study: Study, opinion: Opinion, *, leave_out: int = 0, withdrawn: Sequence[str] = ()) -> Answers:
    """Everybody's answers; the last participant leaves out so many screens."""
    answers = []
    for participant in study.participants:
        last = participant is study.participants[-1]
        screens = participant.screens[: len(participant.screens) - leave_out] if last else participant.screens
        for number, screen in enumerate(screens):
            catch = study.scene(screen.scene).catch
            order = sorted(study.scene(screen.scene).videos) if catch else opinion(participant, screen)
            ranks = best_first(study, screen, order)
            answers.append(
                Answer(
                    participant=participant.name,
                    screen=screen.name,
                    ranks=ranks,
                    opened_s=100.0 * number,
                    sent_s=100.0 * number + 20,
                )
            )
    kept = tuple(item for item in answers if item.participant not in withdrawn)
    names = frozenset(item.name for item in study.participants)
    return Answers(answers=kept, consented=names, withdrawn=frozenset(withdrawn))


def by_scene(_: Participant, screen: Screen) -> Sequence[str]:
    """Everybody: a b c in one scene, a c b in the other; the reverse in the other criterion."""
    order = ("a", "b", "c") if screen.scene == "one" else ("a", "c", "b")
    return order if screen.criterion is Criterion.INSERTION else order[::-1]


def test_scores_by_hand() -> None:
    study = bare_study()
    results, ranked = compute_results(study, answered(study, by_scene))
    insertion, quality = results.criteria
    assert [item.mean for item in insertion.methods] == [3.0, 1.5, 1.5]
    assert [item.mean for item in quality.methods] == [1.0, 2.5, 2.5]
    assert [item.first_share for item in quality.methods] == [0.0, 0.5, 0.5]
    assert insertion.methods[0].interval is not None
    assert (insertion.methods[0].interval.low, insertion.methods[0].interval.high) == (3, 3)
    assert insertion.methods[1].interval is not None
    assert (insertion.methods[1].interval.low, insertion.methods[1].interval.high) == (1, 2)  # by the scenes drawn
    assert insertion.scene_agreement == 1
    # Means 3, 1.5, 1.5 of each of four people are ranks 3, 1.5, 1.5, which with the correction for ties is full agreement.
    assert insertion.friedman is not None
    assert insertion.friedman.kendalls_w == pytest.approx(1)
    assert insertion.median_s == 20
    assert sum(insertion.letter_scores) == pytest.approx(6)
    assert results.included == ("p01", "p02", "p03", "p04")
    assert results.excluded == ()
    assert {array.sum() for array in ranked.scores.values()} == {4 * 2 * 6}
    tied = next(pair for pair in insertion.pairs if (pair.first, pair.second) == ("b", "c"))
    assert (tied.difference, tied.p) == (0, 1)


def test_who_does_not_count_is_listed_with_the_reason() -> None:
    study = bare_study(participants=5)
    given = answered(study, by_scene, leave_out=1, withdrawn=["p02"])
    careless = study.participants[2]
    failed = []
    for answer in given.answers:
        screen = next(item for item in careless.screens if item.name == answer.screen)
        if answer.participant == careless.name and study.scene(screen.scene).catch:
            worst_first = sorted(study.scene(screen.scene).videos)[::-1]
            failed.append(
                Answer(
                    participant=careless.name,
                    screen=answer.screen,
                    ranks=best_first(study, screen, worst_first),
                    opened_s=0,
                    sent_s=1,
                )
            )
        else:
            failed.append(answer)
    given = Answers(answers=tuple(failed), consented=given.consented - {"p04"}, withdrawn=given.withdrawn)
    given = Answers(
        answers=tuple(item for item in given.answers if item.participant != "p04"),
        consented=given.consented,
        withdrawn=given.withdrawn,
    )
    results, ranked = compute_results(study, given)
    assert results.included == ranked.participants == ("p01",)
    assert [(item.participant, item.reason) for item in results.excluded] == [
        ("p02", "withdrew, answers erased"),
        ("p03", "failed 2 of 2 catch screens"),
        ("p05", "did not finish (5 of 6 screens)"),
    ]
    assert (results.invited, results.consented) == (5, 4)
    assert results.criteria[0].friedman is None
    report = write_report(results)
    assert "p03: failed 2 of 2 catch screens" in report
    assert "Friedman's test needs" in report


@pytest.mark.parametrize(("allowed", "included"), [(0, 3), (1, 4)])
def test_failed_catch_screens_are_counted_against_what_is_allowed(allowed: int, included: int) -> None:
    study = bare_study(catch={"allowed_failures": allowed})
    given = list(answered(study, by_scene).answers)
    screen = next(item for item in study.participants[0].screens if study.scene(item.scene).catch)
    place = next(index for index, item in enumerate(given) if (item.participant, item.screen) == ("p01", screen.name))
    order = ["level_1", "level_0", "level_2"]  # one of three pairs the wrong way: tau 1/3
    given[place] = Answer(
        participant="p01", screen=screen.name, ranks=best_first(study, screen, order), opened_s=0, sent_s=1
    )
    names = frozenset(item.name for item in study.participants)
    ranked, _ = collect_rankings(study, Answers(answers=tuple(given), consented=names, withdrawn=frozenset()))
    assert len(ranked.participants) == included


def test_without_anybody_there_are_no_results() -> None:
    with pytest.raises(UserError, match="nobody's answers count yet"):
        compute_results(bare_study(), Answers(answers=(), consented=frozenset(), withdrawn=frozenset()))


def test_catch_scenes_are_in_no_score() -> None:
    study = bare_study(catch={"scenes": 2})
    results, ranked = compute_results(study, answered(study, by_scene))
    assert results.scenes == ("one", "two")
    assert ranked.scores[Criterion.QUALITY].shape == (4, 2, 3)


def test_files_hold_what_was_computed(tmp_path: Path) -> None:
    study = bare_study()
    results, ranked = compute_results(study, answered(study, by_scene), seed=3)
    save_results(results, ranked, tmp_path)
    kept = json.loads((tmp_path / "results.json").read_text())
    assert kept["criteria"][0]["methods"][0]["mean"] == 3
    assert (kept["study_sha256"], kept["seed"]) == (study.digest, 3)
    lines = list(csv.DictReader(io.StringIO((tmp_path / "scores.csv").read_text())))
    assert len(lines) == 4 * 2 * 2 * 3
    assert {int(line["rank"]) + int(line["score"]) for line in lines} == {4}
    chosen = [line for line in lines if line["criterion"] == "insertion_satisfaction" and line["method"] == "b"]
    assert np.mean([int(line["score"]) for line in chosen]) == 1.5
    assert (tmp_path / "table.csv").read_text().splitlines()[0] == "method,H-IS ↑,95 %,first,H-RQ ↑,95 %,first"
    assert "| a | 3.00 | 3.00 to 3.00 | 100 % |" in (tmp_path / "results.md").read_text()
    again, _ = compute_results(study, answered(study, by_scene), seed=3)
    assert again == results
    assert score_table(results).lines[0][0] == "a"


def ranked_by(*rankings: list[list[int]]) -> RankedStudy:
    """One participant for each list of ranks by scene, under both criteria."""
    scores = scores_from_ranks(np.array(rankings))
    return RankedStudy(
        participants=tuple(f"p{index}" for index in range(len(rankings))),
        scenes=("one", "two"),
        methods=("a", "b", "c"),
        scores=dict.fromkeys(Criterion, scores),
    )


def measure(name: str, better: str, *values: float | None) -> list[Measured]:
    places = [(scene, method) for scene in ("one", "two") for method in ("a", "b", "c")]
    return [
        Measured(scene=scene, method=method, measure=name, better=better, value=value)
        for (scene, method), value in zip(places, values, strict=True)
    ]


def test_tau_between_people_and_measures_by_hand() -> None:
    ranked = ranked_by([[1, 2, 3], [1, 2, 3]], [[1, 2, 3], [1, 3, 2]])
    measured = [
        *measure("as people", "higher", 9, 5, 1, 9, 5, 5),
        *measure("error", "lower", 0.1, 0.2, 0.3, 0.3, 0.2, 0.1),
        *measure("gaps", "higher", 1, 2, None, 3, 2, 1),
        *measure("constant", "higher", 1, 1, 1, 1, 1, 1),
    ]
    found = {
        item.measure: item for item in compute_agreement(ranked, measured) if item.criterion is Criterion.INSERTION
    }
    assert found["as people"].tau == pytest.approx(1)
    # The first scene is ranked as by people. In the second, people say 3, 1.5, 1.5 and the measure the reverse: two pairs wrong, one tied.
    assert found["error"].tau == pytest.approx((1 - 2 / np.sqrt(3 * 2)) / 2)
    assert (found["gaps"].scenes, found["gaps"].missing) == (1, 1)
    assert found["gaps"].interval is None
    assert (found["constant"].tau, found["constant"].scenes) == (None, 0)
    # In the first scene people agree; in the second one pair of three is the other way.
    assert found["one participant"].tau == pytest.approx((1 + 1 / 3) / 2)
    table = agreement_table(list(found.values()), 2)
    assert {len(line) for line in table.lines} == {len(table.header)}


def test_what_two_files_say_about_the_same_thing_is_refused() -> None:
    twice = measure("m", "higher", 3, 2, 1, 3, 2, 1) + measure("m", "higher", 1, 2, 3, 1, 2, 3)
    with pytest.raises(UserError, match="has 'm' of 'a' in scene 'one' twice"):
        compute_agreement(ranked_by([[1, 2, 3], [1, 2, 3]]), twice)


def test_measures_of_other_scenes_are_refused() -> None:
    ranked = ranked_by([[1, 2, 3], [1, 2, 3]])
    stranger = [Measured(scene="three", method="a", measure="m", better="higher", value=1.0)]
    with pytest.raises(UserError, match="no measure is of a scene and a method of the study"):
        compute_agreement(ranked, stranger)


HEADER = "scene,method,measure,better,value\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("scene,method\n", "has the columns scene, method"),
        (HEADER + "one,a,judge,up,1\n", "better is 'up'"),
        (HEADER + "one,a,judge,higher,good\n", ":2: value is 'good'"),
        (HEADER + "one,a,judge,higher,nan\n", ":2: value is 'nan'"),
        (HEADER + "one,a,judge,higher\n", "has more or fewer columns"),
        (HEADER + "one,a,judge,higher,1\n" * 2, "has 'judge' of 'a' in scene 'one' twice"),
        (HEADER + "one,a,judge,higher,1\none,b,judge,lower,1\n", "says both higher and lower"),
    ],
)
def test_tables_of_measures_that_say_something_else(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "judge.csv"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        read_measures(path)
    assert expected in caught.value.line()


def test_an_empty_value_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "judge.csv"
    path.write_text(HEADER + "one,a,judge,higher,\n")
    assert read_measures(path) == [Measured(scene="one", method="a", measure="judge", better="higher", value=None)]


def test_rows_of_the_pipeline_are_measures_too(tmp_path: Path) -> None:
    row("one", "a", 21.5).save(tmp_path / "one" / "round_1" / "metrics" / "a.json")
    found = {item.measure: item for item in read_measures(tmp_path)}
    assert all((item.scene, item.method) == ("one", "a") for item in found.values())
    assert 21.5 in [item.value for item in found.values()]
    assert {item.better for item in found.values()} == {"higher", "lower"}
    with pytest.raises(UserError, match="holds no metrics"):
        read_measures(tmp_path / "one" / "round_1" / "metrics")


def test_agreement_is_written(tmp_path: Path) -> None:
    ranked = ranked_by([[1, 2, 3], [1, 2, 3]])
    found = compute_agreement(ranked, measure("m", "higher", 3, 2, 1, 3, 2, 1))
    save_agreement(found, ranked, tmp_path)
    assert json.loads((tmp_path / "agreement.json").read_text())["agreement"][1]["tau"] == 1
    assert "| m | H-IS | 1.00 | 1.00 to 1.00 | 1.00 | 2 | 0 |" in (tmp_path / "agreement.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["bild", "x"], "bild: unknown action; did you mean 'build'?"),
        (["build", "x", "--port", "1"], "--port: means nothing to 'build'"),
        (["serve", "{tmp}"], "{tmp}: holds no study.json"),
        (["serve", "{tmp}", "--port", "70000"], "--port: is 70000"),
        (["serve", "{tmp}", "--allow-host", "http://x"], "--allow-host: is 'http://x'"),
        (["results", "{tmp}"], "{tmp}: holds no study.json"),
        (["results", "{tmp}", "--seed", "-1"], "--seed: is -1"),
        (["agree", "{tmp}"], "--measures: is missing"),
        (["build", "{tmp}/study.yaml"], "{tmp}/study.yaml: does not exist"),
    ],
)
def test_what_is_wrong_with_a_command_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], expected: str
) -> None:
    with pytest.raises(SystemExit) as caught:
        main([item.format(tmp=tmp_path) for item in arguments])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {expected.format(tmp=tmp_path)}")


def test_results_without_answers_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bare_study().save(tmp_path)
    with pytest.raises(SystemExit):
        main(["results", str(tmp_path)])
    assert f"{ANSWERS_NAME}: does not exist; nobody has answered yet" in capsys.readouterr().err
