"""Views that bundle adjustment could not take: last-chance registration, rotation-only motion, placeholders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sceneexpander.frontend.features import Features
from sceneexpander.frontend.mapping import Mapping
from sceneexpander.frontend.resection import solve_pose
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.twoview import (
    PairMatches,
    fit_rotation,
    homogeneous_rays,
    relative_pose,
    triangulate_pair,
)

_MAX_REFERENCE_DISTANCE_PX = 2.0  # a matched keypoint this near (at 768 px) to a triangulated one is taken to be it
_MIN_SPREAD = (
    0.12  # of the long side: standard deviation of a last-chance view's inliers, or the pose hangs on one spot
)

_MIN_PAIR_FOR_DISTANCE = 40  # verified matches: an essential matrix without a third view to confirm it needs plenty


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """How a view outside the adjusted model got its pose."""

    loose: bool  # an estimate, though a rough one; False: a placeholder
    reason: str
    like: int | None  # the view it was placed by or borrows from
    inliers: int


def place_remaining(
    mapping: Mapping,
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    grey_thumbnails: np.ndarray,
    config: SfmConfig,
    *,
    rng: np.random.Generator,
    refused: dict[int, str] | None = None,
) -> dict[int, Placement]:
    """Give every unregistered view a pose: a loose estimate where one holds, else the most similar posed view's.

    Changes ``mapping``'s poses (not ``registered``, which stays the adjusted model's own views). Views that were ``refused`` for a reason
    are not placed roughly either.
    """
    placed: dict[int, Placement] = {}
    refused = {} if refused is None else refused
    posed = mapping.registered.copy()
    open_views = np.array([not mapping.registered[view] and view not in refused for view in range(len(posed))])
    for view in np.flatnonzero(open_views):
        found = _loose_registration(mapping, features, pairs, int(view), config)
        if found is not None:
            placed[int(view)] = found
            posed[view] = True
    before = -1
    while posed.sum() > before:  # chains: a view may hang on one that was itself placed here
        before = int(posed.sum())
        for view in np.flatnonzero(open_views & ~posed):
            found = _rotation_only(mapping, features, pairs, int(view), np.flatnonzero(posed), config, rng=rng)
            if found is None:
                found = _assumed_distance(mapping, features, pairs, int(view), np.flatnonzero(posed), config)
            if found is not None:
                placed[int(view)] = found
                posed[view] = True
    for view in np.flatnonzero(~posed):
        made = _placeholder(mapping, pairs, grey_thumbnails, int(view), np.flatnonzero(posed))
        placed[int(view)] = replace(made, reason=refused.get(int(view), made.reason))
    return placed


def pair_of(pairs: Sequence[PairMatches], view: int, other: int) -> tuple[PairMatches, bool] | None:
    """The pair of two views, and whether ``view`` is its first."""
    for pair in pairs:
        if (pair.view_a, pair.view_b) == (view, other):
            return pair, True
        if (pair.view_a, pair.view_b) == (other, view):
            return pair, False
    return None


def _loose_registration(
    mapping: Mapping, features: Sequence[Features], pairs: Sequence[PairMatches], view: int, config: SfmConfig
) -> Placement | None:
    """PnP from unverified matches to keypoints that sit on triangulated points, at the last-chance threshold."""
    world, pixels = _loose_correspondences(mapping, features, pairs, view)
    if len(world) < config.min_loose_inliers:
        return None
    threshold = config.loose_px * mapping.unit_px
    # Half the threshold as robust scale: such matches are off by several pixels, and all of them count a little.
    found = solve_pose(
        world,
        pixels,
        mapping.intrinsics[view],
        threshold_px=threshold,
        robust_px=threshold / 2,
        seed=mapping.seed + view,
    )
    if found is None:
        return None
    rotation, translation, inlier = found
    places = np.unique(np.rint(pixels[inlier] / (4 * mapping.unit_px)), axis=0)
    long_side = 768 * mapping.unit_px
    if len(places) < config.min_loose_inliers or pixels[inlier].std(0).max() < _MIN_SPREAD * long_side / 2:
        return None
    mapping.rotations[view], mapping.translations[view] = rotation, translation
    reason = f"only {len(places)} rough matches fit (within {config.loose_px:g} px at 768 px)"
    return Placement(loose=True, reason=reason, like=None, inliers=len(places))


def _loose_correspondences(
    mapping: Mapping, features: Sequence[Features], pairs: Sequence[PairMatches], view: int
) -> tuple[np.ndarray, np.ndarray]:
    """(world points, pixels in ``view``) of loose matches to registered views."""
    from scipy.spatial import cKDTree

    world, pixels = [np.zeros((0, 3))], [np.zeros((0, 2))]
    for other in np.flatnonzero(mapping.registered).tolist():
        found = pair_of(pairs, view, other)
        rows = np.flatnonzero(mapping.active[:, other])
        if found is None or len(rows) == 0:
            continue
        pair, first = found
        mine, theirs = (pair.loose.index_a, pair.loose.index_b) if first else (pair.loose.index_b, pair.loose.index_a)
        if len(mine) == 0:
            continue
        tree = cKDTree(mapping.tracks.pixel_xy[rows, other])
        distance, nearest = tree.query(features[other].pixel_xy[theirs])
        close = distance < _MAX_REFERENCE_DISTANCE_PX * mapping.unit_px
        world.append(mapping.points[rows[nearest[close]]])
        pixels.append(features[view].pixel_xy[mine[close]])
    return np.concatenate(world), np.concatenate(pixels)


def _rotation_only(
    mapping: Mapping,
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    view: int,
    posed: np.ndarray,
    config: SfmConfig,
    *,
    rng: np.random.Generator,
) -> Placement | None:
    """The centre of a posed view and the rotation between the two, if a pure rotation explains their matches."""
    best: tuple[int, int, np.ndarray] | None = None
    for other in posed:
        found = pair_of(pairs, view, int(other))
        if found is None or found[0].verified.count < config.min_pair_inliers:
            continue
        pair, first = found
        mine, theirs = (
            (pair.verified.index_a, pair.verified.index_b) if first else (pair.verified.index_b, pair.verified.index_a)
        )
        rotation, inlier = fit_rotation(
            features[other].pixel_xy[theirs],
            features[view].pixel_xy[mine],
            mapping.intrinsics[other],
            mapping.intrinsics[view],
            threshold_px=config.rotation_px * mapping.unit_px,
            rng=rng,
        )
        agreeing = int(inlier.sum())
        if agreeing >= config.rotation_share * len(mine) and (best is None or agreeing > best[1]):
            best = int(other), agreeing, rotation
    if best is None:
        return None
    other, agreeing, rotation = best
    mapping.rotations[view] = rotation @ mapping.rotations[other]
    mapping.translations[view] = rotation @ mapping.translations[other]
    reason = f"no parallax: only its rotation relative to view {other} is known ({agreeing} matches)"
    return Placement(loose=True, reason=reason, like=other, inliers=agreeing)


def _assumed_distance(
    mapping: Mapping,
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    view: int,
    posed: np.ndarray,
    config: SfmConfig,
) -> Placement | None:
    """Pose from the essential matrix with one posed view; its length such that both see things equally far away.

    For views that share matches with a posed view, but on surfaces where nothing was triangulated.
    """
    candidates = []
    for other in posed.tolist():
        found = pair_of(pairs, view, other)
        if found is not None and found[0].verified.count >= _MIN_PAIR_FOR_DISTANCE:
            candidates.append((found[0].verified.count, other, found))
    for _, other, (pair, first) in sorted(candidates, key=lambda entry: (-entry[0], entry[1])):
        matches = pair.verified
        mine, theirs = (matches.index_a, matches.index_b) if first else (matches.index_b, matches.index_a)
        xy_other, xy_view = features[other].pixel_xy[theirs], features[view].pixel_xy[mine]
        pose = relative_pose(
            xy_other,
            xy_view,
            mapping.intrinsics[other],
            mapping.intrinsics[view],
            threshold_px=config.epipolar_px * mapping.unit_px,
            seed=mapping.seed + view,
        )
        known = _visible_depths(mapping, other)
        if pose is None or pose.inlier.mean() < 0.5 or pose.angle_deg < config.min_angle_deg or len(known) == 0:
            continue
        _, depths = triangulate_pair(
            homogeneous_rays(xy_other[pose.inlier], mapping.intrinsics[other]),
            homogeneous_rays(xy_view[pose.inlier], mapping.intrinsics[view]),
            pose.rotation,
            pose.translation,
        )
        length = float(np.median(known) / np.median(depths[:, 0]))
        mapping.rotations[view] = pose.rotation @ mapping.rotations[other]
        mapping.translations[view] = pose.rotation @ mapping.translations[other] + length * pose.translation
        agreeing = int(pose.inlier.sum())
        reason = (
            f"its distance from view {other} is assumed ({agreeing} matches, none on points that other views share)"
        )
        return Placement(loose=True, reason=reason, like=other, inliers=agreeing)
    return None


def _visible_depths(mapping: Mapping, view: int) -> np.ndarray:
    """Depths of the model's points in a view: those it observes, or else all in front of it."""
    depths = mapping.points @ mapping.rotations[view][2] + mapping.translations[view][2]
    observed = depths[mapping.active[:, view] & mapping.valid]
    return observed if len(observed) else depths[mapping.valid & (depths > 0)]


