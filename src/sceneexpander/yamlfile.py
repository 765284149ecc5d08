"""YAML that people write by hand, read so that nothing they wrote is lost or turned into something else without a word.

YAML drops what follows `` #``, keeps the last of two equal keys, reads dates and clock times as values of their own, and lets a few
lines stand for gigabytes. A text editor may add an encoding of its own. Here each of these is either harmless or one clear line.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml

from sceneexpander.errors import UserError
from sceneexpander.plainfiles import read_plain_file

LIMIT_BYTES = 256 * 1024
_MOST_NODES = 50_000  # with every alias written out
_MOST_DIGITS = 300
_TEXT, _NULL, _BOOL = "tag:yaml.org,2002:str", "tag:yaml.org,2002:null", "tag:yaml.org,2002:bool"
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_TIMESTAMP, _MERGE = "tag:yaml.org,2002:timestamp", "tag:yaml.org,2002:merge"
_QUOTE_TEXTS = "put texts that hold ': ' or ' #', or start with a special character, in quotes"
# What PyYAML raises for values that fit no type: "!!int x", "!!float ''", "!!timestamp 2020-13-45".
_VALUE_ERRORS = (yaml.YAMLError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RecursionError)


class _Loader(yaml.SafeLoader):
    """The safe loader, without timestamps: a date is the text that stands there."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != _TIMESTAMP]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def read_user_yaml(path: Path, *, sentences: Collection[str] = (), numbers_as_text: bool = False) -> object:
    """The content of a YAML file as plain values: dict, list, str, int, float, bool or None.

    Args:
        path: a plain file; UTF-8, with or without a byte order mark.
        sentences: keys whose values are sentences. Where YAML would read less than what stands there (``prompt: Sign #5``), or a truth
            value instead of a word (``prompt: yes``), the answer is to quote it.
        numbers_as_text: numbers stay the text that was written (``007``, ``12:30``).

    Raises:
        UserError: one line for whatever keeps the file from being read as it was meant.
    """
    text = _decoded(read_plain_file(path, limit_bytes=LIMIT_BYTES), path)
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _check_expansion(node, path)
            _check(node, text, path, frozenset(sentences), numbers_as_text=numbers_as_text)
            value = loader.construct_document(node)
        finally:
            loader.dispose()
    except RecursionError:
        raise UserError("is nested too deeply", where=path) from None
    except _VALUE_ERRORS as error:
        raise _invalid(error, text, path, sentences) from None
    _check_texts(value, path)
    return value


def _decoded(data: bytes, path: Path) -> str:
    marks = ((codecs.BOM_UTF32_LE, "UTF-32"), (codecs.BOM_UTF16_LE, "UTF-16"), (codecs.BOM_UTF16_BE, "UTF-16"))
    for mark, name in marks:
        if data.startswith(mark):
            raise UserError(f"is {name} text", where=path, fix="save it as UTF-8")
    if b"\0" in data:
        # Every second byte of plain letters is zero in UTF-16.
        problem = "looks like UTF-16 text" if data.count(0) * 3 > len(data) else "holds a NUL character"
        raise UserError(problem, where=path, fix="save it as UTF-8 text")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UserError(f"is not UTF-8 text (line {line})", where=path, fix="save it as UTF-8") from None


