"""Which views can share a focal length, and what is known of it before the pictures are asked.

A focal length belongs to a lens, in pixels of the *original* picture. Views share one only if they can: pictures of the same original
size (up to a turn of the camera), and of the same lens where their files say which. A photo cropped, zoomed or sent through a messenger
has another size and gets a focal of its own, which the pictures must find; so has every generated picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from sceneexpander.errors import UserError
from sceneexpander.frontend.sfm_setup import KnownCameras, Setup
from sceneexpander.frontend.sfm_types import FocalSource, SfmConfig
from sceneexpander.frontend.vanishing import vanishing_focal

_USUAL_FOCALS = 1.8  # standard deviations around the prior: focals that few views may choose among
_CROP_SLACK = 0.01  # of the long side: no lens has its principal point exactly in the middle
Affine = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewOptics:
    """How a view's picture lies on the original that it was made from, and what the file says of its lens.

    Attributes:
        original_size: (height, width) in pixels, upright.
        image_from_original: 2x3 map from pixels of the original to those of the given image (corner origin).
        lens: a text that is equal for photos of one camera, lens and zoom; empty if the file does not say.
        focal_px: focal length in original pixels as the file has it; None without.
        generated: the picture was generated and shares no lens with anything.
        doubt: why no pinhole camera may have taken it; empty without a reason.
    """

    original_size: tuple[int, int]
    image_from_original: Affine
    lens: str = ""
    focal_px: float | None = None
    generated: bool = False
    doubt: str = ""

    @classmethod
    def of_whole_image(cls, height: int, width: int) -> ViewOptics:
        """An image that is its own original."""
        return cls(original_size=(height, width), image_from_original=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))

    @property
    def long_side(self) -> int:
        """Longer side of the original."""
        return max(self.original_size)


@dataclass(frozen=True, slots=True, kw_only=True)
class FocalStart:
    """A focal to begin with: ``ratio`` over the original's long side of the main lens, and how tightly it is held."""

    ratio: float
    prior: float
    sigma: float  # of the logarithm
    penalty: float  # observations that must be explained beyond another start's for this one to win
    source: FocalSource | None  # where the prior came from; None: a guess


