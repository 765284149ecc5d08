"""Incremental mapping: from tracks and a start to cameras and points.

`Mapping` is the growing model: views are registered against its points, new points are triangulated, bundle adjustment and
pruning keep it consistent. All poses are ``cam_from_world``; pixels are those of the feature images.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from sceneexpander.frontend.bundle import BundleProblem, BundleResult, adjust
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.tracks import Tracks
from sceneexpander.frontend.twoview import (
    RelativePose,
    homogeneous_rays,
    ray_angle_deg,
    triangulate_pair,
    usac_parameters,
)

_PRIOR_INFLATION = 8.0  # matching errors are correlated and partly systematic: that many of them count as one
_NEIGHBOURS = 8
_NEIGHBOUR_GAP = 0.2  # of the logarithm of depth: neighbours nearer than this agree


class Mapping:
    """A partial reconstruction over S views and T tracks.

    Attributes:
        registered: views with a pose.
        rotations, translations: ``cam_from_world``; meaningless where not registered.
        points, valid: world points of the tracks, and which exist.
        active: observations that agree with their point.
        log_focal: logarithm of the shared factor on the start intrinsics.
        focal_sigma: its standard deviation after the last adjustment that refined it.
    """

    def __init__(
        self,
        tracks: Tracks,
        intrinsics: Float[np.ndarray, "view 3 3"],
        config: SfmConfig,
        *,
        unit_px: float,
        seed: int,
    ) -> None:
        views = intrinsics.shape[0]
        self.tracks, self.config, self.unit_px, self.seed = tracks, config, unit_px, seed
        self.start_intrinsics = intrinsics
        self.log_focal = 0.0
        self.log_focal_bounds = (-np.inf, np.inf)
        self.log_focal_prior = (0.0, np.inf)  # centre, sigma
        self.focal_sigma = float("nan")
        self.rotations = np.tile(np.eye(3), (views, 1, 1))
        self.translations = np.zeros((views, 3))
        self.registered = np.zeros(views, bool)
        self.points = np.zeros((tracks.count, 3))
        self.valid = np.zeros(tracks.count, bool)
        self.active = np.zeros((tracks.count, views), bool)

    # --- geometry of the current model -------------------------------------------------------------------------------

    @property
    def intrinsics(self) -> Float[np.ndarray, "view 3 3"]:
        """Intrinsics with the current focal."""
        scaled = self.start_intrinsics.copy()
        scaled[:, [0, 1], [0, 1]] *= np.exp(self.log_focal)
        return scaled

    @property
    def centres(self) -> Float[np.ndarray, "view 3"]:
        """Camera centres in the world."""
        return -np.einsum("vji,vj->vi", self.rotations, self.translations)

    def errors_px(
        self, rows: Int[np.ndarray, " row"] | None = None, points: Float[np.ndarray, "row 3"] | None = None
    ) -> Float[np.ndarray, "row view"]:
        """Reprojection error of tracks in all registered views that see them; inf elsewhere and behind cameras."""
        rows = np.arange(self.tracks.count) if rows is None else rows
        points = self.points[rows] if points is None else points
        errors = np.full((len(rows), len(self.registered)), np.inf)
        intrinsics = self.intrinsics
        for view in np.flatnonzero(self.registered):
            in_camera = points @ self.rotations[view].T + self.translations[view]
            depth = np.maximum(in_camera[:, 2], 1e-9)
            matrix = intrinsics[view]
            x = in_camera[:, 0] / depth * matrix[0, 0] + matrix[0, 2] - self.tracks.pixel_xy[rows, view, 0]
            y = in_camera[:, 1] / depth * matrix[1, 1] + matrix[1, 2] - self.tracks.pixel_xy[rows, view, 1]
            usable = self.tracks.seen[rows, view] & (in_camera[:, 2] > 1e-6)
            errors[usable, view] = np.hypot(x, y)[usable]
        return errors

    def angles_deg(self) -> Float[np.ndarray, " track"]:
        """Widest triangulation angle among the active observations of each point; 0 without two."""
        widest = np.zeros(self.tracks.count)
        centres = self.centres
        views = np.flatnonzero(self.registered)
        for i, a in enumerate(views):
            for b in views[i + 1 :]:
                rows = np.flatnonzero(self.active[:, a] & self.active[:, b])
                angle = ray_angle_deg(self.points[rows], centres[a], centres[b])
                widest[rows] = np.maximum(widest[rows], angle)
        return widest

    # --- growing -----------------------------------------------------------------------------------------------------

    def start(self, view_a: int, view_b: int, pose: RelativePose) -> None:
        """Begin with two views; a is the world frame."""
        self.rotations[view_b], self.translations[view_b] = pose.rotation, pose.translation
        self.registered[[view_a, view_b]] = True

    def adopt(self, other: Mapping) -> None:
        """Take over cameras and focal of a model of the same views over other tracks."""
        self.rotations, self.translations = other.rotations.copy(), other.translations.copy()
        self.registered = other.registered.copy()
        self.log_focal, self.focal_sigma = other.log_focal, other.focal_sigma

    def triangulate(self, *, threshold_px: float) -> None:
        """Find points for tracks that have none, from the best pair of their views.

        The pair whose point most views agree with wins; ties go to the wider angle.
        """
        open_rows = ~self.valid & ((self.tracks.seen & self.registered).sum(1) >= 2)
        best_votes = np.zeros(self.tracks.count)
        views = np.flatnonzero(self.registered)
        intrinsics, centres = self.intrinsics, self.centres
        rays = {v: homogeneous_rays(self.tracks.pixel_xy[:, v], intrinsics[v]) for v in views}
        for i, a in enumerate(views):
            for b in views[i + 1 :]:
                rows = np.flatnonzero(open_rows & self.tracks.seen[:, a] & self.tracks.seen[:, b])
                if len(rows) == 0:
                    continue
                rotation = self.rotations[b] @ self.rotations[a].T
                translation = self.translations[b] - rotation @ self.translations[a]
                in_a, depths = triangulate_pair(rays[a][rows], rays[b][rows], rotation, translation)
                world = (in_a - self.translations[a]) @ self.rotations[a]
                agree = self.errors_px(rows, world) < threshold_px * self.unit_px
                angle = ray_angle_deg(world, centres[a], centres[b])
                good = (depths > 0).all(1) & agree[:, a] & agree[:, b] & (angle >= self.config.min_angle_deg)
                votes = np.where(good, agree.sum(1) + np.minimum(angle, 90.0) / 100.0, 0.0)
                better = votes > best_votes[rows]
                kept = rows[better]
                self.points[kept], best_votes[kept] = world[better], votes[better]
                self.valid[kept] = True
                self.active[kept] = agree[better]

    def prune(self, *, threshold_px: float) -> None:
        """Keep observations within the threshold; drop points left with one view, with too small an angle, or too far."""
        errors = self.errors_px()
        self.active = (errors < threshold_px * self.unit_px) & self.valid[:, None]
        self.valid &= self.active.sum(1) >= 2
        self.valid &= self.angles_deg() >= self.config.min_angle_deg
        self.active &= self.valid[:, None]

    def drop_strays(self) -> None:
        """Drop points of only two views whose depth agrees with none of their neighbours in the image.

        Two views cannot contradict a wrong match along an epipolar line; its surroundings can. Points at true depth edges
        keep a neighbour on their own side.
        """
        from scipy.spatial import cKDTree

        pairs_only = self.valid & ((self.active & self.registered).sum(1) == 2)
        stray = np.zeros_like(self.valid)
        for view in np.flatnonzero(self.registered):
            rows = np.flatnonzero(self.valid & self.active[:, view])
            if len(rows) <= _NEIGHBOURS:
                continue
            depth = self.points[rows] @ self.rotations[view][2] + self.translations[view][2]
            pixel_xy = self.tracks.pixel_xy[rows, view]
            _, near = cKDTree(pixel_xy).query(pixel_xy, k=_NEIGHBOURS + 1)
            log_depth = np.log(np.maximum(depth, 1e-9))
            gap = np.abs(log_depth[near[:, 1:]] - log_depth[:, None])
            # One agreeing neighbour may be the same wrong match found twice.
            stray[rows] |= (gap < _NEIGHBOUR_GAP).sum(1) < 2
        self.valid &= ~(stray & pairs_only)
        self.active &= self.valid[:, None]

    def next_view(self, refused: set[int]) -> int | None:
        """The unregistered view that sees most points."""
        visible = (self.tracks.seen & self.valid[:, None]).sum(0)
        visible[self.registered] = -1
        visible[list(refused)] = -1
        best = int(visible.argmax())
        return best if visible[best] >= self.config.min_register_inliers else None

    def register(self, view: int) -> bool:
        """Pose a view from the points it sees; False if too few of them agree on a pose."""
        rows = np.flatnonzero(self.tracks.seen[:, view] & self.valid)
        found = solve_pose(
            self.points[rows],
            self.tracks.pixel_xy[rows, view],
            self.intrinsics[view],
            threshold_px=self.config.register_px * self.unit_px,
            robust_px=self.config.robust_px * self.unit_px,
            seed=self.seed,
        )
        if found is None:
            return False
        rotation, translation, inlier = found
        if inlier.sum() < max(self.config.min_register_inliers, self.config.min_register_share * len(rows)):
            return False
        self.rotations[view], self.translations[view] = rotation, translation
        self.registered[view] = True
        self.active[rows, view] = inlier
        return True

    def grow(self, *, refine_focal: bool, free: Bool[np.ndarray, " view"] | None = None) -> None:
        """Register views until none fits any more, adjusting after each."""
        self.triangulate(threshold_px=self.config.triangulate_px)
        self.adjust(refine_focal=False, iterations=8, free=free)
        self.prune(threshold_px=self.config.triangulate_px)
        refused: set[int] = set()
        while (view := self.next_view(refused)) is not None:
            if not self.register(view):
                refused.add(view)
                continue
            refused.clear()  # every new view brings new points, so a refused view gets another chance
            self.triangulate(threshold_px=self.config.triangulate_px)
            self.adjust(refine_focal=refine_focal and bool(self.registered.sum() >= 3), iterations=8, free=free)
            self.prune(threshold_px=self.config.triangulate_px)

    def finish(self, *, refine_focal: bool, free: Bool[np.ndarray, " view"] | None = None) -> None:
        """Rounds of re-triangulation, bundle adjustment and pruning, ever stricter.

        The last rounds take the robust scale and the threshold from the errors themselves (their median is 1.18 sigma of
        Gaussian noise in two dimensions), so that a few pixels of error count as wrong where features are sharp.
        """
        for threshold in (self.config.triangulate_px, self.config.inlier_px):
            self.triangulate(threshold_px=threshold)
            self.adjust(refine_focal=refine_focal, free=free)
            self.prune(threshold_px=threshold)
        for _ in range(2):
            errors = self.errors_px()[self.active & self.registered] / self.unit_px
            sigma = float(np.median(errors)) / 1.18 if len(errors) else self.config.robust_px
            robust = float(np.clip(2 * sigma, self.config.min_robust_px, self.config.robust_px))
            threshold = float(np.clip(8 * sigma, self.config.min_inlier_px, self.config.inlier_px))
            self.triangulate(threshold_px=threshold)
            self.adjust(refine_focal=refine_focal, free=free, robust_px=robust)
            self.prune(threshold_px=threshold)

    # --- adjusting ---------------------------------------------------------------------------------------------------

    def adjust(
        self,
        *,
        refine_focal: bool,
        iterations: int | None = None,
        free: Bool[np.ndarray, " view"] | None = None,
        robust_px: float | None = None,
    ) -> BundleResult | None:
        """Bundle adjustment of all registered views and points (``free``: which cameras may move)."""
        rows, views = np.nonzero(self.active & self.registered)
        if len(rows) < 6:
            return None
        used = np.flatnonzero(self.valid)
        position = np.full(self.tracks.count, -1)
        position[used] = np.arange(len(used))
        if free is None:
            free = self.registered.copy()
            free[np.flatnonzero(self.registered)[0]] = False
        centre, sigma = self.log_focal_prior
        noise = (robust_px or self.config.robust_px) * self.unit_px
        problem = BundleProblem(
            rotations=self.rotations,
            translations=self.translations,
            focals_px=self.start_intrinsics[:, [0, 1], [0, 1]],
            centres_px=self.start_intrinsics[:, :2, 2],
            points=self.points[used],
            camera_index=views,
            point_index=position[rows],
            pixel_xy=self.tracks.pixel_xy[rows, views],
            camera_free=free & self.registered,
            focal_free=refine_focal,
            log_focal=self.log_focal,
            log_focal_bounds=self.log_focal_bounds,
            log_focal_prior=centre,
            log_focal_weight=_PRIOR_INFLATION * (noise / sigma) ** 2,
            robust_px=noise,
        )
        result = adjust(problem, max_iterations=iterations or self.config.bundle_iterations)
        self.rotations, self.translations = result.problem.rotations, result.problem.translations
        self.points[used] = result.problem.points
        self.log_focal = result.problem.log_focal
        if refine_focal:
            self.focal_sigma = result.log_focal_sigma * noise * _PRIOR_INFLATION**0.5
        return result

    def score(self) -> float:
        """How much the model explains: sum over observations of 1 - (e / threshold)^2, less the focal prior's cost."""
        limit = self.config.inlier_px * self.unit_px
        explained = np.maximum(1.0 - (self.errors_px()[self.active & self.registered] / limit) ** 2, 0.0).sum()
        centre, sigma = self.log_focal_prior
        return float(explained - _PRIOR_INFLATION * ((self.log_focal - centre) / sigma) ** 2 / 2)


