"""The whole geometric front-end: photos -> cameras, dense depth and evidence, in one frame and one scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.frontend.dense import DenseConfig, checked_share, dense_depth
from sceneexpander.frontend.known_depth import merge_known_depth
from sceneexpander.frontend.lenses import ViewOptics
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.sfm import Judge, estimate_cameras
from sceneexpander.frontend.sfm_types import FocalSource, SfmConfig, SparseReconstruction
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.priors import Priors

_JUDGE_PX = 240  # long side at which camera models are compared; half the pixels of the full size


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontendConfig:
    """Constants of both halves of the front-end."""

    strict: bool = False  # what is not as it should be about the cameras ends the run instead of being said
    sfm: SfmConfig = field(default_factory=SfmConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)


def build_priors(
    images: Float[Tensor, "view 3 height width"],
    config: FrontendConfig,
    *,
    generator: torch.Generator,
    feature_images: Float[Tensor, "view 3 feature_height feature_width"] | None = None,
    known_intrinsics_px: Float[Tensor, "view 3 3"] | None = None,
    known_world_from_cam: Float[Tensor, "view 4 4"] | None = None,
    known_depth: Float[Tensor, "view height width"] | None = None,
    focal_hint_px: float | None = None,
    names: Sequence[str] | None = None,
    optics: Sequence[ViewOptics] | None = None,
    valid: Bool[Tensor, "view height width"] | None = None,
    memory: MatchMemory | None = None,
) -> tuple[Priors, SparseReconstruction]:
    """Everything a reconstructor can be told about S >= 1 views; arguments as in `sfm.estimate_cameras`.

    World frame: view 0's camera. Scale: the median of view 0's dense depth is 1, for poses, points and depth together. ``known_depth``
    (in the unit of the known poses; 0 where there is none) takes the place of matched depth where it agrees with it.
    """
    sparse = estimate_cameras(
        images,
        config.sfm,
        generator=generator,
        feature_images=feature_images,
        known_intrinsics_px=known_intrinsics_px,
        known_world_from_cam=known_world_from_cam,
        focal_hint_px=focal_hint_px,
        names=names,
        optics=optics,
        valid=valid,
        memory=memory,
        judge=picture_judge(images, config.dense),
    )
    dense = dense_depth(
        straighten(images, sparse)[0],
        cameras_of(sparse, images),
        sparse.sparse,
        config.dense,
        posed=sparse.posed,
    )
    depth, evidence = dense.depth, dense.evidence
    if known_depth is not None:
        given = bool(known_world_from_cam is not None and (sparse.report.focal_source is FocalSource.KNOWN))
        unit = sparse.report.scale if given else None
        depth, evidence, note = merge_known_depth(depth, evidence, known_depth.cpu(), unit=unit)
        if note:
            sparse = replace(sparse, report=replace(sparse.report, notes=(*sparse.report.notes, note)))
    scale = 1.0 / float(depth[0].median())
    sparse = rescale(sparse, scale)
    priors = Priors(
        world_from_cam=sparse.world_from_cam,
        intrinsics_px=sparse.intrinsics_px,
        depth=depth * scale,
        evidence=evidence,
        posed=sparse.posed,
    )
    return priors, sparse


def picture_judge(images: Float[Tensor, "view 3 height width"], dense: DenseConfig) -> Judge:
    """Says of cameras which share of the pictures they explain: pixels that match another view and lead back.

    A camera model is made of its own matches and explains them whatever they are; the pictures were not asked before.
    """
    rough = replace(dense, work_px=min(dense.work_px, _JUDGE_PX))

    def judge(candidate: SparseReconstruction) -> float:
        return checked_share(
            straighten(images, candidate)[0],
            cameras_of(candidate, images),
            candidate.sparse,
            rough,
            posed=candidate.posed,
        )

    return judge


def straighten(
    images: Float[Tensor, "view 3 height width"], found: SparseReconstruction
) -> tuple[Float[Tensor, "view 3 height width"], Bool[Tensor, "view height width"] | None]:
    """The pictures as pinhole cameras see them, and where they show something; as they are (and None) if the lens bends nothing."""
    if found.distortion is None:
        return images.cpu(), None
    return found.distortion.straightened(images.cpu())


def cameras_of(found: SparseReconstruction, images: Float[Tensor, "view 3 height width"]) -> Cameras:
    """What was found as the cameras of these pictures."""
    height, width = images.shape[-2:]
    return Cameras(found.world_from_cam, found.intrinsics_px, height, width)


def rescale(reconstruction: SparseReconstruction, scale: float) -> SparseReconstruction:
    """The same reconstruction with every length multiplied by ``scale``."""
    world_from_cam = reconstruction.world_from_cam.clone()
    world_from_cam[:, :3, 3] *= scale
    return replace(
        reconstruction,
        world_from_cam=world_from_cam,
        sparse=replace(reconstruction.sparse, points_world=reconstruction.sparse.points_world * scale),
        report=replace(reconstruction.report, scale=reconstruction.report.scale * scale),
    )
