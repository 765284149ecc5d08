"""Imported by Python itself where this folder is on its path: notes which files a stage of a test's pipeline reads."""

import atexit
import os
import sys
from pathlib import Path
from typing import Any

FOLDER = os.environ.get("OPENED_FOLDER")  # where the notes go
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
opened: set[str] = set()


def note(event: str, arguments: tuple[Any, ...]) -> None:
    """Of a file that is opened for reading."""
    if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike) and not arguments[2] & WRITING:
        path = os.path.abspath(os.fsdecode(arguments[0]))
        if os.path.isfile(path):  # not a folder, nor a name below an open one
            opened.add(path)


def write() -> None:
    """What has been noted, if this process is a stage's: an interpreter of its own, or forked."""
    stage = os.environ.get("DVC_STAGE")
    if stage:
        Path(FOLDER or "", stage).write_text("\n".join(sorted(opened)))


if FOLDER:
    sys.addaudithook(note)
    os.register_at_fork(after_in_child=opened.clear)
    atexit.register(write)
