"""What a part of `gpu_check.py` measures, and how it is handed from the part's process to the one that writes the report.

Findings are written as they are made, a line of JSON each: a part that is stopped or dies keeps what it had found.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from sceneexpander.artifacts.store import read_typed, to_plain

Value = bool | int | float | str


class Status(StrEnum):
    """How a part ended."""

    PASSED = "passed"
    FAILED = "failed"
    TIMED_OUT = "timed out"
    SKIPPED = "skipped"


class Skipped(Exception):
    """A part cannot run here; the message says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """A measured value, with the bounds that it has to keep where there are any."""

    name: str
    value: Value
    unit: str = ""
    at_least: float | None = None
    at_most: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the value is a finite number within the bounds; what has no bounds always holds."""
        if self.at_least is None and self.at_most is None:
            return True
        if isinstance(self.value, str) or not math.isfinite(self.value):
            return False
        low = -math.inf if self.at_least is None else self.at_least
        high = math.inf if self.at_most is None else self.at_most
        return low <= self.value <= high


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How a part ended, why if it did not pass, and what it found."""

    part: str
    status: Status
    reason: str
    seconds: float
    findings: tuple[Finding, ...]


class Log:
    """The file that a part writes its findings to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")

    def add(
        self,
        name: str,
        value: Value,
        unit: str = "",
        *,
        at_least: float | None = None,
        at_most: float | None = None,
    ) -> None:
        """Record a value. One that is not finite becomes text, which keeps no bounds."""
        if isinstance(value, float) and not math.isfinite(value):
            value = str(value)
        finding = Finding(name=name, value=value, unit=unit, at_least=at_least, at_most=at_most)
        with self.path.open("a") as file:
            file.write(json.dumps(to_plain(finding)) + "\n")


def read_findings(path: Path) -> Iterator[Finding]:
    """What was written, up to a line that its process did not finish."""
    if not path.is_file():
        return
    for line in path.read_text().splitlines(keepends=True):
        if line.endswith("\n"):
            yield read_typed(Finding, json.loads(line), path)
