"""The table that RealityCapture (RealityScan) exports as "Internal/External camera parameters": one CSV for all pictures.

Columns: ``name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2``, named in a line that starts with ``#``. What the angles mean is the
vendor's forum article "Registration export and camera orientations": the world has x to the east, y to the north and z up; at zero the
camera looks down, with the top of its picture to the north; heading turns it clockwise as seen from above, pitch lifts what it looks at
towards the top of its picture, roll is about the picture's upward axis. Lengths of the lens are as in the XMP files: f is that of a frame
36 mm wide, px and py are in units of the longer side, from the picture's middle.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.decode import read_picture_header
from sceneexpander.ingest.lens_models import Lens
from sceneexpander.ingest.sources.capture import Capture, Shot, name_some, number_array, rigid_pose
from sceneexpander.ingest.sources.photos import mask_of
from sceneexpander.ingest.sources.reality_capture import make_lens
from sceneexpander.ingest.survey import MASKS_FOLDER, list_pictures, natural_key
from sceneexpander.plainfiles import decode_text, read_plain_file

_LIMIT_BYTES = 16 * 2**20
_HEAD_BYTES = 4096
_POSITION, _ANGLES = ("x", "y", "alt"), ("heading", "pitch", "roll")
_LENS = ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_NORTH_UP_LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])  # camera from world at angles of zero


class RealityCaptureCsv:
    """A CSV file of cameras in a folder; pictures in ``images/`` or beside it."""

    title = "pictures with RealityCapture's camera parameters (CSV)"

    def detect(self, place: Path) -> bool:
        """Whether there is a CSV file with the columns of the table."""
        return place.is_dir() and any(_looks_right(path) for path in _csv_files(place))

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """All pictures; those that were registered have cameras."""
        path = next((path for path in _csv_files(place) if _looks_right(path)), None)
        if path is None:
            raise UserError("holds no CSV file of RealityCapture's cameras", where=place)
        cameras = _cameras(path)
        folder = place / "images" if (place / "images").is_dir() else place
        shots = []
        for picture in list_pictures(folder):
            camera = cameras.pop(picture.name, None)
            pose = lens = None
            if camera is not None:
                header = read_picture_header(picture, max_megapixels=config.max_megapixels, upright=False)
                where = f"{path}: {printable(picture.name)}"
                pose, lens = _pose(camera, where), _lens(camera, (header.height, header.width), where)
            mask = mask_of(picture.name, place / MASKS_FOLDER)
            shots.append(Shot(name=picture.name, picture=picture, lens=lens, world_from_cam=pose, mask=mask))
        left = [printable(name) for name in sorted(cameras, key=natural_key)]
        notes = (f"cameras of pictures that are not there: {name_some(left)}",) if left else ()
        return Capture(shots=tuple(shots), notes=notes, files=(path,), chosen=True)


def _csv_files(place: Path) -> list[Path]:
    return sorted(path for path in place.iterdir() if path.suffix.casefold() == ".csv" and path.is_file())


def _looks_right(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return False
    return any(_columns(line) is not None for line in decode_text(head, "replace").splitlines())


def _columns(line: str) -> list[str] | None:
    """The names of the columns, if the line is the one that names them."""
    names = [word.strip().casefold() for word in line.removeprefix("#").split(",")]
    return names if {"name", *_POSITION, *_ANGLES} <= set(names) else None


def _cameras(path: Path) -> dict[str, dict[str, float]]:
    """By picture the numbers of its row, by column."""
    try:
        lines = decode_text(read_plain_file(path, limit_bytes=_LIMIT_BYTES)).splitlines()
    except UnicodeDecodeError:
        raise UserError("is not UTF-8 or UTF-16 text", where=path) from None
    columns: list[str] | None = None
    cameras: dict[str, dict[str, float]] = {}
    for number, line in enumerate(lines, start=1):
        columns = columns or _columns(line)
        if not line.strip() or line.startswith("#") or _columns(line) is not None:
            continue
        where = f"{path}:{number}"
        if columns is None:
            raise UserError("has a row before the line that names its columns", where=where)
        try:
            words = next(csv.reader([line], strict=True))
        except (csv.Error, StopIteration):
            raise UserError("is not a row of a CSV table", where=where) from None
        if len(words) != len(columns):
            raise UserError(f"has {len(words)} values for {len(columns)} columns", where=where)
        row = dict(zip(columns, words, strict=True))
        name = row["name"].strip().replace("\\", "/").rpartition("/")[2]
        if name in cameras:
            raise UserError(f"names {printable(name)} a second time", where=where)
        given = [column for column in (*_POSITION, *_ANGLES, *_LENS) if column in row]
        try:
            values = [float(row[column]) for column in given]
        except ValueError:
            raise UserError("has something else where a number is expected", where=where) from None
        cameras[name] = dict(zip(given, number_array(values, where).tolist(), strict=True))
    return cameras


def _pose(camera: dict[str, float], where: str) -> Float[np.ndarray, "4 4"]:
    heading, pitch, roll = np.radians([camera[name] for name in _ANGLES])
    about_camera = Rotation.from_rotvec([0, roll, 0]) * Rotation.from_rotvec([-pitch, 0, 0])
    about_up = Rotation.from_rotvec([0, 0, heading])
    pose = np.eye(4)
    pose[:3, :3] = (about_camera.as_matrix() @ _NORTH_UP_LOOKING_DOWN @ about_up.as_matrix()).T
    pose[:3, 3] = [camera[name] for name in _POSITION]
    return rigid_pose(pose, where)


def _lens(camera: dict[str, float], size: tuple[int, int], where: str) -> Lens | None:
    if "f" not in camera:
        return None
    radial = (camera.get("k1", 0.0), camera.get("k2", 0.0), camera.get("k3", 0.0))
    # Of the vendor's models only that of divisions has one coefficient; the file does not say which model it is.
    unknown = radial[0] != 0 and not any(radial[1:])
    if unknown or any(camera.get(name, 0.0) for name in ("k4", "t1", "t2")):
        fix = "register with the model Brown3, or export undistorted pictures"
        raise UserError("has a distortion that is not read here", where=where, fix=fix)
    return make_lens(camera["f"], (camera.get("px", 0.0), camera.get("py", 0.0)), radial, size, where)
