"""One view against known points: its pose alone, or together with the lens it was taken through.

A pose alone hides a wrong focal well: a zoomed picture of things at one distance looks like one taken from nearer. So lenses are compared
by what they leave unexplained of *all* the points that a view sees, with errors counted up to a limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from sceneexpander.frontend.bundle import (
    LENS_PARAMETERS,
    LOG_FOCAL,
    SHIFT_X,
    SHIFT_Y,
    BundleProblem,
    Lenses,
    adjust,
)
from sceneexpander.frontend.twoview import MOST_SAMPLES, usac_parameters

_MIN_POINTS = 8  # a pose and a focal have seven unknowns: four points fix them, chance can fit a few more
_SWEEP_SAMPLES = 400  # of the robust fit, while focals are tried: the best one is refined afterwards
_SWEEP_POINTS = 300  # used meanwhile
_WIDE = 2.0  # times the inlier threshold: what a pose with a centred principal point misses of a cropped picture
_KEEP_BEST = 3  # focals that are refined further


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """What one view sees: points in the world and their pixels, through a lens that starts as given.

    ``threshold_px`` makes an inlier, ``noise_px`` is the scale of ordinary errors.
    """

    points: Float[np.ndarray, "point 3"]
    pixel_xy: Float[np.ndarray, "point 2"]
    start: Float[np.ndarray, "3 3"]
    shift_unit_px: Float[np.ndarray, " 2"]
    log_focal_low: float
    log_focal_high: float
    threshold_px: float
    noise_px: float
    seed: int

    def through(self, lens: Float[np.ndarray, " 5"]) -> Float[np.ndarray, "3 3"]:
        """Intrinsics with a lens."""
        return intrinsics_through(self.start, self.shift_unit_px, lens)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResectedView:
    """A view posed against points together with its lens. ``cost`` is 0 for a perfect fit and 1 if no point is explained."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    lens: Float[np.ndarray, " 5"]
    inlier: Bool[np.ndarray, " point"]
    cost: float


def intrinsics_through(
    start: Float[np.ndarray, "*view 3 3"],
    shift_unit_px: Float[np.ndarray, "*view 2"],
    lens: Float[np.ndarray, "*view 5"],
) -> Float[np.ndarray, "*view 3 3"]:
    """Start intrinsics with the focal factor and the shift of the principal point of their lens."""
    made = start.copy()
    made[..., [0, 1], [0, 1]] *= np.exp(lens[..., LOG_FOCAL, None])
    made[..., :2, 2] += shift_unit_px * lens[..., SHIFT_X : SHIFT_Y + 1]
    return made


def judge_view(
    sighting: Sighting,
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, " 3"],
    lens: Float[np.ndarray, " 5"],
) -> ResectedView:
    """A pose and a lens with what they explain."""
    errors = point_errors(sighting.points, sighting.pixel_xy, sighting.through(lens), rotation, translation)
    limit = np.log1p((sighting.threshold_px / sighting.noise_px) ** 2)
    each = np.minimum(np.log1p((np.minimum(errors, 1e6) / sighting.noise_px) ** 2), limit)
    return ResectedView(
        rotation=rotation,
        translation=translation,
        lens=lens,
        inlier=errors < sighting.threshold_px,
        cost=float(each.mean() / limit) if len(errors) else 1.0,
    )


def resect(sighting: Sighting, log_factors: Sequence[float]) -> ResectedView | None:
    """The pose and focal that leave least unexplained, begun from the given factors on the start focal; None if none gives a pose."""
    rough = rough_poses(sighting, log_factors)
    fine = [refine_lens(sighting, start) for start in rough[:_KEEP_BEST]]
    return min((view for view in fine if view is not None), key=lambda view: view.cost, default=None)


def rough_poses(sighting: Sighting, log_factors: Sequence[float]) -> list[ResectedView]:
    """A pose for each factor on the start focal that gives one, what leaves least unexplained first."""
    chosen = np.linspace(0, len(sighting.points) - 1, min(len(sighting.points), _SWEEP_POINTS)).astype(np.int64)
    few = replace(sighting, points=sighting.points[chosen], pixel_xy=sighting.pixel_xy[chosen])
    rough: list[ResectedView] = []
    for factor in log_factors:
        lens = np.zeros(LENS_PARAMETERS)
        lens[LOG_FOCAL] = factor
        pose = solve_pose(
            few.points,
            few.pixel_xy,
            few.through(lens),
            threshold_px=few.threshold_px,
            robust_px=sighting.noise_px,
            seed=sighting.seed,
            samples=_SWEEP_SAMPLES,
        )
        if pose is not None:
            rough.append(judge_view(few, pose[0], pose[1], lens))
    return sorted(rough, key=lambda view: view.cost)


