"""Where the project is, whichever folder or workspace a program runs in."""

from __future__ import annotations

import os
from pathlib import Path

from sceneexpander.errors import UserError

ROOT_ENV = "SCENEEXPANDER_ROOT"  # set in workspaces: the main project folder, which they share
ERROR_FILE_ENV = (
    "SCENEEXPANDER_ERROR_FILE"  # set by whoever starts a pipeline: where a stage leaves its one-line refusal
)
STAGE_ENV = "DVC_STAGE"  # set by DVC for the commands that it runs, and by whoever runs them in its place
SWEEP_ENV = "SCENEEXPANDER_SWEEP"  # set in the jobs of a sweep: its id, a tag of the recorded runs

GENERATED_FOLDER = Path(".cache") / "generated"  # in the project folder: answers of image services, by what was asked
JUDGED_FOLDER = Path(".cache") / "judged"  # in the project folder: answers of judges, by what was asked and shown
LIVE_FOLDER = Path(".cache") / "live"  # in the project folder: logs of running adaptations


def find_project() -> Path:
    """The project folder: named by the environment, or the nearest one above the current folder, or the one of this installation.

    Raises:
        UserError: none of them holds a pipeline.
    """
    named = os.environ.get(ROOT_ENV)
    if named:
        root = Path(named).resolve()
        if not _holds_pipeline(root):
            raise UserError("holds no pipeline (dvc.yaml and conf/)", where=f"{ROOT_ENV}={named}", fix="unset it")
        return root
    here = Path.cwd().resolve()
    for folder in (here, *here.parents, Path(__file__).resolve().parents[3]):
        if _holds_pipeline(folder):
            return folder
    raise UserError("holds no pipeline (dvc.yaml and conf/)", where=here, fix="run this in the project folder")


def _holds_pipeline(folder: Path) -> bool:
    return (folder / "dvc.yaml").is_file() and (folder / "conf" / "config.yaml").is_file()
