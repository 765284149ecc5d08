"""reconstruct_inserted: the baseline. The unadapted model given the inserted view like any other."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.state import ExpansionState, save_priors
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.fitting import fit_to_views
from sceneexpander.reconstruction.cameras import report_cameras
from sceneexpander.reconstruction.loaded import ModelConfig, load_model
from sceneexpander.reconstruction.memory import load_memory
from sceneexpander.reconstruction.views import joint_reconstruction
from stages import layout
from stages.machine import use_machine
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    seed: int
    device: str
    threads: int
    model: ModelConfig
    frontend: FrontendConfig
    refine: RefineConfig


@stage("scene", "round", "previous")
def main(cell: Cell) -> None:
    """Cameras and depth of all views together, and the scene the unadapted model makes of them."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    state = ExpansionState.load(layout.state(cell.scene, cell.previous))
    inserted = InsertedView.load(layout.inserted(cell.scene, cell.round))
    loaded = load_model(sections.model, sections.device)
    priors, reconstruction, sparse = joint_reconstruction(
        state,
        inserted,
        loaded,
        sections.frontend,
        seed=sections.seed,
        memory=load_memory(layout.match_memory(cell.scene)),
    )
    reconstruction, fit = fit_to_views(
        reconstruction,
        state.views.append(inserted.view),
        sections.refine,
        seed=sections.seed,
        device=sections.device,
    )
    with directory_being_written(layout.joint_priors(cell.scene, cell.round)) as folder:
        if sparse is not None:
            report_cameras(state.views.append(inserted.view), sparse).save(layout.cameras(folder))
        save_priors(folder, priors)
    with directory_being_written(layout.reconstruction(cell.scene, cell.round, "backbone").parent) as folder:
        reconstruction.save(folder / "reconstruction")
        if fit is not None:
            write_json_atomic(folder / layout.REFINEMENT, fit)


if __name__ == "__main__":
    main()
