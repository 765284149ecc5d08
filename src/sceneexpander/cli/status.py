"""Say which stages of the pipeline `make repro` would run, and why: what ``dvc status`` says, several times faster for many scenes."""

from __future__ import annotations

import os
from collections.abc import Sequence

from sceneexpander.commandline import CommandParser
from sceneexpander.errors import UserError, entry_point
from sceneexpander.pipeline.declared import read_pipeline, select_stages
from sceneexpander.pipeline.project import find_project
from sceneexpander.pipeline.surroundings import pipeline_environment, settle_project

LOCK = "dvc.lock"


def make_parser() -> CommandParser:
    """The arguments of ``sceneexpander status``."""
    parser = CommandParser("status", __doc__, examples=["", "adapt", "adapt@courtyard-round0"])
    parser.add_argument("targets", nargs="*", metavar="STAGE", help="only these and what they stand on")
    return parser


@entry_point
def main(arguments: Sequence[str] | None = None) -> None:
    """Ask DVC, in the project that the current folder is in."""
    targets = make_parser().parse_args(arguments).targets
    project = find_project()
    chosen = [stage.address for stage in select_stages(read_pipeline(project), targets)] if targets else []
    settle_project(project)
    os.chdir(project)
    os.environ.update(pipeline_environment(project, project))

    from sceneexpander.pipeline import dvc_adapter  # reads where DVC's databases are when it is loaded

    if dvc_adapter.report_status(chosen):
        fix = f"mend the file that they name; without {LOCK} every stage is looked up in the cache anew"
        raise UserError("DVC cannot tell what would run; the lines above say why", where=project, fix=fix)


if __name__ == "__main__":
    main()
