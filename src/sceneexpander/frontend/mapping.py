"""Incremental mapping: from tracks and a start to cameras and points.

`Mapping` is the growing model: views are registered against its points, new points are triangulated, bundle adjustment and
pruning keep it consistent. All poses are ``cam_from_world``; pixels are those of the feature images.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from sceneexpander.frontend.bundle import (
    LENS_PARAMETERS,
    LOG_FOCAL,
    SHIFT_X,
    SHIFT_Y,
    BundleProblem,
    BundleResult,
    Lenses,
    adjust,
    direction_sigma_deg,
)
from sceneexpander.frontend.resection import Sighting, intrinsics_through, judge_view, resect, solve_pose
from sceneexpander.frontend.sfm_types import REFERENCE_LONG_SIDE_PX, SfmConfig
from sceneexpander.frontend.tracks import Tracks
from sceneexpander.frontend.twoview import (
    RelativePose,
    homogeneous_rays,
    ray_angle_deg,
    triangulate_pair,
)

_TAIL = 4.0  # nu of what is assumed of a focal: at four standard deviations it pulls a fifth as much as a Gaussian
_PRIOR_INFLATION = 8.0  # matching errors are correlated and partly systematic: that many of them count as one
_NEIGHBOURS = 8
_STANDS_TOGETHER = 0.05  # of the widest distance between cameras
_NEIGHBOUR_GAP = 0.2  # of the logarithm of depth: neighbours nearer than this agree


@dataclass(frozen=True, slots=True, kw_only=True)
class CropOfMain:
    """A view that may be a part cut out of a picture of the main lens: its principal point can then lie off the centre.

    ``log_focal`` is the factor on its start focal while the main lens has its own start focal; the limits are shifts of its lens.
    """

    log_focal: float
    limit_x: float
    limit_y: float


class Mapping:
    """A partial reconstruction over S views and T tracks.

    Attributes:
        registered: views with a pose.
        rotations, translations: ``cam_from_world``; meaningless where not registered.
        points, valid: world points of the tracks, and which exist.
        active: observations that agree with their point.
        lens_of: the lens of each view, numbered by one of the views that have it.
        lenses: what views of one lens share, relative to the start intrinsics. ``free`` says what may be refined once there are views
            enough. Distortion stays zero here: pixels are undistorted before they come in.
        prior_sigma: standard deviations of the priors in ``lenses`` (inf: none); their weight follows the noise.
        assumed: lenses whose focal prior is no more than what is usual. Its tails are heavy: tele lenses exist.
        lens_guesses: per view of another lens than most, further factors (logarithms) that its start focal may be off by.
        crops: the views that may be parts cut out of pictures of the main lens.
        main: a view with the lens that most views have.
        lens_sigma: standard deviations after the last adjustment that refined something.
        penalty: what `score` takes off for assumptions that went into the start.
    """

    def __init__(
        self,
        tracks: Tracks,
        intrinsics: Float[np.ndarray, "view 3 3"],
        config: SfmConfig,
        *,
        unit_px: float,
        seed: int,
        lens_of: Int[np.ndarray, " view"] | None = None,
        shift_unit_px: Float[np.ndarray, "view 2"] | None = None,
        lenses: Lenses | None = None,
        prior_sigma: Float[np.ndarray, "lens 5"] | None = None,
        assumed: Bool[np.ndarray, " lens"] | None = None,
        guesses: dict[int, tuple[float, ...]] | None = None,
        crops: dict[int, CropOfMain] | None = None,
        main: int = 0,
        penalty: float = 0.0,
    ) -> None:
        views = intrinsics.shape[0]
        self.tracks, self.config, self.unit_px, self.seed = tracks, config, unit_px, seed
        self.start_intrinsics = intrinsics
        self.lens_of = np.zeros(views, np.int64) if lens_of is None else lens_of.copy()
        long_side = REFERENCE_LONG_SIDE_PX * unit_px
        self.shift_unit_px = np.full((views, 2), long_side) if shift_unit_px is None else shift_unit_px
        self.lenses = Lenses.nominal(views) if lenses is None else lenses
        self.prior_sigma = np.full((views, LENS_PARAMETERS), np.inf) if prior_sigma is None else prior_sigma
        self.assumed = np.zeros(views, bool) if assumed is None else assumed
        self.spread_deg = np.zeros(views)  # how far directions move to cameras that explain the photos about as well
        self.halves_deg = np.zeros(views)  # how far directions differ between two halves of the matches
        self.rival_log_focal: float | None = (
            None  # main focal that the matches go better with than with the one held to
        )
        self.lens_guesses = {} if guesses is None else guesses
        self.crops = {} if crops is None else crops
        self.main = main
        self.lens_sigma = np.full((views, LENS_PARAMETERS), np.inf)
        self.penalty = penalty
        self.rotations = np.tile(np.eye(3), (views, 1, 1))
        self.translations = np.zeros((views, 3))
        self.registered = np.zeros(views, bool)
        self.points = np.zeros((tracks.count, 3))
        self.valid = np.zeros(tracks.count, bool)
        self.active = np.zeros((tracks.count, views), bool)

    # --- geometry of the current model -------------------------------------------------------------------------------

    @property
    def intrinsics(self) -> Float[np.ndarray, "view 3 3"]:
        """Intrinsics with what is known of the lenses now."""
        return intrinsics_through(self.start_intrinsics, self.shift_unit_px, self.lenses.resolved[self.lens_of])

    @property
    def log_focal(self) -> Float[np.ndarray, " view"]:
        """Logarithm of each view's factor on its start focal."""
        return self.lenses.resolved[self.lens_of, LOG_FOCAL]

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

    def copy(self) -> Mapping:
        """A model that can change without this one."""
        other = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(other, name, value.copy())
        return other

    def over(self, tracks: Tracks) -> Mapping:
        """The same cameras and lenses over other tracks of the same views, without points."""
        other = self.copy()
        other.tracks = tracks
        other.points, other.valid = np.zeros((tracks.count, 3)), np.zeros(tracks.count, bool)
        other.active = np.zeros((tracks.count, len(self.registered)), bool)
        return other

    def adopt(self, other: Mapping) -> None:
        """Take over cameras and lenses of a model of the same views over other tracks."""
        self.rotations, self.translations = other.rotations.copy(), other.translations.copy()
        self.registered = other.registered.copy()
        self.lens_of, self.lenses, self.lens_sigma = other.lens_of.copy(), other.lenses, other.lens_sigma
        self.prior_sigma, self.penalty, self.main = other.prior_sigma, other.penalty, other.main
        self.assumed, self.spread_deg = other.assumed.copy(), other.spread_deg.copy()

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

    def leave_out(self, view: int) -> None:
        """Take a view out of the model, with the points that only it and one other view see."""
        self.registered[view] = False
        self.active[:, view] = False
        self.valid &= self.active.sum(1) >= 2
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
        """Pose a view from the points it sees; False if too few of them agree on a pose.

        Where no view with its lens is in the model yet, or the lens explains few of the points, other focals are tried; one that
        explains clearly more makes the view a lens of its own.
        """
        rows = np.flatnonzero(self.tracks.seen[:, view] & self.valid)
        sighting = self.sighting(view, rows)
        current = self.lenses.resolved[self.lens_of[view]]
        pose = solve_pose(
            sighting.points,
            sighting.pixel_xy,
            sighting.through(current),
            threshold_px=sighting.threshold_px,
            robust_px=sighting.noise_px,
            seed=self.seed,
        )
        found = None if pose is None else judge_view(sighting, pose[0], pose[1], current)
        holder = self.lenses.focal_of[self.lens_of]
        alone = not (self.registered & (holder == holder[view])).any()
        agreeing = 0 if found is None else int(found.inlier.sum())
        if alone or agreeing < self.config.focal_doubt_share * len(rows):
            other = resect(sighting, self.log_focals_to_try(view, alone))
            if other is not None and (
                found is None or other.cost < (1.0 if alone else self.config.split_cost) * found.cost
            ):
                if not alone:
                    self.split_lens(view)
                self.set_lens(view, other.lens)
                found = other
        if found is None or found.inlier.sum() < max(
            self.config.min_register_inliers, self.config.min_register_share * len(rows)
        ):
            return False
        self.rotations[view], self.translations[view] = found.rotation, found.translation
        self.registered[view] = True
        self.active[rows, view] = found.inlier
        return True

    def sighting(self, view: int, rows: Int[np.ndarray, " row"]) -> Sighting:
        """What a view sees of the points of some tracks."""
        row = self.lens_of[view]
        return Sighting(
            points=self.points[rows],
            pixel_xy=self.tracks.pixel_xy[rows, view],
            start=self.start_intrinsics[view],
            shift_unit_px=self.shift_unit_px[view],
            log_focal_low=float(self.lenses.low[row, LOG_FOCAL]),
            log_focal_high=float(self.lenses.high[row, LOG_FOCAL]),
            threshold_px=self.config.register_px * self.unit_px,
            noise_px=self.config.robust_px * self.unit_px,
            seed=self.seed,
        )

    def log_focals_to_try(self, view: int, alone: bool) -> list[float]:
        """Factors on a view's start focal: a grid over all that is plausible and, with no view of its lens posed, the guesses."""
        row, step = self.lens_of[view], float(np.log(self.config.focal_step))
        grid = np.arange(self.lenses.low[row, LOG_FOCAL] + step / 2, self.lenses.high[row, LOG_FOCAL], step).tolist()
        return [0.0, *self.lens_guesses.get(view, ()), *grid] if alone else grid

    def set_lens(self, view: int, lens: Float[np.ndarray, " 5"]) -> None:
        """Give the lens of a view other values."""
        row = self.lens_of[view]
        values, focal_of, offset = self.lenses.values.copy(), self.lenses.focal_of.copy(), self.lenses.offset.copy()
        values[row], focal_of[row], offset[row] = lens, row, 0.0
        self.lenses = replace(self.lenses, values=values, focal_of=focal_of, offset=offset)

    def move_main_focal(self, log_factor: float) -> None:
        """Multiply the main focal, and those that follow it, by exp(log_factor), within bounds."""
        row = self.lens_of[self.main]
        values = self.lenses.values.copy()
        values[row, LOG_FOCAL] = np.clip(
            values[row, LOG_FOCAL] + log_factor, self.lenses.low[row, LOG_FOCAL], self.lenses.high[row, LOG_FOCAL]
        )
        self.lenses = replace(self.lenses, values=values)

    def assume_main_focal(self) -> None:
        """From now on hold the main focal to what is usual and no longer to what the files say."""
        row = self.lens_of[self.main]
        prior, prior_sigma, assumed = self.lenses.prior.copy(), self.prior_sigma.copy(), self.assumed.copy()
        start_ratio = float(self.start_intrinsics[self.main, 0, 0] / self.shift_unit_px[self.main, 0])
        prior[row, LOG_FOCAL] = np.log(self.config.focal_prior / start_ratio)
        prior_sigma[row, LOG_FOCAL], assumed[row] = self.config.focal_prior_sigma, True
        self.lenses = replace(self.lenses, prior=prior)
        self.prior_sigma, self.assumed = prior_sigma, assumed

    def split_lens(self, view: int) -> None:
        """Make a view a lens of its own, with the values of the one it had and little held against another focal."""
        old = int(self.lens_of[view])
        others = np.flatnonzero((self.lens_of == old) & (np.arange(len(self.lens_of)) != view))
        if len(others) == 0:
            return
        if view == self.main:
            self.main = int(others[0])
        names = ("values", "free", "low", "high", "prior", "focal_of", "offset")
        tables = {name: getattr(self.lenses, name).copy() for name in names}
        tables["sigma"], tables["assumed"] = self.prior_sigma.copy(), self.assumed.copy()
        if old == view:  # the lens goes on under the number of another view that has it
            heir = int(others[0])
            for table in tables.values():
                table[heir] = table[view]
            self.lens_sigma[heir] = self.lens_sigma[view]
            self.lens_of[others] = heir
            tables["focal_of"][tables["focal_of"] == view] = heir
            old = heir
        for table in tables.values():
            table[view] = table[old]
        tables["focal_of"][view], tables["offset"][view] = view, 0.0
        tables["free"][view, LOG_FOCAL], tables["assumed"][view] = True, False
        tables["sigma"][view, LOG_FOCAL] = self.config.split_focal_sigma
        tables["prior"][view, LOG_FOCAL] = tables["values"][old, LOG_FOCAL]
        self.lens_of[view] = view
        self.prior_sigma, self.assumed = tables.pop("sigma"), tables.pop("assumed")
        self.lenses = replace(self.lenses, **tables)
        self.penalty += self.config.split_penalty

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
        problem = self._problem(self.lenses.free & refine_focal, self.prior_sigma, free=free, robust_px=robust_px)
        if problem is None:
            return None
        result = adjust(problem, max_iterations=iterations or self.config.bundle_iterations)
        self.take(result)
        if refine_focal:
            self.lens_sigma = result.lens_sigma * problem.robust_px * _PRIOR_INFLATION**0.5
        return result

    def compare(
        self,
        free: Bool[np.ndarray, "lens 5"],
        prior_sigma: Float[np.ndarray, "lens 5"],
        *,
        pixel_xy: Float[np.ndarray, "track view 2"] | None = None,
        values: Float[np.ndarray, "lens 5"] | None = None,
    ) -> BundleResult | None:
        """What adjustment would make of lenses that are held otherwise, at the scale of the present errors. Changes nothing."""
        errors = self.errors_px()[self.active & self.registered]
        if len(errors) == 0:
            return None
        noise = float(np.clip(np.median(errors) / self.unit_px, self.config.min_robust_px / 2, self.config.robust_px))
        problem = self._problem(free, prior_sigma, robust_px=noise, pixel_xy=pixel_xy, values=values)
        return None if problem is None else adjust(problem, max_iterations=2 * self.config.bundle_iterations)

    def direction_sigma_deg(self, *, least_noise_px: float) -> Float[np.ndarray, "view view"]:
        """Standard deviation of the direction from each view to each other, at the present errors; NaN where not registered.

        Errors are correlated, as for priors: they count as fewer than there are, and as no smaller than ``least_noise_px`` (at 768 px).
        """
        errors = self.errors_px()[self.active & self.registered]
        views = len(self.registered)
        problem = None
        if len(errors):
            noise = max(float(np.median(errors)) / 1.18 / self.unit_px, least_noise_px)  # a median of two dimensions
            problem = self._problem(self.lenses.free, self.prior_sigma, robust_px=noise)
        if problem is None:
            return np.full((views, views), np.nan)
        return direction_sigma_deg(problem) * problem.robust_px * _PRIOR_INFLATION**0.5

    def take(self, result: BundleResult) -> None:
        """Make an adjustment's result the model."""
        self.rotations, self.translations = result.problem.rotations, result.problem.translations
        self.points[np.flatnonzero(self.valid)] = result.problem.points
        self.lenses = replace(self.lenses, values=result.problem.lenses.values)

    def intrinsics_of(self, result: BundleResult) -> Float[np.ndarray, "view 3 3"]:
        """Intrinsics after an adjustment that was not taken."""
        return intrinsics_through(
            self.start_intrinsics, self.shift_unit_px, result.problem.lenses.resolved[self.lens_of]
        )

    def follow_focal(self, view: int, other: int, offset: float) -> None:
        """From now on the focal of a view's lens is that of another view's, ``offset`` (logarithm) apart."""
        focal_of, offsets = self.lenses.focal_of.copy(), self.lenses.offset.copy()
        focal_of[self.lens_of[view]], offsets[self.lens_of[view]] = self.lens_of[other], offset
        self.lenses = replace(self.lenses, focal_of=focal_of, offset=offsets)

    def let_shift(self, view: int, sigma: float) -> None:
        """From now on refine the principal point of a view's lens, too: of a part of a picture within what can have been cut off."""
        row, columns = self.lens_of[view], slice(SHIFT_X, SHIFT_Y + 1)
        free, prior_sigma = self.lenses.free.copy(), self.prior_sigma.copy()
        low, high = self.lenses.low.copy(), self.lenses.high.copy()
        free[row, columns], prior_sigma[row, columns] = True, sigma
        crop = self.crops.get(view)
        if crop is not None:
            high[row, columns] = crop.limit_x, crop.limit_y
            low[row, columns] = -high[row, columns]
        self.lenses, self.prior_sigma = replace(self.lenses, free=free, low=low, high=high), prior_sigma

    def _problem(
        self,
        lens_free: Bool[np.ndarray, "lens 5"],
        prior_sigma: Float[np.ndarray, "lens 5"],
        *,
        free: Bool[np.ndarray, " view"] | None = None,
        robust_px: float | None = None,
        pixel_xy: Float[np.ndarray, "track view 2"] | None = None,
        values: Float[np.ndarray, "lens 5"] | None = None,
    ) -> BundleProblem | None:
        """The model as bundle adjustment takes it; None if there is too little of it."""
        rows, views = np.nonzero(self.active & self.registered)
        if len(rows) < 6:
            return None
        used = np.flatnonzero(self.valid)
        position = np.full(self.tracks.count, -1)
        position[used] = np.arange(len(used))
        if free is None:
            free = self.registered.copy()
            free[np.flatnonzero(self.registered)[0]] = False
        noise = (robust_px or self.config.robust_px) * self.unit_px
        seen_at = self.tracks.pixel_xy if pixel_xy is None else pixel_xy
        return BundleProblem(
            rotations=self.rotations,
            translations=self.translations,
            focals_px=self.start_intrinsics[:, [0, 1], [0, 1]],
            centres_px=self.start_intrinsics[:, :2, 2],
            points=self.points[used],
            camera_index=views,
            point_index=position[rows],
            pixel_xy=seen_at[rows, views],
            camera_free=free & self.registered,
            lens_index=self.lens_of,
            lenses=replace(
                self.lenses,
                values=self.lenses.values if values is None else values,
                free=lens_free,
                weight=_PRIOR_INFLATION * (noise / prior_sigma) ** 2 / self._tail(prior_sigma),
            ),
            shift_unit_px=self.shift_unit_px,
            robust_px=noise,
        )

    def score(self) -> float:
        """How much the model explains: sum over observations of 1 - (e / threshold)^2, less what its lenses' priors cost."""
        limit = self.config.inlier_px * self.unit_px
        explained = np.maximum(1.0 - (self.errors_px()[self.active & self.registered] / limit) ** 2, 0.0).sum()
        used = np.unique(self.lens_of[self.registered])
        pulls = ((self.lenses.values - self.lenses.prior) / self.prior_sigma)[used] ** 2
        tail = self._tail(self.prior_sigma)[used]
        pulls = np.where(tail > 1, pulls * np.log(tail) / (tail - 1).clip(1e-12), pulls)  # nu log(1 + pull / nu)
        return float(explained - _PRIOR_INFLATION * pulls.sum() / 2 - self.penalty)

    def _tail(self, prior_sigma: Float[np.ndarray, "lens 5"]) -> Float[np.ndarray, "lens 5"]:
        """By how much each prior's pull is weakened at the present values: 1 + pull^2 / nu of Student's distribution, 1 for a Gaussian."""
        tail = np.ones_like(prior_sigma)
        pull = (self.lenses.values[:, LOG_FOCAL] - self.lenses.prior[:, LOG_FOCAL]) / prior_sigma[:, LOG_FOCAL]
        tail[self.assumed, LOG_FOCAL] += pull[self.assumed] ** 2 / _TAIL
        return tail


def directions_between_deg(model: Mapping, others: Sequence[Mapping]) -> Float[np.ndarray, " view"]:
    """Per view the median over its neighbours of how far the direction to them moves, in the other model in which that is most; degrees.

    Directions between cameras that stand together, as in a burst, say nothing and are not asked.
    """
    views, most = np.flatnonzero(model.registered), np.zeros(len(model.registered))
    apart = np.linalg.norm(model.centres[views, None] - model.centres[views], axis=-1)
    near = np.zeros((len(most), len(most)), bool)
    near[np.ix_(views, views)] = apart < _STANDS_TOGETHER * apart.max(initial=0.0)
    for other in others:
        for view in views:
            turned = []
            for neighbour in views:
                if (
                    neighbour == view
                    or near[view, neighbour]
                    or not (other.registered[view] and other.registered[neighbour])
                ):
                    continue
                a, b = (m.rotations[view] @ (m.centres[neighbour] - m.centres[view]) for m in (model, other))
                turned.append(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
            most[view] = max(most[view], float(np.median(turned)) if turned else 0.0)
    return most
