"""Whether the lenses of a finished model are what they were taken for: focal alone and together, principal point, distortion.

Each test lets something go free that was held, and keeps it only where much less is left unexplained and the value is far from what it
was held at. Ordinary photos keep the simple camera.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from sceneexpander.frontend.bundle import K1, K2, LENS_PARAMETERS, LOG_FOCAL, SHIFT_X, SHIFT_Y, BundleResult
from sceneexpander.frontend.distortion import Distortion
from sceneexpander.frontend.epipolar import EpipolarFit, EpipolarView, LensFreedom, OtherView, freedom_of, held_lens
from sceneexpander.frontend.evidence import other_views
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.mapping import Mapping
from sceneexpander.frontend.resection import rough_poses
from sceneexpander.frontend.rival_poses import direction_changes_deg
from sceneexpander.frontend.twoview import PairMatches

_log = logging.getLogger(__name__)

_MIN_MATCHES = 60  # of a view with all others: fewer say too little about its lens
_NOISE_PX = 0.5  # at 768 px: of matches, for their distance from epipolar lines
_STANDS_OUT = 1.25  # times the usual share of what stays unexplained
_APART = 2.0  # times what stays unexplained within two groups of views: so much between them sets them apart
_MOST_DIVIDED = 10  # views
_MIN_PAIR_MATCHES = 20
_SNAP = 0.05  # of the logarithm of the focal
_KEEP_BEST = 4  # poses at other focals that are refined
_OWN_FOCAL = 0.04  # of the logarithm: nearer to the shared focal than this nothing is gained by another
_CLEARLY_OTHER = 0.1  # of the logarithm: a focal that is another one for certain
_IN_DOUBT = 0.9  # of what stays unexplained: another focal that leaves less raises doubt
_OWN_SHIFT = 0.03  # of the long side: principal points of whole photos are within a hundredth or two of the centre
_MAX_SHIFT = 0.5  # a crop that keeps a corner of a quarter of the area moves the centre by half
_SHIFT_SIGMA = 0.2  # prior of a cropped picture's principal point
_K_SIGMA = (0.3, 0.3)  # priors of k1 and k2; wide action cameras have k1 near -.3
_BEND_ROUNDS = 8  # of looking for distortion; strong barrels settle in five
_BEND_SETTLED_PX = 0.4  # at 768 px
_MIN_BEND_PX = 1.0  # at 768 px: distortion that moves the outermost points less than this is left alone
_GAIN = 60.0  # of log-likelihood, by which a freer lens must explain a whole model better: eight correlated errors count as one
_GAIN_IN_DOUBT = 16.0  # the same for a focal that was said to be in doubt: two standard deviations
# The same for distortion. Photos without any were seen to gain 13 at most, those with the least that is worth taking out (k1 of -.06) 50
# where the place says least.
_BEND_GAIN = 30.0


def settle_lenses(
    mapping: Mapping, features: Sequence[Features], pairs: Sequence[PairMatches], *, focal_said: bool = False
) -> bool:
    """Find lenses that are not what they were taken for and correct them in place. Returns whether anything changed.

    First the one view that gains most from a lens of its own (zoomed, cropped): with its camera wrong, the others' are not beyond doubt.
    Without such a view whole lenses (a focal that the files say and the pictures do not, all photos cropped alike). Call it again once the
    model is finished anew.

    Args:
        mapping: finished model.
        features: of all views.
        pairs: as verified before any camera was known.
        focal_said: the focal of the main lens is held to what the files say.
    """
    checks = _checks(mapping, features, pairs)
    if not checks:
        return False
    usual = float(np.median([check.now.cost for check in checks]))
    # All matches of one odd view are wrong, a part of those of every other one: it stands out.
    for check in sorted(checks, key=lambda check: -check.now.cost):
        found = check.alternative(thorough=check.alone or check.now.cost > _STANDS_OUT * usual)
        if found is not None:
            check.adopt(found)
            return True
    if focal_said and release_focal(mapping):
        return True
    for lens in np.unique(mapping.lens_of[mapping.registered]):
        if (mapping.registered & (mapping.lens_of == lens)).sum() >= 3 and _free_shift(mapping, int(lens)):
            return True
    return False


def rival_lens_deg(
    mapping: Mapping, features: Sequence[Features], pairs: Sequence[PairMatches]
) -> Float[np.ndarray, " view"]:
    """Per view how far (degrees) directions move to a clearly other focal of its own that explains its matches better; 0 without one.

    Not by so much that `settle_lenses` takes it, or not together with all else: but the camera is then in doubt. Asked of views that stand
    out, as there.
    """
    turned = np.zeros(len(mapping.registered))
    checks = _checks(mapping, features, pairs)
    usual = float(np.median([check.now.cost for check in checks])) if checks else 0.0
    for check in checks:
        if check.now.cost > _STANDS_OUT * usual:
            rival = check.other_focal(thorough=True)
            apart = abs(rival.lens[LOG_FOCAL] - check.now.lens[LOG_FOCAL])
            if apart > _CLEARLY_OTHER and rival.cost < _IN_DOUBT * check.now.cost:
                turned[check.view] = float(np.median(direction_changes_deg(check.now, rival, check.others)))
    return turned


def _checks(mapping: Mapping, features: Sequence[Features], pairs: Sequence[PairMatches]) -> list[_LensCheck]:
    """Of the views that have matches enough; none where fewer than three views are registered."""
    if mapping.registered.sum() < 3:
        return []
    seen = {int(view): other_views(mapping, int(view), features, pairs) for view in np.flatnonzero(mapping.registered)}
    return [
        _LensCheck(mapping, view, others)
        for view, others in seen.items()
        if sum(len(other.own_xy) for other in others) >= _MIN_MATCHES
    ]


def find_apart_group(mapping: Mapping, costs: Float[np.ndarray, "view view"]) -> list[int]:
    """The smaller of two groups of views that explain their own matches and not those between them; empty if there are no such groups.

    Photos of two lenses taken for one look like that. Every division is tried, so for more than ten views none is.

    Args:
        mapping: finished model.
        costs: of `pair_costs`.
    """
    views = np.flatnonzero(mapping.registered).tolist()
    if not 4 <= len(views) <= _MOST_DIVIDED:
        return []
    best: tuple[float, list[int]] = (_APART, [])
    for code in range(1, 2 ** (len(views) - 1)):
        one = [view for k, view in enumerate(views) if code >> k & 1]
        other = [view for view in views if view not in one]
        small, large = sorted((one, other), key=len)
        if len(large) < 3:
            continue
        within = [costs[a, b] for group in (small, large) for a in group for b in group if a < b]
        inner = float(np.nanmean(within)) if np.isfinite(within).any() else float("nan")
        between = costs[np.ix_(small, large)]
        if not np.isfinite(inner) or np.isfinite(between).sum() < 2:
            continue
        ratio = float(np.nanmean(between)) / max(inner, 1e-6)
        if ratio > best[0]:
            best = ratio, small
    _log.debug("pair costs\n%s\napart %s (%.1f)", costs.round(3), best[1], best[0])
    return best[1]


def mean_cost(costs: Float[np.ndarray, "*pair"]) -> float:
    """Over all pairs; 1 without any."""
    return float(np.nanmean(costs)) if np.isfinite(costs).any() else 1.0


def pair_costs(
    mapping: Mapping, features: Sequence[Features], pairs: Sequence[PairMatches]
) -> Float[np.ndarray, "view view"]:
    """What stays unexplained of each pair's matches; NaN where there are too few."""
    views = len(mapping.registered)
    costs = np.full((views, views), np.nan)
    for view in np.flatnonzero(mapping.registered).tolist():
        for other in other_views(mapping, view, features, pairs):
            if len(other.own_xy) >= _MIN_PAIR_MATCHES and np.isnan(costs[view, other.view]):
                fit = EpipolarFit(
                    [other],
                    mapping.intrinsics[view],
                    np.ones(2),
                    noise_px=_NOISE_PX * mapping.unit_px,
                )
                cost = fit.judge(mapping.rotations[view], mapping.translations[view], np.zeros(LENS_PARAMETERS)).cost
                costs[view, other.view] = costs[other.view, view] = cost
    return costs


