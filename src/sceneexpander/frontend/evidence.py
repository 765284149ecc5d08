"""What speaks for each camera of a finished model, and what can fail.

Bundle adjustment makes matches and cameras agree with each other, right or wrong. What is asked here is answered by something it did not
adjust to: matches as they were found before any camera was known, motions of single pairs, how far the directions between cameras could
move without anything being seen of it. A view that fails is taken out and named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sceneexpander.frontend.bundle import LENS_PARAMETERS, LOG_FOCAL, SHIFT_X, SHIFT_Y
from sceneexpander.frontend.epipolar import EpipolarFit, EpipolarView, OtherView, freedom_of, held_lens
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.mapping import Mapping, directions_between_deg
from sceneexpander.frontend.rival_poses import direction_changes_deg, largest_rival_angle_deg
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.tracks import Tracks
from sceneexpander.frontend.twoview import PairMatches, relative_pose

_AGREE_PX = 3.0  # at 768 px: a match this near its epipolar lines agrees with the cameras
_MIN_MATCHES = 30  # fewer say nothing about a camera
# How well pictures tell the focal (logarithm) and the centre (of the long side) of a single view, measured on zoomed and cropped photos;
# of the focal less where only less still fits.
_FOCAL_STEPS = (0.02, 0.01, 0.005)
_SHIFT_STEPS = (0.02,)
_STILL_FITS = 1.15  # times what is unexplained at the best focal
# The same for another explanation of a flat surface. Where there is next to no relief, the right one of the two was seen to leave 1.2 times
# what the wrong one does, with the lens given; right poses of pairs with relief had no rival under 1.4.
_RIVAL_FITS = 1.25
_DIVISIONS = np.array([[1.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, -1.0]])  # (2, division): directions across the pictures
_NOISE_PX = 0.5  # at 768 px: systematic errors of keypoints that the scatter of their errors does not show


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewEvidence:
    """What speaks for a view's camera. NaN where it could not be asked.

    Attributes:
        agreeing: share of its matches, as verified before any camera was known, that lie on the epipolar lines of the model, before
            both cameras.
        rotation_gap_deg: median over the other views of the angle between the model's relative rotation and that of the pair alone.
        direction_sigma_deg: median over the other views of how far the direction to them may be off (one standard deviation).
        lens_sigma_deg: how far the directions to the others move if its focal, or its centre if it was cropped, is off by as much as
            pictures alone leave it uncertain; 0 where they are shared or known from elsewhere.
        rival_angle_deg: how far the directions to the others move if it stood where a flat surface would look the same; 0 where relief
            or a third view rules that out.
        halves_deg: of `halves_apart_deg`.
        spread_deg: how far the directions to the others move to cameras of another focal (of all views or of this one alone), or of another
            centre for a part cut out of a photo, that explain the photos about as well.
    """

    agreeing: float
    rotation_gap_deg: float
    direction_sigma_deg: float
    lens_sigma_deg: float
    rival_angle_deg: float
    halves_deg: float
    spread_deg: float

    def refusal(self, config: SfmConfig) -> str:
        """Why the camera cannot be believed; empty if it can."""
        if self.agreeing < config.min_agreeing:
            return f"only {self.agreeing:.0%} of its matches with other photos agree with any camera"
        if self.rotation_gap_deg > config.max_rotation_gap_deg:
            return f"its turns against other photos contradict each other by {self.rotation_gap_deg:.0f} degrees"
        if self.lens_sigma_deg > config.max_own_direction_deg:
            return (
                "it was zoomed or cropped, and the pictures tell too roughly how:"
                f" its direction may be off by {self.lens_sigma_deg:.0f} degrees"
            )
        return ""

    def doubt(self, config: SfmConfig) -> str:
        """Why the camera is only roughly right; empty if there is no such reason."""
        if self.agreeing < config.sure_agreeing:
            return f"only {self.agreeing:.0%} of its matches with other photos agree with its camera"
        if self.rotation_gap_deg > config.sure_rotation_gap_deg:
            return f"its turns against other photos, pair by pair, are {self.rotation_gap_deg:.0f} degrees off"
        if self.direction_sigma_deg > config.max_direction_deg:
            return (
                "the photos were taken from nearly one place: directions between cameras may be off by"
                f" {min(2 * self.direction_sigma_deg, 180):.0f} degrees"
            )
        if self.rival_angle_deg > config.max_spread_deg:
            return (
                "what it shares with other photos is flat, and looks the same from another place:"
                f" its direction may be off by {self.rival_angle_deg:.0f} degrees"
            )
        if self.halves_deg > config.max_halves_deg:
            return (
                "one half of what it shares with other photos tells another camera than the other half:"
                f" its direction may be off by {self.halves_deg:.0f} degrees"
            )
        if self.spread_deg > config.max_spread_deg:
            return (
                "other cameras explain the photos about as well:"
                f" its direction may be off by {self.spread_deg:.0f} degrees"
            )
        return ""


def weigh_evidence(
    mapping: Mapping, features: Sequence[Features], pairs: Sequence[PairMatches], hinted: Sequence[bool]
) -> dict[int, ViewEvidence]:
    """The evidence for each registered view.

    Args:
        mapping: finished model.
        features: of all views, straightened.
        pairs: as verified before any camera was known.
        hinted: per view whether its file says a focal.
    """
    views = np.flatnonzero(mapping.registered)
    sigma = _direction_sigma_deg(mapping)
    gaps = _rotation_gaps_deg(mapping, features, pairs)
    found: dict[int, ViewEvidence] = {}
    for view in views.tolist():
        row = sigma[view, views][np.isfinite(sigma[view, views])]
        turned = gaps[view, views][np.isfinite(gaps[view, views])]
        found[view] = ViewEvidence(
            agreeing=_agreeing_share(mapping, view, features, pairs),
            rotation_gap_deg=float(np.median(turned)) if len(turned) >= 2 else float("nan"),
            direction_sigma_deg=float(np.median(row)) if len(row) else float("nan"),
            lens_sigma_deg=_lens_sigma_deg(
                mapping, view, features, pairs, _own_parameters(mapping, view, hinted=hinted[view])
            ),
            rival_angle_deg=rival_angle_deg(mapping, view, features, pairs),
            halves_deg=float(mapping.halves_deg[view]),
            spread_deg=max(float(mapping.spread_deg[view]), _crop_spread_deg(mapping, view, features, pairs)),
        )
    return found


def halves_apart_deg(
    mapping: Mapping, tracks: Tracks, free: Bool[np.ndarray, " view"] | None = None
) -> Float[np.ndarray, " view"]:
    """Per view how far (degrees) the directions to the others differ between cameras of one half of the matches and of the other half.

    The pictures are divided in four directions (left and right, upper and lower, along both diagonals): wrong matches lie together, and
    so does what is flat. Their mean counts, since one half may be flat by chance; 0 where halves say too little.

    Args:
        mapping: finished model, where each half begins.
        tracks: of matches that were found before any camera was known. Those found in the epipolar bands of cameras agree with them.
        free: cameras that may move, as for `Mapping.finish`.
    """
    usable = (tracks.seen & mapping.registered).sum(1) >= 2
    seen = (tracks.seen & mapping.registered)[usable]
    apart, asked = np.zeros((2, len(mapping.registered)))
    if len(seen) < 2 * _MIN_MATCHES:
        return apart
    views = np.flatnonzero(seen.any(0))
    at = np.where(seen[:, views, None], tracks.pixel_xy[usable][:, views], np.nan)
    offset = np.nanmean(at - np.nanmedian(at, axis=0), axis=1)  # (track, 2) from the middle of what each view shares
    for along in (offset @ _DIVISIONS).T:
        first = along < np.median(along)
        halves = []
        for side in (first, ~first):
            half = mapping.over(Tracks(pixel_xy=tracks.pixel_xy[usable][side], seen=tracks.seen[usable][side]))
            half.finish(refine_focal=False, free=free)
            half.registered &= half.active.sum(0) >= _MIN_MATCHES
            halves.append(half)
        apart += directions_between_deg(halves[0], halves[1:])
        asked += halves[0].registered & halves[1].registered
    return apart / np.maximum(asked, 1)


def common_doubt(photos: int, *, sure: int, depth: bool, focal_is_guess: bool) -> str:
    """Why all cameras of a set are only roughly right; empty without a reason.

    Args:
        photos: number of photos with a camera.
        sure: as many of them have nothing of their own that speaks against theirs. A camera is only known against others: one that is
            sure says little among others that are rough.
        depth: whether any two of them differ by more than a homography.
        focal_is_guess: nothing tells the focal length, neither files nor lines nor enough parallax.
    """
    if not depth:
        return (
            "what the photos share is one picture zoomed, cropped or stretched, or one flat surface:"
            " there is no depth to tell cameras by"
        )
    if focal_is_guess:
        return "the focal length is a guess, and the directions between cameras depend on it"
    if sure < photos and (sure < 2 or 2 * sure < photos):
        return "the cameras of most photos that it is placed by are only roughly right"
    return ""


def other_views(
    mapping: Mapping, view: int, features: Sequence[Features], pairs: Sequence[PairMatches]
) -> list[OtherView]:
    """The other registered views with their verified matches with this one."""
    found = []
    for pair in pairs:
        if view not in (pair.view_a, pair.view_b) or pair.verified.count == 0:
            continue
        first = pair.view_a == view
        other = pair.view_b if first else pair.view_a
        mine, theirs = (pair.verified.index_a, pair.verified.index_b)[:: 1 if first else -1]
        if mapping.registered[other]:
            found.append(
                OtherView(
                    view=other,
                    rotation=mapping.rotations[other],
                    translation=mapping.translations[other],
                    intrinsics=mapping.intrinsics[other],
                    own_xy=features[other].pixel_xy[theirs],
                    view_xy=features[view].pixel_xy[mine],
                )
            )
    return found


def rival_angle_deg(mapping: Mapping, view: int, features: Sequence[Features], pairs: Sequence[PairMatches]) -> float:
    """How far (degrees) the direction to the only other view moves to a place from which a flat surface looks the same; 0 without one."""
    others = [other for other in other_views(mapping, view, features, pairs) if len(other.own_xy) >= _MIN_MATCHES]
    if len(others) != 1:  # from a third place a flat surface looks different
        return 0.0
    fit, best = _own_fit(mapping, view, others)
    return largest_rival_angle_deg(
        fit,
        best,
        others[0],
        mapping.intrinsics[view],
        threshold_px=mapping.config.epipolar_px * mapping.unit_px,
        still_fits=_RIVAL_FITS,
        seed=mapping.seed,
    )


def _agreeing_share(mapping: Mapping, view: int, features: Sequence[Features], pairs: Sequence[PairMatches]) -> float:
    others = other_views(mapping, view, features, pairs)
    if sum(len(other.own_xy) for other in others) < _MIN_MATCHES:
        return float("nan")
    fit = EpipolarFit(others, mapping.intrinsics[view], np.ones(2), noise_px=1.0)
    pose = mapping.rotations[view], mapping.translations[view], np.zeros(LENS_PARAMETERS)
    near = np.abs(fit.errors_px(*pose)) < _AGREE_PX * mapping.unit_px
    return float((near & ~fit.behind(*pose)).mean())


def _direction_sigma_deg(mapping: Mapping) -> Float[np.ndarray, "view view"]:
    return mapping.direction_sigma_deg(least_noise_px=_NOISE_PX)


def _rotation_gaps_deg(
    mapping: Mapping, features: Sequence[Features], pairs: Sequence[PairMatches]
) -> Float[np.ndarray, "view view"]:
    """Angle between the model's relative rotation of two views and that of their essential matrix; NaN where there is none."""
    config, views = mapping.config, len(mapping.registered)
    intrinsics = mapping.intrinsics
    gaps = np.full((views, views), np.nan)
    for pair in pairs:
        a, b = pair.view_a, pair.view_b
        if not (mapping.registered[a] and mapping.registered[b]) or pair.verified.count < 2 * _MIN_MATCHES:
            continue
        pose = relative_pose(
            features[a].pixel_xy[pair.verified.index_a],
            features[b].pixel_xy[pair.verified.index_b],
            intrinsics[a],
            intrinsics[b],
            threshold_px=config.epipolar_px * mapping.unit_px,
            seed=mapping.seed,
        )
        if pose is None or pose.inlier.sum() < _MIN_MATCHES:
            continue
        model = mapping.rotations[b] @ mapping.rotations[a].T
        cosine = (np.trace(pose.rotation @ model.T) - 1) / 2
        gaps[a, b] = gaps[b, a] = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return gaps


