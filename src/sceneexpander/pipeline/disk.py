"""Folders of the pipeline on a disk: deleting them whatever their permissions say, and whether there is room."""

from __future__ import annotations

import shutil
import stat
from pathlib import Path

from sceneexpander.errors import UserError
from sceneexpander.pipeline.project import find_project

_LITTLE_BYTES = 1 << 20  # a disk with less than that is full


def make_writable(folder: Path) -> None:
    """Let the user write into a folder and all that is in it."""
    for path in (folder, *folder.rglob("*")):
        if not path.is_symlink():
            needed = stat.S_IRWXU if path.is_dir() else stat.S_IRUSR | stat.S_IWUSR
            if path.stat().st_mode & needed != needed:
                path.chmod(path.stat().st_mode | needed)


def remove_tree(folder: Path) -> None:
    """Delete a folder that may not exist, whatever its permissions say. Raises `OSError` if it cannot be deleted."""
    if folder.is_symlink() or folder.is_file():
        folder.unlink()
    elif folder.exists():
        make_writable(folder)
        shutil.rmtree(folder)


def require_room(folder: Path) -> None:
    """Raise `UserError` if there is next to no room left on the disk of a pipeline folder or of its cache."""
    project = find_project()
    for place in (folder, project / ".dvc" / "cache"):
        if place.exists() and shutil.disk_usage(place).free < _LITTLE_BYTES:
            fix = "make room and start the same command again, it goes on with what is missing"
            raise UserError("No space left on device", where=place, fix=fix)
