"""code: the hash of what each stage's program consists of, so that a stage reruns when its code or environment is another."""

from __future__ import annotations

from pathlib import Path

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.pipeline.environment import find_environment
from sceneexpander.pipeline.fingerprint import SourceTree
from stages import layout
from stages.runner import Cell, stage

NOT_STAGES = frozenset({"__init__", "layout", "runner", "machine", "rounds", "fingerprint", "check"})


def stage_names(folder: Path) -> list[str]:
    """Stages that have a file."""
    return sorted(path.stem for path in folder.glob("*.py") if path.stem not in NOT_STAGES)


@stage()
def main(_: Cell) -> None:
    """Write the environment, and one hash per stage of its code in it."""
    environment = find_environment(Path())
    tree = SourceTree(packages={"sceneexpander": Path("src/sceneexpander"), "stages": Path("stages")})
    names = stage_names(Path("stages"))
    write_json_atomic(layout.ENVIRONMENT, environment)
    write_json_atomic(layout.CODE, {name: environment.identify(tree, f"stages.{name}") for name in names})


if __name__ == "__main__":
    main()
