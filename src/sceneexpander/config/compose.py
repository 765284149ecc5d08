"""Compose ``conf/`` with Hydra into plain, resolved, validated values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from yaml import YAMLError

from sceneexpander.artifacts.store import to_plain
from sceneexpander.config.overrides import MAX_OVERRIDE, environment_hidden, key_of
from sceneexpander.config.parse import ConfigError, parse_dataclass
from sceneexpander.config.schema import ProjectConfig
from sceneexpander.errors import did_you_mean
from sceneexpander.typed import fields_of, members_of, shorten

FORBIDDEN_KEYS = frozenset({"size", "nfiles"})  # the pipeline's cache key leaves these names out, silently
DEFAULT_SCENE = "default"
MAX_KEY = 200  # characters
_ROOT = "config"
_ROWS, _NO_ROW = "ablation", "default"  # the group of rows, and its option that changes nothing
_RENAMED = {
    "generator.candidate": "choose.candidate",
    "generator.fit": "choose.fit",
    "adapt.realign": "corrections.camera.realign",
    "adapt.tone": "corrections.colour.match",
    "adapt.trust": "corrections.contradiction.fade",
    "adapt.close_gaps": "corrections.gaps.reach",
    "adapt.splat_steps": "corrections.head.steps",
    "adapt.splat_learning_rate": "corrections.head.learning_rate",
    "adapt.splat_others": "corrections.head.others_weight",
}
_RENAMED_OPTIONS = {
    ("ablation", "none"): "default",
    ("ablation", "full"): "paper",
    ("ablation", "control_no_adaptation"): "corrected",
    ("method", "default"): "extended",
}


def scene_option(conf: Path, scene: str) -> str:
    """The option of the ``scene`` group for a scene: its own file if there is one, else the default."""
    return scene if scene in options_of(conf, "scene") else DEFAULT_SCENE


def options_of(conf: Path, group: str) -> list[str]:
    """Names of the options of a group, e.g. of ``hydra/launcher``; empty if there is no such group."""
    groups = {path.parent.relative_to(conf).as_posix() for path in conf.glob("*/**/*.yaml")}
    return sorted(path.stem for path in (conf / group).glob("*.yaml")) if group in groups else []


def compose(conf: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """Compose, resolve and validate. Returns plain values, those of the validated types.

    Args:
        conf: the configuration folder.
        overrides: Hydra overrides, e.g. ``("adapt.steps=5", "ablation=anchor")``.

    Raises:
        ConfigError: unknown group, option or key, missing value, wrong type, number out of range; one line.
    """
    from hydra import compose as hydra_compose
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    with environment_hidden(), _initialised(conf):
        try:
            kept = [text for text in overrides if check_override(conf, text)]
            plain = OmegaConf.to_container(hydra_compose(config_name=_ROOT, overrides=kept), resolve=True)
            rest = [text for text in kept if key_of(text) != _ROWS]
            others = (
                plain
                if len(rest) == len(kept)
                else OmegaConf.to_container(hydra_compose(config_name=_ROOT, overrides=rest), resolve=True)
            )
        except RecursionError:
            raise ConfigError("is nested too deeply", where=conf) from None
        # Hydra lets errors of its own making through for values that it did not expect.
        except (
            HydraException,
            OmegaConfBaseException,
            ValueError,
            TypeError,
            LookupError,
            OSError,
            YAMLError,
        ) as error:
            raise explain(error, conf, overrides) from None
    if not isinstance(plain, dict):
        raise ConfigError("composes to no sections", where=conf / "config.yaml")
    rows = [text for text in kept if text not in rest]
    if rows and plain == others and rows[-1].partition("=")[2].strip("'\"") != _NO_ROW:
        # What a row leaves out may not be there: its results would be those of the default under another name.
        raise ConfigError(
            "changes nothing of these settings", where=rows[-1], fix="leave it out, or choose another method="
        )
    values = {str(key): value for key, value in plain.items()}
    refuse_forbidden_keys(values)
    return to_plain(parse_dataclass(ProjectConfig, values))


def check_override(conf: Path, text: str) -> bool:
    """Whether an override is to be applied: not if it asks an optional group for nothing.

    Hydra passes over options that an optional group does not have, and fails with a traceback at some values.

    Raises:
        ConfigError: it is no override, too long, a sweep, or names an option that its group does not have.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    name = text.lstrip("+~").partition("=")[0]
    where = shorten(name) or "override"
    if len(name) > MAX_KEY:
        raise ConfigError(f"has {len(name)} characters, more than any key", where=where)
    if len(text) > MAX_OVERRIDE:
        raise ConfigError(f"has {len(text)} characters, at most {MAX_OVERRIDE} are read", where=where)
    if not name or ("=" not in text and not text.startswith("~")):
        raise ConfigError("is not KEY=VALUE", where=shorten(text) or "override")
    try:
        override = OverridesParser.create().parse_override(text)
        value = override.value()
    except RecursionError:
        raise ConfigError("is nested too deeply", where=where) from None
    # Beside its own errors, the parser lets those of very long numbers through.
    except (HydraException, ValueError, TypeError, LookupError) as error:
        reason = "a number of too many digits"
        if "integer string conversion" not in str(error):
            reason = str(error).partition("See https://hydra.cc")[0]
        raise ConfigError(f"is no KEY=VALUE ({shorten(reason, 120)})", where=where, fix="put texts in quotes") from None
    if override.is_sweep_override():
        raise ConfigError("holds several values", where=where, fix="give one, or use sceneexpander sweep")
    group = override.key_or_group
    options = options_of(conf, group)
    if not options or override.is_delete():
        return True
    if value is None and _is_optional(conf, group):
        return False
    if not isinstance(value, str) or value not in options:
        # As it was written: what Hydra reads may be a list or a number.
        written = text.partition("=")[2]
        if (group, written) in _RENAMED_OPTIONS:
            fix = f"write {group}={_RENAMED_OPTIONS[group, written]}"
            raise ConfigError(f"option {written!r} has another name now", where=group, fix=fix)
        raise ConfigError(
            f"has no option {shorten(written)!r}", where=group, fix=did_you_mean(shorten(written), options)
        )
    return True


