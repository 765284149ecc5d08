"""Overrides on their way to Hydra: values that hold any text, and what they may not ask for.

Hydra reads the right side of ``key=value`` by a grammar of its own, in which ``,`` ``#`` ``'`` ``(`` ``{`` and others mean something.
`override` is the one place where a text becomes a value of that grammar.
"""

from __future__ import annotations

import dataclasses
import os
import re
import types
import typing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from sceneexpander.catalogue import METHODS
from sceneexpander.config.parse import ConfigError
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.typed import members_of

PATH_KEYS = frozenset(
    {
        "model.weights",
        "evaluate.lpips_weights",
        "generator.file",
        "generator.workflow",
        "choose.candidate",
        "judge.insertion_prompt",
        "judge.quality_prompt",
        *(f"rivals.{method.name}.weights" for method in METHODS if method.needs_weights),
    }
)
MAX_OVERRIDE = 20_000  # characters: key frames are the longest
ROUND_FIELD = "{round}"  # in a picture's path: the number of the round
_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_./@-]*")  # the same in every grammar, and easier to read without quotes
_WORDS = frozenset({"null", "true", "false", "inf", "nan"})
_SECRETS = "oc.env"  # OmegaConf's way to the environment


def override(key: str, text: str) -> str:
    """The override that sets ``key`` to exactly ``text``, whatever letters are in it."""
    return f"{key}={quote(text)}"


def quote(text: str) -> str:
    """``text`` as a value in Hydra's grammar."""
    from hydra.core.override_parser.types import Quote, QuotedString

    if _PLAIN.fullmatch(text) and text.casefold() not in _WORDS:
        return text
    # Within quotes ${...} would still be looked up; backslashes count only in front of it.
    plain = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)
    return QuotedString(text=plain, quote=Quote.single).with_quotes()


def key_of(item: str) -> str:
    """The key of an override: ``adapt.steps`` of ``++adapt.steps=5``."""
    return item.lstrip("+~").partition("=")[0].strip()


@cache
def text_keys() -> frozenset[str]:
    """Keys of the configuration whose values are texts."""
    return frozenset(_text_keys(ProjectConfig, ""))


def _text_keys(schema: type, prefix: str) -> Iterator[str]:
    for name, hint in typing.get_type_hints(schema).items():
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            for member in members_of(hint):
                yield from _text_keys(member, f"{prefix}{name}.")
        elif hint is str or (
            typing.get_origin(hint) in (typing.Union, types.UnionType) and str in typing.get_args(hint)
        ):
            yield f"{prefix}{name}"


def written_out(
    items: Sequence[str], *, absolute: bool = False, sweep: bool = False, folder: Path | None = None
) -> tuple[str, ...]:
    """Overrides as people write them, as Hydra reads them: texts that its grammar would take apart are quoted.

    Args:
        items: overrides such as ``generator.file=/home/Müller, A/it's #1.png``.
        absolute: make paths of files that exist absolute, for a run in another folder.
        sweep: ``a,b`` stands for two values, unless it is the name of a file.
        folder: what relative paths start at; None: the current folder.

    Raises:
        ConfigError: a value is not valid text, or names the home folder of nobody.
    """
    start = Path.cwd() if folder is None else folder.absolute()
    return tuple(_written_out(item, absolute=absolute, sweep=sweep, folder=start) for item in items)


def _written_out(item: str, *, absolute: bool, sweep: bool, folder: Path) -> str:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import ValueType
    from hydra.errors import HydraException

    key, equals, raw = item.partition("=")
    name = key_of(item)
    if any("\ud800" <= letter <= "\udfff" for letter in item):
        raise ConfigError("holds a byte that is not valid text", where=name)
    if not equals or name not in text_keys():
        return item
    if len(item) > MAX_OVERRIDE:
        return item  # is refused when it is composed
    if name in PATH_KEYS and _names_a_file(raw, folder, where=name):
        return f"{key}={quote(_absolute(raw, folder, name) if absolute else raw)}"
    try:
        parsed = OverridesParser.create().parse_override(item)
        value = parsed.value()
    # Beside its own errors, the parser lets those of very long numbers and deep lists through.
    except (HydraException, ValueError, TypeError, LookupError, RecursionError):
        return f"{key}={quote(raw)}"
    if parsed.value_type != ValueType.ELEMENT or isinstance(value, (list, dict)):
        return item if sweep else f"{key}={quote(raw)}"
    # Written as Hydra wants it, e.g. in quotes.
    text = _plain(value) if isinstance(value, str) and name in PATH_KEYS and absolute else None
    if text is None or not _names_a_file(text, folder, where=name):
        return item
    return f"{key}={quote(_absolute(text, folder, name))}"


def _plain(value: str) -> str | None:
    """What a text means to OmegaConf; None if it refers to another key."""
    found = re.findall(r"(\\*)\$\{", value)
    if any(len(slashes) % 2 == 0 for slashes in found):
        return None
    return re.sub(r"(\\*)\\\$\{", lambda match: match[1][: len(match[1]) // 2] + "${", value)


def _absolute(text: str, folder: Path, name: str) -> str:
    return str(folder / expand_home(text, where=name))


def _names_a_file(text: str, folder: Path, *, where: str) -> bool:
    try:
        return any(
            (folder / expand_home(name, where=where)).is_file()
            for name in dict.fromkeys((text, text.replace(ROUND_FIELD, "1")))
        )
    except (OSError, ValueError):  # too long, or characters that no file has
        return False


def expand_home(text: str, *, where: str) -> Path:
    """A path with ``~`` and ``~user`` written out. Raises `ConfigError` if there is no such home folder, nor a file of that name."""
    path = os.path.expanduser(text)
    if path.startswith("~") and not os.path.lexists(path):
        raise ConfigError(f"there is no home folder {path.partition('/')[0]}", where=where, fix="give the whole path")
    return Path(path)


@contextmanager
def environment_hidden() -> Iterator[None]:
    """Within the block nothing that is composed can read environment variables: their values would land in files and pages.

    Raises:
        ConfigError: something tried; it says so in place of the error that it caused.
    """
    from omegaconf import OmegaConf
    from omegaconf.resolvers import oc

    asked: list[str] = []

    def refuse(name: str, *_: object) -> str:
        asked.append(name)
        raise ValueError(name)

    OmegaConf.register_new_resolver(_SECRETS, refuse, replace=True)
    try:
        yield
    except Exception:
        if not asked:
            raise
    finally:
        OmegaConf.register_new_resolver(_SECRETS, oc.env, replace=True)
    if asked:
        raise ConfigError(
            f"'${{{_SECRETS}:{asked[0]}}}' would write an environment variable into files",
            where="configuration",
            fix="write the value itself; secrets have no place in it",
        )
