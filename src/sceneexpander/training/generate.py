"""Makes samples: a procedural scene, simulated or real front-end errors, and the real dense base run on them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.frontend.dense import DenseConfig, dense_depth
from sceneexpander.frontend.prior import FrontendConfig, build_priors
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig
from sceneexpander.frontend.sparse_points import SparsePoints
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.geometry.rigid import rigid_inverse
from sceneexpander.synthetic.textures import Split
from sceneexpander.synthetic.views import SyntheticViews, make_views
from sceneexpander.training.sample import Sample
from sceneexpander.training.simulated import perturb_poses, sample_sparse_points

PHOTO_SCALE = 2  # photos over working size, as the pipeline keeps them (`scene.detail_scale`)
PHOTO_SUPERSAMPLE = 1.0  # colour samples per pixel side when training scenes are drawn as photos
MIN_CONFIDENT = 200  # pixels, for the scale of a scene to be read from the confident ones alone


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorConfig:
    """What samples are drawn from. Shares and ranges; every draw comes from the sample's own seed."""

    # Height, width. The working sizes of the front-end, for the base of a smaller picture is another base.
    sizes: tuple[tuple[int, int], ...] = ((280, 336), (280, 336), (336, 280), (252, 336), (224, 336), (168, 224))
    view_shares: tuple[float, ...] = (0.02, 0.13, 0.25, 0.45, 0.1, 0.05)  # of 1, 2, ... input views
    held_out_views: int = 1
    own_cameras_share: float = 0.75  # of the samples of several views: the whole front-end, focal unknown
    # Matches of the front-end there: SIFT's alone take a third of the time of the default, and fail in the same ways.
    own_cameras_learned: LearnedUse = LearnedUse.NEVER
    exact_pose_share: float = 0.35
    strong_noise_share: float = 0.12
    wrong_focal_share: float = 0.1
    pose_noise_deg: tuple[float, float] = (0.02, 0.25)  # log-uniform
    strong_noise_deg: tuple[float, float] = (0.25, 1.0)
    baseline_noise_per_deg: float = 0.1  # share of the mean baseline per degree
    wrong_focal: tuple[float, float] = (0.75, 1.33)  # log-uniform factor
    points_per_view: tuple[tuple[int, int], ...] = ((15, 50), (50, 150), (50, 150), (150, 400))
    point_noise: tuple[float, float] = (0.005, 0.03)
    outliers: float = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """How good the simulated front-end is for one sample."""

    rotation_deg: float = 0.0
    baseline_fraction: float = 0.0
    focal_factor: float = 1.0
    points_per_view: tuple[int, int] = (50, 50)
    point_noise: float = 0.03
    outliers: float = 0.03