def snap_lenses(mapping: Mapping) -> bool:
    """Let focals that come near a likely one (the main lens's, the same focal in original pixels, ...) be exactly that.

    Two photos cut to another shape tell their common focal worse than all photos together tell the one that they were cut from.
    """
    changed = False
    main = mapping.lens_of[mapping.main]
    for lens in np.unique(mapping.lens_of[mapping.registered]):
        view = int(np.flatnonzero(mapping.lens_of == lens)[0])
        if lens == main or mapping.lenses.focal_of[lens] != lens:
            continue
        apart = float(mapping.log_focal[view] - mapping.log_focal[mapping.main])
        nearest = min((0.0, *mapping.lens_guesses.get(view, ())), key=lambda guess: abs(guess - apart))
        if abs(nearest - apart) < _SNAP:
            mapping.follow_focal(view, mapping.main, nearest)
            changed = True
    return changed


class _LensCheck:
    """One view's matches with the other posed views, and other lenses that explain them better."""

    def __init__(self, mapping: Mapping, view: int, others: Sequence[OtherView]) -> None:
        self.mapping, self.view, self.others = mapping, view, others
        holder = mapping.lenses.focal_of[mapping.lens_of]
        self.alone = int((holder == holder[view]).sum()) == 1
        self.fit = EpipolarFit(
            others,
            mapping.start_intrinsics[view],
            mapping.shift_unit_px[view],
            noise_px=_NOISE_PX * mapping.unit_px,
        )
        lens = mapping.lenses.resolved[mapping.lens_of[view]]
        self.now = self.fit.refine(mapping.rotations[view], mapping.translations[view], lens, held_lens())

    def alternative(self, *, thorough: bool) -> EpipolarView | None:
        """A lens that leaves much less unexplained; None if there is none.

        Args:
            thorough: begin from many focals, not only from the present one.
        """
        mapping, view, now = self.mapping, self.view, self.now
        focal, starts = self._focal_bounds(), self._starts(thorough=thorough)
        zoomed = self._best(starts, freedom_of(focal, now.lens))
        crop = mapping.crops.get(view)
        candidates = [zoomed] if abs(zoomed.lens[LOG_FOCAL] - now.lens[LOG_FOCAL]) > _OWN_FOCAL else []
        cropped: EpipolarView | None = None
        if crop is not None:
            # A part cut out of a picture of the main lens: its focal is known, its centre lies within what could be cut off.
            cut = zoomed.lens.copy()
            cut[LOG_FOCAL] = crop.log_focal + mapping.log_focal[mapping.main]
            shift = {
                SHIFT_X: (-crop.limit_x, crop.limit_x, np.inf),
                SHIFT_Y: (-crop.limit_y, crop.limit_y, np.inf),
            }
            begin = [replace(start, lens=cut) for start in (*starts, zoomed)]
            cropped = self._best(begin, freedom_of(shift, cut))
            if np.abs(cropped.lens[SHIFT_X : SHIFT_Y + 1]).max() > _OWN_SHIFT:
                candidates.insert(0, cropped)
        if thorough:
            anywhere = {**focal, **dict.fromkeys((SHIFT_X, SHIFT_Y), (-_MAX_SHIFT, _MAX_SHIFT, _SHIFT_SIGMA))}
            free = self._best([zoomed], freedom_of(anywhere, np.zeros_like(now.lens)))
            if np.abs(free.lens[SHIFT_X : SHIFT_Y + 1]).max() > _OWN_SHIFT:
                candidates.append(free)
        _log.debug(
            "view %d: %d matches, unexplained %.4f; others %s",
            view,
            self.fit.count,
            now.cost,
            [(round(c.cost, 4), c.lens[: SHIFT_Y + 1].round(3).tolist()) for c in candidates],
        )
        # Simplest first: each next one must explain much more than what is held so far. A crop frees two numbers and holds one.
        best = now
        for candidate in candidates:
            share = mapping.config.crop_cost if candidate is cropped else mapping.config.split_cost
            if candidate.cost < share * best.cost:
                best = candidate
        return None if best is now else best

    def other_focal(self, *, thorough: bool) -> EpipolarView:
        """What leaves least unexplained if only the focal is free; ``thorough`` as for `alternative`."""
        return self._best(self._starts(thorough=thorough), freedom_of(self._focal_bounds(), self.now.lens))

    def adopt(self, found: EpipolarView) -> None:
        """Make the lens the view's own."""
        mapping, view = self.mapping, self.view
        if not self.alone:
            mapping.split_lens(view)
        mapping.set_lens(view, found.lens)
        mapping.rotations[view], mapping.translations[view] = found.rotation, found.translation
        if np.abs(found.lens[SHIFT_X : SHIFT_Y + 1]).max() > 0:
            mapping.let_shift(view, _SHIFT_SIGMA)
        crop = mapping.crops.get(view)
        if crop is not None and found.lens[LOG_FOCAL] == crop.log_focal + mapping.log_focal[mapping.main]:
            mapping.follow_focal(view, mapping.main, crop.log_focal)
        # Points that the wrong camera has helped to make are made again.
        with_it = mapping.valid & mapping.active[:, view]
        mapping.active[:, view] = False
        mapping.valid &= ~with_it | (mapping.active.sum(1) >= 2)
        mapping.active &= mapping.valid[:, None]

    def _focal_bounds(self) -> dict[int, tuple[float, float, float]]:
        row, lenses = self.mapping.lens_of[self.view], self.mapping.lenses
        return {LOG_FOCAL: (float(lenses.low[row, LOG_FOCAL]), float(lenses.high[row, LOG_FOCAL]), np.inf)}

    def _starts(self, *, thorough: bool) -> list[EpipolarView]:
        return [self.now, *(self._rough_poses() if thorough else [])]

    def _best(self, starts: Sequence[EpipolarView], freedom: LensFreedom) -> EpipolarView:
        found = [self.fit.refine(start.rotation, start.translation, start.lens, freedom) for start in starts]
        return min(found, key=lambda view: view.cost)

    def _rough_poses(self) -> list[EpipolarView]:
        """Poses from the model's points at other focals."""
        mapping, view = self.mapping, self.view
        active = mapping.active.copy()
        active[:, view] = False
        rows = np.flatnonzero(
            mapping.tracks.seen[:, view] & mapping.valid & ((active & mapping.registered).sum(1) >= 2)
        )
        rough = rough_poses(mapping.sighting(view, rows), mapping.log_focals_to_try(view, alone=True))
        judged = [self.fit.judge(pose.rotation, pose.translation, pose.lens) for pose in rough]
        return sorted(judged, key=lambda pose: pose.cost)[:_KEEP_BEST]


