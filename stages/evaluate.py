"""evaluate: the numbers of one method in one round."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sceneexpander.artifacts.held_out_seen import HeldOutSeen
from sceneexpander.artifacts.metrics import Fit, UnavailableRow
from sceneexpander.artifacts.store import read_json
from sceneexpander.artifacts.unavailable import unavailable_in
from sceneexpander.catalogue import Kind, method_named
from sceneexpander.config.files import read_sections
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.files import directory_being_written
from stages import layout
from stages.runner import Cell, stage

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    seed: int
    threads: int
    evaluate: EvaluateConfig


@stage("scene", "round", "previous", "method")
def main(cell: Cell) -> None:
    """Measure on the views of all rounds so far, on held-out photos, on the tour, and against known truth where the scene has it."""
    sections = read_sections(layout.config(cell.scene), Sections)
    made = layout.reconstruction(cell.scene, cell.round, cell.method)
    seen_folder = layout.held_out_seen(cell.scene, cell.round, cell.method)
    lacking = unavailable_in(made)
    if lacking is not None:
        UnavailableRow(
            scene=cell.scene,
            round=cell.round,
            method=lacking.method,
            model=lacking.model,
            seed=sections.seed,
            reason=lacking.reason,
        ).save(layout.metrics(cell.scene, cell.round, cell.method))
        with directory_being_written(seen_folder) as folder:
            HeldOutSeen(pictures={}).save(folder)
        return
    # Only now: torch takes seconds to import.
    from sceneexpander.artifacts.held_out import HeldOut
    from sceneexpander.artifacts.inserted import InsertedView
    from sceneexpander.artifacts.reconstruction import Reconstruction
    from sceneexpander.artifacts.renders import Renders
    from sceneexpander.artifacts.truth import SceneTruth
    from sceneexpander.artifacts.views import ViewSet, save_png
    from sceneexpander.evaluation.evaluate import evaluate
    from sceneexpander.evaluation.repeats import over_repeats
    from stages.machine import use_machine

    use_machine(sections.threads)
    before = ViewSet.load(layout.state(cell.scene, cell.previous) / "views")
    views = before.append(InsertedView.load(layout.inserted(cell.scene, cell.round)).view)
    renders = Renders.load(layout.renders(cell.scene, cell.round, cell.method))
    held_out = HeldOut.load(layout.matched_held_out(cell.scene))
    truth = SceneTruth.load(layout.truth(cell.scene))
    runs = [made, *sorted(made.parent.glob(layout.REPEATS))]
    pictures: dict[str, str] = {}
    with directory_being_written(seen_folder) as folder:

        def keep(view_id: str, rgb: Tensor) -> None:
            pictures[view_id] = f"{view_id}.png"
            save_png(folder / pictures[view_id], rgb)

        rows = [
            evaluate(
                Reconstruction.load(run),
                views,
                sections.evaluate,
                scene=cell.scene,
                round_number=cell.round,
                seed=sections.seed,
                navigation=renders.cameras,
                truth=truth if truth.views else None,
                held_out=held_out,
                fit=fit_of(cell),
                show_held_out=keep if run == made else None,
            )
            for run in runs
        ]
        HeldOutSeen(pictures=pictures).save(folder)
    over_repeats(rows).save(layout.metrics(cell.scene, cell.round, cell.method))


def fit_of(cell: Cell) -> Fit:
    """What was done to the method's Gaussians after they were predicted."""
    if method_named(cell.method).kind is Kind.OPTIMISED:
        return Fit.OPTIMISED
    found = layout.reconstruction(cell.scene, cell.round, cell.method).parent / layout.REFINEMENT
    if not found.is_file():
        return Fit.PREDICTED
    report = read_json(found)
    return Fit.FITTED if report["after"] < report["before"] else Fit.PREDICTED


if __name__ == "__main__":
    main()
