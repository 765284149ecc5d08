"""correct: the round without a step. All that is ours beyond the paper, on the weights that the round starts from."""

from __future__ import annotations

from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from stages import layout
from stages.runner import Cell, left_out, stage


@stage("scene", "round", "previous", "method")
def main(cell: Cell) -> None:
    """The procedure of `adapt` without its steps."""
    if left_out(cell):
        return
    # Only now: who does not ask for it need not wait for torch.
    from sceneexpander.artifacts.anchors import Anchors
    from sceneexpander.artifacts.inserted import InsertedView
    from sceneexpander.artifacts.state import ExpansionState, load_priors
    from sceneexpander.artifacts.store import write_json_atomic
    from sceneexpander.expansion import MethodConfig, RoundInputs, compose_procedure, load_model
    from stages.adapt import Sections
    from stages.machine import use_machine

    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    inputs = RoundInputs(
        state=ExpansionState.load(layout.state(cell.scene, cell.previous)),
        inserted=InsertedView.load(layout.inserted(cell.scene, cell.round)),
        anchors=Anchors.load(layout.anchors(cell.scene, cell.round)),
        joint_priors=load_priors(layout.joint_priors(cell.scene, cell.round)),
    )
    loaded = load_model(sections.model, sections.device)
    method = MethodConfig(adapt=sections.adapt, corrections=sections.corrections)
    corrected = compose_procedure(method, sections.refine).without_steps().run(inputs, loaded, seed=sections.seed)
    with directory_being_written(layout.reconstruction(cell.scene, cell.round, cell.method).parent) as folder:
        corrected.scene.save(folder / "reconstruction")
        write_json_atomic(folder / "corrections.json", corrected.corrections)
        if corrected.fit is not None:
            write_json_atomic(folder / layout.REFINEMENT, corrected.fit)


if __name__ == "__main__":
    main()