def refine_lens(sighting: Sighting, start: ResectedView) -> ResectedView | None:
    """Pose and focal adjusted to fixed points, with inliers found anew each time; None if hardly a point agrees."""
    free = np.zeros((1, LENS_PARAMETERS), bool)
    free[0, LOG_FOCAL] = True
    low, high = np.zeros((1, LENS_PARAMETERS)), np.zeros((1, LENS_PARAMETERS))
    low[0, LOG_FOCAL], high[0, LOG_FOCAL] = sighting.log_focal_low, sighting.log_focal_high
    rotation, translation, lens = start.rotation, start.translation, start.lens
    best = judge_view(sighting, rotation, translation, lens)
    for width in (_WIDE, 1.0, 1.0, 0.5, 0.5):
        threshold = width * sighting.threshold_px
        inlier = (
            point_errors(sighting.points, sighting.pixel_xy, sighting.through(lens), rotation, translation) < threshold
        )
        count = int(inlier.sum())
        if count < _MIN_POINTS:
            break
        problem = BundleProblem(
            rotations=rotation[None],
            translations=translation[None],
            focals_px=sighting.start[[0, 1], [0, 1]][None],
            centres_px=sighting.start[:2, 2][None],
            points=sighting.points[inlier],
            camera_index=np.zeros(count, np.int64),
            point_index=np.arange(count),
            pixel_xy=sighting.pixel_xy[inlier],
            camera_free=np.ones(1, bool),
            lens_index=np.zeros(1, np.int64),
            lenses=replace(Lenses.nominal(1), values=lens[None], free=free, low=low, high=high),
            shift_unit_px=sighting.shift_unit_px[None],
            points_free=False,
            robust_px=sighting.noise_px,
        )
        done = adjust(problem, max_iterations=30).problem
        rotation, translation, lens = done.rotations[0], done.translations[0], done.lenses.values[0]
        found = judge_view(sighting, rotation, translation, lens)
        if found.cost < best.cost:
            best = found
    return best if best.inlier.sum() >= _MIN_POINTS else None


def solve_pose(
    points: Float[np.ndarray, "point 3"],
    pixel_xy: Float[np.ndarray, "point 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    *,
    threshold_px: float,
    robust_px: float,
    seed: int,
    samples: int = MOST_SAMPLES,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"], Bool[np.ndarray, " point"]] | None:
    """``cam_from_world`` (rotation, translation) from 2D-3D correspondences and the inlier mask; None if none fits.

    P3P inside MAGSAC (at most ``samples`` samples), then robust refinement of the pose alone on the inliers, twice.
    """
    if len(points) < 6:
        return None
    try:
        found, _, vector, translation, _ = cv2.solvePnPRansac(
            points, pixel_xy, intrinsics.copy(), None, params=usac_parameters(threshold_px, seed, samples)
        )
    except cv2.error:  # as in `twoview`: degenerate samples can leave the local optimisation without a model
        return None
    if not found or not (np.isfinite(vector).all() and np.isfinite(translation).all()):
        return None
    rotation, translation = cv2.Rodrigues(vector)[0], translation.ravel()
    inlier = point_errors(points, pixel_xy, intrinsics, rotation, translation) < threshold_px
    for _ in range(2):
        if inlier.sum() < 6:
            return None
        count = int(inlier.sum())
        problem = BundleProblem(
            rotations=rotation[None],
            translations=translation[None],
            focals_px=intrinsics[[0, 1], [0, 1]][None],
            centres_px=intrinsics[None, :2, 2],
            points=points[inlier],
            camera_index=np.zeros(count, np.int64),
            point_index=np.arange(count),
            pixel_xy=pixel_xy[inlier],
            camera_free=np.ones(1, bool),
            lens_index=np.zeros(1, np.int64),
            lenses=Lenses.nominal(1),
            shift_unit_px=np.ones((1, 2)),
            points_free=False,
            robust_px=robust_px,
        )
        refined = adjust(problem, max_iterations=20).problem
        rotation, translation = refined.rotations[0], refined.translations[0]
        inlier = point_errors(points, pixel_xy, intrinsics, rotation, translation) < threshold_px
    return rotation, translation, inlier


def point_errors(
    points: Float[np.ndarray, "point 3"],
    pixel_xy: Float[np.ndarray, "point 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " point"]:
    """Distance of each point's projection from its pixel; inf behind the camera."""
    in_camera = points @ rotation.T + translation
    projected = in_camera @ intrinsics.T
    xy = projected[:, :2] / np.maximum(projected[:, 2:], 1e-9)
    return np.where(in_camera[:, 2] > 1e-6, np.linalg.norm(xy - pixel_xy, axis=1), np.inf)
