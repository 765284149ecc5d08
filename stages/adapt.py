"""adapt: Algorithm 1. The weights learn to explain the inserted view without forgetting the captured ones."""

from __future__ import annotations

import logging
import shutil
from dataclasses import asdict, dataclass

from sceneexpander.adaptation.config import AdaptConfig
from sceneexpander.adaptation.observe import Look, warnings_of
from sceneexpander.adaptation.records import StepRecord
from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.artifacts.inserted import InsertedView
from sceneexpander.artifacts.live import LiveLog
from sceneexpander.artifacts.state import ExpansionState, load_priors
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.config.files import read_sections
from sceneexpander.expansion import (
    CorrectionsConfig,
    MethodConfig,
    ModelConfig,
    RoundInputs,
    Watch,
    compose_procedure,
    judge_round,
    load_model,
)
from sceneexpander.files import directory_being_written
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.pipeline.progress import progress_bar
from stages import layout
from stages.machine import use_machine
from stages.runner import Cell, checkpoint_folder, live_folder, remove_checkpoints, remove_folder, run_identity, stage

LOOKS = "looks"  # pictures of the looks, in the log and in the result

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    seed: int
    device: str
    threads: int
    model: ModelConfig
    adapt: AdaptConfig
    corrections: CorrectionsConfig
    refine: RefineConfig


@stage("scene", "round", "previous")
def main(cell: Cell) -> None:
    """Adapt, reconstruct with the adapted weights, and keep the log."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    sources = (
        layout.state(cell.scene, cell.previous),
        layout.inserted(cell.scene, cell.round),
        layout.anchors(cell.scene, cell.round),
        layout.joint_priors(cell.scene, cell.round),
    )
    inputs = RoundInputs(
        state=ExpansionState.load(sources[0]),
        inserted=InsertedView.load(sources[1]),
        anchors=Anchors.load(sources[2]),
        joint_priors=load_priors(sources[3]),
    )
    verdict = judge_round(inputs)
    if verdict is not None and not verdict.accepted:
        _log.warning(
            "%s round %d: the inserted view fits badly: %s", cell.scene, cell.round, "; ".join(verdict.reasons)
        )
    run = run_identity("adapt", sections, sources)
    checkpoints, live = checkpoint_folder(run), live_folder(run)
    if not (checkpoints.is_dir() and (live / LOOKS).is_dir()):  # either is of no use without the other
        remove_folder(checkpoints)
        remove_folder(live / LOOKS)
    loaded = load_model(sections.model, sections.device)
    method = MethodConfig(adapt=sections.adapt, corrections=sections.corrections)
    procedure = compose_procedure(method, sections.refine)
    log = LiveLog(live, {"scene": cell.scene, "round": cell.round, "steps": sections.adapt.steps, "sections": sections})
    with progress_bar(f"adapt {cell.scene} round {cell.round}", sections.adapt.steps) as bar:

        def on_step(record: StepRecord) -> None:
            bar.update(record.step, record.loss)
            log.write("step", record)

        def on_look(look: Look) -> None:
            log.write("look", look)

        watch = Watch(on_step=on_step, on_look=on_look, checkpoint_folder=checkpoints, looks_folder=live / LOOKS)
        adapted = procedure.adapt(inputs, loaded, seed=sections.seed, watch=watch)
    result, posed = adapted.result, adapted.inputs.joint_priors.posed
    count = len(adapted.inputs.views) if posed is None else int(posed.sum())
    with progress_bar(f"refine {cell.scene} round {cell.round}", procedure.fit.visits * count) as bar:
        expanded = procedure.finish(
            adapted, loaded, seed=sections.seed, on_fit_step=lambda step, loss: bar.update(step, loss)
        )
    warnings = warnings_of(result.looks)
    with directory_being_written(layout.state(cell.scene, cell.round)) as folder:
        expanded.state.save(folder)
        expanded.scene.save(folder / "reconstruction")
        if expanded.fit is not None:
            write_json_atomic(folder / layout.REFINEMENT, expanded.fit)
        write_json_atomic(folder / "corrections.json", expanded.corrections)
        if verdict is not None:
            write_json_atomic(folder / "acceptance.json", verdict)
        write_json_atomic(folder / "log.json", [asdict(record) for record in result.records])
        looks = {"identity": run.key, "looks": [asdict(look) for look in result.looks], "warnings": warnings}
        write_json_atomic(folder / "looks.json", looks)
        if result.looks:
            shutil.copytree(live / LOOKS, folder / LOOKS)
    log.end({"warnings": warnings})
    remove_checkpoints(run)


if __name__ == "__main__":
    main()
