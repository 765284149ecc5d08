"""choose_view: which of a round's candidates is inserted, fitted to the captured views' size."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.artifacts.candidates import CandidateSet
from sceneexpander.artifacts.views import save_png
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.generation import ChoiceConfig, choose_view
from sceneexpander.judge.ask import make_judge
from sceneexpander.judge.config import JudgeConfig
from sceneexpander.pipeline.project import JUDGED_FOLDER
from stages import layout
from stages.machine import use_machine
from stages.rounds import generation_context, scene_so_far
from stages.runner import Cell, project_root, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    seed: int
    threads: int
    judge: JudgeConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundSections:
    """What it reads of its round's."""

    choose: ChoiceConfig


@stage("scene", "round", "previous")
def main(cell: Cell) -> None:
    """Check, rank, choose; the contact sheet shows all candidates, the overlay how the chosen one goes with the scene."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    of_round = read_sections(layout.round_settings(cell.scene), RoundSections, within=layout.round_key(cell.round))
    made = CandidateSet.load(layout.candidates(cell.scene, cell.round))
    chosen = choose_view(
        generation_context(cell),
        made.candidates,
        scene_so_far(cell),
        of_round.choose,
        seed=sections.seed,
        judge=make_judge(sections.judge, project_root() / JUDGED_FOLDER),
    )
    with directory_being_written(layout.inserted(cell.scene, cell.round)) as folder:
        chosen.inserted.save(folder)
        save_png(folder / "sheet.png", chosen.sheet)
        if chosen.overlay is not None:
            save_png(folder / "overlay.png", chosen.overlay)


if __name__ == "__main__":
    main()
