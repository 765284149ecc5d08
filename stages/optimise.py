"""optimise: 3DGS after the fact, started from the cameras and Gaussians that a method made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.artifacts.unavailable import Unavailable, unavailable_in
from sceneexpander.catalogue import method_named
from sceneexpander.config.files import read_sections
from sceneexpander.errors import UserError
from sceneexpander.files import directory_being_written
from sceneexpander.optimisation.config import OptimiseConfig
from stages import layout
from stages.runner import Cell, checkpoint_folder, left_out, remove_checkpoints, run_identity, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    seed: int
    device: str
    threads: int
    optimise: OptimiseConfig


def optimise_start(cell: Cell, *, stage_name: str) -> None:
    """Make the cell's method from the one that it starts from, or write down why it cannot be."""
    # Not at the top: most runs ask for no optimisation, and torch takes seconds to import.
    from sceneexpander.artifacts.inserted import InsertedView
    from sceneexpander.artifacts.reconstruction import Reconstruction
    from sceneexpander.artifacts.views import ViewSet
    from sceneexpander.optimisation.optimise import optimise, unusable
    from sceneexpander.pipeline.progress import progress_bar
    from stages.machine import use_machine

    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    method = method_named(cell.method)
    if method.starts_from is None:
        raise UserError(f"{cell.method!r} optimises no other method's result", where=stage_name)
    made = layout.reconstruction(cell.scene, cell.round, method.starts_from)
    target = layout.reconstruction(cell.scene, cell.round, cell.method).parent
    lacking = unavailable_in(made)
    if lacking is not None:
        _write_reason(Unavailable(method=cell.method, model=lacking.model, reason=lacking.reason), target)
        return
    reconstruction = Reconstruction.load(made)
    reason = unusable(reconstruction)
    if reason is not None:
        _write_reason(Unavailable(method=cell.method, model=reconstruction.model, reason=reason), target)
        return
    sources = (
        layout.state(cell.scene, cell.previous) / "views",
        layout.inserted(cell.scene, cell.round),
        made,
    )
    views = ViewSet.load(sources[0]).append(InsertedView.load(sources[1]).view)
    run = run_identity(stage_name, sections, sources)
    checkpoints = checkpoint_folder(run)
    config = sections.optimise
    with (
        directory_being_written(target) as folder,
        progress_bar(f"optimise {cell.scene} {cell.method}", config.steps * config.repeats) as bar,
    ):
        for repeat in range(config.repeats):
            result = optimise(
                reconstruction,
                views.images,
                config,
                photos=views.photos,
                valid=views.valid,
                method=cell.method,
                seed=sections.seed + repeat,
                device=sections.device,
                checkpoint_folder=checkpoints / str(repeat),
                on_step=lambda step, loss, done=repeat * config.steps: bar.update(done + step, loss),  # type: ignore[misc]
            )
            place = folder / layout.repeat_name(repeat)
            result.reconstruction.save(place)
            write_json_atomic(place / "losses.json", result.losses)
    remove_checkpoints(run)


def _write_reason(reason: Unavailable, target: Path) -> None:
    with directory_being_written(target) as folder:
        reason.save(folder / "reconstruction")


@stage("scene", "round", "previous", "method")
def main(cell: Cell) -> None:
    """The catalogue says what the method starts from."""
    if not left_out(cell):
        optimise_start(cell, stage_name="optimise")


if __name__ == "__main__":
    main()
