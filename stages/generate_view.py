"""generate_view: the sentence of a round becomes a picture beyond the captured boundary."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.scene import Scene
from sceneexpander.artifacts.state import ExpansionState
from sceneexpander.artifacts.store import directory_being_written
from sceneexpander.artifacts.views import save_png
from sceneexpander.config.files import read_sections
from sceneexpander.generation import GeneratorConfig, generate_inserted_view
from stages import layout
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    generator: GeneratorConfig


@stage("scene", "round", "previous")
def main(cell: Cell) -> None:
    """Ask the back-end, choose, fit to the captured views' size, record where the picture came from."""
    sections = read_sections(layout.config(cell.scene), Sections)
    scene = Scene.load(layout.prepared(cell.scene))
    state = ExpansionState.load(layout.state(cell.scene, cell.previous))
    view, sheet = generate_inserted_view(scene, cell.round, state.views, layout.source(cell.scene), sections.generator)
    with directory_being_written(layout.inserted(cell.scene, cell.round)) as folder:
        view.save(folder)
        save_png(folder / "sheet.png", sheet)


if __name__ == "__main__":
    main()
