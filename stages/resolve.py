"""resolve: compose conf/ for one scene, strictly, into the file whose sections all later stages read."""

from __future__ import annotations

from pathlib import Path

from sceneexpander.config.compose import compose, scene_option
from sceneexpander.config.files import write_yaml
from sceneexpander.config.overrides import written_out
from sceneexpander.selection import read_selection
from stages import layout
from stages.runner import Cell, stage

CONF = Path("conf")


def read_overrides(path: Path) -> list[str]:
    """The ``overrides`` of params.yaml, as Hydra reads them."""
    return list(written_out(read_selection(path.parent).overrides))


def read_methods(path: Path) -> list[str]:
    """The ``methods`` of params.yaml, all of them known, and none without what it starts from."""
    return list(read_selection(path.parent).methods)


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
