"""Plain values, as YAML and JSON hold them, into typed dataclasses, strictly.

What is not of the annotated type is refused with the whole key; numbers and texts are never converted into each other. One reader for
configurations and for the facts of artefacts: whatever a file holds, the result is a valid value or a `DecodeError`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.ranges import shown_number

T = TypeVar("T")
# What a dataclass raises for values that do not go together.
REFUSALS = (ValueError, TypeError, ArithmeticError, LookupError, AttributeError, RuntimeError)
MISSING = "???"  # how a configuration says that a value must be given
_SHOWN_CHARACTERS = 60
_LARGEST_FLOAT = 10**308


class DecodeError(UserError):
    """A value has another type than its place, or is missing. ``where`` is the dotted key."""


def decode_dataclass(
    schema: type[T], raw: object, *, where: str = "", complete: bool = False, extra: bool = False
) -> T:
    """Build ``schema`` from a mapping whose keys are its fields.

    Args:
        schema: a dataclass type.
        raw: a mapping of plain values.
        where: dotted key of ``raw`` inside the whole, for messages.
        complete: fields with a default must be present too, and ``???`` stands for a value that is still to be given.
        extra: pass over keys of the outermost mapping that are no fields: the file is somebody else's.

    Raises:
        DecodeError: one line that names the offending key.
    """
    if not isinstance(raw, Mapping):
        raise DecodeError(f"is {describe(raw)}, expected a section with keys", where=_key(where))
    schema = _member(schema, raw, where)
    hashable: Any = schema
    hints, required = fields_of(hashable)
    for key in raw:
        if key not in hints and not extra:
            name = shorten(str(key)) if isinstance(key, str) else describe(key)
            raise DecodeError("unknown key", where=_key(where, name), fix=did_you_mean(name, hints))
    values: dict[str, Any] = {}
    for name, hint in hints.items():
        if name in raw:
            values[name] = decode(hint, raw[name], where=_key(where, name), complete=complete)
        elif complete or name in required:
            raise DecodeError("missing key", where=_key(where, name))
    try:
        return schema(**values)
    except UserError as error:
        # Rooms name their own keys; here they get the section that holds them.
        last = (error.where or "").rpartition(".")[2]
        own = last if last.partition("[")[0] in hints else ""
        raise DecodeError(error.problem, where=_key(where, own), fix=error.fix) from None
    except REFUSALS as error:
        raise DecodeError(shorten(str(error), 300), where=_key(where)) from None


def members_of(schema: type) -> tuple[type, ...]:
    """The types that a section annotated as ``schema`` may have: of a family its members, else the type itself.

    A family is a dataclass with a class method ``family() -> (key, members by the value of that key)``: its members have fields of their
    own, and the key in a section says which of them it is.
    """
    family = getattr(schema, "family", None)
    return (schema,) if family is None else tuple(family()[1].values())


def _member(schema: type[T], raw: Mapping[Any, object], where: str) -> type[T]:
    family = getattr(schema, "family", None)
    if family is None:
        return schema
    key, members = family()
    name = raw.get(key)
    if key not in raw:
        raise DecodeError("missing key", where=_key(where, key))
    if not isinstance(name, str) or name not in members:
        shown = repr(shorten(name)) if isinstance(name, str) else describe(name)
        raise DecodeError(f"is {shown}", where=_key(where, key), fix=did_you_mean(str(name), members))
    return members[name]


@functools.cache
def fields_of(schema: Any) -> tuple[dict[str, Any], frozenset[str]]:
    """(annotated type by name, names without a default) of a dataclass's arguments."""
    hints = typing.get_type_hints(schema, include_extras=True)
    arguments = [f for f in dataclasses.fields(schema) if f.init]
    none = dataclasses.MISSING
    required = frozenset(f.name for f in arguments if f.default is none and f.default_factory is none)
    return {f.name: hints[f.name] for f in arguments}, required


def decode(hint: Any, value: object, *, where: str, complete: bool = False) -> Any:
    """One value of the annotated type ``hint``; see `decode_dataclass`."""
    if complete and isinstance(value, str) and value == MISSING:
        raise DecodeError("has no value", where=where)
    origin, args = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin is Annotated:
        return decode(args[0], value, where=where, complete=complete)
    if origin in (typing.Union, types.UnionType):
        return _decode_union(args, value, where, complete)
    if origin is Literal:
        return _decode_choice(args, value, where)
    if origin in (tuple, list, Sequence) or hint in (tuple, list):
        return _decode_sequence(origin or hint, args, value, where, complete)
    if origin in (dict, Mapping) or hint is dict:
        return _decode_mapping(args, value, where, complete)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return decode_dataclass(hint, value, where=where, complete=complete)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(_decode_choice(tuple(member.value for member in hint), value, where))
    return _decode_scalar(hint, value, where)


