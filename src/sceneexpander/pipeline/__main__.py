"""``python -m sceneexpander.pipeline``: ``dvc repro`` in the current folder, wherever that folder is.

A stage that fails does not stop what does not need it, and what gathers all scenes goes on with those that are there.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from sceneexpander.errors import interruptible, printable
from sceneexpander.pipeline.declared import find_stale, read_pipeline
from sceneexpander.pipeline.disk import remove_tree
from sceneexpander.pipeline.recording import ask_for_recording

_MOST_SHOWN = 20  # failed stages by name
AGAIN_ENV = "SCENEEXPANDER_AGAIN"  # the command that the user gave, which does what is missing


def reproduce(arguments: Sequence[str], again: str) -> int:
    """``dvc repro --keep-going``; ``arguments`` are further ones. Says what failed and that ``again`` does only that.

    Returns:
        The exit code.
    """
    from sceneexpander.pipeline import dvc_adapter

    with dvc_adapter.noting_failures() as unfinished:
        code = dvc_adapter.reproduce(["--keep-going", *arguments])
    if not unfinished.failed:
        return code
    lost = {*unfinished.failed, *unfinished.left_out}
    stages = read_pipeline(Path())
    for path in find_stale(stages, lost):
        remove_tree(Path(path))
    gathering = [stage for stage in stages if stage.gathers and stage.address in unfinished.left_out]
    for stage in gathering:
        if all(Path(path).exists() for path in stage.reads) and not dvc_adapter.reproduce(
            ["--single-item", stage.address]
        ):
            lost.discard(stage.address)
    names = [shlex.quote(address) for address in unfinished.failed]
    more = f" and {len(names) - _MOST_SHOWN} more" if len(names) > _MOST_SHOWN else ""
    print(
        f"error: {len(names)} of {len(stages)} stages failed ({printable(' '.join(names[:_MOST_SHOWN]))}{more}), "
        f"{len(lost) - len(names)} were left out; again, only what is missing: {again}",
        file=sys.stderr,
    )
    return code


def main() -> None:
    """Options are those of ``dvc repro``."""
    interruptible()
    ask_for_recording()
    sys.exit(reproduce(sys.argv[1:], os.environ.get(AGAIN_ENV, "the same command")))


if __name__ == "__main__":
    main()
