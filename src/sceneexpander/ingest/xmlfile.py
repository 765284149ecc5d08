"""XML files of other tools: bounded, without entities, and whatever is wrong is one line."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from jaxtyping import Float
from numpy import ndarray

from sceneexpander.errors import UserError
from sceneexpander.ingest.sources.capture import number_array
from sceneexpander.plainfiles import read_plain_file

_LIMIT_BYTES = 16 * 2**20
_PIECE_BYTES = 2**16  # parsed at once
_DEEPEST = 100  # elements within elements; the parser itself would take as many as there is memory for


def read_user_xml(path: Path) -> ElementTree.Element:
    """The outermost element of a file.

    Raises:
        UserError: it is no XML, nested too deeply, or defines entities, which can make a small file a large one.
    """
    data = read_plain_file(path, limit_bytes=_LIMIT_BYTES)
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise UserError("defines entities, which no file of cameras does", where=path)
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    depth = 0
    root: ElementTree.Element | None = None
    try:
        for start in range(0, len(data), _PIECE_BYTES):
            parser.feed(data[start : start + _PIECE_BYTES])
            for event, element in parser.read_events():
                root = element if root is None else root
                depth += 1 if event == "start" else -1
                if depth > _DEEPEST:
                    raise UserError(f"is nested more than {_DEEPEST} deep", where=path)
        parser.close()
    except (ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise UserError(f"is not valid XML ({' '.join(str(error).split())[:80]})", where=path) from None
    if root is None:
        raise UserError("is not valid XML (it is empty)", where=path)
    return root


def numbers_of(text: str | None, count: int, where: str | Path) -> Float[ndarray, " number"]:
    """The numbers of an element or attribute, separated by spaces. Raises `UserError` unless there are ``count`` finite ones."""
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count:
        raise UserError(f"has no {count} numbers where they are expected", where=where)
    return number_array(values, where)
