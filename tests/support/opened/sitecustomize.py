"""Imported by Python itself where this folder is on its path: notes which files a stage of a test's pipeline reads."""

import atexit
import os
import sys
from pathlib import Path
from typing import Any

FOLDER = os.environ.get("OPENED_FOLDER")  # where the notes go
STAGE = os.environ.get("DVC_STAGE")  # set by DVC for the commands that it runs
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT

if FOLDER and STAGE:
    opened: set[str] = set()

    def note(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike) and not arguments[2] & WRITING:
            path = os.path.abspath(os.fsdecode(arguments[0]))
            if os.path.isfile(path):  # not a folder, nor a name below an open one
                opened.add(path)

    sys.addaudithook(note)
    atexit.register(lambda: Path(FOLDER, STAGE).write_text("\n".join(sorted(opened))))
