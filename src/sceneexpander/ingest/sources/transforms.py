"""nerfstudio's and instant-ngp's ``transforms.json`` (also ``transforms_train.json`` of NeRF's synthetic scenes).

https://docs.nerf.studio/quickstart/data_conventions.html. Camera-to-world poses, OpenGL camera axes (y up, looking along -z) unless the
file or the configuration says OpenCV; the world stays the file's own, ``applied_transform`` included.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from sceneexpander.errors import UserError, printable
from sceneexpander.ingest.config import CameraAxes, IngestConfig
from sceneexpander.ingest.decode import read_picture_header
from sceneexpander.ingest.depth_files import depth_file
from sceneexpander.ingest.formats import PICTURE_EXTENSIONS
from sceneexpander.ingest.jsonfile import number_at, read_user_json, text_at
from sceneexpander.ingest.lens_models import Lens, Projection
from sceneexpander.ingest.sources.capture import Capture, Shot, member, name_some, number_array, rigid_pose
from sceneexpander.ingest.survey import natural_key
from sceneexpander.typed import shorten

_FILES = ("transforms.json", "transforms_train.json")
_DEPTH_UNIT = 0.001  # of 16-bit pictures: millimetres, unless 'depth_unit_scale_factor' says otherwise
_PINHOLE_MODELS = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"}
_AXES_KEYS = ("camera_convention", "camera_axes", "coordinate_system")
_AXES_WORDS = {
    CameraAxes.OPENCV: ("opencv", "colmap"),
    CameraAxes.OPENGL: ("opengl", "blender", "nerf", "instant-ngp"),
}
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Transforms:
    """The file, or the folder that it is in."""

    title = "a transforms.json with its pictures"

    def detect(self, place: Path) -> bool:
        """Whether the file is there."""
        return _file(place) is not None

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """The frames whose pictures are there."""
        path = _file(place)
        if path is None:
            raise UserError(f"holds no {_FILES[0]}", where=place)
        content = read_user_json(path)
        frames = content.get("frames")
        if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
            raise UserError("has no list of frames", where=path)
        if (applied := content.get("applied_transform")) is not None:
            number_array(applied, f"{path}: applied_transform")
        axes = _axes(content, config.camera_axes, path)
        shots, missing = [], []
        for index, frame in enumerate(frames):
            where = f"{path}: frame {index}"
            name = text_at(frame, "file_path", where)
            if name is None:
                raise UserError("has no 'file_path'", where=where)
            picture = _existing(path.parent, name, (*sorted(PICTURE_EXTENSIONS), ""))
            if picture is None:
                missing.append(printable(name))
                continue
            shots.append(_shot(content, frame, picture, name, axes, config, path.parent, where))
        if not shots:
            raise UserError(f"lists {name_some(missing)}, none of which is there", where=path)
        shots.sort(key=lambda shot: natural_key(shot.name))
        notes = [f"{len(missing)} of {len(frames)} pictures are not there: {name_some(missing)}"] if missing else []
        return Capture(shots=tuple(shots), notes=tuple(notes), files=(path,), chosen=True)


def _file(place: Path) -> Path | None:
    if place.is_file():
        return place if place.suffix.casefold() == ".json" and place.name.casefold().startswith("transforms") else None
    return next((place / name for name in _FILES if (place / name).is_file()), None)


def _axes(content: dict[str, Any], asked: CameraAxes, path: Path) -> CameraAxes:
    if asked is not CameraAxes.AUTO:
        return asked
    said = next((text_at(content, key, path) for key in _AXES_KEYS if isinstance(content.get(key), str)), None)
    if said is None:
        return CameraAxes.OPENGL
    for axes, words in _AXES_WORDS.items():
        if any(word in said.casefold() for word in words):
            return axes
    raise UserError(
        f"has cameras in axes called {shorten(said)!r}", where=path, fix="set scene.camera_axes to opengl or opencv"
    )


def _existing(folder: Path, name: str, endings: tuple[str, ...] = ("",)) -> Path | None:
    """The file of that name inside the folder; NeRF's files leave the ending out."""
    for ending in ("", *(f".{known}" for known in endings if known)):
        path = member(folder, f"{name}{ending}", folder)
        try:
            if path.is_file():
                return path
        except (OSError, ValueError):
            return None
        if Path(name).suffix and not ending:
            return None
    return None


