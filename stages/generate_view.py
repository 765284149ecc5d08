"""generate_view: the sentence of a round becomes pictures beyond the captured boundary."""

from __future__ import annotations

from dataclasses import dataclass

from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.generation import GeneratorConfig, make_generator
from stages import layout
from stages.machine import use_machine
from stages.rounds import generation_context, scene_so_far
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    threads: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundSections:
    """What it reads of its round's."""

    generator: GeneratorConfig


@stage("scene", "round", "previous")
def main(cell: Cell) -> None:
    """Ask the back-end, and keep what came with the record of where it came from."""
    sections = read_sections(layout.config(cell.scene), Sections)
    use_machine(sections.threads)
    of_round = read_sections(layout.round_settings(cell.scene), RoundSections, within=layout.round_key(cell.round))
    made = make_generator(of_round.generator).generate(generation_context(cell), scene_so_far(cell))
    with directory_being_written(layout.candidates(cell.scene, cell.round)) as folder:
        made.save(folder)


if __name__ == "__main__":
    main()
