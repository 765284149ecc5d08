"""pack: the most visible Gaussians of a method, small enough for a page that one walks through."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import directory_being_written
from sceneexpander.artifacts.unavailable import passed_on
from sceneexpander.config.files import read_sections
from sceneexpander.viewer.packed import pack_splats
from stages import layout
from stages.machine import use_machine
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    device: str
    threads: int


@stage("scene", "round", "method")
def main(cell: Cell) -> None:
    """Weigh by what the method's own cameras see, keep the heaviest, quantise."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    made = layout.reconstruction(cell.scene, cell.round, cell.method)
    if passed_on(made, layout.packed(cell.scene, cell.round, cell.method)):
        return
    reconstruction = Reconstruction.load(made)
    with directory_being_written(layout.packed(cell.scene, cell.round, cell.method)) as folder:
        pack_splats(reconstruction, device=sections.device).save(folder)


if __name__ == "__main__":
    main()
