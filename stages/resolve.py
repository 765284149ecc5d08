"""resolve: compose conf/ for one scene, strictly, into the file whose sections all later stages read."""

from __future__ import annotations

from pathlib import Path

from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.files import read_yaml, write_yaml
from sceneexpander.config.parse import ConfigError
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


@stage("scene")
def main(cell: Cell) -> None:
    """Compose, validate, write."""
    overrides = [f"scene={scene_option(CONF, cell.scene)}", *read_overrides(Path("params.yaml"))]
    write_yaml(layout.config(cell.scene), compose(CONF, overrides))


if __name__ == "__main__":
    main()
