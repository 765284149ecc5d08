"""Which files of a scene folder the pipeline needs, and names that are safe everywhere."""

from __future__ import annotations

import logging
import re
import unicodedata
from pathlib import Path

from sceneexpander.errors import UserError
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.links import require_inside
from sceneexpander.ingest.scene_file import SCENE_FILE, SceneFile, read_scene_file
from sceneexpander.ingest.sources import Capture, read_capture
from sceneexpander.ingest.survey import list_pictures, require_text_name
from sceneexpander.plainfiles import list_folder, require_plain_file

logger = logging.getLogger(__name__)

TRUTH_FOLDER = "truth"
_SAFE_LENGTH = 48
_MOST_TRUTH_FILES = 1000


def scene_files(folder: Path) -> list[Path]:
    """Every file of a scene folder that the pipeline needs: what a copy of the scene must hold, and all that it needs to.

    These are ``scene.yaml``, the captured photos, the pictures to insert (with all candidates) and everything below ``truth/``. Paths
    start with ``folder``; links are followed only where `sceneexpander.ingest.links` allows it, and each path leads to a plain file.
    Files beside the photos that are none are logged: a copy does not hold them, so nobody will notice them later.

    Raises:
        UserError: one line about a file that is missing, leads out of the folder or is no plain file, or what is wrong in ``scene.yaml``.
    """
    facts = read_scene_file(folder)
    capture = read_scene_capture(folder, facts, IngestConfig())
    for note in capture.notes:
        logger.warning("%s", note)
    files = [folder / SCENE_FILE, *capture.all_files]
    for spec in facts.rounds:
        if spec.inserted is not None:
            target = folder / spec.inserted
            files += list_pictures(target, inside=folder) if target.is_dir() else [target]
    truth = folder / TRUTH_FOLDER
    if truth.is_dir():
        files += _truth_files(require_inside(truth, folder), folder)
    for path in files:
        require_plain_file(require_inside(path, folder))
        require_text_name(path)
    return list(dict.fromkeys(files))


def read_scene_capture(folder: Path, facts: SceneFile, config: IngestConfig) -> Capture:
    """The capture of a scene folder, whose files all stay inside it.

    Raises:
        UserError: it cannot be used, or names a file that leads out of the folder.
    """
    place = require_inside(folder / facts.images, folder, where=f"{folder / SCENE_FILE}: 'images'")
    capture = read_capture(place, config, facts.source, where=f"{folder / SCENE_FILE}: 'source'")
    for path in capture.all_files:
        require_inside(path, folder)
    return capture


def _truth_files(truth: Path, folder: Path) -> list[Path]:
    found: list[Path] = []
    waiting = [truth]
    while waiting:
        for path in list_folder(waiting.pop()):
            if path.name.startswith("."):
                continue
            require_inside(path, folder)
            if path.is_dir() and not path.is_symlink():
                waiting.append(path)
            else:
                found.append(path)
        if len(found) + len(waiting) > _MOST_TRUTH_FILES:
            raise UserError(f"holds more than {_MOST_TRUTH_FILES} files", where=truth)
    return sorted(found)


def safe_name(text: str, *, fallback: str = "view") -> str:
    """``text`` reduced to letters, digits, ``.``, ``_`` and ``-`` (ASCII), not starting with a dot or a dash."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    slug = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9._-]", "_", plain)).strip("._-")
    return slug[:_SAFE_LENGTH].rstrip("._-") or fallback