def _decode_scalar(hint: Any, value: object, where: str) -> Any:
    if hint is Path and isinstance(value, str) and "\0" not in value:
        return Path(value)
    if hint in (int, float) and isinstance(value, (int, float)) and not isinstance(value, bool):
        return _decode_number(hint, value, where)
    if hint is bool and isinstance(value, bool):
        return value
    if hint is str and isinstance(value, str):
        # JSON can write half of a surrogate pair, which no file and no terminal can take.
        if any("\ud800" <= letter <= "\udfff" for letter in value):
            raise DecodeError(f"is {shorten(value)!a}, which is no valid text", where=where)
        return value
    if hint is types.NoneType and value is None:
        return None
    name = getattr(hint, "__name__", str(hint))
    raise DecodeError(f"is {describe(value)}, expected {_article(name)}", where=where)


def _decode_number(hint: type, value: float, where: str) -> float:
    if isinstance(value, int):
        if hint is int:
            return value
        if abs(value) > _LARGEST_FLOAT:
            raise DecodeError(f"is {shown_number(value)}, too large for a number", where=where)
        return float(value)
    # No value has a use for infinity, and JSON, which results are kept in, has no way to write it.
    if not math.isfinite(value):
        raise DecodeError(f"is {value}, expected a finite number", where=where)
    if hint is float:
        return value
    if value.is_integer():
        return int(value)  # 1e2
    raise DecodeError(f"is {describe(value)}, expected {_article('int')}", where=where)


def _decode_union(options: tuple[Any, ...], value: object, where: str, complete: bool) -> Any:
    if value is None and types.NoneType in options:
        return None
    errors = []
    for option in sorted((o for o in options if o is not types.NoneType), key=lambda o: -_shared_keys(o, value)):
        try:
            return decode(option, value, where=where, complete=complete)
        except DecodeError as error:
            errors.append(error)
    raise errors[0]


def _shared_keys(option: Any, value: object) -> int:
    """How many of a section's keys a type has: the one with most is what was meant, and its complaint is the useful one."""
    if not dataclasses.is_dataclass(option) or not isinstance(value, Mapping):
        return 0
    return len({f.name for f in dataclasses.fields(option)} & set(value))


def _decode_choice(choices: tuple[Any, ...], value: object, where: str) -> Any:
    for choice in choices:
        if type(choice) is type(value) and choice == value:
            return choice
    text = shorten(value) if isinstance(value, str) else describe(value)
    shown = repr(text) if isinstance(value, str) else text
    raise DecodeError(f"is {shown}", where=where, fix=did_you_mean(text, [str(choice) for choice in choices]))


def _decode_sequence(origin: Any, args: tuple[Any, ...], value: object, where: str, complete: bool) -> Any:
    if not isinstance(value, (list, tuple)):
        raise DecodeError(f"is {describe(value)}, expected a list", where=where)
    if origin is tuple and args and args[-1] is not Ellipsis:
        if len(args) != len(value):
            raise DecodeError(f"has {len(value)} entries, expected {len(args)}", where=where)
        inner = args
    else:
        inner = (args[0] if args else Any,) * len(value)
    pairs = enumerate(zip(inner, value, strict=True))
    items = [decode(kind, item, where=f"{where}[{i}]", complete=complete) for i, (kind, item) in pairs]
    return items if origin is list else tuple(items)


def _decode_mapping(args: tuple[Any, ...], value: object, where: str, complete: bool) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise DecodeError(f"is {describe(value)}, expected a section with keys", where=where)
    kind = args[1] if args else Any
    decoded: dict[str, Any] = {}
    for key, item in value.items():
        name = _decode_scalar(str, key, where)
        decoded[name] = decode(kind, item, where=_key(where, shorten(name)), complete=complete)
    return decoded


def _key(*parts: str) -> str:
    return ".".join(part for part in parts if part) or "configuration"


def describe(value: object) -> str:
    """A value and its type as one short text, however large it is."""
    if value is None:
        return "empty"
    if isinstance(value, Mapping):
        return "a section with keys"
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return f"{shown_number(value)} ({type(value).__name__})"
    if isinstance(value, str):
        return f"{shorten(value)!r} (str)"
    return f"{value!r} (bool)" if isinstance(value, bool) else f"a {type(value).__name__}"


def shorten(text: str, limit: int = _SHOWN_CHARACTERS) -> str:
    """``text``, or its beginning."""
    return text if len(text) <= limit else f"{text[:limit]}..."


def _article(name: str) -> str:
    spoken = {"int": "a whole number", "float": "a number", "str": "text", "bool": "true or false", "Path": "a path"}
    return spoken.get(name, name)