def _lens_sigma_deg(
    mapping: Mapping,
    view: int,
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    parameters: Sequence[int],
) -> float:
    """By how much the directions to the others (their median) move between two values of a lens parameter that both fit; the worst one."""
    if not parameters:
        return 0.0
    others = other_views(mapping, view, features, pairs)
    if sum(len(other.own_xy) for other in others) < _MIN_MATCHES:
        return 180.0
    fit, best = _own_fit(mapping, view, others)
    worst = 0.0
    for parameter in parameters:
        low, high = (_end_of(fit, best, parameter, sign) for sign in (-1.0, 1.0))
        worst = max(worst, float(np.median(direction_changes_deg(low, high, others))) / 2)
    return worst


def _crop_spread_deg(mapping: Mapping, view: int, features: Sequence[Features], pairs: Sequence[PairMatches]) -> float:
    """How far directions move if a view that has the others' focal in original pixels, but not their size, was cut out off the centre."""
    crop, lens = mapping.crops.get(view), int(mapping.lens_of[view])
    if crop is None or mapping.lenses.free[lens, SHIFT_X] or mapping.lenses.offset[lens] != crop.log_focal:
        return 0.0
    others = other_views(mapping, view, features, pairs)
    if sum(len(other.own_xy) for other in others) < _MIN_MATCHES:
        return 0.0
    fit, best = _own_fit(mapping, view, others)
    limits = {SHIFT_X: crop.limit_x, SHIFT_Y: crop.limit_y}
    worst = 0.0
    for corner in ((-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)):
        begun = best.lens.copy()
        begun[SHIFT_X : SHIFT_Y + 1] = np.multiply(corner, list(limits.values()))
        shift = {parameter: (-limit, limit, np.inf) for parameter, limit in limits.items()}
        other = fit.refine(best.rotation, best.translation, begun, freedom_of(shift, begun))
        if other.cost < _STILL_FITS * best.cost:
            worst = max(worst, float(np.median(direction_changes_deg(best, other, others))))
    return worst


