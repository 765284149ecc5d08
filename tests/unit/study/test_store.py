"""Nothing is lost, nothing counts twice, and what was changed afterwards is noticed."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from sceneexpander.errors import UserError
from sceneexpander.study.document import Participant, Study
from sceneexpander.study.store import AnswerStore, RefusedError, read_answers
from tests.support.participants import bare_study


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def ranking(participant: Participant, screen: str) -> dict[str, int]:
    videos = next(item.videos for item in participant.screens if item.name == screen)
    return {video: place for place, video in enumerate(videos, start=1)}


def answer(store: AnswerStore, participant: Participant, screen: str) -> None:
    store.open_screen(participant, screen)
    store.submit(participant, screen, ranking(participant, screen))


@pytest.fixture
def study() -> Study:
    return bare_study()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "answers.sqlite"


@pytest.fixture
def store(study: Study, path: Path) -> AnswerStore:
    return AnswerStore(path, study)


def refused(status: int, do: Callable[[], object]) -> RefusedError:
    with pytest.raises(RefusedError) as caught:
        do()
    assert caught.value.status == status
    return caught.value


def test_an_answer_counts_once_and_the_first_one_counts(store: AnswerStore, study: Study, path: Path) -> None:
    person = study.participants[0]
    store.consent(person)
    store.open_screen(person, "s01")
    ranks = ranking(person, "s01")
    first = store.submit(person, "s01", ranks)
    assert (first.done, first.next) == (("s01",), "s02")
    assert store.submit(person, "s01", dict(reversed(ranks.items()))) == first, "the same again"
    other = dict(zip(ranks, reversed(ranks.values()), strict=True))
    refused(409, lambda: store.submit(person, "s01", other))
    (kept,) = read_answers(path, study).answers
    assert kept.ranks == ranks


def test_the_same_answer_from_many_tabs_at_once_is_one_answer(store: AnswerStore, study: Study, path: Path) -> None:
    person = study.participants[0]
    store.consent(person)
    store.open_screen(person, "s01")
    with ThreadPoolExecutor(6) as pool:
        done = list(pool.map(lambda _: store.submit(person, "s01", ranking(person, "s01")).done, range(12)))
    assert done == [("s01",)] * 12
    assert len(read_answers(path, study).answers) == 1


def test_screens_come_in_order_after_consent(store: AnswerStore, study: Study) -> None:
    person = study.participants[0]
    refused(403, lambda: store.open_screen(person, "s01"))
    refused(403, lambda: store.submit(person, "s01", ranking(person, "s01")))
    store.consent(person)
    refused(409, lambda: store.submit(person, "s01", ranking(person, "s01")))  # never opened
    refused(409, lambda: store.open_screen(person, "s02"))
    refused(409, lambda: store.submit(person, "s02", ranking(person, "s02")))
    refused(404, lambda: store.submit(person, "s99", {}))


def test_a_screen_must_be_open_for_long_enough(path: Path) -> None:
    study, clock = bare_study(minimum_s=15), Clock()
    store, person = AnswerStore(path, study, clock), study.participants[0]
    store.consent(person)
    store.open_screen(person, "s01")
    clock.now += 5
    store.open_screen(person, "s01")  # loading the page again does not start anew
    early = refused(425, lambda: store.submit(person, "s01", ranking(person, "s01")))
    assert early.wait_s == pytest.approx(10)
    clock.now += 10
    assert store.submit(person, "s01", ranking(person, "s01")).next == "s02"


@pytest.mark.parametrize(
    "change",
    [
        lambda ranks: {**ranks, next(iter(ranks)): 2},
        lambda ranks: {video: rank + 1 for video, rank in ranks.items()},
        lambda ranks: dict.fromkeys(ranks, 2),
        lambda ranks: {video: float(rank) for video, rank in ranks.items()},
        lambda ranks: {f"x{video}": rank for video, rank in ranks.items()},
        lambda ranks: {},
        lambda ranks: {**ranks, "more": 4},
    ],
)
def test_what_is_no_ranking_is_not_kept(
    store: AnswerStore, study: Study, path: Path, change: Callable[[dict[str, int]], dict[str, int]]
) -> None:
    person = study.participants[0]
    store.consent(person)
    store.open_screen(person, "s01")
    refused(422, lambda: store.submit(person, "s01", change(ranking(person, "s01"))))
    assert read_answers(path, study).answers == ()


def test_the_end_has_a_code_that_nobody_else_has(store: AnswerStore, study: Study) -> None:
    codes = set()
    for person in study.participants[:2]:
        store.consent(person)
        for screen in person.screens:
            assert store.progress(person).code is None
            answer(store, person, screen.name)
        assert store.progress(person).next is None
        codes.add(store.progress(person).code)
    assert len(codes) == 2
    assert None not in codes


def test_withdrawing_erases_the_answers_of_one_person(store: AnswerStore, study: Study, path: Path) -> None:
    gone, stays = study.participants[:2]
    for person in (gone, stays):
        store.consent(person)
        answer(store, person, "s01")
    store.withdraw(gone)
    assert store.withdraw(gone).withdrawn, "asking again is no error"
    refused(410, lambda: store.submit(gone, "s01", ranking(gone, "s01")))
    refused(410, lambda: store.consent(gone))
    kept = read_answers(path, study)
    assert [item.participant for item in kept.answers] == [stays.name]
    assert kept.withdrawn == {gone.name}
    assert json.dumps(ranking(gone, "s01"), sort_keys=True).encode() not in path.read_bytes()
    answer(store, stays, "s02")
    assert len(read_answers(path, study).answers) == 2


def test_another_process_goes_on_where_the_first_one_stopped(store: AnswerStore, study: Study, path: Path) -> None:
    person = study.participants[0]
    store.consent(person)
    answer(store, person, "s01")
    again = AnswerStore(path, study)
    assert again.progress(person).next == "s02"
    answer(again, person, "s02")
    assert len(read_answers(path, study).answers) == 2


SWAPPED = """UPDATE answers SET content = replace(replace(replace(content, ': 1,', ': 9,'), ': 2', ': 1'), ': 9,', ': 2,')
WHERE number = 2"""


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("UPDATE answers SET content = replace(content, ': 1', ': 2') WHERE number = 2", "answer 2 of p01, s02: ranks"),
        (SWAPPED, "answer 2 (p01, s02): was changed after it was given"),
        ("UPDATE answers SET content = NULL WHERE number = 2", "answer 2 (p01, s02): is missing"),
        ("UPDATE answers SET content = 'x' WHERE number = 2", "answer 2 (p01, s02): is no answer"),
        ("UPDATE answers SET participant = 'p03' WHERE number = 2", "answer 2 (p03, s02): was changed"),
        ("DELETE FROM answers WHERE number = 2", "holds 2 answers, 3 were given"),
        ("DELETE FROM answers WHERE number = 3", "holds 2 answers, 3 were given"),
        (
            "DELETE FROM answers WHERE number = 2; UPDATE facts SET value = 2 WHERE name = 'count'",
            "answer 3 (p01, s03)",
        ),
        (
            "DELETE FROM answers WHERE number = 3; UPDATE facts SET value = 2 WHERE name = 'count'",
            "the last answers were",
        ),
        (
            "INSERT INTO answers SELECT 4, 'p02', screen, content, digest, chain FROM answers WHERE number = 3; "
            "UPDATE facts SET value = 4 WHERE name = 'count'",
            "answer 4 (p02, s03)",
        ),
        ("UPDATE facts SET value = 'y' WHERE name = 'study'", "holds answers of another study"),
        ("UPDATE facts SET value = 'y' WHERE name = 'schema'", "is not of schema"),
        ("DROP TABLE answers", "is no file of answers"),
    ],
)
def test_what_was_tampered_with_is_named(
    store: AnswerStore, study: Study, path: Path, statement: str, expected: str
) -> None:
    person = study.participants[0]
    store.consent(person)
    for screen in ("s01", "s02", "s03"):
        answer(store, person, screen)
    read_answers(path, study)
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript(statement)
    for read in (read_answers, AnswerStore):
        with pytest.raises(UserError) as caught:
            read(path, study)
        assert caught.value.line().startswith(f"{path}: {expected}")


def test_files_that_are_no_answers_are_refused(study: Study, path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        read_answers(path, study)
    path.write_bytes(b"not a database" * 100)
    with pytest.raises(UserError, match="is no file of answers"):
        AnswerStore(path, study)


def test_answers_of_another_study_are_refused(store: AnswerStore, study: Study, path: Path) -> None:
    with pytest.raises(UserError, match="holds answers of another study"):
        read_answers(path, replace(study, seed=1))