def _is_optional(conf: Path, group: str) -> bool:
    from omegaconf import OmegaConf

    content: Any = OmegaConf.load(conf / f"{_ROOT}.yaml")
    return any(not isinstance(entry, str) and f"optional {group}" in entry for entry in content.defaults)


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
    known = known_keys(ProjectConfig)
    first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
    # The longest key first: ``generator`` is in every message about ``generator.file`` as well.
    for key in sorted((override.lstrip("+~").partition("=")[0] for override in overrides), key=len, reverse=True):
        if key and key in str(error):
            if key in _RENAMED:
                return ConfigError("has another name now", where=key, fix=f"write {_RENAMED[key]}")
            if key not in known:
                return ConfigError("unknown key", where=key, fix=_nearest_key(conf, key, known))
            if owners := _owners(key):
                fix = f"it belongs to {' and '.join(owners)}"
                return ConfigError("is no setting of what was chosen", where=key, fix=fix)
            return ConfigError(f"cannot be set ({shorten(first.strip(), 200)})", where=key)
    return ConfigError(shorten(first.strip(), 200), where=conf)


def _owners(key: str) -> list[str]:
    """The members of a section's family that have a setting, as overrides (``generator=file``); none for other sections."""
    import typing

    section, _, name = key.partition(".")
    hint = typing.get_type_hints(ProjectConfig).get(section)
    family = getattr(hint, "family", None)
    if family is None:
        return []
    return [f"{section}={member}" for member, schema in family()[1].items() if name in fields_of(schema)[0]]


def _nearest_key(conf: Path, key: str, known: Sequence[str]) -> str:
    groups = [path.name for path in conf.iterdir() if path.is_dir()]
    near = did_you_mean(key, sorted({*known, *groups}))
    # All keys together would be a page.
    return near if near.startswith("did you mean") else f"sections: {', '.join(k for k in known if '.' not in k)}"


def known_keys(schema: type, prefix: str = "") -> list[str]:
    """All dotted keys of a nested dataclass schema."""
    import dataclasses
    import typing

    keys: list[str] = []
    for name, hint in typing.get_type_hints(schema).items():
        path = f"{prefix}{name}"
        keys.append(path)
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            below = [key for member in members_of(hint) for key in known_keys(member, f"{path}.")]
            keys.extend(dict.fromkeys(below))
    return keys
