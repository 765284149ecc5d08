"""propose: where the camera could go after a round, and what the scene shows so far in all directions."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.proposals import Proposal, Proposals
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet, save_png
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.generation import SceneSoFar
from sceneexpander.generation.propose import measure_coverage, propose_motions, start_of
from stages import layout
from stages.machine import use_machine
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    threads: int


@stage("scene", "round")
def main(cell: Cell) -> None:
    """Rate motions from the central photo; draw the panorama."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    state = layout.state(cell.scene, cell.round)
    so_far = SceneSoFar(
        views=ViewSet.load(state / "views"), reconstruction=Reconstruction.load(state / "reconstruction")
    )
    with directory_being_written(layout.proposals(cell.scene, cell.round)) as folder:
        if not bool((so_far.reconstruction.posed & ~so_far.reconstruction.generated).any()):
            Proposals().save(folder)  # without a camera nothing can be seen from elsewhere
            return
        coverage, motions = measure_coverage(so_far), propose_motions(so_far)
        save_png(folder / "coverage.png", coverage.panorama)
        for number, motion in enumerate(motions, start=1):
            save_png(folder / f"preview_{number}.png", motion.preview)
        Proposals(
            start=so_far.views.records[start_of(so_far)].name,
            covered=coverage.share,
            map="coverage.png",
            proposals=tuple(
                Proposal(
                    motion=motion.words,
                    new=motion.new,
                    direction_deg=motion.direction_deg,
                    preview=f"preview_{number}.png",
                )
                for number, motion in enumerate(motions, start=1)
            ),
        ).save(folder)


if __name__ == "__main__":
    main()
