"""The composed configuration on disk: writing it whole, reading only the sections that a stage declares."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from sceneexpander.config.parse import ConfigError, parse_dataclass
from sceneexpander.files import write_bytes_atomic
from sceneexpander.typed import shorten

T = TypeVar("T")


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML itself keeps the last of two equal keys and says nothing."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"has {key.value!r} twice", key.start_mark)
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """Plain values of a YAML file. Raises `ConfigError` naming the file if it is missing or malformed, or says something twice."""
    return _read(path, "YAML", lambda text: yaml.load(text, _UniqueKeyLoader))  # noqa: S506 - a safe loader


def read_settings(path: Path) -> Any:
    """Plain values of a file that `write_settings` wrote; of YAML where the name does not end in ``.json``.

    Raises `ConfigError` naming the file if it is missing or malformed, or says something twice.
    """
    if path.suffix != ".json":
        return read_yaml(path)
    return _read(path, "JSON", lambda text: json.loads(text, object_pairs_hook=_unique))


def _read(path: Path, language: str, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError("does not exist", where=path) from None
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", where=path) from None
    except RecursionError:
        raise ConfigError("is nested too deeply", where=path) from None
    # Beside its own errors, YAML's loader lets those of dates and of very long numbers through.
    except (yaml.YAMLError, ValueError, TypeError, LookupError, ArithmeticError) as error:
        raise ConfigError(f"is not valid {language} ({shorten(str(error), 200)})", where=path) from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("has a key twice")
    return found


def write_settings(path: Path, content: Mapping[str, Any]) -> None:
    """Write sorted JSON atomically. DVC reads such a file for every stage that depends on it, and YAML hundreds of times slower."""
    text = json.dumps(dict(content), sort_keys=True, ensure_ascii=False, indent=1)
    write_bytes_atomic(path, f"{text}\n".encode())


def read_sections(path: Path, sections: type[T], *, within: str | None = None) -> T:
    """The keys of a composed configuration that ``sections`` (a dataclass) names, and no others: top-level ones, or those ``within`` a key.

    A stage therefore cannot depend on a setting that its entry in ``dvc.yaml`` does not list.
    """
    raw = read_settings(path)
    if within is not None:
        raw = raw.get(within) if isinstance(raw, Mapping) else None
    if not isinstance(raw, Mapping):
        raise ConfigError("holds no sections", where=path, fix="rerun the resolve stage")
    wanted = {f.name for f in dataclasses.fields(sections)}  # type: ignore[arg-type]
    return parse_dataclass(sections, {key: value for key, value in raw.items() if key in wanted})
