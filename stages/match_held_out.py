"""match_held_out: what ties held-out photos to the captured ones, once for all methods; nothing else is made from them."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.held_out import HeldOut
from sceneexpander.artifacts.state import ExpansionState
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.frontend.prior import FrontendConfig
from stages import layout
from stages.runner import Cell, stage, use_threads


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    seed: int
    threads: int
    frontend: FrontendConfig


@stage("scene")
def main(cell: Cell) -> None:
    """Match the held-out photos with the captured ones."""
    sections = read_sections(layout.config(cell.scene), Sections)
    held_out = HeldOut.load(layout.held_out(cell.scene))
    if held_out.views is not None:
        # Only now: the front-end takes seconds to import, and most small scenes hold nothing out.
        from sceneexpander.reconstruction.held_out import match_held_out
        from sceneexpander.reconstruction.memory import load_memory

        use_threads(sections.threads)
        held_out = match_held_out(
            held_out,
            ExpansionState.load(layout.state(cell.scene, 0)),
            sections.frontend.sfm,
            seed=sections.seed,
            memory=load_memory(layout.match_memory(cell.scene)),
        )
    with directory_being_written(layout.matched_held_out(cell.scene)) as folder:
        held_out.save(folder)


if __name__ == "__main__":
    main()
