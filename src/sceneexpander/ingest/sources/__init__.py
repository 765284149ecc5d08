"""What captures come in, by name. A new kind is a file here and a line in `SOURCES`; nothing else knows it.

``scene.yaml`` selects one by ``source: NAME``; ``auto`` takes the first that recognises the data, in the order of `SOURCES`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

from sceneexpander.errors import UserError, did_you_mean, printable
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.formats import kind_of_file, name_of_content, read_head, sniff_format
from sceneexpander.ingest.sources.camera_files import CameraParams, CameraTexts, SevenScenes
from sceneexpander.ingest.sources.capture import Capture, Shot, Source, name_some
from sceneexpander.ingest.sources.colmap import ColmapModel
from sceneexpander.ingest.sources.metashape import MetashapeCameras
from sceneexpander.ingest.sources.photos import PhotoFolder
from sceneexpander.ingest.sources.posed import PosedPhotos
from sceneexpander.ingest.sources.reality_capture import RealityCaptureXmp
from sceneexpander.ingest.sources.reality_capture_csv import RealityCaptureCsv
from sceneexpander.ingest.sources.transforms import Transforms
from sceneexpander.ingest.sources.video import Video
from sceneexpander.ingest.survey import MASKS_FOLDER, NoPicturesError, natural_key
from sceneexpander.plainfiles import list_folder

AUTO = "auto"
_MOST_LOOKED_AT = 200  # folders in search of captures, masks that belong to nothing
# The kinds with cameras come before the photo folder, which takes every folder.
SOURCES: dict[str, Source] = {
    "posed": PosedPhotos(),
    "colmap": ColmapModel(),
    "transforms": Transforms(),
    "seven_scenes": SevenScenes(),
    "camera_texts": CameraTexts(),
    "camera_params": CameraParams(),
    "metashape": MetashapeCameras(),
    "reality_capture": RealityCaptureXmp(),
    "reality_capture_csv": RealityCaptureCsv(),
    "video": Video(),
    "photos": PhotoFolder(),
}

__all__ = ["AUTO", "SOURCES", "Capture", "Shot", "Source", "find_source", "read_capture"]


def find_source(place: Path, name: str = AUTO, *, where: str | Path = "source") -> str:
    """The name of the source that ``place`` is read by: ``name`` itself, or for ``auto`` what it looks like.

    Raises:
        UserError: there is no such source, or none recognises a file; folders are at least folders of photos.
    """
    if name != AUTO:
        if name not in SOURCES:
            raise UserError(
                f"unknown source {name!r}",
                where=where,
                fix=f"{did_you_mean(name, (AUTO, *SOURCES))} (where data is from is 'origin:')",
            )
        return name
    found = next((known for known, source in SOURCES.items() if source.detect(place)), None)
    if found is None:
        head = read_head(place)
        if sniff_format(head):
            raise UserError("is one picture", where=place, fix="give the folder that the photos are in")
        content, ending = name_of_content(head) or "", kind_of_file(place.suffix[1:].casefold())
        if content.endswith("archive"):
            fix = "unpack it and give the folder; 'sceneexpander expand' takes ZIP archives"
            raise UserError(f"is {content}", where=place, fix=fix)
        if ending.endswith("archive"):
            raise UserError(f"is not {ending}, as its name says", where=place, fix="save or download it again")
        kinds = ", ".join(source.title for source in SOURCES.values())
        raise UserError("is no capture that can be read", where=place, fix=f"give one of: {kinds}")
    return found


def read_capture(place: Path, config: IngestConfig, name: str = AUTO, *, where: str | Path = "source") -> Capture:
    """The capture at ``place``, a file or folder, read by the source of that name (see `find_source`).

    Raises:
        UserError: one line about what cannot be used.
    """
    source = SOURCES[find_source(place, name, where=where)]
    try:
        capture = source.read(place, config)
    except NoPicturesError:
        below = _captures_below(place)
        if not below:
            raise
        problem = f"holds no pictures itself, but captures in folders of their own: {name_some(below)}"
        raise NoPicturesError(problem, where=place, fix="pass one of these folders") from None
    unused = _masks_of_nothing(place, capture)
    if unused:
        capture = replace(capture, notes=(*capture.notes, f"masks of no picture that is used: {name_some(unused)}"))
    return capture.thinned(config.max_views)


def _masks_of_nothing(place: Path, capture: Capture) -> list[str]:
    """Names of the masks beside pictures that belong to none of them."""
    used = {shot.mask for shot in capture.shots}
    folder = place / MASKS_FOLDER
    found = (path for path in folder.rglob("*.png") if path not in used and not path.name.startswith("."))
    names = (printable(path.relative_to(folder).as_posix()) for path in islice(found, _MOST_LOOKED_AT))
    return sorted(names, key=natural_key)


def _captures_below(place: Path) -> list[str]:
    """The folders directly in ``place`` that are more than folders of photos, and what they are."""
    found = []
    for folder in sorted(list_folder(place), key=lambda path: natural_key(path.name))[:_MOST_LOOKED_AT]:
        if folder.is_dir() and not folder.is_symlink():
            kind = find_source(folder)
            if kind != "photos":
                found.append(f"{printable(folder.name)} ({SOURCES[kind].title})")
    return found