def _check_expansion(root: yaml.Node, path: Path) -> None:
    """Refuse aliases that lead back to themselves, and few lines that stand for very much."""
    sizes: dict[int, int] = {}
    unfinished: set[int] = set()

    def size(node: yaml.Node) -> int:
        key = id(node)
        if key in unfinished:
            raise UserError("holds an alias that contains itself", where=path)
        if key not in sizes:
            unfinished.add(key)
            sizes[key] = 1 + sum(size(child) for child in _children(node))
            unfinished.discard(key)
            if sizes[key] > _MOST_NODES:
                raise UserError("holds more values than any file of this kind has", where=path)
        return sizes[key]

    size(root)


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [child for pair in node.value for child in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []


def _check(node: yaml.Node, text: str, path: Path, sentences: frozenset[str], *, numbers_as_text: bool) -> None:
    seen: set[int] = set()
    waiting = [node]
    while waiting:
        current = waiting.pop()
        if id(current) in seen:
            continue
        seen.add(id(current))
        waiting += _children(current)
        if isinstance(current, yaml.ScalarNode) and current.tag in _NUMBERS:
            if numbers_as_text and current.style is None:
                current.tag = _TEXT
            elif len(current.value) > _MOST_DIGITS:
                raise UserError(f"line {_line(current)} holds a number of {len(current.value)} characters", where=path)
        if isinstance(current, yaml.MappingNode):
            _check_keys(current, path)
            for key, value in current.value:
                if isinstance(value, yaml.ScalarNode) and key.value in sentences:
                    _check_sentence(key, value, text, path)


def _check_keys(node: yaml.MappingNode, path: Path) -> None:
    lines: dict[tuple[str, str], int] = {}
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode) or key.tag == _MERGE:
            continue
        name = (key.tag, key.value)
        if name in lines:
            raise UserError(
                f"has {_short(key.value)!r} twice (lines {lines[name]} and {_line(key)})",
                where=path,
                fix="remove one of the two",
            )
        lines[name] = _line(key)


def _check_sentence(key: yaml.Node, value: yaml.ScalarNode, text: str, path: Path) -> None:
    """Refuse an unquoted sentence of which YAML would drop a part, or see a truth value instead of a word."""
    if value.style is not None:
        return
    name = key.value
    example = f'quote it: {name}: "..."'
    rest = text[value.end_mark.index :]
    comment = re.match(r"\s*#", rest)
    if comment is not None:
        *lines_between, indent = comment.group()[:-1].split("\n")
        # A comment on a line of its own belongs to the sentence if it stands further right than the key.
        if not lines_between or len(indent) > key.start_mark.column:
            dropped = rest[comment.end() - 1 :].partition("\n")[0]
            raise UserError(
                f"line {_line(value)}: '#' starts a comment, so {_short(dropped)!r} would be dropped from {name!r}",
                where=path,
                fix=example,
            )
    if text[value.start_mark.index : value.start_mark.index + 1] == "&":
        raise UserError(f"line {_line(value)}: {name!r} starts with '&', which YAML drops", where=path, fix=example)
    if value.tag == _BOOL:
        raise UserError(
            f"line {_line(value)}: {name!r} is {value.value!r}, which YAML reads as true or false",
            where=path,
            fix=f'quote it: {name}: "{value.value}"',
        )


def _check_texts(value: Any, path: Path) -> None:
    waiting, seen = [value], set()
    while waiting:
        current = waiting.pop()
        if isinstance(current, str):
            if any("\ud800" <= letter <= "\udfff" or letter == "\0" for letter in current):
                raise UserError(f"{_short(current)!a} holds a character that is not valid text", where=path)
        elif isinstance(current, (dict, list, tuple, set)) and id(current) not in seen:
            seen.add(id(current))
            waiting += [*current, *current.values()] if isinstance(current, dict) else [*current]


def _invalid(error: Exception, text: str, path: Path, sentences: Collection[str]) -> UserError:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    problem = getattr(error, "problem", None) or getattr(error, "reason", None) or str(error) or type(error).__name__
    if mark is None:
        return UserError(f"is not valid YAML ({problem})", where=path, fix=_QUOTE_TEXTS)
    lines = text.splitlines()
    # The scanner often notices only on the next line.
    for number in (mark.line, mark.line - 1):
        line = lines[number] if 0 <= number < len(lines) else ""
        keys = re.findall(r"(?:^|[\s{,-])(\w+)\s*:\s*(?=\S)", line)
        named = next((key for key in keys if key in sentences), None)
        if named is not None:
            return UserError(
                f"is not valid YAML (line {number + 1}: {problem})",
                where=path,
                fix=f'quote the sentence: {named}: "..."',
            )
    return UserError(f"is not valid YAML (line {mark.line + 1}: {problem})", where=path, fix=_QUOTE_TEXTS)


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1


def _short(text: str) -> str:
    text = text.strip()
    return text if len(text) <= 60 else f"{text[:57]}..."
