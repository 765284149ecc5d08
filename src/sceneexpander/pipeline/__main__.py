"""``python -m sceneexpander.pipeline``: ``dvc repro`` in the current folder, wherever that folder is."""

from __future__ import annotations

import sys

from sceneexpander.errors import interruptible
from sceneexpander.pipeline.recording import ask_for_recording


def main() -> None:
    """Reproduce with DVC's own command line; its exit code is this program's."""
    interruptible()
    from sceneexpander.pipeline import dvc_adapter

    ask_for_recording()
    sys.exit(dvc_adapter.reproduce(sys.argv[1:]))


if __name__ == "__main__":
    main()
