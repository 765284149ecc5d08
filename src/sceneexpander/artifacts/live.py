"""The log of a running adaptation: one JSON object per line, appended while it runs, so that a killed run keeps what it knew."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.page import flatten
from sceneexpander.artifacts.store import to_plain

LOG_NAME = "log.jsonl"


class LiveLog:
    """Writes the log of one run into a folder of its own. A resumed run starts the file anew and repeats what it knows.

    Every line has a ``kind``: ``run`` (facts, first), ``step``, ``look`` (see `sceneexpander.adaptation.observe`), ``end`` (last).
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = (folder / LOG_NAME).open("w", encoding="utf-8")
        self.write("run", {**facts, "started": time.time()})

    def write(self, kind: str, values: object) -> None:
        """Append one line; it is on its way to the disk when this returns."""
        self._file.write(json.dumps({"kind": kind, **to_plain(values)}, allow_nan=False, ensure_ascii=False) + "\n")
        self._file.flush()

    def end(self, values: Mapping[str, Any]) -> None:
        """Append the last line and close."""
        self.write("end", values)
        self._file.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveRun:
    """The first line: what runs since when (seconds since 1970), its settings with dotted keys."""

    started: float
    scene: str
    round: int
    settings: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveStep:
    """One step: whether it saw the inserted view, and its numbers by name."""

    step: int
    inserted: bool
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveLook:
    """One look: its numbers by name, and how far each module's weights moved."""

    step: int
    values: Mapping[str, float]
    drift: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveEnd:
    """The last line."""


LiveLine = LiveRun | LiveStep | LiveLook | LiveEnd


def read_live(folder: Path) -> Iterator[LiveLine]:
    """The whole lines of a log so far. What is being written, and what a killed run left half, is skipped."""
    path = folder / LOG_NAME
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
        if not line.endswith("\n"):
            return
        try:
            yield _typed(json.loads(line))
        except (json.JSONDecodeError, KeyError, TypeError):
            return


def _typed(raw: Mapping[str, Any]) -> LiveLine:
    if raw["kind"] == "run":
        settings = flatten(raw["sections"])
        return LiveRun(started=raw["started"], scene=raw["scene"], round=raw["round"], settings=settings)
    values = {name: value for name, value in raw.items() if type(value) in (int, float) and name != "step"}
    if raw["kind"] == "step":
        return LiveStep(step=raw["step"], inserted=bool(raw["inserted"]), values=values)
    if raw["kind"] == "look":
        return LiveLook(step=raw["step"], values=values, drift=raw["drift"])
    return LiveEnd()
