"""rival: another reconstructor, given the captured views and the inserted one like any other; its Gaussians get the same fit as ours."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.store import directory_being_written, write_json_atomic
from sceneexpander.config.files import read_sections
from sceneexpander.inference.config import RivalsConfig
from sceneexpander.optimisation.config import RefineConfig
from stages import layout
from stages.runner import Cell, left_out, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    seed: int
    device: str
    threads: int
    refine: RefineConfig
    rivals: RivalsConfig


@stage("scene", "round", "previous", "method")
def main(cell: Cell) -> None:
    """Reconstruct all views with the rival's own weights and fit its Gaussians to them, or write down why it cannot be."""
    if left_out(cell):
        return
    # Only now: most runs ask for no rival, and torch takes seconds to import.
    from sceneexpander.artifacts.inserted import InsertedView
    from sceneexpander.artifacts.reconstruction import Reconstruction
    from sceneexpander.artifacts.state import load_priors
    from sceneexpander.artifacts.views import ViewSet
    from sceneexpander.inference.rivals import reconstruct_rival
    from sceneexpander.models.registry import licence_of
    from sceneexpander.reconstruction.fitting import fitted
    from stages.machine import use_machine

    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    before = ViewSet.load(layout.state(cell.scene, cell.previous) / "views")
    views = before.append(InsertedView.load(layout.inserted(cell.scene, cell.round)).view)
    priors = load_priors(layout.joint_priors(cell.scene, cell.round))
    made = reconstruct_rival(cell.method, sections.rivals.of(cell.method), views, priors, device=sections.device)
    fit = None
    if isinstance(made, Reconstruction):
        made, fit = fitted(made, views, sections.refine, seed=sections.seed, device=sections.device)
    with directory_being_written(layout.reconstruction(cell.scene, cell.round, cell.method).parent) as folder:
        made.save(folder / "reconstruction")
        if isinstance(made, Reconstruction):
            write_json_atomic(folder / "report.json", {"licence": licence_of(cell.method)})
        if fit is not None:
            write_json_atomic(folder / layout.REFINEMENT, fit)


if __name__ == "__main__":
    main()
