"""Methods that nobody asked for: the pipeline has stages for them all the same, and those need no process of their own.

Stages are fixed before the list in ``params.yaml`` is read, so there is one for every method that can be asked for. With fifty scenes
that is some hundred stages that would each start an interpreter to write one sentence.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.artifacts.unavailable import Unavailable
from sceneexpander.config.files import read_settings
from sceneexpander.errors import UserError
from sceneexpander.files import directory_being_written

METHODS_FILE = "methods.json"  # of a scene: for every method that is not always made, whether it is wanted
NOT_ASKED = "was not asked for"


def write_unasked(method: str, target: Path) -> None:
    """Say in the folder ``target`` of a method why there is no result."""
    with directory_being_written(target) as folder:
        Unavailable(method=method, model="", reason=NOT_ASKED).save(folder / "reconstruction")


def answer_unasked(parameters: Mapping[Path, Sequence[str]], outputs: Sequence[Path]) -> bool:
    """Make the outputs of a stage if it is one of a method that was not asked for; whether that was so.

    Args:
        parameters: keys that the stage reads, by file.
        outputs: a folder with the method's name, and a file of statistics.
    """
    named = [(path, keys) for path, keys in parameters.items() if path.name == METHODS_FILE]
    if len(named) != 1 or len(named[0][1]) != 1:
        return False
    path, (method,) = named[0]
    try:
        if read_settings(path)[method] is not False:
            return False
    except (UserError, KeyError, TypeError):
        return False  # the stage itself says what is wrong
    folders = [output for output in outputs if output.name == method]
    statistics = [output for output in outputs if output.suffix == ".json"]
    if [*folders, *statistics] != list(outputs) or len(folders) != 1:
        return False
    started = round(time.time(), 3)
    write_unasked(method, folders[0])
    for place in statistics:
        host = {"machine": platform.machine(), "cpus": os.cpu_count(), "torch": "not used"}
        write_json_atomic(place, {"started": started, "wall_s": 0.0, "cpu_s": 0.0, "peak_rss_mb": 0.0, "host": host})
    return True
