"""COLMAP models, text and binary, and what comes in their form: ETH3D's scenes and nerfstudio's ``colmap/`` folders.

Format: https://colmap.github.io/format.html. Poses are cam_from_world, OpenCV axes; pixel centres are at .5, as everywhere here.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.depth_files import DepthFile, DepthFormat
from sceneexpander.ingest.lens_models import Lens, Projection
from sceneexpander.ingest.sources.capture import Capture, Shot, member, name_some, number_array, rigid_pose
from sceneexpander.ingest.sources.photos import mask_of
from sceneexpander.ingest.survey import MASKS_FOLDER, natural_key
from sceneexpander.plainfiles import decode_text, read_plain_file

_LIMIT_BYTES = 2 * 2**30  # images.bin lists every keypoint
_MODEL_FOLDERS = (
    "dslr_calibration_undistorted",
    "dslr_calibration_jpg",
    "sparse/0",
    "sparse",
    "colmap/sparse/0",
    "colmap/sparse",
    ".",
)
_PICTURE_FOLDERS = ("images", "input", "rgb", "images_2", "images_4", "images_8", ".")
_ETH3D_DEPTH = Path("ground_truth_depth") / "dslr_images"
_MOST_CAMERAS = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class _Model:
    """One of COLMAP's camera models: how its parameters become a `Lens` (``focals`` of them first, then cx, cy, then distortion)."""

    number: int
    parameters: int
    focals: int = 2
    projection: Projection | None = Projection.PINHOLE  # None: not read here


_MODELS = {
    "SIMPLE_PINHOLE": _Model(number=0, parameters=3, focals=1),
    "PINHOLE": _Model(number=1, parameters=4),
    "SIMPLE_RADIAL": _Model(number=2, parameters=4, focals=1),
    "RADIAL": _Model(number=3, parameters=5, focals=1),
    "OPENCV": _Model(number=4, parameters=8),
    "OPENCV_FISHEYE": _Model(number=5, parameters=8, projection=Projection.FISHEYE),
    "FULL_OPENCV": _Model(number=6, parameters=12),
    "FOV": _Model(number=7, parameters=5, projection=None),
    "SIMPLE_RADIAL_FISHEYE": _Model(number=8, parameters=4, focals=1, projection=Projection.FISHEYE),
    "RADIAL_FISHEYE": _Model(number=9, parameters=5, focals=1, projection=Projection.FISHEYE),
    "THIN_PRISM_FISHEYE": _Model(number=10, parameters=12, projection=Projection.THIN_PRISM_FISHEYE),
    "RAD_TAN_THIN_PRISM_FISHEYE": _Model(number=11, parameters=16, projection=None),
}
_NAMES = {model.number: name for name, model in _MODELS.items()}
_READ = [name for name, model in _MODELS.items() if model.projection is not None]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Image:
    """A line of images.txt."""

    name: str
    camera: int
    quat_wxyz: tuple[float, ...]
    translation: tuple[float, ...]

    def world_from_cam(self, where: Path) -> Float[np.ndarray, "4 4"]:
        w, x, y, z = number_array(self.quat_wxyz, where)
        length = np.sqrt(w * w + x * x + y * y + z * z)
        if not 1e-6 < length < 1e6:
            raise UserError(f"holds a quaternion of length {length:g} for {printable(self.name)}", where=where)
        w, x, y, z = (value / length for value in (w, x, y, z))
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        pose = np.eye(4)
        pose[:3, :3] = rotation.T
        pose[:3, 3] = -rotation.T @ number_array(self.translation, where)
        return rigid_pose(pose, where)


