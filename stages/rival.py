"""rival: another reconstructor, given the captured views and the inserted one like any other; its Gaussians get the same fit as ours."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.artifacts.unavailable import Unavailable
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.inference.config import NEEDS_CHECKPOINT, RivalsConfig
from sceneexpander.photometric.config import RefineConfig
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
    sections = read_sections(layout.config(cell.scene), Sections)
    config = sections.rivals.of(cell.method)
    target = layout.reconstruction(cell.scene, cell.round, cell.method).parent
    if config.weights is None:
        with directory_being_written(target) as folder:
            Unavailable(method=cell.method, model=cell.method, reason=NEEDS_CHECKPOINT).save(folder / "reconstruction")
        return
    # Only now: most runs have no rival's weights, and torch takes seconds to import.
    from sceneexpander.artifacts.inserted import InsertedView
    from sceneexpander.artifacts.reconstruction import Reconstruction
    from sceneexpander.artifacts.state import load_priors
    from sceneexpander.artifacts.views import ViewSet
    from sceneexpander.inference.rivals import reconstruct_rival
    from sceneexpander.models.registry import licence_of
    from sceneexpander.photometric.fitting import fit_to_views
    from stages.machine import use_machine

    use_machine(sections.threads)
    before = ViewSet.load(layout.state(cell.scene, cell.previous) / "views")
    views = before.append(InsertedView.load(layout.inserted(cell.scene, cell.round)).view)
    priors = load_priors(layout.joint_priors(cell.scene, cell.round))
    made = reconstruct_rival(cell.method, config, views, priors, device=sections.device)
    fit = None
    if isinstance(made, Reconstruction):
        made, fit = fit_to_views(made, views, sections.refine, seed=sections.seed, device=sections.device)
    with directory_being_written(target) as folder:
        made.save(folder / "reconstruction")
        if isinstance(made, Reconstruction):
            write_json_atomic(folder / "report.json", {"licence": licence_of(cell.method)})
        if fit is not None:
            write_json_atomic(folder / layout.REFINEMENT, fit)


if __name__ == "__main__":
    main()
