"""precompute_anchors: what the model believes before the insertion, once as anchors and once as a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.state import ExpansionState
from sceneexpander.artifacts.store import directory_being_written, write_json_atomic
from sceneexpander.config.files import read_sections
from sceneexpander.optimisation.refine import RefineConfig
from sceneexpander.reconstruction.loaded import ModelConfig, load_model
from sceneexpander.reconstruction.refining import refined
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
    reconstruction, fit = refined(
        reconstruction,
        state.views,
        sections.refine,
        doubt_generated=True,
        seed=sections.seed,
        device=sections.device,
    )
    with directory_being_written(layout.anchors(cell.scene, cell.round)) as folder:
        anchors.save(folder)
    with directory_being_written(layout.reconstruction(cell.scene, cell.round, "captured").parent) as folder:
        reconstruction.save(folder / "reconstruction")
        if fit is not None:
            write_json_atomic(folder / layout.REFINEMENT, fit)


if __name__ == "__main__":
    main()
