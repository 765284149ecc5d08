"""``python -m sceneexpander.pipeline``: ``dvc repro`` in the current folder, wherever that folder is."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from sceneexpander.errors import interruptible

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
    """Have the last stage run again if its recording did not succeed: its inputs are the same, so DVC would leave it out."""
    try:
        failed = None in json.loads(RECORDED.read_text(encoding="utf-8")).values()
    except (OSError, ValueError, AttributeError):
        return
    if failed:
        RECORDED.unlink()


def main() -> None:
    """Reproduce with DVC's own command line; its exit code is this program's."""
    interruptible()
    from dvc.cli import main as dvc_main

    take_any_path()
    ask_for_recording()
    sys.exit(dvc_main(["repro", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