class ColmapModel:
    """A model beside its pictures: ``sparse/0`` and ``images``, or ETH3D's folders."""

    title = "a COLMAP model with its pictures"

    def detect(self, place: Path) -> bool:
        """Whether there is a model in one of the usual folders."""
        return place.is_dir() and (bool(_model_folders(place)) or _lone_part(place) is not None)

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """The pictures that the model has cameras of."""
        folders = _model_folders(place)
        if not folders:
            lone = _lone_part(place)
            if lone is not None:
                problem = "is one part of a model, whose other one (cameras or images, text or binary) is not beside it"
                raise UserError(problem, where=lone, fix="put both there")
            places = ", ".join(_MODEL_FOLDERS)
            raise UserError("holds no COLMAP model", where=place, fix=f"cameras and images are looked for in: {places}")
        folder, pictures, images = _best(place, folders)
        ending = _ending(folder)
        cameras_file, images_file = folder / f"cameras.{ending}", folder / f"images.{ending}"
        cameras = (_cameras_of_text if ending == "txt" else _cameras_of_binary)(cameras_file)
        if not images:
            raise UserError("holds no images", where=images_file)
        eth3d = folder.name.startswith("dslr_calibration")
        lenses: dict[int, Lens] = {}
        shots, missing = [], []
        for image in images:
            path = _picture(pictures, image.name, folder)
            if path is None:
                missing.append(printable(image.name))
                continue
            if image.camera not in cameras:
                raise UserError(
                    f"has no camera {image.camera}, which {printable(image.name)} is of", where=cameras_file
                )
            if image.camera not in lenses:
                lenses[image.camera] = _lens(*cameras[image.camera], where=cameras_file)
            lens = lenses[image.camera]
            depth = place / _ETH3D_DEPTH / PurePosixPath(image.name).name
            shots.append(
                Shot(
                    name=image.name,
                    picture=path,
                    lens=lens,
                    world_from_cam=image.world_from_cam(images_file),
                    mask=mask_of(image.name, place / MASKS_FOLDER),
                    # ETH3D's depth belongs to the pictures as they were taken.
                    depth=DepthFile(path=depth, format=DepthFormat.RAW) if lens.bends and depth.is_file() else None,
                )
            )
        if not shots:
            raise UserError(f"lists {name_some(missing)}, none of which is there", where=images_file, fix="add images/")
        notes = []
        if missing:
            notes.append(f"{len(missing)} of {len(images)} pictures of the model are not there: {name_some(missing)}")
        if len(folders) > 1 and not eth3d:
            others = name_some([other.relative_to(place).as_posix() for other in folders if other != folder])
            notes.append(f"the model in {folder.relative_to(place).as_posix()} is used; there is also {others}")
        if eth3d and (place / _ETH3D_DEPTH).is_dir() and not any(shot.depth for shot in shots):
            notes.append(
                "ground_truth_depth belongs to the distorted pictures and is not used with the undistorted ones"
            )
        files = (cameras_file, images_file)
        return Capture(shots=tuple(shots), notes=tuple(notes), files=files, metric=eth3d, chosen=True)


def _ending(folder: Path) -> str | None:
    """Of the files of a model in the folder; None if there is none."""
    for ending in ("bin", "txt"):
        if all((folder / f"{part}.{ending}").is_file() for part in ("cameras", "images")):
            return ending
    return None


def _lone_part(place: Path) -> Path | None:
    """A file of a model that lacks its other one; looked for where only models are."""
    for name in _MODEL_FOLDERS:
        if "sparse" in PurePosixPath(name).parts:
            for part in ("cameras.bin", "images.bin", "cameras.txt", "images.txt"):
                if (place / name / part).is_file():
                    return place / name / part
    return None


def _model_folders(place: Path) -> list[Path]:
    found = [place / name for name in _MODEL_FOLDERS]
    for parent in (place / "sparse", place / "colmap" / "sparse"):
        if parent.is_dir():
            found += sorted(
                (path for path in parent.iterdir() if path.is_dir()), key=lambda path: natural_key(path.name)
            )
    return list(dict.fromkeys(folder for folder in found if _ending(folder) is not None))


def _best(place: Path, folders: list[Path]) -> tuple[Path, Path, list[_Image]]:
    """(model, folder of pictures, images of the model) with the most pictures that are there; the first ones among equals."""
    scored = []
    for folder in folders:
        images = sorted(_images(folder), key=lambda image: natural_key(image.name))
        for pictures in (place / name for name in _PICTURE_FOLDERS):
            there = sum(_picture(pictures, image.name, folder) is not None for image in images)
            scored.append((there, folder, pictures, images))
    return max(scored, key=lambda item: item[0])[1:]


def _picture(folder: Path, name: str, model: Path) -> Path | None:
    path = member(folder, name, model)
    try:
        return path if path.is_file() else None
    except (ValueError, OSError):  # no name of a file
        return None


def _images(folder: Path) -> list[_Image]:
    ending = _ending(folder)
    path = folder / f"images.{ending}"
    return list(_images_of_text(path) if ending == "txt" else _images_of_binary(path))


def _lens(model: str, size: tuple[int, int], parameters: tuple[float, ...], *, where: Path) -> Lens:
    known = _MODELS[model]
    if known.projection is None:
        raise UserError(
            f"has a camera of the model {model}, which is not read here",
            where=where,
            fix=f"undistort the pictures in COLMAP, or use one of {', '.join(_READ)}",
        )
    focal = (parameters[0], parameters[known.focals - 1])
    bends = parameters[known.focals + 2 :]
    # COLMAP's shorter models leave out the last coefficients of OpenCV's.
    length = 4 if len(bends) <= 4 else 8
    distortion = (*bends, *(0.0,) * (length - len(bends))) if bends else ()
    try:
        return Lens(
            focal_px=focal,
            centre_px=(parameters[known.focals], parameters[known.focals + 1]),
            size=size,
            distortion=distortion,
            projection=known.projection,
        )
    except UserError as error:
        raise UserError(f"has a camera that {error.problem}", where=where) from None