def _own_fit(mapping: Mapping, view: int, others: Sequence[OtherView]) -> tuple[EpipolarFit, EpipolarView]:
    """The view's matches with the others, and the pose that fits them best with the lens it has."""
    fit = EpipolarFit(
        others,
        mapping.start_intrinsics[view],
        mapping.shift_unit_px[view],
        noise_px=_NOISE_PX * mapping.unit_px,
    )
    lens = mapping.lenses.resolved[mapping.lens_of[view]]
    return fit, fit.refine(mapping.rotations[view], mapping.translations[view], lens, held_lens())


def _end_of(fit: EpipolarFit, best: EpipolarView, parameter: int, sign: float) -> EpipolarView:
    """The view with one lens parameter as far off as still fits, of the sizes that are usual."""
    found = best
    for size in _FOCAL_STEPS if parameter == LOG_FOCAL else _SHIFT_STEPS:
        lens = best.lens.copy()
        lens[parameter] += sign * size
        found = fit.refine(best.rotation, best.translation, lens, held_lens())
        if found.cost < _STILL_FITS * best.cost:
            break
    return found


def _own_parameters(mapping: Mapping, view: int, *, hinted: bool) -> list[int]:
    """Lens parameters that nothing but this view's pictures tell."""
    own = [LOG_FOCAL] if _focal_is_own(mapping, view) and not hinted else []
    lens = mapping.lens_of[view]
    if mapping.lenses.free[lens, SHIFT_X] and int((mapping.lens_of == lens).sum()) == 1:
        own += [SHIFT_X, SHIFT_Y]
    return own


def _focal_is_own(mapping: Mapping, view: int) -> bool:
    """No other registered view shares the focal, which nothing but the pictures holds."""
    holder = mapping.lenses.focal_of[mapping.lens_of]
    alone = int((holder[mapping.registered] == holder[view]).sum()) == 1
    return alone and mapping.registered.sum() > 1 and bool(mapping.lenses.free[holder[view], LOG_FOCAL])
