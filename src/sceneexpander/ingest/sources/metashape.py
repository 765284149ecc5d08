"""Cameras that Agisoft Metashape exports ("Export Cameras", XML), beside their pictures.

Format: Metashape Professional manual, appendix "Camera models"; the XML's elements name themselves. Transforms are camera-to-chunk with
OpenCV axes; f in pixels, cx and cy from the picture's middle; radial k1 to k3 as OpenCV, p1 and p2 in the opposite order.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.lens_models import Lens
from sceneexpander.ingest.sources.capture import Capture, Shot, named, number_array, rigid_pose
from sceneexpander.ingest.sources.photos import mask_of
from sceneexpander.ingest.survey import MASKS_FOLDER, list_pictures, natural_key
from sceneexpander.plainfiles import read_plain_file

_LIMIT_BYTES = 64 * 2**20
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
        scale = _scale(chunk, path)
        shots = []
        for picture in list_pictures(folder):
            label = picture.name if picture.name in cameras else picture.stem
            camera = cameras.pop(label, None)
            pose = None if camera is None else _pose(camera, scale, path)
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
        notes = (f"cameras of pictures that are not there: {named(left)}",) if left else ()
        return Capture(shots=tuple(shots), notes=notes, files=(path,), metric=scale is not None, chosen=True)


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
    data = read_plain_file(path, limit_bytes=_LIMIT_BYTES)
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise UserError("defines entities, which no file of Metashape does", where=path)
    try:
        root = ElementTree.fromstring(data)  # noqa: S314
    except (ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise UserError(f"is not valid XML ({' '.join(str(error).split())[:80]})", where=path) from None
    chunk = root.find("chunk")
    if chunk is None:
        raise UserError("has no chunk of cameras", where=path)
    return chunk


def _floats(text: str | None, count: int, where: str | Path) -> Float[np.ndarray, " number"]:
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count:
        raise UserError(f"has no {count} numbers where they are expected", where=where)
    return number_array(values, where)


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
    width, height = (_floats(resolution.get(side), 1, where)[0] for side in ("width", "height"))
    values = dict.fromkeys(_READ, 0.0)
    for element in calibration:
        if element.tag in _READ:
            values[element.tag] = float(_floats(element.text, 1, where)[0])
        elif element.tag in ("k4", "b1", "b2", "p3", "p4") and float(_floats(element.text, 1, where)[0]) != 0:
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


def _scale(chunk: ElementTree.Element, path: Path) -> float | None:
    """Metres per unit of the chunk; None if it has no scale of its own."""
    scale = chunk.find("transform/scale")
    if scale is None:
        return None
    value = float(_floats(scale.text, 1, path)[0])
    if not 0 < value < 1e9:
        raise UserError(f"has the scale {value:g}", where=path)
    return value


def _pose(camera: ElementTree.Element, scale: float | None, path: Path) -> Float[np.ndarray, "4 4"] | None:
    transform = camera.find("transform")
    if transform is None or camera.get("enabled") in ("0", "false"):
        return None
    where = f"{path}: camera {printable(camera.get('label', ''))}"
    pose = rigid_pose(_floats(transform.text, 16, where).reshape(4, 4), where)
    pose[:3, 3] *= scale or 1.0
    return pose
