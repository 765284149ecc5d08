"""JSON files of other tools: bounded, and whatever is wrong is one line."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from sceneexpander.errors import UserError
from sceneexpander.plainfiles import decode_text, read_plain_file

_LIMIT_BYTES = 256 * 2**20


def read_user_json(path: Path) -> dict[str, Any]:
    """The object that a file holds.

    Raises:
        UserError: it is no JSON, or no object.
    """
    data = read_plain_file(path, limit_bytes=_LIMIT_BYTES)
    try:
        value = json.loads(decode_text(data))
    except UnicodeDecodeError:
        raise UserError("is not UTF-8 or UTF-16 text", where=path) from None
    except json.JSONDecodeError as error:
        raise UserError(f"is not valid JSON (line {error.lineno}: {error.msg})", where=path) from None
    except (RecursionError, ValueError):  # the second: numbers of thousands of digits
        raise UserError("is not valid JSON (nested too deeply, or a number too long)", where=path) from None
    if not isinstance(value, dict):
        raise UserError("holds no object with keys", where=path)
    return value


def number_at(content: dict[str, Any], key: str, where: str | Path) -> float | None:
    """The number with that key; None if there is none. Raises `UserError` if it is something else."""
    value = content.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UserError(f"{key!r} is no number", where=where)
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise UserError(f"{key!r} is not finite", where=where)
    return number


def text_at(content: dict[str, Any], key: str, where: str | Path) -> str | None:
    """The text with that key; None if there is none. Raises `UserError` if it is something else, or could be no name."""
    value = content.get(key)
    if value is None:
        return None
    if (
        not isinstance(value, str)
        or not value
        or "\0" in value
        or any("\ud800" <= letter <= "\udfff" for letter in value)
    ):
        raise UserError(f"{key!r} is no text", where=where)
    return value
