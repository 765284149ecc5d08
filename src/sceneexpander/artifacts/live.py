"""The log of a running adaptation: one JSON object per line, appended while it runs, so that a killed run keeps what it knew."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sceneexpander.artifacts.store import to_plain

LOG_NAME = "log.jsonl"


class LiveLog:
    """Writes the log of one run into a folder of its own. A resumed run starts the file anew and repeats what it knows.

    Every line has a ``kind``: ``run`` (facts, first), ``step``, ``look`` (see `sceneexpander.adaptation.observe`), ``end`` (last).
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = (folder / LOG_NAME).open("w", encoding="utf-8")
        self.write("run", {**facts, "started": time.time()})

    def write(self, kind: str, values: object) -> None:
        """Append one line; it is on its way to the disk when this returns."""
        self._file.write(json.dumps({"kind": kind, **to_plain(values)}, allow_nan=False, ensure_ascii=False) + "\n")
        self._file.flush()

    def end(self, values: Mapping[str, Any]) -> None:
        """Append the last line and close."""
        self.write("end", values)
        self._file.close()


def read_live(folder: Path) -> Iterator[dict[str, Any]]:
    """The whole lines of a log so far. What is being written, and what a killed run left half, is skipped."""
    path = folder / LOG_NAME
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
        if not line.endswith("\n"):
            return
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            return
