"""Every number of the configuration has a range: declared where the number is, and nothing outside passes."""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import pytest

from sceneexpander.config.compose import compose
from sceneexpander.config.parse import ConfigError, parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import UserError
from sceneexpander.generation import GeneratorConfig
from sceneexpander.ranges import Range, check_ranges, number_ranges
from sceneexpander.typed import members_of

CONF = Path(__file__).parents[3] / "conf"
KEYS = "render.keyframes=[{eye: [0, 0, 0], target: [0, 0, 1]}]"
Steps = tuple[str | int, ...]  # from the whole configuration to one number


def classes_in(hint: Any) -> Iterator[type]:
    """Dataclasses that a value of this type may hold."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        yield hint
    for inner in typing.get_args(hint):
        yield from classes_in(inner)


def numbers(schema: type, way: Steps = ()) -> Iterator[tuple[Steps, Any, Range | None]]:
    """(way to it, its type, its range) of every kind of number below a settings dataclass."""
    for name, hint in typing.get_type_hints(schema, include_extras=True).items():
        here: Steps = (*way, name)
        for declared in number_ranges(hint):
            yield here, hint, declared
        for inner in classes_in(hint):
            # Settings in a list: the first of them.
            listed = typing.get_origin(hint) in (tuple, list)
            yield from numbers(inner, (*here, 0) if listed else here)


def all_numbers() -> list[tuple[Steps, Any, Range | None]]:
    return list(numbers(ProjectConfig))


NUMBERS = all_numbers()


@cache
def good() -> dict[str, Any]:
    return compose(CONF, [KEYS])


def changed(way: Steps, value: float) -> tuple[dict[str, Any], str]:
    """The default configuration with one number replaced, and the number's key; the first one of a sequence."""
    values = copy.deepcopy(good())
    holder: Any = values
    for step in way[:-1]:
        holder = holder[step]
    last: str | int = way[-1]
    if isinstance(holder[last], list):
        holder, last, way = holder[last], 0, (*way, 0)
    assert isinstance(holder[last], (int, float)) or holder[last] == "auto", way
    holder[last] = value
    key = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in way)
    return values, key.removeprefix(".")


def outside(hint: Any, declared: Range) -> tuple[float, float]:
    """The nearest numbers below and above."""
    if "int" in str(hint).replace("Interval", "").split("Range")[0]:
        assert not declared.low_open
        assert not declared.high_open
        return declared.low - 1, declared.high + 1
    low, high = float(declared.low), float(declared.high)
    return (
        low if declared.low_open else math.nextafter(low, -math.inf),
        high if declared.high_open else math.nextafter(high, math.inf),
    )


def test_the_walk_sees_them_all() -> None:
    keys = {".".join(str(step) for step in way) for way, _, _ in NUMBERS}
    assert {"seed", "adapt.steps", "adapt.augment.feather", "optimise.density.noise", "render.keyframes.0.eye"} <= keys
    assert {"frontend.dense.plane_weights", "scene.max_megapixels", "rivals.ttt3r.long_side_px"} <= keys
    assert len(keys) > 110


@pytest.mark.parametrize(
    ("way", "hint", "declared"), NUMBERS, ids=lambda item: ".".join(map(str, item)) if isinstance(item, tuple) else ""
)
def test_a_number_has_a_range_and_nothing_just_outside_passes(way: Steps, hint: Any, declared: Range | None) -> None:
    assert declared is not None, "declare one: Annotated[..., Range(low, high)]"
    assert math.isfinite(declared.low)
    assert math.isfinite(declared.high)
    for value in outside(hint, declared):
        values, key = changed(way, value)
        with pytest.raises(ConfigError) as caught:
            parse_dataclass(ProjectConfig, values)
        assert caught.value.line() == f"{key}: is {value}, must be {declared}"


@pytest.mark.parametrize("member", members_of(GeneratorConfig), ids=lambda member: member.__name__)
def test_numbers_of_every_back_end_have_ranges(member: type) -> None:
    for way, _, declared in numbers(member):
        if way == ("arguments",):
            continue  # of another library's pipeline, which has its own opinion of them
        assert declared is not None, way
        assert math.isfinite(declared.low)
        assert math.isfinite(declared.high)


@pytest.mark.parametrize("value", [1e30, -1e30, 10**5000, -(10**5000)], ids=["1e30", "-1e30", "1e5000", "-1e5000"])
def test_no_number_is_without_bounds(value: float) -> None:
    for way, _, _ in NUMBERS:
        values, key = changed(way, value)
        with pytest.raises(ConfigError) as caught:
            parse_dataclass(ProjectConfig, values)
        assert caught.value.line().startswith(f"{key}: ")
        assert len(caught.value.line()) < 200


@dataclass(frozen=True)
class Ranged:
    whole: Annotated[int, Range(1, 3)] = 1
    open_low: Annotated[float, Range(0, 1, low_open=True)] = 0.5
    maybe: Annotated[float, Range(0, 1, high_open=True)] | None = None
    many: tuple[Annotated[float, Range(0, 1)], ...] = ()
    pair: tuple[Annotated[int, Range(0, 1)], Annotated[int, Range(5, 6)]] = (0, 5)

    def __post_init__(self) -> None:
        check_ranges(self)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"whole": 0}, "whole: is 0, must be from 1 to 3"),
        ({"open_low": 0.0}, "open_low: is 0.0, must be above 0 and at most 1"),
        ({"open_low": math.nan}, "open_low: is nan, must be above 0 and at most 1"),
        ({"maybe": 1.0}, "maybe: is 1.0, must be at least 0 and below 1"),
        ({"many": (0.5, 2.0)}, "many[1]: is 2.0, must be from 0 to 1"),
        ({"pair": (0, 1)}, "pair[1]: is 1, must be from 5 to 6"),
        ({"whole": 10**5000}, "whole: is a whole number of more than 40 digits, must be from 1 to 3"),
    ],
    ids=["whole", "open end", "nan", "optional", "in a list", "in a pair", "huge"],
)
def test_a_value_outside_is_named_with_its_range(values: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=f"^{re.escape(message)}$"):
        Ranged(**values)


def test_both_ends_are_inside_unless_they_are_open() -> None:
    Ranged(whole=1, open_low=1.0, maybe=0.0, many=(0.0, 1.0), pair=(1, 6))
    Ranged(whole=3, open_low=math.nextafter(0, 1))
