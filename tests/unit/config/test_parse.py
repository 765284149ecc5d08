from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

import pytest

from sceneexpander.config.files import read_settings, read_yaml, write_settings
from sceneexpander.config.parse import ConfigError, parse_dataclass
from sceneexpander.errors import UserError


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True, kw_only=True)
class Inner:
    rate: float = 0.5

    def __post_init__(self) -> None:
        if self.rate < 0:
            raise ValueError(f"rate must be >= 0, is {self.rate}")


@dataclass(frozen=True, kw_only=True)
class Outer:
    steps: int
    name: str
    flag: bool
    colour: Colour
    mode: Literal["a", "b"]
    pair: tuple[float, float]
    many: tuple[int, ...]
    maybe: str | None
    inner: Inner = field(default_factory=Inner)


GOOD: dict[str, Any] = {
    "steps": 3,
    "name": "x",
    "flag": False,
    "colour": "blue",
    "mode": "b",
    "pair": [1, 2.5],
    "many": [],
    "maybe": None,
    "inner": {"rate": 1},
}


def test_every_kind_of_field() -> None:
    parsed = parse_dataclass(Outer, GOOD)
    assert parsed == Outer(
        steps=3,
        name="x",
        flag=False,
        colour=Colour.BLUE,
        mode="b",
        pair=(1.0, 2.5),
        many=(),
        maybe=None,
        inner=Inner(rate=1.0),
    )
    assert isinstance(parsed.inner.rate, float)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stepz": 3}, "stepz: unknown key; did you mean 'steps'?"),
        ({"inner": {"rat": 1}}, "inner.rat: unknown key; did you mean 'rate'?"),
        ({"steps": 3.5}, "steps: is 3.5 (float), expected a whole number"),
        ({"steps": True}, "steps: is True (bool), expected a whole number"),
        ({"steps": "3"}, "steps: is '3' (str), expected a whole number"),
        ({"flag": 1}, "flag: is 1 (int), expected true or false"),
        ({"name": None}, "name: is empty, expected text"),
        ({"name": "???"}, "name: has no value; set it in conf/ or as an override"),
        ({"colour": "rad"}, "colour: is 'rad'; did you mean 'red'?"),
        ({"mode": "c"}, "mode: is 'c'; known: a, b"),
        ({"pair": [1]}, "pair: has 1 entries, expected 2"),
        ({"many": [1, "2"]}, "many[1]: is '2' (str), expected a whole number"),
        ({"many": 4}, "many: is 4 (int), expected a list"),
        ({"inner": 4}, "inner: is 4 (int), expected a section with keys"),
        ({"inner": {"rate": -1}}, "inner: rate must be >= 0, is -1.0"),
        ({"inner": {"rate": float("inf")}}, "inner.rate: is inf, expected a finite number"),
        ({"pair": [1, float("nan")]}, "pair[1]: is nan, expected a finite number"),
    ],
)
def test_one_line_that_names_the_key(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_dataclass(Outer, {**GOOD, **change})
    assert caught.value.line() == message


@pytest.mark.parametrize("key", sorted(GOOD))
def test_a_default_in_the_type_does_not_excuse_a_missing_key(key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_dataclass(Outer, {name: value for name, value in GOOD.items() if name != key})
    assert caught.value.line().startswith(f"{key}: missing key")


def test_a_rooms_own_message_gets_the_section_that_holds_it() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Room:
        side: int

        def __post_init__(self) -> None:
            raise UserError("is odd", where="ingest.side", fix="use 2")

    with pytest.raises(ConfigError) as caught:
        parse_dataclass(Room, {"side": 1}, where="scene")
    assert caught.value.line() == "scene.side: is odd; use 2"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: 1\na: 2", "has 'a' twice"),
        ("a:\n  b: 1\n  c: 2\n  b: 1", "has 'b' twice"),
        ("a: 2020-13-45", "is not valid YAML"),
        ("a: " + "9" * 5000, "is not valid YAML"),
        ("a: " + "[" * 20_000, "is nested too deeply"),
        ("a: [", "is not valid YAML"),
        ("a: !!python/object/apply:os.system [ls]", "is not valid YAML"),
        (b"\xff\xfea\x00:\x00", "is not valid YAML"),
        (b"a: \xff", "is not valid YAML"),
        (b"a: \x00", "is not valid YAML"),
    ],
    ids=lambda item: item[:20],
)
def test_a_damaged_file_is_one_line(tmp_path: Path, text: str | bytes, problem: str) -> None:
    path = tmp_path / "params.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as caught:
        read_yaml(path)
    assert problem in caught.value.line()
    assert len(caught.value.line()) < 400


def test_a_path_that_is_no_file_is_one_line(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / ("x" * 300), tmp_path / "nothing"):
        with pytest.raises(ConfigError):
            read_yaml(path)


def test_settings_come_back_as_they_were_written(tmp_path: Path) -> None:
    settings = {"rate": 1e-05, "name": "Größe: #1", "none": None, "yes": True, "list": [1, {"a": "2"}], "a": {}}
    write_settings(tmp_path / "config.json", settings)
    assert read_settings(tmp_path / "config.json") == settings
    assert list(read_settings(tmp_path / "config.json")) == sorted(settings)


@pytest.mark.parametrize(
    ("text", "problem"),
    [("{", "is not valid JSON"), ('{"a": 1, "a": 2}', "has a key twice"), ("[" * 100_000, "is nested too deeply")],
    ids=["cut", "twice", "deep"],
)
def test_damaged_settings_are_one_line(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_settings(tmp_path / "config.json")
    assert problem in caught.value.line()
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(ConfigError):
            read_settings(path)
