"""prepare: the user's folder of photos becomes a `Scene`."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.store import directory_being_written
from sceneexpander.config.files import read_sections
from sceneexpander.ingest import IngestConfig, load_scene
from stages import layout
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    scene: IngestConfig


@stage("scene")
def main(cell: Cell) -> None:
    """Read, check and fit the photos."""
    sections = read_sections(layout.config(cell.scene), Sections)
    scene = load_scene(layout.source(cell.scene), sections.scene)
    with directory_being_written(layout.prepared(cell.scene)) as folder:
        scene.save(folder)


if __name__ == "__main__":
    main()
