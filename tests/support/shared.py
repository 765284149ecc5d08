"""Where the recorded fixtures lie."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ABSENT = "recorded fixtures are absent"  # what the summary of the tests counts


def shared_folder(name: str) -> Path:
    """A folder of recorded fixtures or specifications; skips the test where it is absent.

    The root is ``SCENEEXPANDER_SHARED``, by default ``shared`` beside the repository.
    """
    root = Path(os.environ.get("SCENEEXPANDER_SHARED", Path(__file__).resolve().parents[2].parent / "shared"))
    folder = root / name
    if not folder.exists():
        pytest.skip(f"{ABSENT}: {name} (set SCENEEXPANDER_SHARED)")
    return folder
