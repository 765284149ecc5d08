"""How well the embedded reconstructor does on held-out procedural scenes, beside trivial baselines."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.frontend.dense import DenseConfig
from sceneexpander.frontend.prior import FrontendConfig
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rigid_inverse, rotation_angle_deg
from sceneexpander.models.mini.model import Mini
from sceneexpander.models.protocol import ALL_HEADS, Head
from sceneexpander.splatting import render
from sceneexpander.synthetic.views import SyntheticViews, make_views
from sceneexpander.training.buffer import samples_folder
from sceneexpander.training.generate import (
    PHOTO_SUPERSAMPLE,
    Conditions,
    input_photos,
    own_cameras_sample,
    sample_of_scene,
)
from sceneexpander.training.measure import geometry_row, mean_row
from sceneexpander.training.sample import Sample

_LOG = logging.getLogger(__name__)
HEIGHT, WIDTH = 280, 336  # the working size of the front-end
INPUTS = 4
TRUE_CAMERAS = Conditions(points_per_view=(50, 50), point_noise=0.03, outliers=0.03)
NOISY_CAMERAS = replace(TRUE_CAMERAS, rotation_deg=0.1, baseline_fraction=0.01)
AUC_DEG = 30
OVERLAPPING = 0.4
DEPTH_FIELDS = (("abs_rel", "lower"), ("within", "higher"))


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreRow:
    """One row of the table. ``better`` is "lower" or "higher"; ``baselines`` are the same number of simpler estimates."""

    name: str
    value: float
    better: str
    baselines: dict[str, float]
    scenes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneScores:
    """Numbers of one scene under each condition; None where that condition was not run."""

    true_cameras: dict[str, float]
    noisy_cameras: dict[str, float] | None
    front_end: dict[str, float] | None
    pose_errors_deg: tuple[float, ...]  # one per pair of views, from the front-end
    pose_errors_overlapping_deg: tuple[float, ...]  # those that share more than 40 % of the smaller overlap


def scene_with_views(seed: int) -> SyntheticViews:
    """The held-out scene of a seed: four input views and one to render, textures that training never saw.

    Scenes with a disconnected view are left to the front-end's own tests: the next seed of the same stream is taken.
    """
    for attempt in range(50):
        try:
            scene = make_views(seed + 1_000_000 * attempt, views=INPUTS + 1, height=HEIGHT, width=WIDTH, split="test")
        except ValueError:
            continue
        if scene.disconnected is None:
            return scene
    raise ValueError(f"no connected scene for seed {seed} in 50 attempts")


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneSamples:
    """One held-out scene under each condition; None where that condition is not wanted."""

    true_cameras: Sample
    noisy_cameras: Sample | None
    own_cameras: Sample | None


def scene_samples(seed: int, *, noisy: bool, front_end: bool, kept: Path | None = None) -> SceneSamples:
    """What the front-end makes of the held-out scene of a seed: nothing here depends on the network's weights.

    Args:
        seed: of the scene and of all simulated errors.
        noisy, front_end: also with slightly wrong cameras; also with the front-end's own.
        kept: folder in which samples lie that were made before, and where new ones are left.
    """
    if kept is not None:
        samples_folder(kept)
    dense = DenseConfig(threads=torch.get_num_threads())

    def sample(condition: str, make: Callable[[], Sample]) -> Sample:
        if kept is None:
            return make()
        path = kept / f"{seed}_{condition}.safetensors"
        if not path.exists():
            make().save(path)
        return Sample.load(path)

    def simulated(conditions: Conditions, offset: int) -> Sample:
        generator = torch.Generator().manual_seed(seed + offset)
        return sample_of_scene(scene_with_views(seed), INPUTS, conditions, generator, dense=dense)

    def own(true: Sample) -> Sample:
        photos = input_photos(scene_with_views(seed), true, supersample=PHOTO_SUPERSAMPLE)
        return own_cameras_sample(true, photos, torch.Generator().manual_seed(seed), FrontendConfig(dense=dense))

    true = sample("true", lambda: simulated(TRUE_CAMERAS, 0))
    return SceneSamples(
        true_cameras=true,
        noisy_cameras=sample("noisy", lambda: simulated(NOISY_CAMERAS, 1)) if noisy else None,
        own_cameras=sample("own", lambda: own(true)) if front_end else None,
    )


def score_samples(model: Mini, samples: SceneSamples) -> SceneScores:
    """All numbers of one held-out scene. ``model`` is compared with the same model without residuals."""
    noisy, own = samples.noisy_cameras, samples.own_cameras
    errors, overlapping = ((), ()) if own is None else pose_errors_deg(own)
    return SceneScores(
        true_cameras=geometry_row(model, samples.true_cameras) | splat_row(model, samples.true_cameras),
        noisy_cameras=None if noisy is None else geometry_row(model, noisy),
        front_end=None if own is None else geometry_row(model, own, unposed_count=True),
        pose_errors_deg=errors,
        pose_errors_overlapping_deg=overlapping,
    )


@torch.no_grad()
def splat_row(model: Mini, sample: Sample) -> dict[str, float]:
    """PSNR of rendered Gaussians at the input views and at the held-out view, with and without the network."""
    base = Mini(model.config)
    row: dict[str, float] = {}
    cameras = torch.cat([sample.prior_world_from_cam, sample.world_from_cam[sample.inputs :]])
    intrinsics = torch.cat([sample.prior_intrinsics_px, sample.intrinsics_px[sample.inputs :]])
    for name, candidate in (("network", model), ("base", base)):
        prediction = candidate.predict(sample.input_images, sample.priors(), heads=ALL_HEADS - {Head.POINTS})
        assert prediction.gaussians is not None  # noqa: S101 - asked for
        drawn = render(prediction.gaussians, Cameras(cameras, intrinsics, *sample.images.shape[-2:]))
        row |= _psnr_row(name, drawn.rgb.clamp(0, 1), sample)
    flat = sample.images.mean((-2, -1), keepdim=True).expand_as(sample.images)
    return row | _psnr_row("mean_colour", flat, sample)


def _psnr_row(name: str, pictures: Float[Tensor, "all 3 height width"], sample: Sample) -> dict[str, float]:
    """PSNR at the inputs (all pixels) and at the held-out view (pixels whose surface an input sees)."""
    error = (pictures - sample.images).square().mean(1)
    inputs = error[: sample.inputs].mean((1, 2))
    known = sample.visible_from(sample.inputs, range(sample.inputs))
    held_out = error[sample.inputs][known].mean()
    return {
        f"{name}/psnr_inputs": float(-10 * inputs.clamp(min=1e-10).log10().mean()),
        f"{name}/psnr_held_out": float(-10 * held_out.clamp(min=1e-10).log10()),
    }


def pose_errors_deg(sample: Sample) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Per pair of input views the larger of the errors of relative rotation and translation direction (degrees).

    All pairs, and the pairs of which at least one view sees more than 40 % of the other's surface. A view that the
    front-end could not pose counts as 180 degrees.
    """
    truth, estimate = sample.world_from_cam[: sample.inputs], sample.prior_world_from_cam
    everything, overlapping = [], []
    for i in range(sample.inputs):
        for j in range(i + 1, sample.inputs):
            error = 180.0
            if bool(sample.posed[i]) and bool(sample.posed[j]):
                true = rigid_inverse(truth[i]) @ truth[j]
                found = rigid_inverse(estimate[i]) @ estimate[j]
                turned = float(rotation_angle_deg(true[:3, :3], found[:3, :3]))
                cosine = torch.cosine_similarity(true[:3, 3], found[:3, 3], dim=0).clamp(-1, 1)
                error = max(turned, float(torch.rad2deg(torch.acos(cosine))))
            everything.append(error)
            if max(_overlap(sample, i, j), _overlap(sample, j, i)) > OVERLAPPING:
                overlapping.append(error)
    return tuple(everything), tuple(overlapping)


