"""Cameras and sparse points of a handful of photos: calibrated structure from motion with an unknown shared focal.

Features -> mutual matches -> verified pairs -> tracks; then, for several plausible focals, an initial pair chosen by inliers
x triangulation angle, PnP registration, triangulation and bundle adjustment; the focal that explains the matches best is kept
and refined where there is enough evidence. Every view comes out with a pose; those without evidence are marked.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.frontend.features import Features, detect_features, grey_u8
from sceneexpander.frontend.mapping import Mapping
from sceneexpander.frontend.placement import place_remaining, thumbnails_of
from sceneexpander.frontend.sfm_report import build_reconstruction
from sceneexpander.frontend.sfm_types import (
    REFERENCE_LONG_SIDE_PX,
    FocalSource,
    PairKind,
    PairReport,
    SfmConfig,
    SfmReport,
    SparseReconstruction,
    ViewReport,
)
from sceneexpander.frontend.tracks import Tracks, build_tracks
from sceneexpander.frontend.twoview import (
    PairMatches,
    fit_rotation,
    fundamental_from_poses,
    match_and_verify,
    match_guided,
    relative_pose,
)

__all__ = ["SfmConfig", "SfmReport", "SparseReconstruction", "ViewReport", "estimate_cameras"]

_MIN_COMMON = 8  # points two views must share before their matches are worth finding again

_log = logging.getLogger(__name__)


def estimate_cameras(
    images: Float[Tensor, "view 3 height width"],
    config: SfmConfig,
    *,
    generator: torch.Generator,
    feature_images: Float[Tensor, "view 3 feature_height feature_width"] | None = None,
    known_intrinsics_px: Float[Tensor, "view 3 3"] | None = None,
    known_world_from_cam: Float[Tensor, "view 4 4"] | None = None,
    focal_hint_px: float | None = None,
    names: Sequence[str] | None = None,
) -> SparseReconstruction:
    """Poses, intrinsics and sparse points of S >= 1 views. Never fails on hard images: see ``report`` and ``posed``.

    Args:
        images: RGB in [0, 1]; results are in their pixels.
        config: constants.
        generator: source of every random draw.
        feature_images: the same views with the same framing at a higher resolution, for features only.
        known_intrinsics_px: of ``images``; kept as they are unless the configuration says otherwise.
        known_world_from_cam: any world frame and unit; rows that are not finite are unknown. Kept relative to each other
            (the result is expressed in view 0's frame and rescaled, see ``report.scale``) unless the configuration says
            otherwise.
        focal_hint_px: focal of all views in pixels of ``images`` (EXIF): a strong hint, still refined.
        names: of the views, for the report.

    Raises:
        UserError: known cameras that are no cameras.
        ValueError: tensors whose shapes do not agree.
    """
    setup = _prepare(images, feature_images, config, generator, names)
    known = _known_cameras(setup, known_intrinsics_px, known_world_from_cam)
    features = [detect_features(grey, config) for grey in setup.greys]
    pairs = _all_pairs(features, config, setup)
    focal = _FocalPlan.make(config, setup, known, focal_hint_px)
    kinds = _pair_kinds(features, pairs, focal.nominal, config, setup)
    mapping, source = _map(build_tracks(features, pairs), features, pairs, kinds, known, focal, config, setup)
    if not mapping.registered.any():
        mapping.registered[0] = True  # the frame of reference, with or without others
    placed = place_remaining(
        mapping, features, pairs, thumbnails_of(setup.greys), config, rng=np.random.default_rng(setup.seed)
    )
    pair_reports = tuple(
        PairReport(view_a=p.view_a, view_b=p.view_b, matches=p.tentative, inliers=p.verified.count, kind=kind)
        for p, kind in zip(pairs, kinds, strict=True)
    )
    return build_reconstruction(mapping, placed, features, pair_reports, source, setup.names, setup.scale_xy)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Setup:
    """Inputs in the form the steps need."""

    greys: list[np.ndarray]
    names: tuple[str, ...]
    scale_xy: np.ndarray  # pixels of the given images per pixel of the feature images
    unit_px: float
    seed: int

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the feature images."""
        height, width = self.greys[0].shape
        return int(height), int(width)

    @property
    def long_side(self) -> int:
        """Longer side of the feature images in pixels."""
        return max(self.size)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Known:
    """Given cameras, in feature pixels; ``posed`` marks the views whose pose was given."""

    intrinsics: np.ndarray | None
    cam_from_world: np.ndarray  # identity where unknown
    posed: np.ndarray


def _prepare(
    images: Tensor,
    feature_images: Tensor | None,
    config: SfmConfig,
    generator: torch.Generator,
    names: Sequence[str] | None,
) -> _Setup:
    """Check shapes, make grey images and draw the seed."""
    if images.ndim != 4 or images.shape[1] != 3 or images.shape[0] < 1:
        raise ValueError(f"images must be (view, 3, height, width) with at least one view, are {tuple(images.shape)}")
    source = images if feature_images is None else feature_images
    if source.ndim != 4 or source.shape[:2] != images.shape[:2]:
        raise ValueError(f"feature_images {tuple(source.shape)} do not belong to images {tuple(images.shape)}")
    labels = tuple(f"view {i}" for i in range(images.shape[0])) if names is None else tuple(names)
    if len(labels) != images.shape[0]:
        raise ValueError(f"{len(labels)} names for {images.shape[0]} views")
    height, width = source.shape[2:]
    # Always one draw, so that the caller's stream does not depend on what was found.
    seed = int(torch.randint(0, 2**30, (1,), generator=generator).item())
    return _Setup(
        greys=[grey_u8(image) for image in source.detach().cpu().numpy()],
        names=labels,
        scale_xy=np.array([images.shape[3] / width, images.shape[2] / height]),
        unit_px=max(height, width) / REFERENCE_LONG_SIDE_PX,
        seed=seed,
    )


def _known_cameras(setup: _Setup, intrinsics_px: Tensor | None, world_from_cam: Tensor | None) -> _Known:
    """Validate given cameras and bring them to feature pixels and ``cam_from_world``."""
    views = len(setup.greys)
    intrinsics = None
    if intrinsics_px is not None:
        intrinsics = intrinsics_px.detach().cpu().numpy().astype(np.float64)
        if intrinsics.shape != (views, 3, 3):
            raise ValueError(f"known_intrinsics_px must be ({views}, 3, 3), is {intrinsics.shape}")
        if not np.isfinite(intrinsics).all() or (intrinsics[:, [0, 1], [0, 1]] <= 0).any():
            raise UserError(
                "holds a focal length that is not positive", where="known intrinsics", fix="give pixels > 0"
            )
        intrinsics = intrinsics * np.array([1 / setup.scale_xy[0], 1 / setup.scale_xy[1], 1.0])[:, None]
    cam_from_world = np.tile(np.eye(4), (views, 1, 1))
    posed = np.zeros(views, bool)
    if world_from_cam is not None:
        given = world_from_cam.detach().cpu().numpy().astype(np.float64)
        if given.shape != (views, 4, 4):
            raise ValueError(f"known_world_from_cam must be ({views}, 4, 4), is {given.shape}")
        posed = np.asarray(np.isfinite(given).all((1, 2)))
        for view in np.flatnonzero(posed):
            rotation = given[view, :3, :3]
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
                raise UserError(
                    "is not a rigid pose",
                    where=f"known pose of {setup.names[view]}",
                    fix="give camera-to-world, OpenCV axes",
                )
            u, _, vt = np.linalg.svd(rotation)  # poses from text files are orthogonal to a few digits only
            cam_from_world[view, :3, :3] = (u @ vt).T
            cam_from_world[view, :3, 3] = -(u @ vt).T @ given[view, :3, 3]
    return _Known(intrinsics=intrinsics, cam_from_world=cam_from_world, posed=posed)


@dataclass(frozen=True, slots=True, kw_only=True)
class _FocalPlan:
    """Start intrinsics to try, and how tightly the focal is tied to its prior."""

    starts: tuple[np.ndarray, ...]  # each (view, 3, 3)
    nominal: np.ndarray  # (view, 3, 3): for decisions that any plausible focal serves
    prior: float  # focal over long side
    sigma: float
    source: FocalSource | None  # set when nothing is to be estimated or hinted
    refine: bool

    @classmethod
    def make(cls, config: SfmConfig, setup: _Setup, known: _Known, focal_hint_px: float | None) -> _FocalPlan:
        """Known intrinsics, else the hint, else the sweep."""
        views = len(setup.greys)
        if known.intrinsics is not None:
            ratio = float(known.intrinsics[0, 0, 0]) / setup.long_side
            return cls(
                starts=(known.intrinsics,),
                nominal=known.intrinsics,
                prior=ratio,
                sigma=config.focal_hint_sigma,
                source=FocalSource.KNOWN,
                refine=config.refine_known_intrinsics,
            )

        def intrinsics(ratio: float) -> np.ndarray:
            height, width = setup.size
            focal = ratio * setup.long_side
            return np.tile(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), (views, 1, 1))

        if focal_hint_px is not None:
            if not np.isfinite(focal_hint_px) or focal_hint_px <= 0:
                raise UserError(f"is {focal_hint_px}", where="focal hint", fix="give pixels > 0, or none")
            ratio = focal_hint_px / float(setup.scale_xy[0]) / setup.long_side
            start = intrinsics(ratio)
            return cls(
                starts=(start,),
                nominal=start,
                prior=ratio,
                sigma=config.focal_hint_sigma,
                source=FocalSource.HINT,
                refine=True,
            )
        return cls(
            starts=tuple(intrinsics(ratio) for ratio in config.focal_starts),
            nominal=intrinsics(config.focal_prior),
            prior=config.focal_prior,
            sigma=config.focal_prior_sigma,
            source=None,
            refine=True,
        )


