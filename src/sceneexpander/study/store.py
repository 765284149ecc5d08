"""Answers on disk: one SQLite file, each answer once, sealed so that a changed or missing one is noticed.

Every answer is digested with the study's key, and the digests are chained. Whoever has the key could forge a chain; what is kept out are
damage, hand edits and answers of another study.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneexpander.errors import UserError
from sceneexpander.study.document import Participant, Screen, Study

SCHEMA = "study answers/1"
_TABLES = """
CREATE TABLE IF NOT EXISTS facts (name TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS events (participant TEXT, kind TEXT, at_s REAL NOT NULL, PRIMARY KEY (participant, kind)) STRICT;
CREATE TABLE IF NOT EXISTS openings (participant TEXT, screen TEXT, at_s REAL NOT NULL, PRIMARY KEY (participant, screen)) STRICT;
CREATE TABLE IF NOT EXISTS answers (number INTEGER PRIMARY KEY, participant TEXT NOT NULL, screen TEXT NOT NULL, content TEXT,
  digest TEXT NOT NULL, chain TEXT NOT NULL, UNIQUE (participant, screen)) STRICT;
"""
_BROKEN = "take the file from a copy; nothing was computed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far a participant is.

    Attributes:
        consented: the consent text was agreed to.
        withdrawn: answers were erased at the participant's wish.
        done: names of answered screens, in their order.
        next: name of the screen to answer; None: no more.
        code: proof of completion, once everything is answered.
    """

    consented: bool
    withdrawn: bool
    done: tuple[str, ...]
    next: str | None
    code: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """One answered screen: ranks by video, 1 for the best; times in seconds since 1970."""

    participant: str
    screen: str
    ranks: dict[str, int]
    opened_s: float
    sent_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers:
    """Everything a study's file holds."""

    answers: tuple[Answer, ...]
    consented: frozenset[str]
    withdrawn: frozenset[str]


class RefusedError(Exception):
    """A request that is not carried out.

    Args:
        reason: one sentence.
        status: of HTTP.
        wait_s: seconds after which it will be.
    """

    def __init__(self, reason: str, status: int, *, wait_s: float | None = None) -> None:
        super().__init__(reason)
        self.reason = reason
        self.status = status
        self.wait_s = wait_s


class AnswerStore:
    """The file that a server writes. Several servers may share it: each request is one transaction.

    Args:
        path: of the file; made if there is none.
        study: whose answers it holds.
        clock: seconds since 1970.

    Raises:
        UserError: it is another study's, damaged, or cannot be written.
    """

    def __init__(self, path: Path, study: Study, clock: Callable[[], float] = time.time) -> None:
        self._path = path
        self._study = study
        self._clock = clock
        if path.exists():
            read_answers(path, study)
        try:
            path.touch(mode=0o600)
            with self._transaction() as database:
                for statement in _TABLES.split(";"):
                    database.execute(statement)
                facts = {"schema": SCHEMA, "study": study.digest, "count": "0", "chain": ""}
                database.executemany("INSERT OR IGNORE INTO facts VALUES (?, ?)", facts.items())
        except (OSError, sqlite3.Error) as error:
            raise UserError(f"cannot be written ({error})", where=path) from None

    @contextlib.contextmanager
    def _transaction(self, *, writes: bool = True) -> Iterator[sqlite3.Connection]:
        database = sqlite3.connect(self._path, timeout=30, isolation_level=None)
        try:
            database.execute("PRAGMA synchronous = FULL")
            database.execute("PRAGMA secure_delete = ON")  # what is erased at somebody's wish is gone from the file
            database.execute("BEGIN IMMEDIATE" if writes else "BEGIN")
            try:
                yield database
            except BaseException:
                database.execute("ROLLBACK")
                raise
            database.execute("COMMIT")
        finally:
            database.close()

    def progress(self, participant: Participant) -> Progress:
        """How far somebody is."""
        with self._transaction(writes=False) as database:
            return self._progress(database, participant)

    def consent(self, participant: Participant) -> Progress:
        """Note that the consent text was agreed to."""
        with self._transaction() as database:
            self._require(database, participant, consented=False)
            self._note(database, participant, "consent")
            return self._progress(database, participant)

    def open_screen(self, participant: Participant, screen: str) -> Progress:
        """Note when a screen was first seen. Raises `RefusedError` unless it is the next one."""
        with self._transaction() as database:
            progress = self._require(database, participant)
            if screen != progress.next:
                raise RefusedError("this is not the screen that comes next", 409)
            database.execute(
                "INSERT OR IGNORE INTO openings VALUES (?, ?, ?)", (participant.name, screen, self._clock())
            )
            return progress

    def submit(self, participant: Participant, screen: str, ranks: Mapping[str, int]) -> Progress:
        """Keep an answer. The same one again changes nothing and is no error; the first one counts.

        Raises:
            RefusedError: no consent, withdrawn, not the next screen, no ranking of its videos, answered otherwise before, or too early.
        """
        with self._transaction() as database:
            progress = self._require(database, participant)
            planned = next((item for item in participant.screens if item.name == screen), None)
            if planned is None:
                raise RefusedError("there is no such screen", 404)
            problem = ranking_problem(planned, ranks)
            if problem is not None:
                raise RefusedError(problem, 422)
            kept = database.execute(
                "SELECT content FROM answers WHERE participant = ? AND screen = ?", (participant.name, screen)
            ).fetchone()
            if kept is not None:
                if json.loads(kept[0])["ranks"] == dict(ranks):
                    return progress
                raise RefusedError("this screen was answered before; the first answer counts", 409)
            if screen != progress.next:
                raise RefusedError("this is not the screen that comes next", 409)
            self._insert(database, participant, screen, ranks)
            return self._progress(database, participant)

    def withdraw(self, participant: Participant) -> Progress:
        """Erase what a participant answered, and take no more."""
        with self._transaction() as database:
            self._require(database, participant, consented=False, withdrawn=True)
            self._note(database, participant, "withdrawal")
            database.execute("UPDATE answers SET content = NULL WHERE participant = ?", (participant.name,))
            database.execute("DELETE FROM openings WHERE participant = ?", (participant.name,))
            return self._progress(database, participant)

    def _insert(
        self, database: sqlite3.Connection, participant: Participant, screen: str, ranks: Mapping[str, int]
    ) -> None:
        now = self._clock()
        opened = database.execute(
            "SELECT at_s FROM openings WHERE participant = ? AND screen = ?", (participant.name, screen)
        ).fetchone()
        wait = self._study.minimum_s if opened is None else opened[0] + self._study.minimum_s - now
        if opened is None:
            raise RefusedError("this screen has not been opened", 409)
        if wait > 0:
            raise RefusedError("this screen has not been open for long enough", 425, wait_s=wait)
        answer = {
            "participant": participant.name,
            "screen": screen,
            "ranks": dict(ranks),
            "opened_s": opened[0],
            "sent_s": now,
        }
        content = json.dumps(answer, sort_keys=True)
        facts = dict(database.execute("SELECT name, value FROM facts"))
        number = int(facts["count"]) + 1
        digest = self._study.sign("answer", str(number), content)
        chain = self._study.sign("chain", facts["chain"], digest)
        database.execute(
            "INSERT INTO answers VALUES (?, ?, ?, ?, ?, ?)",
            (number, participant.name, screen, content, digest, chain),
        )
        database.executemany("UPDATE facts SET value = ? WHERE name = ?", [(str(number), "count"), (chain, "chain")])

    def _note(self, database: sqlite3.Connection, participant: Participant, kind: str) -> None:
        database.execute("INSERT OR IGNORE INTO events VALUES (?, ?, ?)", (participant.name, kind, self._clock()))

    def _require(
        self, database: sqlite3.Connection, participant: Participant, *, consented: bool = True, withdrawn: bool = False
    ) -> Progress:
        progress = self._progress(database, participant)
        if progress.withdrawn and not withdrawn:
            raise RefusedError("you have withdrawn from this study", 410)
        if consented and not progress.consented:
            raise RefusedError("the consent text comes first", 403)
        return progress

    def _progress(self, database: sqlite3.Connection, participant: Participant) -> Progress:
        name = (participant.name,)
        kinds = {row[0] for row in database.execute("SELECT kind FROM events WHERE participant = ?", name)}
        answered = {row[0] for row in database.execute("SELECT screen FROM answers WHERE participant = ?", name)}
        order = [screen.name for screen in participant.screens]
        left = [screen for screen in order if screen not in answered]
        withdrawn = "withdrawal" in kinds
        return Progress(
            consented="consent" in kinds,
            withdrawn=withdrawn,
            done=() if withdrawn else tuple(screen for screen in order if screen in answered),
            next=left[0] if left and not withdrawn else None,
            code=None if left or withdrawn else self._study.sign("complete", participant.name)[:10].upper(),
        )


def ranking_problem(screen: Screen, ranks: Mapping[str, object]) -> str | None:
    """Why an answer is no ranking of a screen's videos, or None: each video once, each rank from 1 to their number once."""
    if set(ranks) != set(screen.videos):
        return f"{screen.name}: ranks other videos than it shows"
    given = list(ranks.values())
    if any(type(rank) is not int for rank in given) or sorted(given, key=str) != sorted(
        range(1, len(given) + 1), key=str
    ):
        return f"{screen.name}: ranks are {given}, not each of 1 to {len(given)} once"
    return None


def read_answers(path: Path, study: Study) -> Answers:
    """Everything in a file that `AnswerStore` wrote, after checking all of it.

    Raises:
        UserError: the file is missing, damaged, of another study, or something in it was changed, added, removed or doubled; names what.
    """
    if not path.is_file():
        raise UserError("does not exist", where=path, fix="nobody has answered yet: sceneexpander study serve FOLDER")
    try:
        with contextlib.closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=30)
        ) as database:
            database.execute("BEGIN")
            tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not tables and path.stat().st_size == 0:
                return Answers(answers=(), consented=frozenset(), withdrawn=frozenset())  # made, and not yet written
            facts = dict(database.execute("SELECT name, value FROM facts"))
            rows = database.execute(
                "SELECT number, participant, screen, content, digest, chain FROM answers ORDER BY number"
            ).fetchall()
            events = database.execute("SELECT participant, kind FROM events").fetchall()
    except sqlite3.Error as error:
        raise UserError(f"is no file of answers ({error})", where=path, fix=_BROKEN) from None
    if facts.get("schema") != SCHEMA:
        raise UserError(f"is not of schema {SCHEMA!r}", where=path, fix=_BROKEN)
    if facts.get("study") != study.digest:
        raise UserError(
            "holds answers of another study", where=path, fix="put it beside the study.json that it was made with"
        )
    withdrawn = frozenset(name for name, kind in events if kind == "withdrawal")
    answers = tuple(_read_rows(path, study, facts, rows, withdrawn))
    consented = frozenset(name for name, kind in events if kind == "consent")
    return Answers(answers=answers, consented=consented, withdrawn=withdrawn)