def _shot(
    content: dict[str, Any],
    frame: dict[str, Any],
    picture: Path,
    name: str,
    axes: CameraAxes,
    config: IngestConfig,
    folder: Path,
    where: str,
) -> Shot:
    pose = None
    if frame.get("transform_matrix") is not None:
        pose = rigid_pose(frame["transform_matrix"], where)
        if axes is CameraAxes.OPENGL:
            pose = pose @ _OPENCV_FROM_OPENGL
    mask_name, depth_name = text_at(frame, "mask_path", where), text_at(frame, "depth_file_path", where)
    mask = None if mask_name is None else _existing(folder, mask_name)
    if mask_name is not None and mask is None:
        raise UserError(f"names the mask {printable(mask_name)}, which is not there", where=where)
    depth = None
    if depth_name is not None and (depth_path := _existing(folder, depth_name)) is not None:
        unit = number_at(content, "depth_unit_scale_factor", where) or _DEPTH_UNIT
        depth = depth_file(depth_path, unit=unit)
    lens = _lens({**content, **frame}, picture, config, where)
    return Shot(
        name=Path(name).name if Path(name).suffix else picture.name,
        picture=picture,
        lens=lens,
        world_from_cam=pose,
        mask=mask,
        depth=depth,
    )


def _lens(content: dict[str, Any], picture: Path, config: IngestConfig, where: str) -> Lens | None:
    """The camera of a frame, whose own keys stand before the file's; None if nothing says a focal length."""
    values = {key: number_at(content, key, where) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    angles = [number_at(content, key, where) for key in ("camera_angle_x", "camera_angle_y")]
    if values["fl_x"] is None and values["fl_y"] is None and angles == [None, None]:
        return None
    model = text_at(content, "camera_model", where) or "OPENCV"
    fisheye = model == "OPENCV_FISHEYE" or content.get("is_fisheye") is True
    if not fisheye and model not in _PINHOLE_MODELS:
        known = ", ".join(sorted({*_PINHOLE_MODELS, "OPENCV_FISHEYE"}))
        raise UserError(
            f"has the camera model {printable(model[:40])}, which is not read here",
            where=where,
            fix=f"use one of {known}",
        )
    width, height = values["w"], values["h"]
    if width is None or height is None:
        header = read_picture_header(picture, max_megapixels=config.max_megapixels, upright=False)
        width, height = header.width, header.height
    if min(width, height) < 1:
        raise UserError(f"has pictures of {width:g} x {height:g} pixels", where=where)
    focals = []
    for focal, angle, side in zip((values["fl_x"], values["fl_y"]), angles, (width, height), strict=True):
        if focal is None and angle is not None:
            if not 0 < angle < math.pi:
                raise UserError(f"has an opening angle of {angle:g} radians", where=where)
            focal = side / (2 * math.tan(angle / 2))
        focals.append(focal)
    along, down = focals[0] or focals[1] or 0.0, focals[1] or focals[0] or 0.0
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    distortion = tuple(number_at(content, key, where) or 0.0 for key in keys)
    try:
        return Lens(
            focal_px=(along, down),
            centre_px=(
                width / 2 if values["cx"] is None else values["cx"],
                height / 2 if values["cy"] is None else values["cy"],
            ),
            size=(round(height), round(width)),
            distortion=distortion if fisheye or any(distortion) else (),
            projection=Projection.FISHEYE if fisheye else Projection.PINHOLE,
        )
    except UserError as error:
        raise UserError(f"has a camera that {error.problem}", where=where) from None