def outvote_focal(mapping: Mapping) -> tuple[BundleResult, float] | None:
    """(What adjustment makes of the model at a clearly other main focal, log-likelihood it gains); None if no other explains more.

    Asked where the focal is held to what something other than matches says (files, straight lines); here to no more than what is usual.

    Args:
        mapping: finished model over matches that were found before any camera was known; unchanged.
    """
    lens = int(mapping.lens_of[mapping.main])
    if mapping.assumed[lens]:
        return None
    free = mapping.copy()
    free.assume_main_focal()
    held = mapping.compare(mapping.lenses.free, mapping.prior_sigma)
    freed = free.compare(mapping.lenses.free, free.prior_sigma)
    if held is None or freed is None:
        return None
    moved = float(freed.problem.lenses.values[lens, LOG_FOCAL] - mapping.lenses.values[lens, LOG_FOCAL])
    gain = _gain(held, freed)
    _log.debug("held focal: another one %.3f away, gain %.1f", moved, gain)
    return (freed, gain) if abs(moved) > _CLEARLY_OTHER and gain > 0 else None


def release_focal(mapping: Mapping) -> bool:
    """If another main focal explains much more than the one that it is held to, let go of that. Returns whether anything changed.

    Args:
        mapping: as for `outvote_focal`; corrected in place.
    """
    found = outvote_focal(mapping)
    if found is None or found[1] < _GAIN:
        return False
    mapping.assume_main_focal()
    mapping.take(found[0])
    return True


