"""Folders of pictures with one small file of cameras, or one per picture: 7-Scenes, OmniVGGT's folders, WorldMirror's priors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.depth_files import DepthFile, depth_file
from sceneexpander.ingest.jsonfile import read_user_json
from sceneexpander.ingest.lens_models import Lens
from sceneexpander.ingest.sources.capture import Capture, Shot, name_some, number_array, rigid_pose
from sceneexpander.ingest.sources.photos import mask_of
from sceneexpander.ingest.survey import MASKS_FOLDER, list_pictures, natural_key
from sceneexpander.plainfiles import decode_text, read_plain_file

_LIMIT_BYTES = 2**20
_MILLIMETRES = 0.001
_SEVEN_SCENES = re.compile(r"(frame-\d{6})\.color\.(?:png|jpe?g)", re.IGNORECASE)
_PARAMS_FILE = "camera_params.json"
_DEPTH_FOLDERS = ("prior_depth", "depths", "depth")


class SevenScenes:
    """``frame-000000.color.png`` and ``.pose.txt``, as in the 7-Scenes data set (one ``seq-XX`` folder).

    The data set's page says that colour and depth camera are not calibrated to each other, and names a focal length for the depth camera
    only: the colour pictures' is estimated, and the depth is not used.
    """

    title = "frames of 7-Scenes (one sequence)"

    def detect(self, place: Path) -> bool:
        """Whether a colour frame with its pose is there."""
        return place.is_dir() and any(_pose_file(path).is_file() for path in _colour_frames(place))

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """All frames; some may have no pose. Recordings of this form write numbers that are not finite where tracking was lost."""
        shots, files, lost = [], [], []
        for path in _colour_frames(place):
            pose_file = _pose_file(path)
            pose = None
            if pose_file.is_file():
                values = _numbers(pose_file, (12, 16), finite=False)
                if np.isfinite(values).all():
                    pose = rigid_pose(values.reshape(-1, 4), pose_file)
                else:
                    lost.append(path.name)
                files.append(pose_file)
            shots.append(Shot(name=path.name, picture=path, world_from_cam=pose))
        if not shots:
            raise UserError("holds no frame-XXXXXX.color.png", where=place)
        notes = (f"frames whose pose is not finite are taken without one: {name_some(lost)}",) if lost else ()
        return Capture(shots=tuple(shots), notes=notes, files=tuple(files), metric=True, chosen=True)


def _colour_frames(place: Path) -> list[Path]:
    found = [path for path in place.iterdir() if _SEVEN_SCENES.fullmatch(path.name)]
    return sorted(found, key=lambda path: natural_key(path.name))


def _pose_file(colour: Path) -> Path:
    return colour.with_name(f"{colour.name.split('.')[0]}.pose.txt")


class CameraTexts:
    """OmniVGGT's folders: ``images/``, ``cameras/NAME.txt`` for any of them (3x4 camera-to-world, then 3x3 intrinsics), ``depths/``."""

    title = "images/ with cameras/NAME.txt"

    def detect(self, place: Path) -> bool:
        """Whether both folders are there, and a text file in the second."""
        folders = (place / "images").is_dir() and (place / "cameras").is_dir()
        return folders and any(path.suffix == ".txt" for path in (place / "cameras").iterdir())

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """All pictures; those with a text file have a camera."""
        pictures = list_pictures(place / "images")
        known = {path.stem: path for path in (place / "cameras").iterdir() if path.suffix == ".txt"}
        shots, files = [], []
        for path in pictures:
            pose, lens, file = None, None, known.pop(path.stem, None)
            if file is not None:
                files.append(file)
                values = _numbers(file, (21,))
                pose, lens = rigid_pose(values[:12].reshape(3, 4), file), _lens(values[12:].reshape(3, 3), file)
            shots.append(
                Shot(
                    name=path.name,
                    picture=path,
                    lens=lens,
                    world_from_cam=pose,
                    mask=mask_of(path.name, place / MASKS_FOLDER),
                    depth=_depth_of(path.stem, place, ("depths", "depth")),
                )
            )
        notes = (
            (f"cameras of pictures that are not there: {name_some([printable(name) for name in known])}",)
            if known
            else ()
        )
        return Capture(shots=tuple(shots), notes=notes, files=tuple(files), chosen=True)


