"""What captures come in, by name. A new kind is a file here and a line in `SOURCES`; nothing else knows it.

``scene.yaml`` selects one by ``source: NAME``; ``auto`` takes the first that recognises the data, in the order of `SOURCES`.
"""

from __future__ import annotations

from pathlib import Path

from sceneexpander.errors import UserError, did_you_mean
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.formats import kind_of_file, name_of_content, read_head, sniff_format
from sceneexpander.ingest.sources.camera_files import CameraParams, CameraTexts, SevenScenes
from sceneexpander.ingest.sources.capture import Capture, Shot, Source
from sceneexpander.ingest.sources.colmap import ColmapModel
from sceneexpander.ingest.sources.metashape import MetashapeCameras
from sceneexpander.ingest.sources.photos import PhotoFolder
from sceneexpander.ingest.sources.posed import PosedPhotos
from sceneexpander.ingest.sources.reality_capture import RealityCaptureXmp
from sceneexpander.ingest.sources.transforms import Transforms
from sceneexpander.ingest.sources.video import Video

AUTO = "auto"
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
    capture = SOURCES[find_source(place, name, where=where)].read(place, config)
    return capture.thinned(config.max_views)
