"""prepare: the user's folder becomes a `Scene`, what each round asks for, and what is known of the truth."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

from sceneexpander.artifacts.truth import SceneTruth
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.ingest import IngestConfig, load_scene, recorded_files
from sceneexpander.ingest.truth import load_truth
from stages import layout
from stages.runner import Cell, stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    scene: IngestConfig


@stage("scene")
def main(cell: Cell) -> None:
    """Read, check and fit the photos; keep rounds apart, so that one more changes none of the others."""
    sections = read_sections(layout.config(cell.scene), Sections)
    source = layout.source(cell.scene)
    scene = load_scene(source, sections.scene)
    with directory_being_written(layout.prepared(cell.scene)) as folder:
        scene.save(folder)
    with directory_being_written(layout.asked(cell.scene, 1).parent) as folder:
        for number, spec in enumerate(scene.rounds, start=1):
            place = folder / layout.asked(cell.scene, number).name
            spec.save(place)
            for path in recorded_files(spec, source):
                copy = place / layout.RECORDED / path.relative_to(source)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)
    with directory_being_written(layout.truth(cell.scene)) as folder:
        (load_truth(source) or SceneTruth()).save(folder)


if __name__ == "__main__":
    main()
