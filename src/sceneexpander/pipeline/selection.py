"""What is to run: the content of ``params.yaml``, checked before anything starts.

Scenes and rounds become names of folders and words of commands, so only plain ones are taken.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sceneexpander.catalogue import METHODS, method_named
from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.yamlfile import read_user_yaml

PARAMS = "params.yaml"
RESERVED = frozenset(
    {"pages", "report", "given", "code.json", "environment.json"}
)  # in outputs/, where every scene has a folder of its name
MOST_ROUNDS = 100
ROUND_SECTIONS = ("generator", "choose")  # of the configuration, that a round may have of its own
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")
_KEYS = ("scenes", "rounds", "methods", "overrides")


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What a pipeline runs.

    Attributes:
        scenes: names of folders.
        rounds: how many.
        previous: of each round, the one that it goes on from; empty: the one before.
        methods: rows of the tables.
        overrides: Hydra overrides as they were written.
        round_overrides: of each round, further ones of `ROUND_SECTIONS`; empty: no round has any.
    """

    scenes: tuple[str, ...]
    rounds: int
    previous: tuple[int, ...] = ()
    methods: tuple[str, ...] = tuple(method.name for method in METHODS if method.always_made)
    overrides: tuple[str, ...] = ()
    round_overrides: tuple[tuple[str, ...], ...] = ()

    def overrides_of(self, number: int) -> tuple[str, ...]:
        """Overrides that round ``number`` (from 1) alone has."""
        return self.round_overrides[number - 1] if self.round_overrides else ()

    def to_yaml(self) -> str:
        """The text of params.yaml."""
        previous = self.previous or tuple(range(self.rounds))
        content = {
            "scenes": list(self.scenes),
            "rounds": [
                {"k": k, "prev": earlier, **({"overrides": list(more)} if (more := self.overrides_of(k)) else {})}
                for k, earlier in enumerate(previous, start=1)
            ],
            "methods": list(self.methods),
            "overrides": list(self.overrides),
        }
        return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def read_selection(project: Path) -> Selection:
    """The selection of a project folder.

    Raises:
        UserError: one line about the first thing in its params.yaml that cannot run.
    """
    path = project / PARAMS
    raw = read_user_yaml(path)
    if not isinstance(raw, dict):
        raise UserError("does not select a run", where=path, fix=f"it needs {', '.join(_KEYS)}")
    for key in raw:
        if key not in _KEYS:
            raise UserError(f"has the unknown key {key!r}", where=path, fix=did_you_mean(str(key), _KEYS))
    for key in _KEYS:
        if key not in raw:
            raise UserError(f"does not select a run ({key!r} is missing)", where=path)
    rounds = _list(raw, "rounds", path)
    return Selection(
        scenes=_scenes(_list(raw, "scenes", path), f"{path}: scenes"),
        rounds=len(rounds),
        previous=_previous(rounds, f"{path}: rounds"),
        round_overrides=_round_overrides(rounds, f"{path}: rounds"),
        methods=check_methods(_list(raw, "methods", path), where=f"{path}: methods"),
        overrides=_texts(_list(raw, "overrides", path, may_be_empty=True), f"{path}: overrides", "adapt.steps=5"),
    )


def check_name(name: str, *, where: str | Path, fix: str) -> None:
    """Raise `UserError` unless ``name`` can be the folder of a scene, in ``scenes/`` and in ``outputs/``."""
    if not _NAME.fullmatch(name):
        shown = name if len(name) <= 60 else f"{name[:57]}..."
        problem = f"{shown!r} is no plain name (letters, digits, '.', '_' and '-', at most 100)"
        raise UserError(problem, where=where, fix=fix)
    if name.casefold() in RESERVED:
        raise UserError(f"{name!r} is a name that the pipeline uses for its own results", where=where, fix=fix)


def check_methods(items: Sequence[Any], *, where: str) -> tuple[str, ...]:
    """The names of methods: all of them known, none twice, and none without what it starts from. Raises `UserError`."""
    methods = _texts(items, where, "sceneexpander")
    for method in [method_named(name, where=where) for name in methods]:
        start = None if method.starts_from is None else method_named(method.starts_from)
        if start is not None and not start.always_made and start.name not in methods:
            problem, fix = f"{method.name!r} starts from {start.name!r}", f"list {start.name} too"
            raise UserError(problem, where=where, fix=fix)
    return _distinct(methods, where)


def _list(raw: Mapping[str, Any], key: str, path: Path, *, may_be_empty: bool = False) -> list[Any]:
    value = raw[key]
    if not isinstance(value, list):
        raise UserError("must be a list", where=f"{path}: {key}", fix=f"write {key}: [...]")
    if not value and not may_be_empty:
        raise UserError("is empty", where=f"{path}: {key}", fix="then nothing would run")
    return value


def _texts(items: Sequence[Any], where: str, example: str) -> tuple[str, ...]:
    for item in items:
        if not isinstance(item, str):
            raise UserError(f"holds {_shown(item)}, expected a list of texts such as {example}", where=where)
    return tuple(items)


def _distinct(items: tuple[str, ...], where: str) -> tuple[str, ...]:
    for index, item in enumerate(items):
        if item in items[:index]:
            raise UserError(f"names {item!r} twice", where=where)
    return items


def _scenes(items: list[Any], where: str) -> tuple[str, ...]:
    names = _texts(items, where, "courtyard")
    for name in names:
        check_name(name, where=where, fix="name a folder of scenes/")
    return _distinct(names, where)


def _previous(items: list[Any], where: str) -> tuple[int, ...]:
    """Of rounds 1, 2, ... the one that each goes on from: an earlier one, or 0, the captured scene."""
    fix = "write {k: 1, prev: 0}, {k: 2, prev: 1}, ..."
    if len(items) > MOST_ROUNDS:
        raise UserError(f"are {len(items)}, more than the {MOST_ROUNDS} allowed", where=where)
    previous = []
    for number, item in enumerate(items, start=1):
        if not isinstance(item, dict) or set(item) - {"overrides"} != {"k", "prev"}:
            raise UserError(f"entry {number} is {_shown(item)}", where=where, fix=fix)
        k, earlier = item["k"], item["prev"]
        if type(k) is not int or k != number:  # not True, which is 1 to Python
            raise UserError(f"entry {number} has k: {_shown(k)}, expected {number}", where=where, fix=fix)
        if type(earlier) is not int or not 0 <= earlier < k:
            problem = f"round {k} has prev: {_shown(earlier)}, expected an earlier round, or 0 for the captured scene"
            raise UserError(problem, where=where, fix=fix)
        previous.append(earlier)
    return () if previous == list(range(len(previous))) else tuple(previous)


def _round_overrides(items: list[dict[str, Any]], where: str) -> tuple[tuple[str, ...], ...]:
    """Of every round its own overrides, which may say how its picture is obtained and nothing else."""
    found = []
    for number, item in enumerate(items, start=1):
        own = item.get("overrides", [])
        place = f"{where}: round {number}: overrides"
        if not isinstance(own, list):
            raise UserError(f"holds {_shown(own)}, expected a list", where=place)
        for override in _texts(own, place, "generator=reproject"):
            if re.split(r"[.=]", override.lstrip("+~"), maxsplit=1)[0] not in ROUND_SECTIONS:
                problem = f"{override!r} is for all rounds"
                raise UserError(problem, where=place, fix=f"only {' and '.join(ROUND_SECTIONS)} can be a round's own")
        found.append(tuple(own))
    return tuple(found) if any(found) else ()


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
