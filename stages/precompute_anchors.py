"""precompute_anchors: what the model believes before the insertion, as anchors, and the scene as it was then."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.state import ExpansionState
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.fitting import fit_to_views
from sceneexpander.reconstruction.loaded import ModelConfig, load_model
from sceneexpander.reconstruction.views import captured_prediction
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
    refine: RefineConfig


@stage("scene", "round", "previous")
def main(cell: Cell) -> None:
    """Predict all views so far, without augmentation, with the weights before the round."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    state = ExpansionState.load(layout.state(cell.scene, cell.previous))
    anchors, reconstruction = captured_prediction(state, load_model(sections.model, sections.device))
    if cell.previous:
        # What the scene was before this insertion is what the last round left, not what the model would make of its views now.
        last = Reconstruction.load(layout.reconstruction(cell.scene, cell.previous, "sceneexpander"))
        reconstruction, fit = replace(last, method="captured"), None
    else:
        reconstruction, fit = fit_to_views(
            reconstruction, state.views, sections.refine, seed=sections.seed, device=sections.device
        )
    with directory_being_written(layout.anchors(cell.scene, cell.round)) as folder:
        anchors.save(folder)
    with directory_being_written(layout.reconstruction(cell.scene, cell.round, "captured").parent) as folder:
        reconstruction.save(folder / "reconstruction")
        if fit is not None:
            write_json_atomic(folder / layout.REFINEMENT, fit)


if __name__ == "__main__":
    main()
