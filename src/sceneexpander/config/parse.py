"""Plain nested dictionaries (from YAML) into typed, frozen dataclasses, strictly.

Unknown, missing and mistyped keys are refused with the full key and a suggestion, before any model is loaded.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from sceneexpander.errors import UserError, did_you_mean

T = TypeVar("T")


class ConfigError(UserError):
    """A configuration key is unknown, missing, of the wrong type or out of range."""


def parse_dataclass(schema: type[T], raw: object, *, where: str = "") -> T:
    """Build ``schema`` from a mapping whose keys must be exactly its fields.

    Every field must be present, even one with a default in the dataclass: the composed configuration is the whole truth.

    Args:
        schema: a dataclass type.
        raw: a mapping of plain values (what YAML yields).
        where: dotted key of ``raw`` inside the whole configuration, for messages.

    Raises:
        ConfigError: one line that names the offending key.
    """
    if not isinstance(raw, Mapping):
        raise ConfigError(f"is {_describe(raw)}, expected a section with keys", where=_key(where))
    hints = typing.get_type_hints(schema)
    names = [f.name for f in dataclasses.fields(schema) if f.init]  # type: ignore[arg-type]
    for key in raw:
        if key not in names:
            raise ConfigError("unknown key", where=_key(where, str(key)), fix=did_you_mean(str(key), names))
    values: dict[str, Any] = {}
    for name in names:
        if name not in raw:
            raise ConfigError("missing key", where=_key(where, name), fix="set it in conf/ or as an override")
        values[name] = parse_value(hints[name], raw[name], where=_key(where, name))
    try:
        return schema(**values)
    except UserError as error:
        # Rooms name their own keys; here they get the section that holds them.
        last = (error.where or "").rpartition(".")[2]
        raise ConfigError(error.problem, where=_key(where, last if last in names else ""), fix=error.fix) from None
    except (ValueError, TypeError) as error:
        raise ConfigError(str(error), where=_key(where)) from None


def parse_value(hint: Any, value: object, *, where: str) -> Any:
    """One value of the annotated type ``hint``; numbers and strings are never converted into each other."""
    if value == "???":
        raise ConfigError("has no value", where=where, fix="set it in conf/ or as an override")
    origin = get_origin(hint)
    if hint is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        return _parse_union(get_args(hint), value, where)
    if origin is Literal:
        return _parse_choice(get_args(hint), value, where)
    if origin in (tuple, list, Sequence) or hint in (tuple, list):
        return _parse_sequence(hint, origin or hint, value, where)
    if origin in (dict, Mapping):
        return _parse_mapping(get_args(hint), value, where)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return parse_dataclass(hint, value, where=where)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(_parse_choice(tuple(member.value for member in hint), value, where))
    return _parse_scalar(hint, value, where)


def _parse_scalar(hint: Any, value: object, where: str) -> Any:
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        # No setting has a use for infinity, and JSON, which results are kept in, has no way to write it.
        if not math.isfinite(value):
            raise ConfigError(f"is {value}, expected a finite number", where=where)
        return float(value)
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint in (str, bool) and isinstance(value, hint):
        return value
    if hint is types.NoneType and value is None:
        return None
    name = getattr(hint, "__name__", str(hint))
    raise ConfigError(f"is {_describe(value)}, expected {_article(name)}", where=where)


def _parse_union(options: tuple[Any, ...], value: object, where: str) -> Any:
    if value is None and types.NoneType in options:
        return None
    errors = []
    for option in sorted((o for o in options if o is not types.NoneType), key=lambda o: -_shared_keys(o, value)):
        try:
            return parse_value(option, value, where=where)
        except ConfigError as error:
            errors.append(error)
    raise errors[0]


def _shared_keys(option: Any, value: object) -> int:
    """How many of a section's keys a type has: the one with most is what was meant, and its complaint is the useful one."""
    if not dataclasses.is_dataclass(option) or not isinstance(value, Mapping):
        return 0
    return len({f.name for f in dataclasses.fields(option)} & set(value))


def _parse_choice(choices: tuple[Any, ...], value: object, where: str) -> Any:
    for choice in choices:
        if type(choice) is type(value) and choice == value:
            return choice
    raise ConfigError(f"is {value!r}", where=where, fix=did_you_mean(str(value), [str(choice) for choice in choices]))


def _parse_sequence(hint: Any, origin: Any, value: object, where: str) -> Any:
    if not isinstance(value, (list, tuple)):
        raise ConfigError(f"is {_describe(value)}, expected a list", where=where)
    args = get_args(hint)
    if origin is tuple and args and args[-1] is not Ellipsis:
        if len(args) != len(value):
            raise ConfigError(f"has {len(value)} entries, expected {len(args)}", where=where)
        inner = args
    else:
        inner = (args[0] if args else Any,) * len(value)
    items = [
        parse_value(kind, item, where=f"{where}[{i}]") for i, (kind, item) in enumerate(zip(inner, value, strict=True))
    ]
    return items if origin is list else tuple(items)


def _parse_mapping(args: tuple[Any, ...], value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"is {_describe(value)}, expected a section with keys", where=where)
    kind = args[1] if args else Any
    return {str(key): parse_value(kind, item, where=_key(where, str(key))) for key, item in value.items()}


def _key(*parts: str) -> str:
    return ".".join(part for part in parts if part) or "configuration"


def _describe(value: object) -> str:
    if value is None:
        return "empty"
    if isinstance(value, Mapping):
        return "a section with keys"
    return f"{value!r} ({type(value).__name__})"


def _article(name: str) -> str:
    spoken = {"int": "a whole number", "float": "a number", "str": "text", "bool": "true or false", "Path": "a path"}
    return spoken.get(name, name)
