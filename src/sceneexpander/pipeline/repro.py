"""``python -m sceneexpander.pipeline.repro``: the pipeline of the project folder itself, as ``make repro`` runs it.

``dvc repro`` does the same in a clone; this also works in a downloaded archive, in a folder with any letters in its name, and ends all
that it started when it ends.
"""

from __future__ import annotations

import sys

from sceneexpander.errors import entry_point
from sceneexpander.pipeline.__main__ import AGAIN_ENV
from sceneexpander.pipeline.disk import require_room
from sceneexpander.pipeline.locks import run_lock
from sceneexpander.pipeline.processes import run_group
from sceneexpander.pipeline.project import find_project
from sceneexpander.pipeline.surroundings import pipeline_environment, settle_project


@entry_point
def main() -> None:
    """Options are those of ``dvc repro``."""
    project = find_project()
    settle_project(project)
    with run_lock(project / ".cache" / "repro", what=project) as lock:
        code = run_group(
            [sys.executable, "-m", "sceneexpander.pipeline", *sys.argv[1:]],
            cwd=project,
            env=pipeline_environment(project, project) | {AGAIN_ENV: "make repro"},
            held=(lock.descriptor,),
        )
    if code:
        require_room(project)
        print(f"error: the pipeline is not up to date (exit code {code}); the lines above say why", file=sys.stderr)
        raise SystemExit(1)


if __name__ == "__main__":
    main()