def _read_rows(
    path: Path, study: Study, facts: Mapping[str, str], rows: list[tuple[Any, ...]], withdrawn: frozenset[str]
) -> Iterator[Answer]:
    screens = {(item.name, screen.name): screen for item in study.participants for screen in item.screens}
    if facts.get("count") != str(len(rows)):
        raise UserError(f"holds {len(rows)} answers, {facts.get('count')} were given", where=path, fix=_BROKEN)
    chain = ""
    seen: set[tuple[str, str]] = set()
    for expected, (number, participant, screen, content, digest, link) in enumerate(rows, start=1):
        where = f"answer {number} ({participant}, {screen})"
        chain = study.sign("chain", chain, digest)
        if number != expected or link != chain:
            raise UserError(f"{where}: what came before it was changed or removed", where=path, fix=_BROKEN)
        if (participant, screen) in seen or (participant, screen) not in screens:
            raise UserError(f"{where}: is there twice, or for a screen that does not exist", where=path, fix=_BROKEN)
        seen.add((participant, screen))
        if content is None:
            if participant not in withdrawn:
                raise UserError(f"{where}: is missing", where=path, fix=_BROKEN)
            continue
        try:
            answer = Answer(**json.loads(content))
        except (ValueError, TypeError):
            raise UserError(f"{where}: is no answer", where=path, fix=_BROKEN) from None
        problem = ranking_problem(screens[participant, screen], answer.ranks)
        if problem is not None:
            raise UserError(f"answer {number} of {participant}, {problem}", where=path, fix=_BROKEN)
        if digest != study.sign("answer", str(number), content) or (answer.participant, answer.screen) != (
            participant,
            screen,
        ):
            raise UserError(f"{where}: was changed after it was given", where=path, fix=_BROKEN)
        yield answer
    if facts.get("chain") != chain:
        raise UserError("the last answers were changed or removed", where=path, fix=_BROKEN)
