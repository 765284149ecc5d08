"""Cameras that Agisoft Metashape exports ("Export Cameras", XML), beside their pictures.

Format: Metashape Professional manual, appendix "Camera models"; the XML's elements name themselves. Transforms are camera-to-chunk with
OpenCV axes; f in pixels, cx and cy from the picture's middle; radial k1 to k3 as OpenCV, p1 and p2 in the opposite order. The chunk's own
transform (rotation, translation, scale) leads from there to the world, in metres; where it has one, that is the capture's world.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.lens_models import Lens
from sceneexpander.ingest.sources.capture import Capture, Shot, name_some, rigid_pose
from sceneexpander.ingest.sources.photos import mask_of
from sceneexpander.ingest.survey import MASKS_FOLDER, list_pictures, natural_key
from sceneexpander.ingest.xmlfile import numbers_of, read_user_xml

_FARTHEST_M = 1e5  # origins beyond it are the Earth's centre, and leave nothing of single precision
_READ = {"f", "cx", "cy", "k1", "k2", "k3", "p1", "p2"}


class MetashapeCameras:
    """An XML file with a ``chunk`` of cameras in a folder; pictures in ``images/`` or beside it."""

    title = "pictures with Metashape's cameras (XML)"

    def detect(self, place: Path) -> bool:
        """Whether there is an XML file that begins like one of Metashape's."""
        return place.is_dir() and any(_looks_right(path) for path in _xml_files(place))

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """All pictures; those that were aligned have cameras."""
        path = next((path for path in _xml_files(place) if _looks_right(path)), None)
        if path is None:
            raise UserError("holds no XML file of Metashape's cameras", where=place)
        chunk = _parsed(path)
        folder = place / "images" if (place / "images").is_dir() else place
        lenses = {sensor.get("id", ""): _lens(sensor, path) for sensor in chunk.iterfind("sensors/sensor")}
        cameras = {camera.get("label", ""): camera for camera in chunk.iter("camera")}
        world = _world(chunk, path)
        shots = []
        for picture in list_pictures(folder):
            label = picture.name if picture.name in cameras else picture.stem
            camera = cameras.pop(label, None)
            pose = None if camera is None else _pose(camera, world, path)
            shots.append(
                Shot(
                    name=picture.name,
                    picture=picture,
                    lens=None if camera is None else lenses.get(camera.get("sensor_id", "")),
                    world_from_cam=pose,
                    mask=mask_of(picture.name, place / MASKS_FOLDER),
                )
            )
        left = [printable(label) for label in sorted(cameras, key=natural_key)]
        notes = [f"cameras of pictures that are not there: {name_some(left)}"] if left else []
        if world is not None and world.moved:
            notes.append(f"{path.name}: is placed on the Earth; the axes are kept, the origin is the chunk's own")
        return Capture(shots=tuple(shots), notes=tuple(notes), files=(path,), metric=world is not None, chosen=True)


def _xml_files(place: Path) -> list[Path]:
    return sorted(path for path in place.iterdir() if path.suffix.casefold() == ".xml" and path.is_file())


def _looks_right(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(2000)
    except OSError:
        return False
    return b"<document" in head and b"<chunk" in head


def _parsed(path: Path) -> ElementTree.Element:
    chunk = read_user_xml(path).find("chunk")
    if chunk is None:
        raise UserError("has no chunk of cameras", where=path)
    return chunk


def _lens(sensor: ElementTree.Element, path: Path) -> Lens | None:
    where = f"{path}: sensor {printable(sensor.get('id', ''))}"
    calibrations = [found for found in sensor.iterfind("calibration") if found.get("class") != "initial"]
    calibration = calibrations[-1] if calibrations else None
    if calibration is None:
        return None
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind != "frame":
        raise UserError(f"is of the type {printable(kind[:40])}, only frame cameras are read", where=where)
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise UserError("has no resolution", where=where)
    width, height = (numbers_of(resolution.get(side), 1, where)[0] for side in ("width", "height"))
    values = dict.fromkeys(_READ, 0.0)
    for element in calibration:
        if element.tag in _READ:
            values[element.tag] = float(numbers_of(element.text, 1, where)[0])
        elif element.tag in ("k4", "b1", "b2", "p3", "p4") and float(numbers_of(element.text, 1, where)[0]) != 0:
            problem = f"has the coefficient {element.tag}, which is not read here"
            raise UserError(problem, where=where, fix="undistort the pictures in Metashape, or calibrate without it")
    # Metashape's p1 belongs to x, OpenCV's to y.
    distortion = (values["k1"], values["k2"], values["p2"], values["p1"], values["k3"])
    try:
        return Lens(
            focal_px=(values["f"], values["f"]),
            centre_px=(float(width) / 2 + values["cx"], float(height) / 2 + values["cy"]),
            size=(int(height), int(width)),
            distortion=distortion if any(distortion) else (),
        )
    except UserError as error:
        raise UserError(f"has a camera that {error.problem}", where=where) from None


@dataclass(frozen=True, slots=True, kw_only=True)
class _World:
    """World from chunk: ``scale * rotation @ x + translation``. ``moved``: a translation that was left out, see `_FARTHEST_M`."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    scale: float
    moved: bool

    def pose(self, chunk_from_cam: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """World from camera, rigid: distances are scaled, the camera itself is not."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation @ chunk_from_cam[:3, :3]
        pose[:3, 3] = self.scale * self.rotation @ chunk_from_cam[:3, 3] + self.translation
        return pose


def _world(chunk: ElementTree.Element, path: Path) -> _World | None:
    """The chunk's transform; None if it has no scale, and so no world but its own."""
    transform = chunk.find("transform")
    if transform is None or transform.find("scale") is None:
        return None
    parts = {name: transform.find(name) for name in ("rotation", "translation", "scale")}
    where = f"{path}: transform of the chunk"
    texts = {name: None if part is None else part.text for name, part in parts.items()}
    scale = float(numbers_of(texts["scale"], 1, where)[0])
    if not 0 < scale < 1e9:
        raise UserError(f"has the scale {scale:g}", where=where)
    rotation = np.eye(3) if parts["rotation"] is None else numbers_of(texts["rotation"], 9, where).reshape(3, 3)
    translation = np.zeros(3) if parts["translation"] is None else numbers_of(texts["translation"], 3, where)
    rigid = rigid_pose(np.column_stack([rotation, np.zeros(3)]), where)
    moved = bool(np.abs(translation).max() > _FARTHEST_M)
    return _World(rotation=rigid[:3, :3], translation=np.zeros(3) if moved else translation, scale=scale, moved=moved)


def _pose(camera: ElementTree.Element, world: _World | None, path: Path) -> Float[np.ndarray, "4 4"] | None:
    transform = camera.find("transform")
    if transform is None or camera.get("enabled") in ("0", "false"):
        return None
    where = f"{path}: camera {printable(camera.get('label', ''))}"
    pose = rigid_pose(numbers_of(transform.text, 16, where).reshape(4, 4), where)
    return pose if world is None else world.pose(pose)
