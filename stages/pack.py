"""pack: the most visible Gaussians of a method, small enough for a page that one walks through."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.unavailable import passed_on
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from stages import layout
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    device: str
    threads: int


@stage("scene", "round", "method")
def main(cell: Cell) -> None:
    """Weigh by what the method's own cameras see, keep the heaviest, quantise."""
    made = layout.reconstruction(cell.scene, cell.round, cell.method)
    if passed_on(made, layout.packed(cell.scene, cell.round, cell.method)):
        return
    # Only now: torch takes seconds to import.
    from sceneexpander.artifacts.reconstruction import Reconstruction
    from sceneexpander.viewer.packed import pack_splats
    from stages.machine import use_machine

    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    reconstruction = Reconstruction.load(made)
    with directory_being_written(layout.packed(cell.scene, cell.round, cell.method)) as folder:
        pack_splats(reconstruction, device=sections.device).save(folder)


if __name__ == "__main__":
    main()
