"""``python -m sceneexpander.pipeline``: ``dvc repro`` in the current folder, wherever that folder is."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from sceneexpander.config.files import read_yaml
from sceneexpander.errors import interruptible
from sceneexpander.project import ROOT_ENV
from sceneexpander.tracking.store import database_path

RECORDED = Path("mlflow") / "tracked.json"  # what the last stage leaves: of every scene which runs are recorded


def take_any_path() -> None:
    """Let DVC work in folders with braces in their names: one of its progress bars takes the cache's path for a format.

    Does nothing where a later version of DVC has no such bar.
    """
    try:
        from dvc_data.hashfile._progress import QueryingProgress
    except ImportError:
        return
    bar: Any = QueryingProgress
    original = bar.__init__

    def escaped(self: Any, iterable: Any = None, total: Any = None, name: Any = None, phase: str = "Querying") -> None:
        shown = name.replace("{", "{{").replace("}", "}}") if isinstance(name, str) else name
        original(self, iterable, total=total, name=shown, phase=phase)

    bar.__init__ = escaped


def ask_for_recording() -> None:
    """Have the last stage run again if its recording did not succeed, or the local database with it is lost.

    Its inputs are the same, so DVC would leave it out.
    """
    try:
        recorded = json.loads(RECORDED.read_text(encoding="utf-8"))
        asked = None in recorded.values() or any(_database_is_lost(scene) for scene, keys in recorded.items() if keys)
    except (OSError, ValueError, AttributeError):
        return
    if asked:
        RECORDED.unlink()


def _database_is_lost(scene: str) -> bool:
    path = Path("outputs") / scene / "config.yaml"
    if not path.is_file() or database_path(Path(os.environ.get(ROOT_ENV, "."))).is_file():
        return False
    tracking = read_yaml(path)["tracking"]
    return tracking["uri"] == "local"


def main() -> None:
    """Reproduce with DVC's own command line; its exit code is this program's."""
    interruptible()
    from dvc.cli import main as dvc_main

    take_any_path()
    ask_for_recording()
    sys.exit(dvc_main(["repro", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
