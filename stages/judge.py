"""judge: what a vision-language model says about a round's renders. Without one configured it says so, and asks nobody."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sceneexpander.artifacts.judgement import JudgedRound
from sceneexpander.artifacts.unavailable import unavailable_in
from sceneexpander.config.files import read_sections
from sceneexpander.files import directory_being_written
from sceneexpander.judge.config import ChatJudgeConfig, JudgeConfig
from sceneexpander.pipeline.project import JUDGED_FOLDER
from sceneexpander.pipeline.selection import read_selection
from stages import layout
from stages.runner import Cell, project_root, stage

if TYPE_CHECKING:
    from sceneexpander.judge.rounds import Work

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sections:
    """What this stage reads of the configuration."""

    judge: JudgeConfig


def work_of(scene: str, number: int, methods: Sequence[str], config: ChatJudgeConfig) -> Work:
    """What is shown of a finished round."""
    # Only now: torch takes seconds to import.
    from sceneexpander.artifacts.inserted import InsertedView
    from sceneexpander.artifacts.views import to_uint8
    from sceneexpander.judge.frames import shown_of
    from sceneexpander.judge.rounds import Work
    from sceneexpander.services.pictures import encode_picture

    target = to_uint8(InsertedView.load(layout.inserted(scene, number)).view.photo(0))
    folders = {method: layout.renders(scene, number, method) for method in methods}
    lacking = {method: found for method, folder in folders.items() if (found := unavailable_in(folder)) is not None}
    return Work(
        scene=scene,
        round=number,
        target=encode_picture(target, long_side_px=config.picture_side_px),
        shown=tuple(
            shown_of(folder, count=config.frames, long_side_px=config.picture_side_px)
            for method, folder in folders.items()
            if method not in lacking
        ),
        unavailable={method: found.reason for method, found in lacking.items()},
    )


@stage("scene", "round")
def main(cell: Cell) -> None:
    """Judge what params.yaml selects. An answer that is there already is not asked for again, whatever is rerun."""
    config = read_sections(layout.config(cell.scene), Sections).judge
    with directory_being_written(layout.judged(cell.scene, cell.round)) as folder:
        if not isinstance(config, ChatJudgeConfig):
            JudgedRound(scene=cell.scene, round=cell.round).save(folder, {})
            _log.info("no judge configured")
            return
        from sceneexpander.judge.ask import make_judge
        from sceneexpander.judge.rounds import judge_round

        judge = make_judge(config, project_root() / JUDGED_FOLDER)
        assert judge is not None  # noqa: S101 - by the type of its settings
        methods = read_selection(Path()).methods
        judge_round(judge, work_of(cell.scene, cell.round, methods, config)).save(folder, judge.chat.requests)


if __name__ == "__main__":
    main()