def doubt_focal(mapping: Mapping) -> Mapping | None:
    """The model at another main focal that explains more than the one that it is held to, not by so much that it is let go; else None.

    Args:
        mapping: as for `outvote_focal`.
    """
    found = outvote_focal(mapping)
    if found is None or found[1] < _GAIN_IN_DOUBT:
        return None
    other = mapping.copy()
    other.take(found[0])
    return other


def _free_shift(mapping: Mapping, lens: int) -> bool:
    """Let the principal point of a lens of several views go where all of them want it."""
    if mapping.lenses.free[lens, SHIFT_X]:
        return False
    free = mapping.lenses.free.copy()
    free[lens, [LOG_FOCAL, SHIFT_X, SHIFT_Y]] = True
    sigma = mapping.prior_sigma.copy()
    sigma[lens, [SHIFT_X, SHIFT_Y]] = _SHIFT_SIGMA
    held, freed = mapping.compare(mapping.lenses.free, mapping.prior_sigma), mapping.compare(free, sigma)
    if held is None or freed is None:
        return False
    shift = freed.problem.lenses.values[lens, SHIFT_X : SHIFT_Y + 1]
    _log.debug("lens %d: shift %s, gain %.1f", lens, shift.round(3), _gain(held, freed))
    if np.abs(shift).max() < _OWN_SHIFT or _gain(held, freed) < _GAIN:
        return False
    mapping.lenses, mapping.prior_sigma = replace(mapping.lenses, free=free), sigma
    mapping.take(freed)
    return True


