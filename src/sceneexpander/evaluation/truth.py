"""How far a reconstruction is from the known truth of its scene.

An inserted picture that is misaligned on purpose is held against the consistent view: its pixels are a little off from the truth's, so
its errors have a floor that no method gets below.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.truth import SceneTruth, ViewTruth, check_size
from sceneexpander.artifacts.views import ViewRecord, ViewSet
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.image import WINDOW, psnr, ssim
from sceneexpander.evaluation.likeness import PSNR_CAP_DB
from sceneexpander.evaluation.measure import FEWEST_PIXELS, Measure, Subject, Values
from sceneexpander.geometry.camera import pixel_centres
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.geometry.similarity import umeyama

_WITHIN = 1.25
_MARGIN = WINDOW // 2  # pixels at the border are no centre of a window of SSIM
_SHORT_BASELINE = 1e-6  # of the largest one: no direction


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


class InsertedRegions(Measure):
    """The inserted view where no captured view saw the place, and where one did, against its picture at the method's own camera."""

    metrics = metrics_named("psnr_inserted_new_db", "ssim_inserted_new", "psnr_inserted_seen_db", "ssim_inserted_seen")

    def of_scene(self, subject: Subject) -> Values:
        """Nothing without a known new region; a region too small to say anything has no numbers."""
        if subject.truth is None:
            return {}
        records = {record.view_id: record for record in subject.views.records}
        values: dict[str, float | None] = {}
        for view in subject.seen:
            made = view.reconstruction
            record = records[made.view_ids[view.index]]
            known = subject.truth.of(record)
            if (
                not view.generated
                or record.round != subject.round_number
                or not bool(made.posed[view.index])
                or known is None
            ):
                continue
            new = _in_stored_pixels(known.new_region, record, *view.picture.shape[1:])
            if new is None:
                continue
            counted = torch.ones_like(new) if view.valid is None else view.valid
            for name, region in (("new", new & counted), ("seen", ~new & counted)):
                inner = region[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
                if int(inner.sum()) >= FEWEST_PIXELS:
                    rgb = view.render.rgb[0]
                    values[f"psnr_inserted_{name}_db"] = min(psnr(rgb, view.picture, region), PSNR_CAP_DB)
                    values[f"ssim_inserted_{name}"] = ssim(rgb, view.picture, region)
        return values


def _in_stored_pixels(plane: Tensor | None, record: ViewRecord, height: int, width: int) -> Tensor | None:
    """A map of the original picture at the centres of the stored pixels: nearest sample, 0 (False) outside."""
    if plane is None:
        return None
    centres = pixel_centres(height, width, like=torch.zeros((), dtype=torch.float64))
    affine = torch.tensor(record.original_from_stored(), dtype=torch.float64)
    x, y = (centres @ affine[:, :2].T + affine[:, 2]).floor().long().unbind(-1)
    check_size(plane, record)
    rows, columns = plane.shape
    inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
    values = plane[y.clamp(0, rows - 1), x.clamp(0, columns - 1)]
    return torch.where(inside, values, torch.zeros_like(values))


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
