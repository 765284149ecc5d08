"""The form of an answer, asked for as a JSON schema and checked again here: servers differ in how strictly they keep to one."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from sceneexpander.artifacts.judgement import HIGHEST_SCORE, LOWEST_SCORE
from sceneexpander.typed import DecodeError, decode_dataclass

SCORES = tuple(LOWEST_SCORE + step / 2 for step in range(int(2 * (HIGHEST_SCORE - LOWEST_SCORE)) + 1))
Form = TypeVar("Form")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreAnswer:
    """``score`` is one of `SCORES`, ``confidence`` in [0, 1]."""

    reason: str
    score: float
    confidence: float

    def __post_init__(self) -> None:
        if self.score not in SCORES:
            raise ValueError(f"the score is {self.score:g}, not one of 1, 1.5, ... 5")
        _check_confidence(self.confidence)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairAnswer:
    """``confidence`` in [0, 1]."""

    reason: str
    better: Literal["A", "B", "equal"]
    confidence: float

    def __post_init__(self) -> None:
        _check_confidence(self.confidence)


def _schema(verdict: str, values: dict[str, object]) -> dict[str, object]:
    # The reason comes first: a score that is written before its reason is a guess that is then defended.
    properties = {
        "reason": {"type": "string"},
        verdict: values,
        "confidence": {"type": "number", "minimum": 0, "maximum": 1},
    }
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


SCORE_SCHEMA = _schema("score", {"type": "number", "enum": list(SCORES)})
PAIR_SCHEMA = _schema("better", {"type": "string", "enum": ["A", "B", "equal"]})


def read_answer(form: type[Form], text: str) -> Form:
    """The answer in ``text``, which is one JSON object and nothing else.

    Raises:
        ValueError: it is anything else; says what.
    """
    try:
        content = json.loads(text, object_pairs_hook=_each_key_once, parse_constant=_refuse_constant)
    except RecursionError:
        raise ValueError("is nested too deeply") from None
    try:
        return decode_dataclass(form, content)
    except DecodeError as error:
        raise ValueError(error.line()) from None


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is there twice")
    return found


def _refuse_constant(name: str) -> None:
    raise ValueError(f"it holds {name}")


def _check_confidence(value: float) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"the confidence is {value:g}, not between 0 and 1")
