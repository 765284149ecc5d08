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
from sceneexpander.geometry.similarity import align_poses

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
    settled: SettledCameras | None = None,
) -> tuple[Priors, SparseReconstruction]:
    """Everything a reconstructor can be told about S >= 1 views; arguments as in `sfm.estimate_cameras` and `keep_settled`.

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
    if settled is not None:
        sparse = keep_settled(sparse, settled)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class SettledCameras:
    """Cameras of the first views as they were found before, in any frame and unit, and which of them are not to be found anew."""

    world_from_cam: Float[Tensor, "settled 4 4"]
    intrinsics_px: Float[Tensor, "settled 3 3"]
    posed: Bool[Tensor, "settled"]
    kept: Bool[Tensor, "settled"]


def keep_settled(sparse: SparseReconstruction, settled: SettledCameras) -> SparseReconstruction:
    """The reconstruction with the cameras that are kept where they were, relative to all others with a pose then and now.

    A picture that was inserted and need not agree with the place takes part in what is estimated next, and so do pictures that were drawn
    of it: its camera would follow whatever they have in common. As it was when all was made from it, it shows what it showed. Its
    observations go: they belong to another camera. Fewer than two others, or others all in one place: nothing is changed.
    """
    count = len(settled.kept)
    posed = settled.posed.to(sparse.posed.device)
    anchors = torch.nonzero(sparse.posed[:count] & posed & ~settled.kept)[:, 0]
    kept = torch.nonzero(settled.kept & posed)[:, 0]
    if len(anchors) < 2 or len(kept) == 0:
        return sparse
    try:
        similarity = align_poses(settled.world_from_cam[anchors], sparse.world_from_cam[anchors])
    except ValueError:  # they stand in one place: no scale
        return sparse
    poses, lenses, found = sparse.world_from_cam.clone(), sparse.intrinsics_px.clone(), sparse.posed.clone()
    poses[kept] = similarity.poses(settled.world_from_cam[kept]).to(poses)
    lenses[kept], found[kept] = settled.intrinsics_px[kept].to(lenses), True
    points = sparse.sparse
    left = ~torch.isin(points.view_index, kept)
    return replace(
        sparse,
        world_from_cam=poses,
        intrinsics_px=lenses,
        posed=found,
        sparse=replace(
            points,
            view_index=points.view_index[left],
            point_index=points.point_index[left],
            pixel_xy=points.pixel_xy[left],
        ),
    )


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
