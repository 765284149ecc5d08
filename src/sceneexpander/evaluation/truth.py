"""Known truth of a scene, and how far a reconstruction is from it.

A scene folder may have ``truth/``::

    truth/cameras.json        {"intrinsics_px": 3x3, "captured": [{"file": "captured/a.jpg", "world_from_cam": 4x4}, ...],
                               "inserted": {"file": "inserted/round_1.png", "world_from_cam": 4x4}}
    truth/depth/<stem>.png    z-depth of a captured view: 16 bits, millimetres, 0 where unknown
    truth/depth/inserted.png  the same for the inserted view, as it would be if it agreed with the scene
    truth/new_region.png      non-zero where that consistent inserted view shows what no captured view sees

``file`` is relative to the scene folder; ``inserted`` and the pictures may be absent. Cameras follow the project's conventions;
intrinsics and maps have the pixels of the original pictures. An inserted picture that is misaligned on purpose is held against the
consistent view: its pixels are a little off from the truth's, so its errors have a floor that no method gets below.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.store import ArtifactError, check_inside, read_json, read_typed, sha256_of_file
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.geometry.camera import pixel_centres
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.geometry.similarity import umeyama
from sceneexpander.typed import REFUSALS, shorten

TRUTH_FOLDER = "truth"
_MILLIMETRE = 1e-3
_WITHIN = 1.25
_MASKED = 127  # grey level above which a mask is set
_NOT_RIGID = 1e-2  # how far the product of a rotation with its transpose may be from the identity
_MEND = "mend or remove the scene's truth/"
MAX_PIXELS = 200_000_000
_Row3 = tuple[float, float, float]
_Row4 = tuple[float, float, float, float]
_SHORT_BASELINE = 1e-6  # of the largest one: no direction


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewTruth:
    """Truth of one picture, in its original pixels. ``depth`` is 0 where unknown."""

    world_from_cam: Float[Tensor, "4 4"]
    intrinsics_px: Float[Tensor, "3 3"]
    depth: Float[Tensor, "height width"] | None = None
    new_region: Bool[Tensor, "height width"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneTruth:
    """Truth by the digest of the picture's bytes: a picture that was exchanged has none."""

    views: dict[str, ViewTruth] = field(default_factory=dict)

    def of(self, record: ViewRecord) -> ViewTruth | None:
        """Truth of a view, if known."""
        return self.views.get(record.sha256)


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthMetrics:
    """Against known truth. Angles in degrees, from relative poses of view pairs; ATE in the truth's unit; depths after one common scale.

    The scale is the median ratio of true to estimated depth over all captured views; the inserted view's new region
    uses that same scale. None where too little is known.
    """

    camera_rotation_deg: float | None = None
    camera_direction_deg: float | None = None
    camera_ate: float | None = None
    depth_abs_rel: float | None = None
    depth_within_125: float | None = None
    inserted_rotation_deg: float | None = None
    inserted_direction_deg: float | None = None
    new_region_abs_rel: float | None = None
    new_region_within_125: float | None = None


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
    read = read_typed(_CamerasFile, read_json(path), path, fix=_MEND, extra=True)
    intrinsics = torch.tensor(read.intrinsics_px, dtype=torch.float64)
    if not (float(intrinsics[0, 0]) > 0 and float(intrinsics[1, 1]) > 0 and read.intrinsics_px[2] == (0, 0, 1)):
        raise ArtifactError("is invalid (intrinsics_px: is no camera matrix)", where=path, fix=_MEND)
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
                _check_size(plane, record)


def _digest(item: _Camera, scene_folder: Path, path: Path) -> str:
    """Of the bytes of a picture that the file names."""
    try:
        check_inside(item.file, scene_folder)
    except ArtifactError as error:
        raise ArtifactError(error.problem, where=path, fix=_MEND) from None
    picture = scene_folder / item.file
    if not _is_file(picture):
        raise ArtifactError(f"names {shorten(item.file)!a}, which is not there", where=path, fix=_MEND)
    return sha256_of_file(picture)


def _pose(item: _Camera, where: str, path: Path) -> Float[Tensor, "4 4"]:
    matrix = torch.tensor(item.world_from_cam, dtype=torch.float64)
    rotation = matrix[:3, :3]
    error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    if not error < _NOT_RIGID or float(torch.linalg.det(rotation)) < 0 or item.world_from_cam[3] != (0, 0, 0, 1):
        raise ArtifactError(f"is invalid ({where}.world_from_cam: is no camera pose)", where=path, fix=_MEND)
    return matrix


