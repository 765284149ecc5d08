"""Whether the camera of a whole set of photos only turned, whatever wrong matches say.

Repeated structure gives wrong matches that agree on an epipolar geometry, and two pictures from one place then seem to have parallax.
But what is matched rightly still moves as it does before a turning camera: by H = K_b R K_a^-1, at one focal for all pairs (Hartley,
"Self-calibration of stationary cameras", 1997). Of the eight numbers of a free homography that leaves three per pair and one for the set.
Where they explain as much, the others have nothing to say: the simpler of two models, as Torr chooses ("Geometric motion segmentation and
model selection", 1998), here by what they explain. One thing looks the same: a far background that nearly all matches lie on. What stands
before it is then matched, too, and agrees on the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from sceneexpander.frontend.features import Features
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.twoview import (
    PairMatches,
    distinct_positions,
    fit_homography,
    homography_errors_px,
    refine_rotation,
    rotation_errors_px,
    scaled_focal,
    unit_rays,
)

# Of what one homography per pair explains. From one place a turn explains .994 of it and more; from places some centimetres apart, in a
# room, .97 and less, from ordinary ones at most .6.
_AS_MUCH = 0.985
_MOST = 0.6  # of all verified matches: a turn that explains fewer is one of several things that may be
# Of the matches that the turn does not explain so many agree on an epipolar geometry where there is depth. Before a turning camera all of
# them are wrong, and .15 to .45 agree.
_LEFT_AGREE = 0.55
_MOST_MATCHES = 250  # of a pair, while the focal is looked for
_FOCAL_STEPS = (0.06, 0.015, 0.004)  # of its logarithm


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """A camera that only turned.

    Attributes:
        factor: on the assumed focals, that makes it so.
        pairs: by their place among all: those that were asked, without the matches that the turn leaves.
    """

    factor: float
    pairs: dict[int, PairMatches]


def find_turn(
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    intrinsics: Float[np.ndarray, "view 3 3"],
    bounds: tuple[float, float],
    config: SfmConfig,
    *,
    unit_px: float,
    seed: int,
) -> Turn | None:
    """The turn of a camera that did nothing else, by all pairs whose descriptors say enough; None if they say more than that.

    Args:
        features: of all views.
        pairs: as verified. Learned matches are not asked: their noise looks like parallax.
        intrinsics: of all views, but for the factor.
        bounds: of the factor; equal ones if the focal is known.
        config: thresholds.
        unit_px: pixels per pixel at the reference size.
        seed: of the robust fits.
    """
    threshold, far = config.epipolar_px * unit_px, config.rotation_px * unit_px
    asked: dict[int, _Pair] = {}
    for place, pair in enumerate(pairs):
        found = _Pair.make(features, pair, intrinsics, config, threshold_px=threshold, seed=seed)
        if found is not None:
            asked[place] = found
    verified = sum(own.verified.count for own in asked.values())
    by_homography = sum(int(own.explained.sum()) for own in asked.values())
    if not asked or by_homography < _MOST * verified:
        return None
    factor = _find_factor(list(asked.values()), bounds, threshold)
    fits = {place: own.fit(factor, threshold) for place, own in asked.items()}
    by_turn = sum(count for _, count in fits.values())
    if by_turn < max(_AS_MUCH * by_homography, _MOST * verified):
        return None
    agree = open_to_all = 0
    narrowed: dict[int, PairMatches] = {}
    for place, own in asked.items():
        rotation = fits[place][0]
        agree += int((own.errors_px(own.verified, factor, rotation) >= far).sum())
        open_to_all += int((own.errors_px(own.tentative, factor, rotation) >= far).sum())
        every = pairs[place].verified
        kept = every.select(own.errors_px(every, factor, rotation) < far)
        narrowed[place] = replace(pairs[place], verified=kept)
    return None if agree >= _LEFT_AGREE * max(open_to_all, 1) else Turn(factor=factor, pairs=narrowed)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """Two views, their matches of descriptors (verified, and those that were to be verified), and which a homography explains."""

    a: Features
    b: Features
    intrinsics_a: Float[np.ndarray, "3 3"]
    intrinsics_b: Float[np.ndarray, "3 3"]
    verified: Matches
    tentative: Matches
    explained: Bool[np.ndarray, " match"]

    @classmethod
    def make(
        cls,
        features: Sequence[Features],
        pair: PairMatches,
        intrinsics: Float[np.ndarray, "view 3 3"],
        config: SfmConfig,
        *,
        threshold_px: float,
        seed: int,
    ) -> _Pair | None:
        """The pair as it is asked; None if its descriptors say too little, or of no turn: words over all photos stay where they are."""
        a, b = features[pair.view_a], features[pair.view_b]
        verified = pair.verified.select(pair.verified.index_a < a.described)
        if verified.count < config.min_pair_inliers:
            return None
        xy_a, xy_b = a.pixel_xy[verified.index_a], b.pixel_xy[verified.index_b]
        if np.median(np.linalg.norm(xy_a - xy_b, axis=1)) < threshold_px:
            return None
        homography = fit_homography(xy_a, xy_b, threshold_px=threshold_px, seed=seed)
        if homography is None:
            return None
        strict = pair.loose.select((pair.loose.ratio <= config.match_ratio) & (pair.loose.index_a < a.described))
        return cls(
            a=a,
            b=b,
            intrinsics_a=intrinsics[pair.view_a],
            intrinsics_b=intrinsics[pair.view_b],
            verified=verified,
            tentative=strict.select(distinct_positions(a.pixel_xy[strict.index_a], b.pixel_xy[strict.index_b])),
            explained=homography_errors_px(homography, xy_a, xy_b) < threshold_px,
        )

    def fit(
        self, factor: float, threshold_px: float, *, step: int = 1, rounds: int = 3
    ) -> tuple[Float[np.ndarray, "3 3"], int]:
        """(rotation, how many verified matches it explains) at a factor on the focals; of every ``step``-th match."""
        xy_b, camera_b = self.b.pixel_xy[self.verified.index_b[::step]], scaled_focal(self.intrinsics_b, factor)
        rotation, agree = refine_rotation(
            unit_rays(self.a.pixel_xy[self.verified.index_a[::step]], scaled_focal(self.intrinsics_a, factor)),
            unit_rays(xy_b, camera_b),
            xy_b,
            camera_b,
            self.explained[::step],
            threshold_px=threshold_px,
            rounds=rounds,
        )
        return rotation, int(agree.sum())

    def errors_px(
        self, matches: Matches, factor: float, rotation: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, " match"]:
        """How far matches are from where a rotation takes them."""
        unit_a = unit_rays(self.a.pixel_xy[matches.index_a], scaled_focal(self.intrinsics_a, factor))
        camera_b = scaled_focal(self.intrinsics_b, factor)
        return rotation_errors_px(unit_a, self.b.pixel_xy[matches.index_b], camera_b, rotation)


def _find_factor(pairs: Sequence[_Pair], bounds: tuple[float, float], threshold_px: float) -> float:
    """The factor on the focals at which rotations explain most."""
    steps = [max(1, pair.verified.count // _MOST_MATCHES) for pair in pairs]

    def explained(log_factor: float) -> int:
        fits = (
            pair.fit(float(np.exp(log_factor)), threshold_px, step=step, rounds=1)
            for pair, step in zip(pairs, steps, strict=True)
        )
        return sum(count for _, count in fits)

    low, high = np.log(bounds)
    coarse, *finer = _FOCAL_STEPS
    best = max(np.linspace(low, high, 1 + int(np.ceil((high - low) / coarse))), key=explained)
    for wide, step in zip(_FOCAL_STEPS, finer, strict=False):
        near = np.clip(best + np.arange(-wide, wide + step / 2, step), low, high)
        best = max(near, key=explained)
    return float(np.exp(best))
