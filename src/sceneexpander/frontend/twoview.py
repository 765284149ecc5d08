"""Geometry of one pair of views: verified matches, essential matrix, rotation-only motion.

Points are in pixels, first pixel centre at 0.5. Relative poses are ``b_from_a``: x_b = R x_a + t with |t| = 1.
Robust fits are OpenCV's USAC with MAGSAC scoring, seeded explicitly.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from sceneexpander.frontend.features import Features
from sceneexpander.frontend.matching import Matches, guided_matches, mutual_matches, similarity
from sceneexpander.frontend.sfm_types import SfmConfig

_log = logging.getLogger(__name__)
MOST_SAMPLES = 4000  # of a robust fit
_CONFIDENCE = 0.9999
_NEAR_LEADING = 4.0  # descriptor matches this many noise scales from the learned geometry may still refine it


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMatches:
    """Matches of views ``view_a`` < ``view_b``, before and after verification."""

    view_a: int
    view_b: int
    loose: Matches  # mutual neighbours at the loose ratio, unverified
    tentative: int  # how many of those pass the strict ratio
    verified: Matches  # consistent with one epipolar geometry; empty if the pair is unrelated


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativePose:
    """Calibrated motion of a pair."""

    rotation: Float[np.ndarray, "3 3"]  # b_from_a
    translation: Float[np.ndarray, " 3"]  # b_from_a, unit length
    inlier: Bool[np.ndarray, " match"]
    angle_deg: float  # median triangulation angle of the inliers


def usac_parameters(threshold: float, seed: int, samples: int = MOST_SAMPLES) -> cv2.UsacParams:
    """Single-threaded MAGSAC with its own random state, so that equal inputs give equal results."""
    parameters = cv2.UsacParams()
    parameters.threshold = threshold
    parameters.confidence = _CONFIDENCE
    parameters.maxIterations = samples
    parameters.sampler = cv2.SAMPLING_UNIFORM
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.isParallel = False
    parameters.randomGeneratorState = seed
    return parameters


def _robust_matrix(
    fit: Callable[..., tuple[np.ndarray | None, np.ndarray | None]], *arguments: object
) -> tuple[Float[np.ndarray, "3 3"], np.ndarray] | None:
    """(matrix, mask) of one of OpenCV's robust fits, or None where it finds nothing.

    Degenerate samples can leave its local optimisation without a model, which it reports by an exception.
    """
    try:
        matrix, mask = fit(*arguments)
    except cv2.error as error:
        _log.debug("robust fit failed: %s", error)
        return None
    return None if matrix is None or mask is None or matrix.shape != (3, 3) else (matrix, mask)


def match_descriptors(a: Features, b: Features, config: SfmConfig) -> Matches:
    """Mutual neighbours of the descriptors of two views, at the loose ratio."""
    if min(a.described, b.described) < 2:
        return Matches.empty()
    return mutual_matches(similarity(a, b), config.loose_match_ratio)


def match_and_verify(
    view_a: int,
    view_b: int,
    features: list[Features],
    config: SfmConfig,
    *,
    unit_px: float,
    seed: int,
    described: Matches | None = None,
    learned: Matches | None = None,
    learned_leads: bool = False,
) -> PairMatches:
    """Match two views and keep what one fundamental matrix explains.

    Args:
        view_a: index of the first view.
        view_b: index of the second view.
        features: of all views.
        config: ratios and thresholds.
        unit_px: pixels per pixel at the reference size (thresholds are multiplied by it).
        seed: of the robust fit.
        described: `match_descriptors` of the views, if it was asked before.
        learned: matches between the views' keypoints without descriptors, counted from the first of those; they are
            verified together with the others.
        learned_leads: only descriptor matches near the geometry of the learned ones take part, where those agree on one.
            Descriptors see a few pixels and agree on the wrong window of a facade; the learned matcher sees the picture.
    """
    a, b = features[view_a], features[view_b]
    loose = match_descriptors(a, b, config) if described is None else described
    strict = loose.select(loose.ratio <= config.match_ratio)
    if learned is not None:
        own = Matches.empty().joined(learned, offset_a=a.described, offset_b=b.described)
        if learned_leads:
            leading = fit_fundamental(
                a.pixel_xy[own.index_a], b.pixel_xy[own.index_b], config, unit_px=unit_px, seed=seed
            )
            if leading is not None:
                distance = epipolar_distance(leading[0], a.pixel_xy[strict.index_a], b.pixel_xy[strict.index_b])
                strict = strict.select(distance < _NEAR_LEADING * config.epipolar_px * unit_px)
        loose, strict = loose.joined(own), strict.joined(own)
    verified = Matches.empty()
    fit = fit_fundamental(a.pixel_xy[strict.index_a], b.pixel_xy[strict.index_b], config, unit_px=unit_px, seed=seed)
    if fit is not None:
        verified = strict.select(fit[1])
    distinct = distinct_positions(a.pixel_xy[verified.index_a], b.pixel_xy[verified.index_b])
    return PairMatches(
        view_a=view_a, view_b=view_b, loose=loose, tentative=strict.count, verified=verified.select(distinct)
    )


def match_guided(
    pair: PairMatches,
    features: list[Features],
    fundamental: Float[np.ndarray, "3 3"],
    config: SfmConfig,
    *,
    unit_px: float,
) -> PairMatches:
    """The same pair with its verified matches found again inside the epipolar band of a known geometry.

    Matches of keypoints without descriptors stay as they are.

    Args:
        pair: as matched before.
        features: of all views.
        fundamental: x_b^T F x_a = 0 in pixels.
        config: band, ratio, distance.
        unit_px: as in `match_and_verify`.
    """
    a, b = features[pair.view_a], features[pair.view_b]
    found = guided_matches(
        similarity(a, b),
        a,
        b,
        fundamental,
        band_px=config.guided_band_px * unit_px,
        max_ratio=config.guided_ratio,
        max_distance=config.guided_max_distance,
    )
    found = found.joined(pair.verified.select(pair.verified.index_a >= a.described))
    distinct = distinct_positions(a.pixel_xy[found.index_a], b.pixel_xy[found.index_b])
    return replace(pair, verified=found.select(distinct))


def fundamental_from_poses(
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, " 3"],
    intrinsics_a: Float[np.ndarray, "3 3"],
    intrinsics_b: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "3 3"]:
    """F with x_b^T F x_a = 0 of a calibrated motion ``b_from_a``."""
    x, y, z = translation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.linalg.inv(intrinsics_b).T @ cross @ rotation @ np.linalg.inv(intrinsics_a)


def epipolar_distance(
    fundamental: Float[np.ndarray, "3 3"], xy_a: Float[np.ndarray, "match 2"], xy_b: Float[np.ndarray, "match 2"]
) -> Float[np.ndarray, " match"]:
    """Larger distance in pixels of a match from the two epipolar lines (x_b^T F x_a = 0)."""
    points_a, points_b = (np.concatenate([xy, np.ones((len(xy), 1))], 1) for xy in (xy_a, xy_b))
    lines_b, lines_a = points_a @ fundamental.T, points_b @ fundamental
    algebraic = np.abs((lines_b * points_b).sum(1))
    norms = (np.linalg.norm(lines[:, :2], axis=1) for lines in (lines_a, lines_b))
    return np.maximum(*(algebraic / np.maximum(norm, 1e-12) for norm in norms))


def distinct_positions(xy_a: Float[np.ndarray, "match 2"], xy_b: Float[np.ndarray, "match 2"]) -> np.ndarray:
    """Indices of matches at distinct places: SIFT repeats a keypoint once per dominant orientation."""
    if len(xy_a) == 0:
        return np.zeros(0, np.int64)
    cells = np.rint(np.concatenate([xy_a, xy_b], 1)).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def fit_fundamental(
    xy_a: Float[np.ndarray, "match 2"],
    xy_b: Float[np.ndarray, "match 2"],
    config: SfmConfig,
    *,
    unit_px: float,
    seed: int,
) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, " match"]] | None:
    """(F with x_b^T F x_a = 0, inlier mask), or None where chance could explain the agreement."""
    if len(xy_a) < max(config.min_pair_inliers, 8):
        return None
    found = _robust_matrix(cv2.findFundamentalMat, xy_a, xy_b, usac_parameters(config.epipolar_px * unit_px, seed))
    if found is None:
        return None
    matrix, mask = found
    inlier = mask.ravel().astype(bool)
    distinct = len(distinct_positions(xy_a[inlier], xy_b[inlier]))
    # About 7 matches always fit; beyond them a random line band of this width holds a few per cent.
    if distinct < config.min_pair_inliers or inlier.sum() < 8 + config.min_pair_inlier_share * len(xy_a):
        return None
    return matrix, inlier


def relative_pose(
    xy_a: Float[np.ndarray, "match 2"],
    xy_b: Float[np.ndarray, "match 2"],
    intrinsics_a: Float[np.ndarray, "3 3"],
    intrinsics_b: Float[np.ndarray, "3 3"],
    *,
    threshold_px: float,
    seed: int,
) -> RelativePose | None:
    """Essential matrix and the one of its four decompositions with the points in front; None if it fails."""
    if len(xy_a) < 8:
        return None
    found = _robust_matrix(
        cv2.findEssentialMat, xy_a, xy_b, intrinsics_a, intrinsics_b, None, None, usac_parameters(threshold_px, seed)
    )
    if found is None:
        return None
    essential, mask = found
    rays_a, rays_b = homogeneous_rays(xy_a, intrinsics_a), homogeneous_rays(xy_b, intrinsics_b)
    inlier = mask.ravel().astype(bool)
    count, rotation, translation, front = cv2.recoverPose(
        essential, rays_a[inlier, :2], rays_b[inlier, :2], np.eye(3), distanceThresh=1e6
    )[:4]
    if count < 8:
        return None
    inlier[np.flatnonzero(inlier)] = front.ravel().astype(bool)
    translation = translation.ravel() / np.linalg.norm(translation)
    points, _ = triangulate_pair(rays_a[inlier], rays_b[inlier], rotation, translation)
    angle = ray_angle_deg(points, np.zeros(3), -rotation.T @ translation)
    return RelativePose(rotation=rotation, translation=translation, inlier=inlier, angle_deg=float(np.median(angle)))


def fit_rotation(
    xy_a: Float[np.ndarray, "match 2"],
    xy_b: Float[np.ndarray, "match 2"],
    intrinsics_a: Float[np.ndarray, "3 3"],
    intrinsics_b: Float[np.ndarray, "3 3"],
    *,
    threshold_px: float,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, " match"]]:
    """Rotation ``b_from_a`` that maps most rays of a onto those of b within ``threshold_px``, and who agrees.

    RANSAC over pairs of matches (two rays fix a rotation), refitted on the inliers (Kabsch).
    """
    count = len(xy_a)
    best_inlier = np.zeros(count, bool)
    if count < 3:
        return np.eye(3), best_inlier
    unit_a, unit_b = unit_rays(xy_a, intrinsics_a), unit_rays(xy_b, intrinsics_b)
    for _ in range(60):
        sample = rng.choice(count, 3, replace=False)
        rotation = kabsch(unit_a[sample], unit_b[sample])
        inlier = rotation_errors_px(unit_a, xy_b, intrinsics_b, rotation) < threshold_px
        if inlier.sum() > best_inlier.sum():
            best_inlier = inlier
    return refine_rotation(unit_a, unit_b, xy_b, intrinsics_b, best_inlier, threshold_px=threshold_px)


def refine_rotation(
    unit_a: Float[np.ndarray, "match 3"],
    unit_b: Float[np.ndarray, "match 3"],
    xy_b: Float[np.ndarray, "match 2"],
    intrinsics_b: Float[np.ndarray, "3 3"],
    inlier: Bool[np.ndarray, " match"],
    *,
    threshold_px: float,
    rounds: int = 3,
) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, " match"]]:
    """Rotation ``b_from_a`` fitted to the rays that agree (Kabsch), and who agrees with it then; ``rounds`` times over."""
    rotation = np.eye(3)
    for _ in range(rounds):
        if inlier.sum() < 3:
            break
        rotation = kabsch(unit_a[inlier], unit_b[inlier])
        inlier = rotation_errors_px(unit_a, xy_b, intrinsics_b, rotation) < threshold_px
    return rotation, inlier


def rotation_errors_px(
    unit_a: Float[np.ndarray, "match 3"],
    xy_b: Float[np.ndarray, "match 2"],
    intrinsics_b: Float[np.ndarray, "3 3"],
    rotation: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, " match"]:
    """How far from where it was found each match lies in b if the camera only turned; inf if it would then be behind."""
    moved = unit_a @ rotation.T
    projected = moved @ intrinsics_b.T
    error = np.linalg.norm(projected[:, :2] / np.maximum(projected[:, 2:], 1e-9) - xy_b, axis=1)
    return np.where(moved[:, 2] > 0, error, np.inf)


def homography_share(
    xy_a: Float[np.ndarray, "match 2"],
    xy_b: Float[np.ndarray, "match 2"],
    *,
    threshold_px: float,
    seed: int,
) -> float:
    """Share of the matches that one homography takes to within ``threshold_px``; 0 without one."""
    homography = fit_homography(xy_a, xy_b, threshold_px=threshold_px, seed=seed)
    if homography is None:
        return 0.0
    return float((homography_errors_px(homography, xy_a, xy_b) < threshold_px).mean())


def fit_homography(
    xy_a: Float[np.ndarray, "match 2"], xy_b: Float[np.ndarray, "match 2"], *, threshold_px: float, seed: int
) -> Float[np.ndarray, "3 3"] | None:
    """The homography ``b_from_a`` of most matches; None without one."""
    if len(xy_a) < 8:
        return None
    found = _robust_matrix(cv2.findHomography, xy_a, xy_b, usac_parameters(threshold_px, seed))
    return None if found is None else found[0]


def homography_errors_px(
    homography: Float[np.ndarray, "3 3"], xy_a: Float[np.ndarray, "match 2"], xy_b: Float[np.ndarray, "match 2"]
) -> Float[np.ndarray, " match"]:
    """How far from where it was found each match lies in b; not finite on the homography's vanishing line."""
    moved = np.concatenate([xy_a, np.ones((len(xy_a), 1))], 1) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(moved[:, :2] / moved[:, 2:] - xy_b, axis=1))


