"""Compose ``conf/`` with Hydra into plain, resolved, validated values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sceneexpander.config.overrides import environment_hidden
from sceneexpander.config.parse import ConfigError, parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import did_you_mean

FORBIDDEN_KEYS = frozenset({"size", "nfiles"})  # the pipeline's cache key leaves these names out, silently
DEFAULT_SCENE = "default"


def scene_option(conf: Path, scene: str) -> str:
    """The option of the ``scene`` group for a scene: its own file if there is one, else the default."""
    return scene if (conf / "scene" / f"{scene}.yaml").is_file() else DEFAULT_SCENE


def compose(conf: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """Compose, resolve and validate. Returns plain values (what the validated types were built from).

    Args:
        conf: the configuration folder.
        overrides: Hydra overrides, e.g. ``("adapt.steps=5", "ablation=anchor")``.

    Raises:
        ConfigError: unknown group, option or key, missing value, wrong type; one line.
    """
    from hydra import compose as hydra_compose
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    with environment_hidden(), _initialised(conf):
        try:
            composed = hydra_compose(config_name="config", overrides=list(overrides))
            plain = OmegaConf.to_container(composed, resolve=True)
        except (HydraException, OmegaConfBaseException) as error:
            raise explain(error, conf, overrides) from None
    if not isinstance(plain, dict):
        raise ConfigError("composes to no sections", where=conf / "config.yaml")
    values = {str(key): value for key, value in plain.items()}
    refuse_forbidden_keys(values)
    parse_dataclass(ProjectConfig, values)
    return values


@contextmanager
def _initialised(conf: Path) -> Iterator[None]:
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    if not (conf / "config.yaml").is_file():
        raise ConfigError("does not exist", where=conf / "config.yaml")
    # Inside a sweep's job Hydra is running already; it allows one at a time.
    current = GlobalHydra.instance()
    outer, current.hydra = current.hydra, None
    try:
        with initialize_config_dir(config_dir=str(conf.resolve()), version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra = outer


def refuse_forbidden_keys(values: Mapping[str, Any], where: str = "") -> None:
    """Raise `ConfigError` if any key at any depth has a name that the cache key would ignore."""
    for key, value in values.items():
        path = f"{where}.{key}" if where else str(key)
        if key in FORBIDDEN_KEYS:
            raise ConfigError("this key name is ignored by the pipeline's cache", where=path, fix="rename it")
        if isinstance(value, Mapping):
            refuse_forbidden_keys(value, path)


def explain(error: Exception, conf: Path, overrides: Sequence[str]) -> ConfigError:
    """Hydra's message as one line that names the override at fault and the nearest thing that exists."""
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        group = key.partition("@")[0]
        folder = conf / group
        if folder.is_dir():
            options = [path.stem for path in folder.glob("*.yaml")]
            if value not in options:
                return ConfigError(f"has no option {value!r}", where=group, fix=did_you_mean(value, options))
        elif str(error).find(key) >= 0:
            return ConfigError("unknown key", where=key, fix=_nearest_key(conf, key))
    first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return ConfigError(first.strip(), where=conf)


def _nearest_key(conf: Path, key: str) -> str:
    groups = [path.name for path in conf.iterdir() if path.is_dir()]
    return did_you_mean(key, sorted({*known_keys(ProjectConfig), *groups}))


def known_keys(schema: type, prefix: str = "") -> list[str]:
    """All dotted keys of a nested dataclass schema."""
    import dataclasses
    import typing

    keys: list[str] = []
    for name, hint in typing.get_type_hints(schema).items():
        path = f"{prefix}{name}"
        keys.append(path)
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            keys.extend(known_keys(hint, f"{path}."))
    return keys
