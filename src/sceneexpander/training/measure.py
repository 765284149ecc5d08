"""How good a prediction is on a sample, beside the base and trivial baselines. One depth scale per scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.geometry.camera import resize_intrinsics
from sceneexpander.geometry.normals import normals_from_depth
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.models.protocol import GEOMETRY_HEADS, Prediction, Reconstructor
from sceneexpander.training.sample import Sample

_D_THRESHOLD = torch.tensor(1.25).log().item()


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthScore:
    """AbsRel and share of pixels within a factor 1.25; NaN where there are no pixels of that kind."""

    abs_rel: float
    within: float
    abs_rel_confident: float
    within_confident: float
    abs_rel_unconfident: float
    within_unconfident: float


def depth_score(
    log_depth: Float[Tensor, "view height width"], sample: Sample, valid: Bool[Tensor, "view height width"]
) -> DepthScore:
    """Scores after the one scale that makes the median log error of the whole scene zero."""
    error = (log_depth - torch.where(valid, sample.log_depth[: sample.inputs], 0.0))[valid]
    error = error - error.median()
    confident = sample.priors_confident()[valid]
    relative, within = (error.exp() - 1).abs(), (error.abs() < _D_THRESHOLD).float()
    return DepthScore(
        abs_rel=float(relative.mean()),
        within=float(within.mean()),
        abs_rel_confident=float(relative[confident].mean()),
        within_confident=float(within[confident].mean()),
        abs_rel_unconfident=float(relative[~confident].mean()),
        within_unconfident=float(within[~confident].mean()),
    )


def posed_pixels(sample: Sample) -> Bool[Tensor, "view height width"]:
    """Pixels that count: a surface, in a view whose pose is known (the scale of the others is not defined)."""
    return sample.valid[: sample.inputs] & sample.posed[:, None, None]


def normals_angle_deg(normals: Float[Tensor, "view height width 3"], sample: Sample) -> float:
    """Mean angle to the true normals, degrees."""
    truth = sample.normals[: sample.inputs]
    cosine = (normals * truth).sum(-1).clamp(-1, 1)
    angle = torch.rad2deg(torch.atan2(torch.linalg.cross(normals, truth).norm(dim=-1), cosine))
    return float(angle[sample.valid[: sample.inputs]].mean())


def base_normals(sample: Sample, *, shrink: int = 2) -> Float[Tensor, "view height width 3"]:
    """Normals of the base depth, smoothed: what a person would do without a network."""
    height, width = sample.images.shape[-2:]
    small = torch.nn.functional.avg_pool2d(sample.prior_log_depth[:, None], shrink)[:, 0].exp()
    intrinsics = resize_intrinsics(sample.prior_intrinsics_px, 1 / shrink, 1 / shrink)
    normals = normals_from_depth(small, intrinsics, smoothing=2).movedim(-1, 1)
    grown = torch.nn.functional.interpolate(normals, size=(height, width), mode="bilinear", align_corners=False)
    return torch.nn.functional.normalize(grown, dim=1).movedim(1, -1)


@torch.no_grad()
def geometry_row(model: Reconstructor, sample: Sample, *, unposed_count: bool = False) -> dict[str, float]:
    """All geometry numbers of one scene: network, base, interpolation of the sparse points, constant depth.

    ``unposed_count``: views without a pose count too, in the one scale of the scene.
    """
    valid = sample.valid[: sample.inputs] if unposed_count else posed_pixels(sample)
    prediction = model.predict(sample.input_images, sample.priors(), heads=GEOMETRY_HEADS)
    assert prediction.depth is not None and prediction.normals is not None  # noqa: S101, PT018 - both were asked for
    depths = {
        "network": prediction.depth.log(),
        "base": sample.prior_log_depth,
        "sparse": sample.sparse_log_depth,
        "constant": torch.zeros_like(sample.prior_log_depth),
    }
    row: dict[str, float] = {}
    for name, log_depth in depths.items():
        score = depth_score(log_depth, sample, valid)
        row |= {f"{name}/{field}": getattr(score, field) for field in DepthScore.__dataclass_fields__}
    row["coverage"] = float(sample.priors_confident()[valid].float().mean())
    row["network/normals_deg"] = normals_angle_deg(prediction.normals, sample)
    row["base/normals_deg"] = normals_angle_deg(base_normals(sample), sample)
    row |= _camera_errors(prediction, sample)
    return row


def _camera_errors(prediction: Prediction, sample: Sample) -> dict[str, float]:
    """Mean rotation error (degrees) and centre error (over the scene's median depth) of the posed views but the first."""
    kept = torch.nonzero(sample.posed)[1:, 0]
    truth = sample.world_from_cam[kept]
    scale = float(sample.prior_log_depth.median().exp())
    row = {}
    for name, poses in (("network", prediction.world_from_cam[kept]), ("base", sample.prior_world_from_cam[kept])):
        row[f"{name}/rotation_deg"] = float(rotation_angle_deg(poses[:, :3, :3], truth[:, :3, :3]).mean())
        row[f"{name}/centre_error"] = float((poses[:, :3, 3] - truth[:, :3, 3]).norm(dim=-1).mean()) / scale
    return row


def mean_row(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Mean of every number over the scenes that have it, and the share of scenes better than the base."""
    rows = list(rows)
    result = {}
    for name in rows[0]:
        values = torch.tensor([row[name] for row in rows])
        values = values[~values.isnan()]
        result[name] = float(values.mean()) if len(values) else float("nan")
        if name.endswith(("/abs_rel", "/within")):
            result[f"{name}_median"] = float(values.median())
    gains = torch.tensor([row["network/within"] - row["base/within"] for row in rows])
    errors = torch.tensor([row["base/abs_rel"] - row["network/abs_rel"] for row in rows])
    result["scenes"] = float(len(rows))
    result["share_better_within"] = float((gains > 0).float().mean())
    result["share_better_abs_rel"] = float((errors > 0).float().mean())
    result["share_worse_by_.01"] = float((gains < -0.01).float().mean())
    return result