def _depth_map(path: Path) -> Float[Tensor, "height width"] | None:
    values = _picture(path)
    if values is None:
        return None
    if values.ndim != 2 or values.dtype == np.uint8 or values.dtype.kind not in "iu":
        raise ArtifactError("is not a 16-bit grey picture", where=path, fix=_MEND)
    return torch.from_numpy(values.astype(np.float32) * np.float32(_MILLIMETRE))


def _mask(path: Path) -> Bool[Tensor, "height width"] | None:
    values = _picture(path, mode="L")
    return None if values is None else torch.from_numpy(values > _MASKED)


def _picture(path: Path, mode: str | None = None) -> NDArray[Any] | None:
    """Pixels of a picture; None if there is none."""
    if not os.path.lexists(path):
        return None
    if not _is_file(path):
        raise ArtifactError("is not a file", where=path, fix=_MEND)
    try:
        with Image.open(path) as picture:
            if picture.width * picture.height > MAX_PIXELS:
                raise ArtifactError(f"has more than {MAX_PIXELS} pixels", where=path, fix=_MEND)
            return np.asarray(picture.convert(mode) if mode else picture)
    # Pillow raises a SyntaxError for broken chunks, and others of its own making for other damage.
    except (*REFUSALS, OSError, SyntaxError, EOFError, struct.error, zlib.error, Image.DecompressionBombError) as error:
        problem = f"cannot be read ({shorten(str(error) or type(error).__name__, 200)})"
        raise ArtifactError(problem, where=path, fix=_MEND) from None