def rotation_focal(
    xy_a: Float[np.ndarray, "match 2"],
    xy_b: Float[np.ndarray, "match 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    bounds: tuple[float, float],
    *,
    threshold_px: float,
    seed: int,
) -> float | None:
    """Factor on the focal of both views at which the homography of the matches is nearest to a rotation; None without one.

    H = K R K^-1 holds for a turning camera alone, and fixes the focal length (Hartley, "Self-calibration of stationary cameras",
    1997). Searched on a logarithmic grid of 1.5 % within ``bounds``.
    """
    homography = fit_homography(xy_a, xy_b, threshold_px=threshold_px, seed=seed)
    if homography is None or abs(np.linalg.det(homography)) < 1e-12:
        return None
    low, high = np.log(bounds)
    factors = np.exp(np.linspace(low, high, max(2, round((high - low) / 0.015))))
    residuals = []
    for factor in factors:
        camera = scaled_focal(intrinsics, factor)
        turn = np.linalg.inv(camera) @ homography @ camera
        turn = turn / np.cbrt(np.linalg.det(turn))
        residuals.append(float(np.linalg.norm(turn @ turn.T - np.eye(3))))
    return float(factors[int(np.argmin(residuals))])


def scaled_focal(intrinsics: Float[np.ndarray, "3 3"], factor: float) -> Float[np.ndarray, "3 3"]:
    """The same camera with its focal lengths multiplied."""
    scaled = intrinsics.copy()
    scaled[[0, 1], [0, 1]] *= factor
    return scaled


def kabsch(from_rays: Float[np.ndarray, "ray 3"], to_rays: Float[np.ndarray, "ray 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation R that minimises sum |R from - to|^2."""
    u, _, vt = np.linalg.svd(to_rays.T @ from_rays)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def homogeneous_rays(
    pixel_xy: Float[np.ndarray, "point 2"], intrinsics: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "point 3"]:
    """Camera-frame rays with z = 1."""
    x = (pixel_xy[:, 0] - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (pixel_xy[:, 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    return np.stack([x, y, np.ones_like(x)], 1)


def unit_rays(
    pixel_xy: Float[np.ndarray, "point 2"], intrinsics: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "point 3"]:
    """Camera-frame rays of length 1."""
    rays = homogeneous_rays(pixel_xy, intrinsics)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def triangulate_pair(
    rays_a: Float[np.ndarray, "point 3"],
    rays_b: Float[np.ndarray, "point 3"],
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, " 3"],
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point 2"]]:
    """Points in a's frame nearest to both rays (midpoint), and their depths in (a, b); negative = behind.

    Parallel rays give a point very far away, never a NaN.
    """
    centre_b = -rotation.T @ translation
    directions_b = rays_b @ rotation
    aa, bb = (rays_a * rays_a).sum(1), (directions_b * directions_b).sum(1)
    ab = (rays_a * directions_b).sum(1)
    a_c, b_c = rays_a @ centre_b, directions_b @ centre_b
    denominator = np.maximum(aa * bb - ab * ab, 1e-12)
    depth_a = (bb * a_c - ab * b_c) / denominator
    depth_b = (ab * a_c - aa * b_c) / denominator
    points = 0.5 * (rays_a * depth_a[:, None] + centre_b + directions_b * depth_b[:, None])
    return points, np.stack([depth_a, depth_b], 1)


def ray_angle_deg(
    points: Float[np.ndarray, "point 3"],
    centre_a: Float[np.ndarray, " 3"],
    centre_b: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " point"]:
    """Angle under which each point sees the two camera centres."""
    to_a, to_b = points - centre_a, points - centre_b
    sine = np.linalg.norm(np.cross(to_a, to_b), axis=1)
    return np.rad2deg(np.arctan2(sine, (to_a * to_b).sum(1)))
