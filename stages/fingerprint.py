"""code: the hash of what each stage's program consists of, so that a stage reruns when its code means something else."""

from __future__ import annotations

from pathlib import Path

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.fingerprint import SourceTree
from stages import layout
from stages.runner import Cell, stage

NOT_STAGES = frozenset({"__init__", "layout", "runner", "rounds", "fingerprint", "check"})


def stage_names(folder: Path) -> list[str]:
    """Stages that have a file."""
    return sorted(path.stem for path in folder.glob("*.py") if path.stem not in NOT_STAGES)


@stage()
def main(_: Cell) -> None:
    """Write one hash per stage."""
    tree = SourceTree(packages={"sceneexpander": Path("src/sceneexpander"), "stages": Path("stages")})
    write_json_atomic(layout.CODE, {name: tree.fingerprint(f"stages.{name}") for name in stage_names(Path("stages"))})


if __name__ == "__main__":
    main()