def _is_file(path: Path) -> bool:
    """False, never an error, for everything that is no plain file: links to nowhere or to themselves, names that can be none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class _Known:
    """A view of the reconstruction with its truth, brought to stored pixels."""

    index: int
    record: ViewRecord
    truth: ViewTruth
    depth: Float[Tensor, "height width"] | None
    new_region: Bool[Tensor, "height width"] | None


def against_truth(
    reconstruction: Reconstruction, views: ViewSet, truth: SceneTruth, *, round_number: int
) -> TruthMetrics:
    """Errors of cameras and depths, and of the view inserted in this round; None where too little is known (see `TruthMetrics`)."""
    records = {record.view_id: record for record in views.records}
    known = []
    for index, view_id in enumerate(reconstruction.view_ids):
        record = records.get(view_id)
        found = None if record is None else truth.of(record)
        if record is not None and found is not None:
            height, width = reconstruction.depth.shape[1:]
            known.append(
                _Known(
                    index=index,
                    record=record,
                    truth=found,
                    depth=_in_stored_pixels(found.depth, record, height, width),
                    new_region=_in_stored_pixels(found.new_region, record, height, width),
                )
            )
    # A captured view without a pose stands at a placeholder: it is left out here as in every other mean.
    captured = [item for item in known if not item.record.generated and bool(reconstruction.posed[item.index])]
    inserted = [item for item in known if item.record.generated and item.record.round == round_number]
    rotation, direction = _pair_errors(reconstruction, _pairs(captured, captured))
    inserted_rotation, inserted_direction = _pair_errors(reconstruction, _pairs(captured, inserted))
    scale = _depth_scale(reconstruction, captured)
    depth_errors = _depth_errors(reconstruction, captured, scale)
    new_errors = _depth_errors(reconstruction, inserted, scale, new_region=True)
    return TruthMetrics(
        camera_rotation_deg=rotation,
        camera_direction_deg=direction,
        camera_ate=_trajectory_error(reconstruction, captured),
        depth_abs_rel=depth_errors[0],
        depth_within_125=depth_errors[1],
        inserted_rotation_deg=inserted_rotation,
        inserted_direction_deg=inserted_direction,
        new_region_abs_rel=new_errors[0],
        new_region_within_125=new_errors[1],
    )


def _in_stored_pixels(plane: Tensor | None, record: ViewRecord, height: int, width: int) -> Tensor | None:
    """A map of the original picture at the centres of the stored pixels: nearest sample, 0 (False) outside."""
    if plane is None:
        return None
    centres = pixel_centres(height, width, like=torch.zeros((), dtype=torch.float64))
    affine = torch.tensor(record.original_from_stored(), dtype=torch.float64)
    x, y = (centres @ affine[:, :2].T + affine[:, 2]).floor().long().unbind(-1)
    _check_size(plane, record)
    rows, columns = plane.shape
    inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
    values = plane[y.clamp(0, rows - 1), x.clamp(0, columns - 1)]
    return torch.where(inside, values, torch.zeros_like(values))


def _check_size(plane: Tensor, record: ViewRecord) -> None:
    rows, columns = plane.shape
    if (rows, columns) != (record.original_height, record.original_width):
        raise ArtifactError(
            f"truth of {rows} x {columns} pixels for a picture of {record.original_height} x {record.original_width}",
            where=record.name,
            fix=_MEND,
        )


def _pairs(first: list[_Known], second: list[_Known]) -> list[tuple[_Known, _Known]]:
    return [(a, b) for a in first for b in second if a.index < b.index]


def _pair_errors(
    reconstruction: Reconstruction, pairs: list[tuple[_Known, _Known]]
) -> tuple[float | None, float | None]:
    """Mean errors of relative rotation and of the direction of relative translation, degrees: free of frame and scale.

    A direction is undefined for true baselines of zero length (left out); an estimate of zero length counts as 90 degrees off.
    """
    poses = reconstruction.world_from_cam.double()
    true = [rigid_inverse(a.truth.world_from_cam) @ b.truth.world_from_cam for a, b in pairs]
    estimated = [rigid_inverse(poses[a.index]) @ poses[b.index] for a, b in pairs]
    longest = max((float(pose[:3, 3].norm()) for pose in true), default=0.0)
    rotations, directions = [], []
    for guess, truth in zip(estimated, true, strict=True):
        rotations.append(float(rotation_angle_deg(guess[:3, :3], truth[:3, :3])))
        if float(truth[:3, 3].norm()) > _SHORT_BASELINE * longest:
            directions.append(_angle_deg(guess[:3, 3], truth[:3, 3]))
    return _mean(rotations), _mean(directions)


def _angle_deg(estimated: Float[Tensor, "3"], true: Float[Tensor, "3"]) -> float:
    if float(estimated.norm()) == 0:
        return 90.0
    cross = torch.linalg.cross(estimated, true).norm()
    return float(torch.rad2deg(torch.atan2(cross, (estimated * true).sum())))


def _trajectory_error(reconstruction: Reconstruction, captured: list[_Known]) -> float | None:
    """Root mean square distance of camera centres after the best similarity; None if that is not determined."""
    if len(captured) < 3:
        return None
    estimated = reconstruction.world_from_cam[[item.index for item in captured], :3, 3].double()
    true = torch.stack([item.truth.world_from_cam[:3, 3] for item in captured])
    try:
        aligned = umeyama(estimated, true).points(estimated)
    except ValueError:
        return None  # cameras on one line
    return float(((aligned - true) ** 2).sum(-1).mean().sqrt())


def _depth_scale(reconstruction: Reconstruction, captured: list[_Known]) -> float | None:
    """True unit per scene unit: one number for the whole reconstruction."""
    ratios = [
        (item.depth / reconstruction.depth[item.index])[item.depth > 0] for item in captured if item.depth is not None
    ]
    together = torch.cat(ratios) if ratios else torch.zeros(0)
    return float(together.median()) if together.numel() else None


def _depth_errors(
    reconstruction: Reconstruction, items: list[_Known], scale: float | None, *, new_region: bool = False
) -> tuple[float | None, float | None]:
    """(mean |d - d*| / d*, share of max(d / d*, d* / d) < 1.25) over all pixels with known depth."""
    errors, ratios = [], []
    for item in items:
        if scale is None or item.depth is None or (new_region and item.new_region is None):
            continue
        valid = item.depth > 0
        if new_region and item.new_region is not None:
            valid = valid & item.new_region
        estimated, true = reconstruction.depth[item.index][valid] * scale, item.depth[valid]
        errors.append((estimated - true).abs() / true)
        ratios.append(torch.maximum(estimated / true, true / estimated))
    together = torch.cat(errors) if errors else torch.zeros(0)
    if not together.numel():
        return None, None
    return float(together.double().mean()), float((torch.cat(ratios) < _WITHIN).double().mean())


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