def _overlap(sample: Sample, view: int, other: int) -> float:
    """Share of a view's surface that another view sees."""
    return float(sample.visible_from(view, [other])[sample.valid[view]].float().mean())


def pose_auc(errors_deg: Sequence[float]) -> float:
    """Mean over the integer thresholds 1..30 degrees of the share of pairs below the threshold."""
    if not errors_deg:
        return float("nan")
    errors = torch.tensor(errors_deg)
    return float(torch.stack([(errors < limit).float().mean() for limit in range(1, AUC_DEG + 1)]).mean())


def score_table(scores: Sequence[SceneScores]) -> list[ScoreRow]:
    """The means over scenes, a row each."""
    table: list[ScoreRow] = []
    true = [score.true_cameras for score in scores]
    mean = mean_row(true)

    def add(name: str, value: float, better: str, count: int, **baselines: float) -> None:
        table.append(ScoreRow(name=name, value=value, better=better, baselines=baselines, scenes=count))

    def add_depth(label: str, rows: Sequence[dict[str, float]]) -> None:
        numbers = mean_row(rows)
        for field, better in DEPTH_FIELDS:
            others = {name: numbers[f"{name}/{field}"] for name in ("base", "sparse", "constant")}
            medians = {f"{name}_median": numbers[f"{name}/{field}_median"] for name in ("network", "base", "sparse")}
            add(f"{label}: {field}", numbers[f"network/{field}"], better, len(rows), **others, **medians)

    add_depth("true cameras, base + network, all pixels", true)
    for field, better in DEPTH_FIELDS:
        others = {name: mean[f"{name}/{field}"] for name in ("sparse", "constant")}
        add(f"true cameras, dense base alone: {field}", mean[f"base/{field}"], better, len(true), **others)
    for part in ("confident", "unconfident"):
        for field, better in DEPTH_FIELDS:
            others = {name: mean[f"{name}/{field}_{part}"] for name in ("base", "sparse", "constant")}
            value = mean[f"network/{field}_{part}"]
            add(f"true cameras, {part} pixels: {field}", value, better, len(true), **others)
    add("coverage of the confident pixels", mean["coverage"], "higher", len(true))
    add("share of scenes better than the base (within)", mean["share_better_within"], "higher", len(true))
    add("share of scenes better than the base (abs_rel)", mean["share_better_abs_rel"], "higher", len(true))
    add("share of scenes worse than the base by > .01 (within)", mean["share_worse_by_.01"], "lower", len(true))
    normals, analytic = mean["network/normals_deg"], mean["base/normals_deg"]
    add("normals, mean angle in degrees", normals, "lower", len(true), analytic=analytic)
    for place in ("inputs", "held_out"):
        others = {name: mean[f"{name}/psnr_{place}"] for name in ("base", "mean_colour")}
        value = mean[f"network/psnr_{place}"]
        add(f"Gaussian rendering, PSNR in dB, {place}", value, "higher", len(true), **others)
    noisy = [score.noisy_cameras for score in scores if score.noisy_cameras is not None]
    if noisy:
        add_depth("cameras off by 0.1 degrees and 1 % of the baseline", noisy)
    own = [score.front_end for score in scores if score.front_end is not None]
    if own:
        add_depth("own front-end's cameras, focal unknown", own)
        pairs = [error for score in scores for error in score.pose_errors_deg]
        overlapping = [error for score in scores for error in score.pose_errors_overlapping_deg]
        add("pose AUC@30, all pairs, focal unknown", pose_auc(pairs), "higher", len(own))
        add("pose AUC@30, pairs that overlap > 40 %, focal unknown", pose_auc(overlapping), "higher", len(own))
    return table