def training_sample(index: int, seed: int, config: GeneratorConfig, *, split: Split = "train") -> Sample:
    """Sample number ``index`` of the stream ``seed``: the same arguments give the same sample."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + index)
    shares = torch.tensor(config.view_shares)
    for _ in range(20):
        inputs = 1 + int(torch.multinomial(shares, 1, generator=generator))
        height, width = config.sizes[int(torch.randint(len(config.sizes), (), generator=generator))]
        scene_seed = int(torch.randint(2**31 - 1, (), generator=generator))
        conditions = _draw_conditions(config, generator)
        try:
            scene = make_views(
                scene_seed,
                views=inputs + config.held_out_views,
                height=height,
                width=width,
                supersample=1.3,
                split=split,
            )
        except ValueError:
            # Some worlds have no camera set of that size; the next draw is part of the same deterministic stream.
            continue
        sample = sample_of_scene(scene, inputs, conditions, generator)
        if inputs > 1 and float(torch.rand((), generator=generator)) < config.own_cameras_share:
            photos = input_photos(scene, sample, supersample=PHOTO_SUPERSAMPLE)
            frontend = FrontendConfig(sfm=SfmConfig(learned=config.own_cameras_learned), dense=DenseConfig(threads=1))
            return own_cameras_sample(sample, photos, generator, frontend)
        return sample
    raise ValueError(f"sample {index} of stream {seed}: no scene in 20 attempts")


def _draw_conditions(config: GeneratorConfig, generator: torch.Generator) -> Conditions:
    def log_uniform(low: float, high: float) -> float:
        return low * (high / low) ** float(torch.rand((), generator=generator))

    kind = float(torch.rand((), generator=generator))
    exact = kind < config.exact_pose_share
    strong = not exact and kind < config.exact_pose_share + config.strong_noise_share
    noise = 0.0 if exact else log_uniform(*(config.strong_noise_deg if strong else config.pose_noise_deg))
    wrong_focal = float(torch.rand((), generator=generator)) < config.wrong_focal_share
    focal = log_uniform(*config.wrong_focal) if wrong_focal else 1.0
    points = config.points_per_view[int(torch.randint(len(config.points_per_view), (), generator=generator))]
    low, high = config.point_noise
    return Conditions(
        rotation_deg=noise,
        baseline_fraction=noise * config.baseline_noise_per_deg,
        focal_factor=focal,
        points_per_view=points,
        point_noise=low + (high - low) * float(torch.rand((), generator=generator)),
        outliers=config.outliers,
    )


def sample_of_scene(
    scene: SyntheticViews,
    inputs: int,
    conditions: Conditions,
    generator: torch.Generator,
    *,
    dense: DenseConfig | None = None,
) -> Sample:
    """Run the simulated sparse front-end and the real dense base on the first ``inputs`` views; the rest are held out.

    A view that shares nothing with the others becomes the last input without a pose.
    """
    posed = torch.ones(inputs, dtype=torch.bool)
    if scene.disconnected is not None and len(scene.images) > 1:
        posed[inputs - 1] = inputs == 1
    pick = torch.tensor(input_order(scene, inputs))
    images, depth, valid = scene.images[pick], scene.depth[pick], scene.valid[pick]
    height, width = images.shape[-2:]
    intrinsics = scene.intrinsics_px[pick]
    truth = scene.world_from_cam[pick]
    truth = rigid_inverse(truth[:1]) @ truth
    kept = slice(0, inputs)
    sparse = sample_sparse_points(
        images[kept][posed],
        depth[kept][posed],
        valid[kept][posed],
        Cameras(truth, intrinsics, height, width)[kept][posed],
        generator,
        per_view=conditions.points_per_view,
        depth_noise=conditions.point_noise,
        outliers=conditions.outliers,
    )
    prior_poses = perturb_poses(truth[kept].clone(), conditions.rotation_deg, conditions.baseline_fraction, generator)
    prior_poses[~posed] = torch.eye(4)
    prior_intrinsics = intrinsics[kept].clone()
    prior_intrinsics[:, [0, 1], [0, 1]] *= conditions.focal_factor
    # A longer focal length explains the first view equally well with everything proportionally farther away.
    prior_poses[:, 2, 3] *= conditions.focal_factor
    points = sparse.points_world * sparse.points_world.new_tensor([1.0, 1.0, conditions.focal_factor])
    sparse = SparsePoints(
        points_world=points, view_index=sparse.view_index, point_index=sparse.point_index, pixel_xy=sparse.pixel_xy
    )
    settings = DenseConfig(threads=1) if dense is None else dense
    prior_cameras = Cameras(prior_poses, prior_intrinsics, height, width)
    base = dense_depth(images[kept], prior_cameras, sparse, settings, posed=posed)
    log_base = base.depth.log()
    gap = base.evidence[:, EVIDENCE_CHANNELS.index("sparse")]
    return Sample(
        images=images,
        log_depth=torch.where(valid, depth.log(), torch.inf) + torch.tensor(conditions.focal_factor).log(),
        normals=scene.normals[pick],
        world_from_cam=truth,
        intrinsics_px=intrinsics,
        prior_world_from_cam=prior_poses,
        prior_intrinsics_px=prior_intrinsics,
        prior_log_depth=log_base,
        sparse_log_depth=_add_gap(log_base, gap),
        evidence=base.evidence,
        posed=posed,
        wrong_focal=conditions.focal_factor != 1.0,
        kind=scene.kind,
        seed=scene.seed,
    )


def input_photos(scene: SyntheticViews, sample: Sample, *, supersample: float) -> Float[Tensor, "view 3 tall wide"]:
    """The input views of a sample at the size at which the pipeline looks for features: the same scene, drawn larger."""
    height, width = scene.images.shape[-2:]
    photos = make_views(
        scene.seed,
        views=len(scene.images),
        height=height * PHOTO_SCALE,
        width=width * PHOTO_SCALE,
        supersample=supersample,
        split=scene.split,
    )
    return photos.images[torch.tensor(input_order(scene, sample.inputs)[: sample.inputs])]


def input_order(scene: SyntheticViews, inputs: int) -> list[int]:
    """Which view of a scene is which of a sample: a view that shares nothing with the others becomes the last input."""
    order = list(range(len(scene.images)))
    if scene.disconnected is not None and len(order) > 1:
        order.remove(scene.disconnected)
        order.insert(inputs - 1, scene.disconnected)
    return order


def own_cameras_sample(
    sample: Sample,
    photos: Float[Tensor, "view 3 tall wide"],
    generator: torch.Generator,
    frontend: FrontendConfig,
) -> Sample:
    """The sample with the cameras (focal unknown) and the base of the whole geometric front-end; truth in their scale."""
    priors, _ = build_priors(sample.input_images, frontend, generator=generator, feature_images=photos)
    poses, intrinsics, depth, evidence, posed = (
        priors.world_from_cam,
        priors.intrinsics_px,
        priors.depth,
        priors.evidence,
        priors.posed,
    )
    if poses is None or intrinsics is None or depth is None or evidence is None or posed is None:
        raise ValueError("the front-end returned incomplete priors")
    return in_scale_of_base(
        replace(
            sample,
            prior_world_from_cam=poses,
            prior_intrinsics_px=intrinsics,
            prior_log_depth=depth.log(),
            sparse_log_depth=_add_gap(depth.log(), evidence[:, EVIDENCE_CHANNELS.index("sparse")]),
            evidence=evidence,
            posed=posed,
            wrong_focal=True,
        )
    )


def in_scale_of_base(sample: Sample) -> Sample:
    """The sample with truth multiplied by the one factor that brings its depth to that of the base (median, confident pixels).

    Views without a pose have no say, unless no view has one.
    """
    counted = sample.valid[: sample.inputs]
    if bool(sample.posed.any()):
        counted = counted & sample.posed[:, None, None]
    confident = counted & sample.priors_confident()
    counted = confident if int(confident.sum()) >= MIN_CONFIDENT else counted
    if not bool(counted.any()):
        return sample
    shift = (sample.prior_log_depth - sample.log_depth[: sample.inputs])[counted].median()
    world_from_cam = sample.world_from_cam.clone()
    world_from_cam[:, :3, 3] *= shift.exp()
    return replace(sample, log_depth=sample.log_depth + shift, world_from_cam=world_from_cam)


def _add_gap(log_base: Float[Tensor, "view height width"], gap: Float[Tensor, "view height width"]) -> Tensor:
    """The sparse interpolation, from the evidence channel log(interpolated / final), which is clamped to [-1, 1]."""
    return log_base + gap
