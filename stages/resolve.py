"""resolve: compose conf/ for one scene, strictly, into the file whose sections all later stages read."""

from __future__ import annotations

from pathlib import Path

from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.files import read_yaml, write_yaml
from sceneexpander.config.parse import ConfigError
from sceneexpander.errors import did_you_mean
from stages import layout
from stages.runner import Cell, stage

CONF = Path("conf")


def read_overrides(path: Path) -> list[str]:
    """The ``overrides`` of params.yaml."""
    raw = read_yaml(path)
    overrides = raw.get("overrides") if isinstance(raw, dict) else None
    if not isinstance(overrides, list) or not all(isinstance(item, str) for item in overrides):
        raise ConfigError("must be a list of texts such as adapt.steps=5", where=f"{path}: overrides")
    return overrides


def read_methods(path: Path) -> list[str]:
    """The ``methods`` of params.yaml, all of them known, and none without what it starts from."""
    raw = read_yaml(path)
    methods = raw.get("methods") if isinstance(raw, dict) else None
    where = f"{path}: methods"
    if not isinstance(methods, list) or not methods:
        raise ConfigError("must be a list of methods", where=where, fix=f"use {', '.join(layout.METHODS)}")
    for method in methods:
        if method not in layout.METHODS:
            raise ConfigError(f"unknown {method!r}", where=where, fix=did_you_mean(str(method), layout.METHODS))
    for start in layout.RIVALS:
        if f"{start}_optimised" in methods and start not in methods:
            raise ConfigError(f"'{start}_optimised' starts from {start!r}", where=where, fix=f"list {start} too")
    return [str(method) for method in methods]


@stage("scene")
def main(cell: Cell) -> None:
    """Compose, validate, write; note for every method that is not always made whether it is wanted."""
    methods = read_methods(Path("params.yaml"))
    overrides = [f"scene={scene_option(CONF, cell.scene)}", *read_overrides(Path("params.yaml"))]
    write_yaml(layout.config(cell.scene), compose(CONF, overrides))
    write_yaml(
        layout.selection(cell.scene), {name: name in methods for name in layout.METHODS if name not in layout.OURS}
    )


if __name__ == "__main__":
    main()
