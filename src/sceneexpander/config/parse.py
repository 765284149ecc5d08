"""Plain nested dictionaries (from YAML) into typed, frozen dataclasses, strictly.

Unknown, missing, mistyped and out-of-range keys are refused with the full key and a suggestion, before any model is loaded.
"""

from __future__ import annotations

from typing import TypeVar

from sceneexpander.errors import UserError
from sceneexpander.typed import DecodeError, decode_dataclass

T = TypeVar("T")
_LACKS = ("missing key", "has no value")


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
    try:
        return decode_dataclass(schema, raw, where=where, complete=True)
    except DecodeError as error:
        fix = "set it in conf/ or as an override" if error.problem in _LACKS else error.fix
        raise ConfigError(error.problem, where=error.where, fix=fix) from None