def solve_pose(
    points: Float[np.ndarray, "point 3"],
    pixel_xy: Float[np.ndarray, "point 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    *,
    threshold_px: float,
    robust_px: float,
    seed: int,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"], Bool[np.ndarray, " point"]] | None:
    """``cam_from_world`` (rotation, translation) from 2D-3D correspondences and the inlier mask; None if none fits.

    P3P inside MAGSAC, then robust refinement of the pose alone on the inliers, twice.
    """
    if len(points) < 6:
        return None
    try:
        found, _, vector, translation, _ = cv2.solvePnPRansac(
            points, pixel_xy, intrinsics.copy(), None, params=usac_parameters(threshold_px, seed)
        )
    except cv2.error:  # as in `twoview`: degenerate samples can leave the local optimisation without a model
        return None
    if not found or not (np.isfinite(vector).all() and np.isfinite(translation).all()):
        return None
    rotation, translation = cv2.Rodrigues(vector)[0], translation.ravel()
    inlier = pose_inliers(points, pixel_xy, intrinsics, rotation, translation, threshold_px)
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
            points_free=False,
            robust_px=robust_px,
        )
        refined = adjust(problem, max_iterations=20).problem
        rotation, translation = refined.rotations[0], refined.translations[0]
        inlier = pose_inliers(points, pixel_xy, intrinsics, rotation, translation, threshold_px)
    return rotation, translation, inlier


def pose_inliers(
    points: Float[np.ndarray, "point 3"],
    pixel_xy: Float[np.ndarray, "point 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, " 3"],
    threshold_px: float,
) -> Bool[np.ndarray, " point"]:
    """Points in front of the camera that project within the threshold of their pixel."""
    in_camera = points @ rotation.T + translation
    projected = in_camera @ intrinsics.T
    xy = projected[:, :2] / np.maximum(projected[:, 2:], 1e-9)
    return (in_camera[:, 2] > 1e-6) & (np.linalg.norm(xy - pixel_xy, axis=1) < threshold_px)
