"""collect: what the report and the tracking show of one scene, gathered in one folder."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from sceneexpander.artifacts.page import flatten
from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.config.files import read_settings, write_settings
from sceneexpander.files import directory_being_written
from sceneexpander.pipeline.selection import Selection, read_selection
from sceneexpander.report import MethodSource, RoundSource, SceneSource, collect_scene
from stages import layout
from stages.resolve import read_overrides
from stages.runner import Cell, stage


def _round(scene: str, number: int, methods: Sequence[str], *, last: bool) -> RoundSource:
    return RoundSource(
        number=number,
        asked=layout.asked(scene, number),
        inserted=layout.inserted(scene, number),
        methods=[
            MethodSource(
                name=method,
                reconstruction=layout.reconstruction(scene, number, method),
                renders=layout.renders(scene, number, method),
                splats=layout.packed(scene, number, method),
                metrics=layout.metrics(scene, number, method),
                held_out=layout.held_out_seen(scene, number, method),
                report=layout.reconstruction(scene, number, method).parent / "report.json",
                refinement=layout.reconstruction(scene, number, method).parent / layout.REFINEMENT,
            )
            for method in methods
        ],
        log=layout.state(scene, number) / "log.json",
        statistics=layout.round_folder(scene, number) / "stats",
        cameras=layout.cameras(layout.joint_priors(scene, number)),
        proposals=layout.proposals(scene, number) if last else None,
        judged=layout.judged(scene, number),
    )


def _gaussians(scene: str, selected: Selection) -> dict[str, str]:
    """Hash by path of every file of Gaussians that there is."""
    paths = [
        layout.gaussians(scene, number, method)
        for number in range(1, selected.rounds + 1)
        for method in selected.methods
    ]
    found: dict[str, str] = {}
    for path in paths:
        if path.is_file():
            with path.open("rb") as file:
                found[path.as_posix()] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


@stage("scene")
def main(cell: Cell) -> None:
    """List artefacts by what params.yaml selects: files of rounds or methods that were taken out may still lie there."""
    selected = read_selection(Path())
    config = read_settings(layout.config(cell.scene))
    source = SceneSource(
        scene=layout.prepared(cell.scene),
        report=layout.state(cell.scene, 0) / "report.json",
        statistics=layout.OUTPUTS / cell.scene / "stats",
        rounds=[
            _round(cell.scene, number, selected.methods, last=number == selected.rounds)
            for number in range(1, selected.rounds + 1)
        ],
        settings=flatten(config),
        overrides=read_overrides(Path("params.yaml")),
        cameras=layout.cameras(layout.state(cell.scene, 0)),
        held_out=layout.held_out(cell.scene),
    )
    with directory_being_written(layout.PAGES / cell.scene) as folder:
        collect_scene(source, folder)
        # For the recording, which depends on the gathered folders alone.
        write_settings(folder / layout.PAGE_CONFIG, config)
        write_json_atomic(folder / layout.PAGE_GAUSSIANS, _gaussians(cell.scene, selected))


if __name__ == "__main__":
    main()
