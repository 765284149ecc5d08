"""render: the tour of a method's scene, from the captured cameras into the inserted view and back."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.unavailable import passed_on
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.pipeline.progress import progress_bar
from sceneexpander.rendering.config import RenderConfig
from stages import layout
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    device: str
    threads: int
    render: RenderConfig


@stage("scene", "round", "method")
def main(cell: Cell) -> None:
    """Render videos, stills, every view, the Gaussians as PLY, and what else is asked for."""
    made = layout.reconstruction(cell.scene, cell.round, cell.method)
    if passed_on(made, layout.renders(cell.scene, cell.round, cell.method)):
        return
    # Only now: torch takes seconds to import.
    from sceneexpander.artifacts.reconstruction import Reconstruction
    from sceneexpander.rendering.produce import produce_renders
    from stages.machine import use_machine

    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    reconstruction = Reconstruction.load(made)
    # The method before the insertion has no inserted camera of its own: it takes the unadapted backbone's.
    reference = Reconstruction.load(layout.reconstruction(cell.scene, cell.round, "backbone"))
    with (
        directory_being_written(layout.renders(cell.scene, cell.round, cell.method)) as folder,
        progress_bar(f"render {cell.scene} {cell.method}", sections.render.frames) as bar,
    ):
        produce_renders(reconstruction, reference, sections.render, folder, device=sections.device, on_frame=bar.update)
        if sections.render.exports:
            from sceneexpander.exports.scene import load_scene
            from sceneexpander.exports.write import write_exports

            scene = load_scene(layout.OUTPUTS / cell.scene, cell.round, cell.method)
            write_exports(scene, sections.render.exports, folder / "exports")


if __name__ == "__main__":
    main()