@dataclass(frozen=True, slots=True, kw_only=True)
class LensPlan:
    """Lenses of the views, focals to start from, and what holds them.

    Lenses are numbered by the first view that has them, so that there is room for every view to become its own.
    """

    lens_of: Int[np.ndarray, " view"]
    main: int  # the lens of most views
    centres_px: Float[np.ndarray, "view 2"]  # the original's centre, in feature pixels
    units_px: Float[np.ndarray, "view 2"]  # feature pixels per long side of the original, along x and y
    original_sizes: tuple[tuple[int, int], ...]  # (height, width)
    originals_px: Float[np.ndarray, " view"]  # long side of the original in its own pixels
    focal_hints: Float[np.ndarray, " lens"]  # over the long side, NaN without
    generated: np.ndarray  # per view
    doubts: tuple[str, ...]  # per view why no pinhole camera may have taken it; empty without a reason
    starts: tuple[FocalStart, ...]
    nominal: Float[np.ndarray, "view 3 3"]  # for decisions that any plausible focal serves
    known: Float[np.ndarray, "view 3 3"] | None  # given intrinsics
    refine: bool

    @property
    def source(self) -> FocalSource | None:
        """Set when the main lens's focal was given or hinted."""
        return self.starts[0].source

    def intrinsics(self, ratio: float) -> Float[np.ndarray, "view 3 3"]:
        """Of all views, if the main lens has that ratio: other lenses as their files say, or else as `guesses` begin."""
        if self.known is not None:
            return self.known.copy()
        made = np.tile(np.eye(3), (len(self.lens_of), 1, 1))
        for view in range(len(self.lens_of)):
            own = ratio if self.lens_of[view] == self.main else self.guesses(view, ratio)[0]
            made[view, [0, 1], [0, 1]] = own * self.units_px[view]
            made[view, :2, 2] = self.centres_px[view]
        return made

    def guesses(self, view: int, ratio: float) -> tuple[float, ...]:
        """Likely focals of a view of another lens, over its own long side, likeliest first.

        What its file says against the main lens's; the same field of view (a copy sent smaller); the same focal in original pixels
        (a crop). Generated pictures have the ratio of the photos, in the pixels that both are seen in.
        """
        lens, first = int(self.lens_of[view]), int(np.flatnonzero(self.lens_of == self.main)[0])
        same_pixels = ratio * float(self.units_px[first, 0] / self.units_px[view, 0])
        if self.generated[view]:
            return (same_pixels, ratio)
        originals = ratio * float(self.originals_px[first] / self.originals_px[view])
        tied: tuple[float, ...] = (ratio, originals)
        hint, main_hint = self.focal_hints[lens], self.focal_hints[self.main]
        if np.isfinite(hint):
            tied = (float(hint) * (ratio / float(main_hint) if np.isfinite(main_hint) else 1.0), *tied)
        return tied

    def crop_of_main(self, view: int) -> tuple[float, float] | None:
        """How far (x, y; in long sides of the view's original) the centre lies off if the view was cut out of a picture of the main lens.

        None if it cannot have been: larger than those, of the main lens itself, or generated.
        """
        if self.lens_of[view] == self.main or self.generated[view] or self.known is not None:
            return None
        whole = self.original_sizes[int(np.flatnonzero(self.lens_of == self.main)[0])]
        part = self.original_sizes[view]
        room = [
            np.subtract(turned, part) for turned in (whole, whole[::-1])
        ]  # held as most photos were, or else turned
        fits = [r for r in room if (r >= 0).all() and (r > 0).any()]
        if not fits:
            return None
        height, width = fits[0] / (2 * self.originals_px[view]) + _CROP_SLACK
        return float(width), float(height)

    @classmethod
    def make(
        cls,
        config: SfmConfig,
        setup: Setup,
        known: KnownCameras,
        optics: Sequence[ViewOptics],
        focal_hint_px: float | None,
    ) -> LensPlan:
        """Group the views and collect what is known: given intrinsics, else EXIF and the sweep.

        Raises:
            UserError: a hint that is no focal.
        """
        scale = 1.0 / setup.scale_xy  # feature pixels per pixel of the given images
        centres, units = np.zeros((len(optics), 2)), np.zeros((len(optics), 2))
        for view, own in enumerate(optics):
            affine = np.asarray(own.image_from_original)
            h, w = own.original_size
            centres[view] = scale * (affine[:, :2] @ np.array([w / 2, h / 2]) + affine[:, 2])
            units[view] = scale * np.array([affine[0, 0], affine[1, 1]]) * own.long_side
        lens_of = _lenses_of(optics) if known.intrinsics is None else np.zeros(len(optics), np.int64)
        main = _main_lens(lens_of, optics)
        hints = _hints(lens_of, optics)
        if focal_hint_px is not None:
            if not np.isfinite(focal_hint_px) or focal_hint_px <= 0:
                raise UserError(f"is {focal_hint_px}", where="focal hint", fix="give pixels > 0, or none")
            hints[:] = focal_hint_px * scale[0] / units[:, 0]
        return cls(
            lens_of=lens_of,
            main=main,
            centres_px=centres,
            units_px=units,
            original_sizes=tuple(own.original_size for own in optics),
            originals_px=np.array([own.long_side for own in optics], np.float64),
            focal_hints=hints,
            generated=np.array([own.generated for own in optics]),
            doubts=tuple(own.doubt for own in optics),
            starts=_starts(
                config,
                hints[main],
                _lines_focal(config, hints[main], known, lens_of, main, units, setup),
                known,
                units,
                setup,
            ),
            nominal=_nominal(config, hints, lens_of, centres, units) if known.intrinsics is None else known.intrinsics,
            known=known.intrinsics,
            refine=known.intrinsics is None or config.refine_known_intrinsics,
        )


def _lenses_of(optics: Sequence[ViewOptics]) -> Int[np.ndarray, " view"]:
    """Per view the first one whose lens it can share."""
    first: dict[object, int] = {}
    lens_of = np.zeros(len(optics), np.int64)
    for view, own in enumerate(optics):
        key: object = ("generated", view) if own.generated else (tuple(sorted(own.original_size)), own.lens)
        lens_of[view] = first.setdefault(key, view)
    return lens_of