class CameraParams:
    """Pictures (in ``images/`` or beside the file) with WorldMirror's ``camera_params.json`` and a folder of depth maps.

    Format: documentation of HY-World 2.0, "Prior Injection": camera-to-world, OpenCV axes, intrinsics at the pictures' own size; a camera
    is named by the picture's place in the order of names, or by its name without the ending.
    """

    title = "pictures with camera_params.json"

    def detect(self, place: Path) -> bool:
        """Whether the file is there."""
        return (place / _PARAMS_FILE).is_file()

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """All pictures; those that the file names have a pose, intrinsics or both."""
        path = place / _PARAMS_FILE
        content = read_user_json(path)
        pictures = list_pictures(place / "images" if (place / "images").is_dir() else place)
        poses, intrinsics = (_matrices(content, key, path) for key in ("extrinsics", "intrinsics"))
        names = {str(index): picture.stem for index, picture in enumerate(pictures)}
        stems = {picture.stem for picture in pictures}
        for key in (*poses, *intrinsics):
            if key not in stems and key not in names:
                raise UserError(f"names the camera {printable(key[:60])}, which no picture has", where=path)
        shots = []
        for index, picture in enumerate(pictures):
            pose = poses.get(picture.stem, poses.get(str(index)))
            matrix = intrinsics.get(picture.stem, intrinsics.get(str(index)))
            shots.append(
                Shot(
                    name=picture.name,
                    picture=picture,
                    lens=None if matrix is None else _lens(matrix, path),
                    world_from_cam=None if pose is None else rigid_pose(pose, path),
                    mask=mask_of(picture.name, place / MASKS_FOLDER),
                    depth=_depth_of(picture.stem, place, _DEPTH_FOLDERS),
                )
            )
        return Capture(shots=tuple(shots), files=(path,), chosen=True)


def _matrices(content: dict[str, Any], key: str, path: Path) -> dict[str, np.ndarray]:
    entries = content.get(key) or []
    if not isinstance(entries, list):
        raise UserError(f"{key!r} is no list", where=path)
    found = {}
    for entry in entries:
        if not isinstance(entry, dict) or not isinstance(entry.get("camera_id"), (int, str)):
            raise UserError(f"{key!r} holds something else than camera_id and matrix", where=path)
        found[str(entry["camera_id"])] = number_array(entry.get("matrix"), f"{path}: {key}")
    return found


def _lens(matrix: np.ndarray, where: Path) -> Lens:
    if matrix.shape != (3, 3) or np.abs(matrix[[1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1]).max() > 1e-6:
        raise UserError("holds intrinsics that are not fx 0 cx, 0 fy cy, 0 0 1", where=where)
    fx, fy, cx, cy = (float(value) for value in matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
    try:
        return Lens(focal_px=(fx, fy), centre_px=(cx, cy))
    except UserError as error:
        raise UserError(f"has a camera that {error.problem}", where=where) from None


def _depth_of(stem: str, place: Path, folders: tuple[str, ...]) -> DepthFile | None:
    for folder in folders:
        for ending in (".npy", ".png"):
            path = place / folder / f"{stem}{ending}"
            if path.is_file():
                return depth_file(path, unit=_MILLIMETRES)
    return None


def _numbers(path: Path, counts: tuple[int, ...], *, finite: bool = True) -> np.ndarray:
    """All numbers of a small text file. Raises `UserError` unless it holds as many of them as one of ``counts``, and ``finite`` ones."""
    try:
        words = decode_text(read_plain_file(path, limit_bytes=_LIMIT_BYTES)).split()
        numbers = [float(word) for word in words]
        values = number_array(numbers, path) if finite else np.asarray(numbers)
    except ValueError:
        raise UserError("holds something else where a number is expected", where=path) from None
    if values.size not in counts:
        expected = " or ".join(map(str, counts))
        raise UserError(f"holds {values.size} numbers, one camera has {expected} here", where=path)
    return values
