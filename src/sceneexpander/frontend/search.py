"""The search for the cameras of matched views: focal starts, initial pairs, lenses that are not what they seem.

For several plausible focals and initial pairs a model is grown; the one that explains most is finished, its lenses are tested, and views
that stand out are left out and brought back with a lens of their own.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from sceneexpander.frontend.bundle import LOG_FOCAL, Lenses
from sceneexpander.frontend.evidence import rival_angle_deg
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.lens_tests import (
    doubt_focal,
    find_apart_group,
    mean_cost,
    pair_costs,
    release_focal,
    settle_lenses,
    snap_lenses,
)
from sceneexpander.frontend.lenses import FocalStart, LensPlan
from sceneexpander.frontend.mapping import CropOfMain, Mapping, directions_between_deg
from sceneexpander.frontend.sfm_setup import KnownCameras, Setup
from sceneexpander.frontend.sfm_types import FocalSource, PairKind, SfmConfig
from sceneexpander.frontend.tracks import Tracks, build_tracks
from sceneexpander.frontend.twoview import (
    PairMatches,
    fundamental_from_poses,
    match_guided,
    relative_pose,
)

_log = logging.getLogger(__name__)

_STRANGE = (
    3.0  # times what is usual among the others: a view that even a lens of its own does not bring together with them
)
_BETTER = 0.85  # of what stayed unexplained before
_AS_GOOD = 0.98  # of the score
_UNCERTAIN_FOCAL = 0.015  # standard deviation of its logarithm, beyond which other focals are tried
_FOCAL_JUMP = 0.2  # of the logarithm
_MOST_JUMPS = 6
_MIN_COMMON = 8  # points two views must share before their matches are worth finding again


@dataclass(frozen=True, slots=True, kw_only=True)
class PairKinds:
    """What the pairs are, and what a turning camera says about its focal length."""

    kinds: list[PairKind]
    distinct: int  # number of views of which no two show the same from the same place
    turning_focal: float | None  # factor on the nominal focal that makes pure rotations of such pairs; None without any


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundCameras:
    """A finished model, what it was over the matches that were found before any camera was known, and where its main focal came from."""

    mapping: Mapping
    unguided: Mapping
    focal_source: FocalSource


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSearch:
    """Matched views, and what is known of their cameras. ``features`` are those of pinhole cameras."""

    features: list[Features]
    pairs: list[PairMatches]
    found: PairKinds
    known: KnownCameras
    plan: LensPlan
    config: SfmConfig
    setup: Setup

    def run(self) -> FoundCameras:
        """The best model, finished."""
        config = self.config
        tracks = build_tracks(self.features, self.pairs)
        begun = self._best_start(tracks)
        if begun is None:
            return self._without_points(tracks)
        model, start, refine, attempted = self._settled(tracks, *begun)
        if refine and not self.known.posed.any():
            model = self._with_groups_apart(tracks, model)
        unguided = model
        # Only now: matches found again in the epipolar bands of a wrong camera would only agree with it.
        if config.guided:
            again = build_tracks(self.features, self._guided_pairs(model))
            guided = self._new_mapping(again, start)
            guided.adopt(model)
            guided.grow(refine_focal=False, free=self.free_views(guided))
            refine = self._finish(guided, refine)
            model = guided
        if start.source is not None and self.plan.refine:
            before = model.over(tracks)
            before.finish(refine_focal=False, free=self.free_views(model))
            other = doubt_focal(before)
            if other is not None:
                model.rival_log_focal = float(other.log_focal[model.main])
                model.spread_deg = np.maximum(model.spread_deg, directions_between_deg(before, [other]))
        if refine:
            return FoundCameras(mapping=model, unguided=unguided, focal_source=FocalSource.REFINED)
        if self.plan.refine:
            others = [self._moved(model, sign * start.sigma) for sign in (-1, 1)]
            model.spread_deg = np.maximum(model.spread_deg, directions_between_deg(model, others))
        source = start.source or (FocalSource.ASSUMED if attempted else FocalSource.SWEPT)
        return FoundCameras(mapping=model, unguided=unguided, focal_source=source)

    def _without_points(self, tracks: Tracks) -> FoundCameras:
        """A model of cameras alone, where nothing has parallax."""
        plan = self.plan
        turning = 1.0 if self.found.turning_focal is None else self.found.turning_focal
        ratio = plan.starts[0].ratio if plan.source else self.config.focal_prior
        empty = self._new_mapping(tracks, replace(plan.starts[0], ratio=turning * ratio))
        self._set_known_poses(empty)
        source = plan.source or (FocalSource.ASSUMED if turning == 1 else FocalSource.TURNED)
        return FoundCameras(mapping=empty, unguided=empty, focal_source=source)

    def _best_start(self, tracks: Tracks) -> tuple[Mapping, FocalStart] | None:
        """The model that explains most, grown over the longest tracks; None if none has a point."""
        config, plan = self.config, self.plan
        few = tracks.longest(config.sweep_tracks)
        initial: list[PairMatches | None] = [None] if self.known.posed.any() else list(self._initial_pairs())
        best: tuple[float, Mapping, FocalStart] | None = None
        for position, pair in enumerate(initial):
            # The first pair finds the focal; further pairs only have to beat it there. Unless the first one leaves much unexplained:
            # then one of its views may have another lens than the rest, and its focal says nothing.
            doubtful = best is None or best[0] < config.focal_doubt_share * few.seen.sum()
            starts = plan.starts if position == 0 or doubtful or best is None else (best[2],)
            for start in starts:
                candidate = self._grown(few, start, pair)
                if candidate is not None and (best is None or candidate.score() > best[0]):
                    best = candidate.score(), candidate, start
        if best is None or not best[1].valid.any():
            return None
        _, model, start = best
        found = start.ratio * float(np.exp(model.log_focal[plan.main]))
        _log.debug("started from a focal of %.2f, found %.3f", start.ratio, found)
        return model, start

    def _grown(self, tracks: Tracks, start: FocalStart, pair: PairMatches | None) -> Mapping | None:
        """A model grown from one pair; None if the pair has no motion at this focal."""
        candidate = self._new_mapping(tracks, start)
        if pair is None:
            self._set_known_poses(candidate)
        elif not self._set_initial_pair(candidate, pair):
            return None
        enough = self.found.distinct >= self.config.min_views_for_focal
        refine = self.plan.refine and (enough or self._hinted(start))
        candidate.grow(refine_focal=refine, free=self.free_views(candidate))
        return candidate

    def _hinted(self, start: FocalStart) -> bool:
        """Whether a focal that the files say can be refined: two views fit others as well."""
        return start.source is not None and self.found.distinct > 2

    def _settled(self, tracks: Tracks, grown: Mapping, start: FocalStart) -> tuple[Mapping, FocalStart, bool, bool]:
        """(finished model over all tracks with its lenses tested, its start, whether its main focal was refined, and was to be)."""
        model = self._new_mapping(tracks, start)
        model.adopt(grown)
        free = self.free_views(model)
        model.grow(refine_focal=False, free=free)
        several = min(int(model.registered.sum()), self.found.distinct) >= self.config.min_views_for_focal
        attempted = self.plan.refine and (several or self._hinted(start))
        refine = self._finish(model, attempted)
        for _ in range(self.config.lens_rounds if refine else 0):
            freer = model.copy()
            if not settle_lenses(freer, self.features, self.pairs, focal_said=start.source is not None):
                break
            freer.grow(refine_focal=True, free=free)
            refined = self._finish(freer, refine)
            _log.debug("other lenses: score %.1f -> %.1f", model.score(), freer.score())
            if freer.score() <= model.score():
                break
            model, refine = freer, refined
        if refine and snap_lenses(model):
            refine = self._finish(model, refine)
        if refine:  # only now: a view with another lens than it seems to have leaves the focal of all uncertain
            model = self._with_focal_elsewhere(model)
        elif start.source is not None and self.plan.refine and not self._flat(model) and release_focal(model):
            self._finish(model, False)
            start = replace(start, sigma=self.config.focal_prior_sigma, source=None)
        return model, start, refine, attempted

    def _flat(self, model: Mapping) -> bool:
        """Whether two views see a surface so flat that they may stand elsewhere: the focal then goes along with where they are put."""
        views = np.flatnonzero(model.registered).tolist()
        most = self.config.max_spread_deg
        return any(rival_angle_deg(model, view, self.features, self.pairs) > most for view in views)

    def _with_focal_elsewhere(self, model: Mapping) -> Mapping:
        """The model, or a better one at another main focal, where that is uncertain; it knows what other cameras would do as well.

        Through a long lens a nearer and flatter scene looks nearly the same; adjustment creeps along such a valley, and what it prunes
        on the way keeps it where it is.
        """
        found, tried = [model], [float(model.log_focal[model.main])]
        while model.lens_sigma[model.lens_of[model.main], LOG_FOCAL] > _UNCERTAIN_FOCAL and len(tried) <= _MOST_JUMPS:
            for jump in (_FOCAL_JUMP, -_FOCAL_JUMP):
                target = float(model.log_focal[model.main]) + jump
                if min(abs(target - other) for other in tried) > _FOCAL_JUMP / 2:
                    tried.append(target)
                    other = self._moved(model, jump)
                    if self._finish(other, True):
                        found.append(other)
            best = max(found, key=Mapping.score)
            if best is model:
                break
            _log.debug("another focal: score %.1f -> %.1f", model.score(), best.score())
            model = best
        as_good = [other for other in found if other.score() > _AS_GOOD * model.score()]
        model.spread_deg = directions_between_deg(model, as_good)
        _log.debug("%d of %d cameras tried are as good, spread %s", len(as_good), len(found), model.spread_deg.round(1))
        return model

    def _moved(self, model: Mapping, jump: float) -> Mapping:
        """The model settled at another main focal, which is held."""
        other = model.copy()
        other.move_main_focal(jump)
        other.finish(refine_focal=False, free=self.free_views(other))
        return other

    def _with_groups_apart(self, tracks: Tracks, model: Mapping) -> Mapping:
        """The model, or a better one in which a group of views that does not go with the rest has a lens of its own."""
        costs = pair_costs(model, self.features, self.pairs)
        group = find_apart_group(model, costs)
        if not group:
            return model
        seen = tracks.seen.copy()
        seen[:, group] = False
        fewer = Tracks(pixel_xy=tracks.pixel_xy, seen=seen)
        rest = self.without(group)
        begun = rest._best_start(fewer)
        if begun is None:
            return model
        apart, start, refine, _ = rest._settled(fewer, *begun)
        if not refine:
            return model
        whole = self._new_mapping(tracks, start)
        whole.adopt(apart)
        whole.split_lens(group[0])
        whole.lens_of[group] = whole.lens_of[group[0]]
        for view in group:
            whole.register(view)
        whole.grow(refine_focal=True)
        self._finish(whole, True)
        if snap_lenses(whole):
            self._finish(whole, True)
        now = pair_costs(whole, self.features, self.pairs)
        others = [view for view in np.flatnonzero(whole.registered) if view not in group]
        usual = mean_cost(now[np.ix_(others, others)])
        for view in group:
            if whole.registered[view] and mean_cost(now[view, others]) > _STRANGE * usual:
                whole.leave_out(view)
                now[view, :] = now[:, view] = np.nan
        _log.debug("views %s apart: unexplained %.3f -> %.3f", group, mean_cost(costs), mean_cost(now))
        return whole if mean_cost(now) < _BETTER * mean_cost(costs) else model

    def without(self, views: list[int]) -> CameraSearch:
        """The same search without what some views share with others."""
        kept = [k for k, pair in enumerate(self.pairs) if pair.view_a not in views and pair.view_b not in views]
        found = replace(
            self.found,
            kinds=[self.found.kinds[k] for k in kept],
            distinct=max(2, self.found.distinct - len(views)),
        )
        config = replace(self.config, min_views_for_focal=min(self.config.min_views_for_focal, 3))
        return replace(self, pairs=[self.pairs[k] for k in kept], found=found, config=config)

    def _new_mapping(self, tracks: Tracks, start: FocalStart) -> Mapping:
        """An empty model with start intrinsics, and bounds and priors of the focals relative to them."""
        plan, config = self.plan, self.config
        intrinsics = plan.intrinsics(start.ratio)
        views = len(plan.lens_of)
        lenses = Lenses.nominal(views)
        sigma = np.full(lenses.values.shape, np.inf)
        assumed = np.zeros(views, bool)
        ratios = intrinsics[:, 0, 0] / plan.units_px[:, 0]
        low, high = config.focal_bounds
        # A given focal outside the bounds is believed, and stays where it is.
        lenses.low[:, LOG_FOCAL] = np.minimum(np.log(low / ratios), 0.0)
        lenses.high[:, LOG_FOCAL] = np.maximum(np.log(high / ratios), 0.0)
        lenses.free[:, LOG_FOCAL] = True
        guesses: dict[int, tuple[float, ...]] = {}
        crops: dict[int, CropOfMain] = {}
        for view in range(views):
            lens = plan.lens_of[view]
            if plan.known is not None or lens == plan.main:
                lenses.prior[view, LOG_FOCAL] = np.log(start.prior / start.ratio)
                sigma[view, LOG_FOCAL] = start.sigma
                assumed[view] = plan.known is None and start.source is None
                continue
            likely = plan.guesses(view, start.ratio)
            guesses[view] = tuple(float(np.log(other / likely[0])) for other in likely[1:])
            limits = plan.crop_of_main(view)
            if limits is not None:
                crops[view] = CropOfMain(log_focal=guesses[view][-1], limit_x=limits[0], limit_y=limits[1])
            hinted = bool(np.isfinite(plan.focal_hints[lens])) and start.source is not None
            sigma[view, LOG_FOCAL] = config.focal_hint_sigma if hinted else config.split_focal_sigma
            if plan.generated[view]:
                # Drawn after the photos, with their field of view; a wrong one shows when its matches are looked at.
                lenses.focal_of[view] = plan.main
                sigma[view, LOG_FOCAL] = config.generated_focal_sigma
        return Mapping(
            tracks,
            intrinsics,
            config,
            unit_px=self.setup.unit_px,
            seed=self.setup.seed,
            lens_of=plan.lens_of,
            shift_unit_px=plan.units_px,
            lenses=lenses,
            prior_sigma=sigma,
            assumed=assumed,
            guesses=guesses,
            crops=crops,
            main=plan.main,
            penalty=start.penalty,
        )

    def _finish(self, mapping: Mapping, refine: bool) -> bool:
        """Finish a model; a main focal that turns out too uncertain falls back to its prior. Returns whether it was refined."""
        free = self.free_views(mapping)
        mapping.finish(refine_focal=refine, free=free)
        main = mapping.lens_of[mapping.main]
        if refine and mapping.lens_sigma[main, LOG_FOCAL] > self.config.max_focal_sigma:
            uncertain = float(mapping.lens_sigma[main, LOG_FOCAL])
            _log.info("focal is uncertain (sigma of its logarithm %.2f): the prior is kept", uncertain)
            values = mapping.lenses.values.copy()
            values[main, LOG_FOCAL] = mapping.lenses.prior[main, LOG_FOCAL]
            mapping.lenses = replace(mapping.lenses, values=values)
            mapping.finish(refine_focal=False, free=free)
            return False
        return refine

    def _guided_pairs(self, mapping: Mapping) -> list[PairMatches]:
        """All pairs, those of registered views with motion between them matched again along the epipolar lines."""
        found = []
        intrinsics = mapping.intrinsics
        for pair in self.pairs:
            a, b = pair.view_a, pair.view_b
            rotation = mapping.rotations[b] @ mapping.rotations[a].T
            translation = mapping.translations[b] - rotation @ mapping.translations[a]
            common = int((mapping.active[:, a] & mapping.active[:, b]).sum())
            if not (mapping.registered[a] and mapping.registered[b]) or common < _MIN_COMMON:
                found.append(pair)
                continue
            fundamental = fundamental_from_poses(rotation, translation, intrinsics[a], intrinsics[b])
            found.append(match_guided(pair, self.features, fundamental, self.config, unit_px=mapping.unit_px))
        return found

    def _set_known_poses(self, mapping: Mapping) -> None:
        """Register the views whose pose was given."""
        mapping.rotations[:] = self.known.cam_from_world[:, :3, :3]
        mapping.translations[:] = self.known.cam_from_world[:, :3, 3]
        mapping.registered = self.known.posed.copy()

    def free_views(self, mapping: Mapping) -> Bool[np.ndarray, " view"] | None:
        """Cameras that adjustment may move; None leaves the choice of the reference to the mapping."""
        if not self.known.posed.any():
            return None
        free = ~self.known.posed
        if self.config.refine_known_poses:
            free[:] = True
            free[np.flatnonzero(self.known.posed)[0]] = False
        return free

    def _initial_pairs(self) -> list[PairMatches]:
        """The most promising pairs to begin with: inliers x triangulation angle, capped; of the main lens where there are such.

        No view is in all of them where that can be: one view with another lens than it seems to have must not spoil every start.
        """
        features, plan, config, setup = self.features, self.plan, self.config, self.setup
        scored: list[tuple[bool, float, PairMatches]] = []
        for pair, kind in zip(self.pairs, self.found.kinds, strict=True):
            if kind not in (PairKind.PARALLAX, PairKind.FLAT):
                continue
            a, b = pair.view_a, pair.view_b
            pose = relative_pose(
                features[a].pixel_xy[pair.verified.index_a],
                features[b].pixel_xy[pair.verified.index_b],
                plan.nominal[a],
                plan.nominal[b],
                threshold_px=config.epipolar_px * setup.unit_px,
                seed=setup.seed,
            )
            if pose is not None and pose.angle_deg > config.min_angle_deg:
                alike = plan.lens_of[a] == plan.lens_of[b] == plan.main
                value = float(pose.inlier.sum()) * min(pose.angle_deg, config.max_initial_angle_deg)
                scored.append((alike, value, pair))
        scored.sort(key=lambda entry: (not entry[0], -entry[1]))
        ranked = [pair for _, _, pair in scored]
        chosen = ranked[: config.initial_pairs]
        for view in (chosen[0].view_a, chosen[0].view_b) if chosen else ():
            if all(view in (pair.view_a, pair.view_b) for pair in chosen):
                chosen += [pair for pair in ranked if view not in (pair.view_a, pair.view_b)][:1]
        return chosen

    def _set_initial_pair(self, mapping: Mapping, pair: PairMatches) -> bool:
        """Start the model from one pair; False if it has no motion at this focal."""
        a, b = pair.view_a, pair.view_b
        pose = relative_pose(
            self.features[a].pixel_xy[pair.verified.index_a],
            self.features[b].pixel_xy[pair.verified.index_b],
            mapping.intrinsics[a],
            mapping.intrinsics[b],
            threshold_px=self.config.epipolar_px * mapping.unit_px,
            seed=mapping.seed,
        )
        if pose is None:
            return False
        mapping.start(a, b, pose)
        return True