def _all_pairs(features: list[Features], config: SfmConfig, setup: _Setup) -> list[PairMatches]:
    """Matches of every pair of views."""
    views = len(features)
    return [
        match_and_verify(a, b, features, config, unit_px=setup.unit_px, seed=setup.seed)
        for a in range(views)
        for b in range(a + 1, views)
    ]


def _pair_kinds(
    features: list[Features], pairs: list[PairMatches], intrinsics: np.ndarray, config: SfmConfig, setup: _Setup
) -> list[PairKind]:
    """Which pairs have parallax. The focal hardly matters for that question."""
    kinds = []
    rng = np.random.default_rng(setup.seed)
    for pair in pairs:
        a, b, matches = pair.view_a, pair.view_b, pair.verified
        if matches.count == 0:
            kinds.append(PairKind.UNRELATED)
            continue
        _, inlier = fit_rotation(
            features[a].pixel_xy[matches.index_a],
            features[b].pixel_xy[matches.index_b],
            intrinsics[a],
            intrinsics[b],
            threshold_px=config.rotation_px * setup.unit_px,
            rng=rng,
        )
        rotation_only = inlier.sum() >= config.rotation_share * matches.count
        kinds.append(PairKind.ROTATION if rotation_only else PairKind.PARALLAX)
    return kinds