def _placeholder(
    mapping: Mapping, pairs: Sequence[PairMatches], thumbnails: np.ndarray, view: int, posed: np.ndarray
) -> Placement:
    """The pose of the posed view that shares most matches, or else looks most alike; the identity if none is posed."""
    if len(posed) == 0:
        mapping.rotations[view], mapping.translations[view] = np.eye(3), np.zeros(3)
        return Placement(loose=False, reason="no view of the set could be posed", like=None, inliers=0)
    matches = np.zeros(len(posed))
    verified = np.zeros(len(posed))
    for position, other in enumerate(posed):
        found = pair_of(pairs, view, int(other))
        if found is not None:
            verified[position] = found[0].verified.count
            matches[position] = found[0].tentative
    alike = thumbnails[posed] @ thumbnails[view]
    # Verified matches decide; a thumbnail decides among views without any.
    like = int(posed[np.lexsort((alike, verified))[-1]])
    mapping.rotations[view], mapping.translations[view] = mapping.rotations[like], mapping.translations[like]
    if verified.max() > 0:
        reason = f"its {int(verified.max())} verified matches fit no pose"
    else:
        reason = f"shares too few matches with the posed views (at most {int(matches.max())} tentative)"
    return Placement(loose=False, reason=reason, like=like, inliers=0)


def thumbnails_of(greys: Sequence[np.ndarray]) -> np.ndarray:
    """(view, 256) unit-length, zero-mean thumbnails: their dot product says how alike two views look."""
    import cv2

    small = np.stack([cv2.resize(grey, (16, 16), interpolation=cv2.INTER_AREA).reshape(-1) for grey in greys])
    centred = small.astype(np.float64) - small.mean(1, keepdims=True)
    return centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-9)
