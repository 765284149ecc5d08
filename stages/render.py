"""render: the tour of a method's scene, from the captured cameras into the inserted view and back."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import directory_being_written
from sceneexpander.artifacts.unavailable import passed_on
from sceneexpander.config.files import read_sections
from sceneexpander.progress import progress_bar
from sceneexpander.rendering import RenderConfig, produce_renders
from stages import layout
from stages.machine import use_machine
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    device: str
    threads: int
    render: RenderConfig


@stage("scene", "round", "method")
def main(cell: Cell) -> None:
    """Render videos, stills, every view, and the Gaussians as PLY."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    made = layout.reconstruction(cell.scene, cell.round, cell.method)
    if passed_on(made, layout.renders(cell.scene, cell.round, cell.method)):
        return
    reconstruction = Reconstruction.load(made)
    # The method before the insertion has no inserted camera of its own: it takes the unadapted backbone's.
    reference = Reconstruction.load(layout.reconstruction(cell.scene, cell.round, "backbone"))
    with (
        directory_being_written(layout.renders(cell.scene, cell.round, cell.method)) as folder,
        progress_bar(f"render {cell.scene} {cell.method}", sections.render.frames) as bar,
    ):
        produce_renders(reconstruction, reference, sections.render, folder, device=sections.device, on_frame=bar.update)


if __name__ == "__main__":
    main()
