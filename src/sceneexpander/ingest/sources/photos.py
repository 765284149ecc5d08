"""A folder of photos. Masks may lie beside them: ``masks/NAME.jpg.png`` (COLMAP's habit) or ``masks/NAME.png``."""

from __future__ import annotations

from pathlib import Path

from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.sources.capture import Capture, Shot
from sceneexpander.ingest.survey import MASKS_FOLDER, survey_pictures


class PhotoFolder:
    """The first and last of the sources: it takes every folder."""

    title = "a folder of photos"

    def detect(self, place: Path) -> bool:
        """Every folder."""
        return place.is_dir()

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """The pictures directly in the folder, in natural order."""
        survey = survey_pictures(place)
        masks = place / MASKS_FOLDER
        shots = tuple(Shot(name=path.name, picture=path, mask=mask_of(path.name, masks)) for path in survey.pictures)
        return Capture(shots=shots, notes=survey.notes)


def mask_of(name: str, folder: Path) -> Path | None:
    """The mask of a picture in a folder of masks; ``name`` may have sub-folders."""
    for candidate in (folder / f"{name}.png", (folder / name).with_suffix(".png")):
        if candidate.is_file():
            return candidate
    return None
