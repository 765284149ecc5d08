"""``truth/``: what a scene folder knows of its true cameras and depths.

A scene folder may have ``truth/``::

    truth/cameras.json        {"intrinsics_px": 3x3, "captured": [{"file": "captured/a.jpg", "world_from_cam": 4x4}, ...],
                               "inserted": {"file": "inserted/round_1.png", "world_from_cam": 4x4}}
    truth/depth/<stem>.png    z-depth of a captured view: 16 bits, millimetres, 0 where unknown
    truth/depth/inserted.png  the same for the inserted view, as it would be if it agreed with the scene
    truth/new_region.png      non-zero where that consistent inserted view shows what no captured view sees

``file`` is relative to the scene folder; ``inserted`` and the pictures may be absent. Cameras follow the project's conventions;
intrinsics and maps have the pixels of the original pictures.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sceneexpander.artifacts.store import ArtifactError, check_inside, read_json, read_typed, sha256_of_file
from sceneexpander.artifacts.truth import MEND, SceneTruth, ViewTruth, check_size
from sceneexpander.artifacts.views import ViewRecord
from sceneexpander.ingest.listing import TRUTH_FOLDER
from sceneexpander.typed import REFUSALS, shorten

_MILLIMETRE = 1e-3
_MASKED = 127  # grey level above which a mask is set
_NOT_RIGID = 1e-2  # how far the product of a rotation with its transpose may be from the identity
MAX_PIXELS = 200_000_000
_Row3 = tuple[float, float, float]
_Row4 = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Camera:
    """Of one picture, as the file holds it."""

    file: str
    world_from_cam: tuple[_Row4, _Row4, _Row4, _Row4]


@dataclass(frozen=True, slots=True, kw_only=True)
class _CamerasFile:
    intrinsics_px: tuple[_Row3, _Row3, _Row3]
    captured: tuple[_Camera, ...]
    inserted: _Camera | None = None


def load_truth(scene_folder: Path) -> SceneTruth | None:
    """Read ``scene_folder/truth``; None if there is none.

    Raises:
        ArtifactError: it is there but damaged, holds cameras that are none, or leads out of the scene folder.
    """
    folder = scene_folder / TRUTH_FOLDER
    path = folder / "cameras.json"
    if not os.path.lexists(path):
        return None
    read = read_typed(_CamerasFile, read_json(path), path, fix=MEND, extra=True)
    intrinsics = torch.tensor(read.intrinsics_px, dtype=torch.float64)
    if not (float(intrinsics[0, 0]) > 0 and float(intrinsics[1, 1]) > 0 and read.intrinsics_px[2] == (0, 0, 1)):
        raise ArtifactError("is invalid (intrinsics_px: is no camera matrix)", where=path, fix=MEND)
    views: dict[str, ViewTruth] = {}
    for index, item in enumerate(read.captured):
        digest = _digest(item, scene_folder, path)
        views[digest] = ViewTruth(
            world_from_cam=_pose(item, f"captured[{index}]", path),
            intrinsics_px=intrinsics,
            depth=_depth_map(folder / "depth" / f"{Path(item.file).stem}.png"),
        )
    if read.inserted is not None:
        views[_digest(read.inserted, scene_folder, path)] = ViewTruth(
            world_from_cam=_pose(read.inserted, "inserted", path),
            intrinsics_px=intrinsics,
            depth=_depth_map(folder / "depth" / "inserted.png"),
            new_region=_mask(folder / "new_region.png"),
        )
    return SceneTruth(views=views)


def check_truth(scene_folder: Path, records: Sequence[ViewRecord]) -> None:
    """Raise `ArtifactError` if a scene's truth is damaged, or its maps have other sizes than the pictures they belong to."""
    truth = load_truth(scene_folder)
    for record in records:
        found = None if truth is None else truth.of(record)
        for plane in (found.depth, found.new_region) if found is not None else ():
            if plane is not None:
                check_size(plane, record)


def _digest(item: _Camera, scene_folder: Path, path: Path) -> str:
    """Of the bytes of a picture that the file names."""
    try:
        check_inside(item.file, scene_folder)
    except ArtifactError as error:
        raise ArtifactError(error.problem, where=path, fix=MEND) from None
    picture = scene_folder / item.file
    if not _is_file(picture):
        raise ArtifactError(f"names {shorten(item.file)!a}, which is not there", where=path, fix=MEND)
    return sha256_of_file(picture)


def _pose(item: _Camera, where: str, path: Path) -> Float[Tensor, "4 4"]:
    matrix = torch.tensor(item.world_from_cam, dtype=torch.float64)
    rotation = matrix[:3, :3]
    error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    if not error < _NOT_RIGID or float(torch.linalg.det(rotation)) < 0 or item.world_from_cam[3] != (0, 0, 0, 1):
        raise ArtifactError(f"is invalid ({where}.world_from_cam: is no camera pose)", where=path, fix=MEND)
    return matrix


def _depth_map(path: Path) -> Float[Tensor, "height width"] | None:
    values = _picture(path)
    if values is None:
        return None
    if values.ndim != 2 or values.dtype == np.uint8 or values.dtype.kind not in "iu":
        raise ArtifactError("is not a 16-bit grey picture", where=path, fix=MEND)
    return torch.from_numpy(values.astype(np.float32) * np.float32(_MILLIMETRE))


def _mask(path: Path) -> Bool[Tensor, "height width"] | None:
    values = _picture(path, mode="L")
    return None if values is None else torch.from_numpy(values > _MASKED)


def _picture(path: Path, mode: str | None = None) -> NDArray[Any] | None:
    """Pixels of a picture; None if there is none."""
    if not os.path.lexists(path):
        return None
    if not _is_file(path):
        raise ArtifactError("is not a file", where=path, fix=MEND)
    try:
        with Image.open(path) as picture:
            if picture.width * picture.height > MAX_PIXELS:
                raise ArtifactError(f"has more than {MAX_PIXELS} pixels", where=path, fix=MEND)
            return np.asarray(picture.convert(mode) if mode else picture)
    # Pillow raises a SyntaxError for broken chunks, and others of its own making for other damage.
    except (*REFUSALS, OSError, SyntaxError, EOFError, struct.error, zlib.error, Image.DecompressionBombError) as error:
        problem = f"cannot be read ({shorten(str(error) or type(error).__name__, 200)})"
        raise ArtifactError(problem, where=path, fix=MEND) from None


def _is_file(path: Path) -> bool:
    """False, never an error, for everything that is no plain file: links to nowhere or to themselves, names that can be none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
