"""Photos with ``cameras.json``: the form that `expand` writes whatever cameras, masks and depth came with pictures in.

Everything is per picture and may be missing; names are relative to the folder. Poses are camera-to-world with OpenCV axes, intrinsics in
the original's pixels from the top-left corner of its top-left pixel.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneexpander.artifacts.store import write_json_atomic
from sceneexpander.errors import UserError
from sceneexpander.ingest.config import IngestConfig
from sceneexpander.ingest.decode import read_picture_header
from sceneexpander.ingest.depth_files import DepthFile, DepthFormat, sampled_depth
from sceneexpander.ingest.jsonfile import read_user_json
from sceneexpander.ingest.lens_models import Lens
from sceneexpander.ingest.links import require_inside
from sceneexpander.ingest.sources.capture import Capture, Shot, rigid_pose
from sceneexpander.ingest.survey import MASKS_FOLDER
from sceneexpander.typed import decode_dataclass

CAMERAS_FILE = "cameras.json"
_FORMAT = "sceneexpander-cameras/1"
_DEPTH_FOLDER = "depth"
_DEPTH_SIDE_PX = 1024  # of copies: more than any reconstructor takes


@dataclass(frozen=True, slots=True, kw_only=True)
class _Camera:
    picture: str
    name: str
    lens: Lens | None = None
    world_from_cam: tuple[tuple[float, float, float, float], ...] | None = None
    mask: str | None = None
    depth: str | None = None
    depth_of_straightened: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cameras:
    format: str
    metric: bool
    pictures: tuple[_Camera, ...]


class PosedPhotos:
    """The folder with the file."""

    title = f"photos with {CAMERAS_FILE}"

    def detect(self, place: Path) -> bool:
        """Whether the file is there."""
        return (place / CAMERAS_FILE).is_file()

    def read(self, place: Path, config: IngestConfig) -> Capture:
        """The pictures that the file lists."""
        path = require_inside(place / CAMERAS_FILE, place)
        content = read_user_json(path)
        if content.get("format") != _FORMAT:
            raise UserError(f"is not of the format {_FORMAT}", where=path)
        try:
            read = decode_dataclass(_Cameras, content)
        except UserError as error:
            raise UserError(error.line(), where=path) from None
        shots = tuple(_shot(camera, place, path) for camera in read.pictures)
        if not shots:
            raise UserError("lists no pictures", where=path)
        return Capture(shots=shots, files=(path,), metric=read.metric)


def _shot(camera: _Camera, place: Path, path: Path) -> Shot:
    def file(name: str) -> Path:
        return require_inside(place / name, place, where=str(path))

    depth = None
    if camera.depth is not None:
        depth = DepthFile(path=file(camera.depth), format=DepthFormat.NPY, of_straightened=camera.depth_of_straightened)
    pose = camera.world_from_cam
    return Shot(
        name=camera.name,
        picture=file(camera.picture),
        lens=camera.lens,
        world_from_cam=None if pose is None else rigid_pose(pose, path),
        mask=None if camera.mask is None else file(camera.mask),
        depth=depth,
    )


def write_posed_photos(capture: Capture, folder: Path, config: IngestConfig) -> None:
    """Write a capture so that `PosedPhotos` reads the same: pictures and masks as they are, depth maps reduced.

    Raises:
        UserError: a picture or depth map that cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras = []
    for index, shot in enumerate(capture.shots):
        # The number keeps names apart that differ in their folders only; views are named without it.
        picture = f"{index:04d}_{Path(shot.name).name}"
        if isinstance(shot.picture, Path):
            shutil.copyfile(shot.picture, folder / picture)
        else:
            (folder / picture).write_bytes(shot.picture)
        mask = depth = None
        if shot.mask is not None:
            mask = f"{MASKS_FOLDER}/{index:04d}.png"
            (folder / MASKS_FOLDER).mkdir(exist_ok=True)
            shutil.copyfile(shot.mask, folder / mask)
        if shot.depth is not None:
            header = read_picture_header(folder / picture, max_megapixels=config.max_megapixels, upright=False)
            values = shot.depth.read((header.height, header.width))
            depth = f"{_DEPTH_FOLDER}/{index:04d}.npy"
            (folder / _DEPTH_FOLDER).mkdir(exist_ok=True)
            np.save(folder / depth, _reduced(values))
        pose = shot.world_from_cam
        cameras.append(
            _Camera(
                picture=picture,
                name=Path(shot.name).name,
                lens=shot.lens,
                world_from_cam=None
                if pose is None
                else tuple((row[0], row[1], row[2], row[3]) for row in pose.tolist()),
                mask=mask,
                depth=depth,
                depth_of_straightened=shot.depth is not None and shot.depth.of_straightened,
            )
        )
    write_json_atomic(folder / CAMERAS_FILE, _Cameras(format=_FORMAT, metric=capture.metric, pictures=tuple(cameras)))


def _reduced(depth: np.ndarray) -> np.ndarray:
    share = _DEPTH_SIDE_PX / max(depth.shape)
    if share >= 1:
        return depth
    height, width = (max(1, round(side * share)) for side in depth.shape)
    columns, rows = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return sampled_depth(depth, columns, rows)
