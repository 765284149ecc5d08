"""Ranges of numbers, declared where the numbers are: ``steps: Annotated[int, Range(0, 1_000_000)] = 400``.

A settings dataclass that declares ranges calls `check_ranges` when it is made, so a value outside can come from nowhere: no file, no
override, no caller.
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

from sceneexpander.errors import UserError

MAX_STEPS = 1_000_000  # of anything that is repeated
_SHOWN_DIGITS = 40


@dataclass(frozen=True, slots=True)
class Range:
    """What a number may be. Both ends belong to it unless they are open."""

    low: float
    high: float
    low_open: bool = False
    high_open: bool = False

    def __contains__(self, value: float) -> bool:
        above = self.low < value if self.low_open else self.low <= value
        return above and (value < self.high if self.high_open else value <= self.high)

    def __str__(self) -> str:
        if not self.low_open and not self.high_open:
            return f"from {self.low} to {self.high}"
        low = f"above {self.low}" if self.low_open else f"at least {self.low}"
        return f"{low} and {f'below {self.high}' if self.high_open else f'at most {self.high}'}"


Share = Annotated[float, Range(0, 1)]
OpenShare = Annotated[float, Range(0, 1, low_open=True, high_open=True)]
Weight = Annotated[float, Range(0, 1e6)]  # of a term among others
LearningRate = Annotated[float, Range(0, 1, low_open=True)]
Rate = Annotated[float, Range(0, 1000)]  # a learning rate that may be 0: what it belongs to then stays
Steps = Annotated[int, Range(0, MAX_STEPS)]


def check_ranges(config: object) -> None:
    """Raise `UserError` naming the first field of a dataclass whose number lies outside its declared range."""
    schema: Any = type(config)
    for name, hint in _ranged_fields(schema):
        _check(hint, getattr(config, name), name)


@functools.cache
def _ranged_fields(schema: Any) -> tuple[tuple[str, Any], ...]:
    hints = typing.get_type_hints(schema, include_extras=True)
    names = [f.name for f in dataclasses.fields(schema)]
    return tuple((name, hints[name]) for name in names if any(True for _ in number_ranges(hints[name])))


def number_ranges(hint: Any) -> typing.Iterator[Range | None]:
    """The range of every kind of number that a type can hold, inside unions and sequences too; None where none is declared.

    Dataclasses are not looked into: their fields are their own.
    """
    if get_origin(hint) is Annotated:
        kind, *extras = get_args(hint)
        declared = [extra for extra in extras if isinstance(extra, Range)]
        if kind in (int, float):
            yield declared[0] if declared else None
        else:
            yield from number_ranges(kind)
    elif hint in (int, float):
        yield None
    elif get_origin(hint) is not typing.Literal:
        for inner in get_args(hint):
            yield from number_ranges(inner)


def _check(hint: Any, value: Any, where: str) -> None:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        declared = next((extra for extra in args[1:] if isinstance(extra, Range)), None)
        if declared is not None and isinstance(value, (int, float)) and value not in declared:
            raise UserError(f"is {shown_number(value)}, must be {declared}", where=where)
    elif origin in (typing.Union, types.UnionType):
        for option in args:
            _check(option, value, where)
    elif isinstance(value, (tuple, list)):
        each = args if origin is tuple and args[-1:] != (...,) else args[:1] * len(value)
        for index, (inner, item) in enumerate(zip(each, value, strict=False)):
            _check(inner, item, f"{where}[{index}]")


def shown_number(value: float) -> str:
    """A number as a person can read it, however many digits it has."""
    # Python refuses to write out whole numbers of more than 4300 digits.
    if isinstance(value, int) and abs(value) >= 10**_SHOWN_DIGITS:
        return f"a whole number of more than {_SHOWN_DIGITS} digits"
    return str(value)