def _map(
    tracks: Tracks,
    features: list[Features],
    pairs: list[PairMatches],
    kinds: list[PairKind],
    known: _Known,
    focal: _FocalPlan,
    config: SfmConfig,
    setup: _Setup,
) -> tuple[Mapping, FocalSource]:
    """The best model over all focal starts and initial pairs, finished; and where its focal came from."""
    enough = len(setup.greys) >= config.min_views_for_focal or focal.source is not None
    few = tracks.longest(config.sweep_tracks)

    def grown(start: np.ndarray, pair: PairMatches | None) -> Mapping | None:
        candidate = _new_mapping(few, start, focal, config, setup)
        if pair is None:
            _set_known_poses(candidate, known)
        elif not _set_initial_pair(candidate, features, pair, config):
            return None
        candidate.grow(refine_focal=focal.refine and enough, free=_free_views(candidate, known, config))
        return candidate

    initial: list[PairMatches | None] = [None]
    if not known.posed.any():
        initial = _initial_pairs(features, pairs, kinds, focal.nominal, config, setup)
    best: Mapping | None = None
    for position, pair in enumerate(initial):
        # The first pair finds the focal; further pairs only have to beat it there.
        starts = focal.starts if position == 0 or best is None else (best.start_intrinsics,)
        for candidate in (grown(start, pair) for start in starts):
            if candidate is not None and (best is None or candidate.score() > best.score()):
                best = candidate
    if best is None or not best.valid.any():
        empty = _new_mapping(tracks, focal.nominal, focal, config, setup)
        _set_known_poses(empty, known)
        return empty, focal.source or FocalSource.ASSUMED
    best = _on_all_tracks(best, tracks, focal, config, setup)
    free = _free_views(best, known, config)
    best.grow(refine_focal=False, free=free)
    refine = focal.refine and (focal.source is not None or int(best.registered.sum()) >= config.min_views_for_focal)
    refine = _finish(best, refine, free, config)
    if config.guided:
        again = build_tracks(features, _guided_pairs(best, features, pairs, config))
        best = _on_all_tracks(best, again, focal, config, setup)
        best.grow(refine_focal=False, free=_free_views(best, known, config))
        refine = _finish(best, refine, free, config)
    if refine:
        return best, FocalSource.REFINED
    return best, focal.source or FocalSource.SWEPT


def _new_mapping(
    tracks: Tracks, intrinsics: np.ndarray, focal: _FocalPlan, config: SfmConfig, setup: _Setup
) -> Mapping:
    """An empty model with start intrinsics, bounds and prior of the focal relative to them."""
    mapping = Mapping(tracks, intrinsics, config, unit_px=setup.unit_px, seed=setup.seed)
    ratio = float(intrinsics[0, 0, 0]) / setup.long_side
    low, high = config.focal_bounds
    # A given focal outside the bounds is believed, and stays where it is.
    mapping.log_focal_bounds = (min(np.log(low / ratio), 0.0), max(np.log(high / ratio), 0.0))
    mapping.log_focal_prior = (float(np.log(focal.prior / ratio)), focal.sigma)
    return mapping


