"""The composed configuration on disk: writing it whole, reading only the sections that a stage declares."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from sceneexpander.artifacts.store import write_bytes_atomic
from sceneexpander.config.parse import ConfigError, parse_dataclass

T = TypeVar("T")


def read_yaml(path: Path) -> Any:
    """Plain values of a YAML file. Raises `ConfigError` naming the file if it is missing or malformed."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError("does not exist", where=path) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"is not valid YAML ({error})", where=path) from None


def write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    """Write sorted YAML atomically."""
    text = yaml.safe_dump(dict(content), sort_keys=True, allow_unicode=True, width=120)
    write_bytes_atomic(path, text.encode())


def read_sections(path: Path, sections: type[T]) -> T:
    """The top-level keys of a composed configuration that ``sections`` (a dataclass) names, and no others.

    A stage therefore cannot depend on a setting that its entry in ``dvc.yaml`` does not list.
    """
    raw = read_yaml(path)
    if not isinstance(raw, Mapping):
        raise ConfigError("holds no sections", where=path, fix="rerun the resolve stage")
    wanted = {f.name for f in dataclasses.fields(sections)}  # type: ignore[arg-type]
    return parse_dataclass(sections, {key: value for key, value in raw.items() if key in wanted})