_Cameras = dict[int, tuple[str, tuple[int, int], tuple[float, ...]]]


def _lines(path: Path) -> list[str]:
    data = read_plain_file(path, limit_bytes=_LIMIT_BYTES)
    try:
        return [line.rstrip("\r") for line in decode_text(data).split("\n")]
    except UnicodeDecodeError:
        raise UserError("is not UTF-8 or UTF-16 text", where=path) from None


def _cameras_of_text(path: Path) -> _Cameras:
    cameras: _Cameras = {}
    for number, line in enumerate(_lines(path), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}: line {number}"
        if len(words) < 5:
            raise UserError("is no camera (CAMERA_ID MODEL WIDTH HEIGHT PARAMS)", where=where)
        model = words[1]
        if model not in _MODELS:
            raise UserError(
                f"has the camera model {printable(model[:40])}", where=where, fix=f"use one of {', '.join(_READ)}"
            )
        try:
            key, width, height = int(words[0]), int(words[2]), int(words[3])
            parameters = tuple(float(word) for word in words[4:])
        except ValueError:
            raise UserError("holds something else where a number is expected", where=where) from None
        cameras[key] = (model, _size(height, width, where), _checked(parameters, model, where))
    return cameras


def _checked(parameters: tuple[float, ...], model: str, where: str | Path) -> tuple[float, ...]:
    if len(parameters) != _MODELS[model].parameters:
        problem = f"has {len(parameters)} parameters for {model}, which takes {_MODELS[model].parameters}"
        raise UserError(problem, where=where)
    return parameters


def _size(height: int, width: int, where: str | Path) -> tuple[int, int]:
    if not (0 < height < 10**6 and 0 < width < 10**6):
        raise UserError(f"has pictures of {width} x {height} pixels", where=where)
    return height, width


def _images_of_text(path: Path) -> Iterator[_Image]:
    # Every second line lists keypoints and may be empty, so empty lines count.
    lines = [(number, line) for number, line in enumerate(_lines(path), start=1) if not line.startswith("#")]
    for number, line in lines[::2]:
        words = line.split(maxsplit=9)
        if not words:
            continue
        where = f"{path}: line {number}"
        if len(words) < 10:
            raise UserError("is no image (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME)", where=where)
        try:
            values = [float(word) for word in words[1:8]]
            camera = int(words[8])
        except ValueError:
            raise UserError("holds something else where a number is expected", where=where) from None
        yield _Image(name=words[9].strip(), camera=camera, quat_wxyz=tuple(values[:4]), translation=tuple(values[4:]))


class _Bytes:
    """Little-endian numbers one after the other; a file that ends early is a `UserError`."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.place = path, read_plain_file(path, limit_bytes=_LIMIT_BYTES), 0

    def take(self, kinds: str) -> tuple[float, ...]:
        layout = struct.Struct(f"<{kinds}")
        self.skip(layout.size)
        return layout.unpack_from(self.data, self.place - layout.size)

    def count(self) -> int:
        count = int(self.take("Q")[0])
        if count > _MOST_CAMERAS:
            raise UserError(f"announces {count} entries", where=self.path)
        return count

    def skip(self, size: int) -> None:
        if self.place + size > len(self.data):
            raise UserError("is damaged or truncated", where=self.path, fix="copy it again")
        self.place += size

    def name(self) -> str:
        end = self.data.find(b"\0", self.place)
        text = self.data[self.place : end]
        self.skip(len(text) + 1 if end >= 0 else len(self.data))
        try:
            return text.decode()
        except UnicodeDecodeError:
            raise UserError("holds a name that is not valid text", where=self.path) from None


def _cameras_of_binary(path: Path) -> _Cameras:
    file, cameras = _Bytes(path), dict[int, tuple[str, tuple[int, int], tuple[float, ...]]]()
    for _ in range(file.count()):
        key, number, width, height = (int(value) for value in file.take("iiQQ"))
        if number not in _NAMES:
            raise UserError(f"has a camera of model number {number}", where=path, fix=f"use one of {', '.join(_READ)}")
        model = _NAMES[number]
        cameras[key] = (model, _size(height, width, path), file.take("d" * _MODELS[model].parameters))
    return cameras


def _images_of_binary(path: Path) -> Iterator[_Image]:
    file = _Bytes(path)
    for _ in range(file.count()):
        values = file.take("idddddddi")
        name = file.name()
        points = int(file.take("Q")[0])
        file.skip(points * 24)
        yield _Image(name=name, camera=int(values[8]), quat_wxyz=values[1:5], translation=values[5:8])