def _gain(held: BundleResult, freed: BundleResult) -> float:
    """By how much the logarithm of the likelihood rises (Cauchy, at the scale of the errors)."""
    return (held.cost - freed.cost) / held.problem.robust_px**2


def find_distortion(mapping: Mapping, before: Distortion | None) -> Distortion | None:
    """Radial distortion of the model's photos, or None if the pictures show none.

    Strong distortion bends the model itself, and what does not fit the bent model was dropped: so tracks are straightened, the model is
    finished again, and distortion is looked for anew until it no longer changes.

    Args:
        mapping: finished over pixels that ``before`` has straightened, and over matches that were found before any camera was known: those
            found in the epipolar bands of a camera without distortion agree with it. Unchanged.
        before: what was taken out already; found anew together with the focals.
    """
    raw = mapping.tracks.pixel_xy if before is None else before.distorted_tracks(mapping.tracks.pixel_xy)
    model, found = mapping.copy(), before
    for _ in range(_BEND_ROUNDS):
        again = _bend_of(model, found, raw)
        if again is None:
            break
        moved = _bend_px(again, model, raw, than=found)
        if before is not None and found is before and moved < _BEND_SETTLED_PX:
            break
        found = again
        straight = np.stack([found.undistorted(view, raw[:, view]) for view in range(raw.shape[1])], 1)
        model.tracks = replace(model.tracks, pixel_xy=straight)
        model.finish(refine_focal=True)
        if moved < _BEND_SETTLED_PX:
            break
    return None if found is before else found


def _bend_of(mapping: Mapping, before: Distortion | None, raw: np.ndarray) -> Distortion | None:
    """Distortion that explains a model much better than ``before``; None if none does."""
    values = mapping.lenses.values.copy()
    lenses = [
        int(lens)
        for lens in np.unique(mapping.lens_of[mapping.registered])
        if (mapping.registered & (mapping.lens_of == lens)).sum() >= 2
    ]
    if mapping.registered.sum() < 3 or not lenses:
        return None
    if before is not None:
        for view in np.flatnonzero(mapping.registered):
            values[mapping.lens_of[view], [K1, K2]] = before.coefficients_at(int(view), mapping.intrinsics[view])
    free, sigma = mapping.lenses.free.copy(), mapping.prior_sigma.copy()
    for lens in lenses:
        free[lens, [K1, K2]] = True
        sigma[lens, [K1, K2]] = _K_SIGMA
    held = mapping.compare(mapping.lenses.free, mapping.prior_sigma)
    freed = mapping.compare(free, sigma, pixel_xy=raw, values=values)
    if held is None or freed is None:
        return None
    k = freed.problem.lenses.values[mapping.lens_of][:, [K1, K2]]
    found = Distortion(intrinsics=mapping.intrinsics_of(freed), k=k)
    bend = _bend_px(found, mapping, raw, than=None)
    _log.debug("distortion %s, moves corners %.2f px, gain %.1f", k[0].round(4), bend, _gain(held, freed))
    if bend < _MIN_BEND_PX or (before is None and _gain(held, freed) < _BEND_GAIN):
        return None
    return found


def _bend_px(distortion: Distortion, mapping: Mapping, raw: np.ndarray, *, than: Distortion | None) -> float:
    """How far (at 768 px) the outermost observations are moved against another distortion, at the view where that is most."""
    most = 0.0
    for view in np.flatnonzero(mapping.registered).tolist():
        xy = raw[mapping.active[:, view], view]
        if len(xy):
            old = xy if than is None else than.undistorted(view, xy)
            moved = np.linalg.norm(distortion.undistorted(view, xy) - old, axis=1)
            most = max(most, float(np.quantile(moved, 0.95)))
    return most / mapping.unit_px