def _finish(mapping: Mapping, refine: bool, free: np.ndarray | None, config: SfmConfig) -> bool:
    """Finish a model; a focal that turns out too uncertain goes back to where it was. Returns whether it was refined."""
    before = mapping.log_focal
    mapping.finish(refine_focal=refine, free=free)
    if refine and mapping.focal_sigma > config.max_focal_sigma:
        _log.info("focal is uncertain (sigma of its logarithm %.2f): kept at its start", mapping.focal_sigma)
        mapping.log_focal = before
        mapping.finish(refine_focal=False, free=free)
        return False
    return refine


def _guided_pairs(
    mapping: Mapping, features: list[Features], pairs: list[PairMatches], config: SfmConfig
) -> list[PairMatches]:
    """All pairs, those of registered views with motion between them matched again along the epipolar lines."""
    found = []
    intrinsics = mapping.intrinsics
    for pair in pairs:
        a, b = pair.view_a, pair.view_b
        rotation = mapping.rotations[b] @ mapping.rotations[a].T
        translation = mapping.translations[b] - rotation @ mapping.translations[a]
        common = int((mapping.active[:, a] & mapping.active[:, b]).sum())
        if not (mapping.registered[a] and mapping.registered[b]) or common < _MIN_COMMON:
            found.append(pair)
            continue
        fundamental = fundamental_from_poses(rotation, translation, intrinsics[a], intrinsics[b])
        found.append(match_guided(pair, features, fundamental, config, unit_px=mapping.unit_px))
    return found


def _on_all_tracks(model: Mapping, tracks: Tracks, focal: _FocalPlan, config: SfmConfig, setup: _Setup) -> Mapping:
    """The same cameras over all tracks."""
    full = _new_mapping(tracks, model.start_intrinsics, focal, config, setup)
    full.adopt(model)
    return full


def _set_known_poses(mapping: Mapping, known: _Known) -> None:
    """Register the views whose pose was given."""
    mapping.rotations[:] = known.cam_from_world[:, :3, :3]
    mapping.translations[:] = known.cam_from_world[:, :3, 3]
    mapping.registered = known.posed.copy()


def _free_views(mapping: Mapping, known: _Known, config: SfmConfig) -> Bool[np.ndarray, " view"] | None:
    """Cameras that adjustment may move; None leaves the choice of the reference to the mapping."""
    if not known.posed.any():
        return None
    free = ~known.posed
    if config.refine_known_poses:
        free[:] = True
        free[np.flatnonzero(known.posed)[0]] = False
    return free


def _initial_pairs(
    features: list[Features],
    pairs: list[PairMatches],
    kinds: list[PairKind],
    intrinsics: np.ndarray,
    config: SfmConfig,
    setup: _Setup,
) -> list[PairMatches | None]:
    """The most promising pairs to begin with: inliers x triangulation angle, capped."""
    scored: list[tuple[float, PairMatches]] = []
    for pair, kind in zip(pairs, kinds, strict=True):
        if kind is not PairKind.PARALLAX:
            continue
        a, b = pair.view_a, pair.view_b
        pose = relative_pose(
            features[a].pixel_xy[pair.verified.index_a],
            features[b].pixel_xy[pair.verified.index_b],
            intrinsics[a],
            intrinsics[b],
            threshold_px=config.epipolar_px * setup.unit_px,
            seed=setup.seed,
        )
        if pose is not None and pose.angle_deg > config.min_angle_deg:
            scored.append((float(pose.inlier.sum()) * min(pose.angle_deg, config.max_initial_angle_deg), pair))
    scored.sort(key=lambda entry: -entry[0])
    return [pair for _, pair in scored[: config.initial_pairs]]


def _set_initial_pair(mapping: Mapping, features: list[Features], pair: PairMatches, config: SfmConfig) -> bool:
    """Start the model from one pair; False if it has no motion at this focal."""
    a, b = pair.view_a, pair.view_b
    pose = relative_pose(
        features[a].pixel_xy[pair.verified.index_a],
        features[b].pixel_xy[pair.verified.index_b],
        mapping.intrinsics[a],
        mapping.intrinsics[b],
        threshold_px=config.epipolar_px * mapping.unit_px,
        seed=mapping.seed,
    )
    if pose is None:
        return False
    mapping.start(a, b, pose)
    return True