def _main_lens(lens_of: np.ndarray, optics: Sequence[ViewOptics]) -> int:
    """The lens of most photos; the earliest among equals. A generated picture's only if there is no other."""
    photos = np.array([not own.generated for own in optics])
    counts = np.bincount(lens_of[photos] if photos.any() else lens_of, minlength=len(lens_of))
    return int(counts.argmax())


def _hints(lens_of: np.ndarray, optics: Sequence[ViewOptics]) -> np.ndarray:
    """Median over a lens's files of the focal over the long side."""
    hints = np.full(len(optics), np.nan)
    for lens in np.unique(lens_of):
        said = [
            own.focal_px / own.long_side
            for view, own in enumerate(optics)
            if lens_of[view] == lens and own.focal_px is not None
        ]
        if said:
            hints[lens] = float(np.median(said))
    return hints


def _lines_focal(
    config: SfmConfig,
    hint: float,
    known: KnownCameras,
    lens_of: np.ndarray,
    main: int,
    units: np.ndarray,
    setup: Setup,
) -> FocalStart | None:
    """The focal at which the straight lines of the main lens's pictures meet in three directions at right angles, if they say one.

    Where there are few views this is worth more than any guess; where there are many it is one more place to begin.
    """
    if known.intrinsics is not None or np.isfinite(hint) or not 1 < len(lens_of) <= config.choose_most_views:
        return None
    views = np.flatnonzero(lens_of == main)
    views = views[np.isclose(units[views, 0], units[views[0], 0])]
    found = vanishing_focal([setup.colours[view] for view in views.tolist()])
    if found is None or found.sigma > config.focal_lines_sigma:
        return None
    ratio = found.focal_ratio * setup.long_side / float(units[views[0], 0])
    if not config.focal_bounds[0] <= ratio <= config.focal_bounds[1]:
        return None
    return FocalStart(ratio=ratio, prior=ratio, sigma=found.sigma, penalty=0.0, source=FocalSource.LINES)


def _starts(
    config: SfmConfig, hint: float, lines: FocalStart | None, known: KnownCameras, units: np.ndarray, setup: Setup
) -> tuple[FocalStart, ...]:
    if known.intrinsics is not None:
        ratio = float(known.intrinsics[0, 0, 0]) / setup.long_side
        return (
            FocalStart(ratio=ratio, prior=ratio, sigma=config.focal_hint_sigma, penalty=0.0, source=FocalSource.KNOWN),
        )
    unsaid = not np.isfinite(hint)
    usual = _USUAL_FOCALS * config.focal_prior_sigma  # two views fit unlikely focals as well as the right one
    guesses = tuple(
        FocalStart(
            ratio=ratio,
            prior=config.focal_prior,
            sigma=config.focal_prior_sigma,
            penalty=0.0 if unsaid else config.focal_hint_penalty,
            source=None,
        )
        for ratio in config.focal_starts
        if len(units) >= config.min_views_for_focal or abs(np.log(ratio / config.focal_prior)) < usual
    )
    if lines is not None and len(units) >= config.min_views_for_focal:
        # The pictures decide; lines bent by the lens or a crop would mislead as a prior.
        return (*guesses, replace(lines, prior=config.focal_prior, sigma=config.focal_prior_sigma, source=None))
    if lines is not None:
        return (lines,)
    if unsaid:
        return guesses
    said = FocalStart(
        ratio=float(hint),
        prior=float(hint),
        sigma=config.focal_hint_sigma,
        penalty=0.0,
        source=FocalSource.HINT,
    )
    # Another start within a few sigma of what the file says is the same start with a weaker prior.
    far = tuple(g for g in guesses if abs(np.log(g.ratio / hint)) > 3 * config.focal_hint_sigma)
    return (said, *far)


def _nominal(
    config: SfmConfig, hints: np.ndarray, lens_of: np.ndarray, centres: np.ndarray, units: np.ndarray
) -> np.ndarray:
    made = np.tile(np.eye(3), (len(lens_of), 1, 1))
    for view, lens in enumerate(lens_of):
        ratio = config.focal_prior if np.isnan(hints[lens]) else hints[lens]
        made[view, [0, 1], [0, 1]] = ratio * units[view]
        made[view, :2, 2] = centres[view]
    return made
