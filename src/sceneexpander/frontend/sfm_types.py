"""Settings and results of the sparse front-end (`sceneexpander.frontend.sfm`)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.frontend.distortion import Distortion
from sceneexpander.frontend.sparse_points import SparsePoints
from sceneexpander.ranges import Range, Share, Weight, check_ranges

REFERENCE_LONG_SIDE_PX = 768  # every `_px` threshold below is for images of this long side, and scales with it


_Focal = Annotated[float, Range(0.05, 50)]  # over the long side


class LearnedUse(StrEnum):
    """When learned keypoints and matches (`sceneexpander.frontend.learned`) join SIFT's."""

    NEVER = "never"
    RESCUE = "rescue"  # only if SIFT leaves a view out of the model, and kept only if that brings one in
    ALWAYS = "always"
    CHOOSE = "choose"  # models with and without, and whoever asks for cameras judges them; else like RESCUE


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmConfig:
    """Constants of the sparse front-end. Thresholds in pixels hold at a long side of 768 px and scale with the images.

    Raises:
        ValueError: a bound that is empty or a count that cannot work.
    """

    # Features and matches.
    max_features: Annotated[int, Range(1, 1_000_000)] = 4000  # strongest kept per view
    contrast_threshold: Annotated[float, Range(0, 100)] = (
        0.01  # SIFT's default of 0.04 leaves plain rooms with a few hundred features
    )
    upsample_below_px: Annotated[int, Range(0, 100_000)] = (
        700  # images with a shorter long side are enlarged 2x before detection
    )
    equalise: bool = True  # local contrast equalisation (CLAHE) before detection
    match_ratio: Annotated[float, Range(0, 1, low_open=True)] = (
        0.87  # nearest / second nearest distance, both directions, of mutual neighbours
    )
    loose_match_ratio: Annotated[float, Range(0, 1, low_open=True)] = 0.95  # the same for last-chance registration
    guided: bool = True  # once cameras are known, match all pairs again inside their epipolar bands
    guided_band_px: Annotated[float, Range(0, 1000, low_open=True)] = 2.0
    guided_ratio: Annotated[float, Range(0, 1, low_open=True)] = 0.85
    guided_max_distance: Annotated[float, Range(0, 2, low_open=True)] = 0.7  # of unit descriptors

    learned: LearnedUse = LearnedUse.CHOOSE
    choose_most_views: Annotated[int, Range(0, 1_000)] = (
        8  # more views than this are not chosen among: three models of them are dear to make and judge
    )
    learned_features: Annotated[int, Range(1, 100_000)] = 2048  # per view
    learned_long_side_px: Annotated[int, Range(64, 8_192)] = 1024
    learned_min_expected: Weight = 20.0  # matches that must be expected to be right, or two views share nothing
    learned_candidates: Annotated[int, Range(1, 1_000)] = (
        8  # of each view that SIFT has left out: the others it is matched with, by their descriptors
    )
    learned_neighbours: Annotated[int, Range(0, 1_000)] = (
        4  # of each view that SIFT has connected: the others it is matched with
    )
    min_patch_agreement: Share = (
        0.35  # mean correlation of patches at a pair's learned matches: they find structure in noise, too
    )

    # Verification of pairs.
    epipolar_px: Annotated[float, Range(0, 1000, low_open=True)] = (
        1.5  # MAGSAC noise scale for fundamental, essential and homography models
    )
    min_pair_inliers: Annotated[int, Range(8, 1_000_000)] = 15
    min_pair_inlier_share: Share = 0.12
    rotation_share: Share = 0.8  # rotation-only: a pure rotation explains this share of the verified matches
    rotation_share_free_focal: Share = 0.9  # the same at the focal that suits the pair best
    rotation_px: Annotated[float, Range(0, 1000, low_open=True)] = 2.5
    flat_share: Share = 0.9  # without depth: a homography explains this share of the verified matches, at `epipolar_px`

    # Focal length, in units of the original's long side.
    focal_starts: tuple[_Focal, ...] = (0.35, 0.48, 0.62, 0.78, 0.98, 1.25, 1.7, 2.5)
    focal_bounds: tuple[_Focal, _Focal] = (0.3, 4.0)  # ultra-wide and tele lenses of phones are .36 and 3.3
    focal_prior: _Focal = 0.85  # phones .7-.75, 35-50 mm lenses 1-1.4, wide lenses .5-.6
    focal_prior_sigma: Annotated[float, Range(0, 10, low_open=True)] = 0.25  # of the logarithm
    focal_hint_sigma: Annotated[float, Range(0, 10, low_open=True)] = 0.03  # of the logarithm, around a focal from EXIF
    focal_lines_sigma: Annotated[float, Range(0, 10)] = (
        0.12  # of the logarithm: focals of vanishing lines less certain are not used
    )
    focal_hint_penalty: Weight = 60.0  # observations that another focal must explain beyond those that EXIF's does
    generated_focal_sigma: Annotated[float, Range(0, 10, low_open=True)] = (
        0.1  # of the logarithm: a generated picture's focal around that of the photos
    )
    min_views_for_focal: Annotated[int, Range(2, 1_000)] = (
        4  # with fewer views the focal is chosen among the starts and then fixed
    )
    max_focal_sigma: Annotated[float, Range(0, 10)] = (
        0.15  # of the logarithm: a focal less certain than this is fixed at its prior
    )
    focal_doubt_share: Share = 0.7  # a view whose lens explains less of the points that it sees is tried with others
    split_cost: Share = 0.7  # a lens of its own must leave at most this share of what the shared one leaves unexplained
    focal_step: Annotated[float, Range(1, 10, low_open=True)] = 1.2  # between the focals tried for one view
    split_focal_sigma: Annotated[float, Range(0, 10, low_open=True)] = (
        0.5  # of the logarithm, around the lens that a view was split from
    )
    crop_cost: Share = 0.85  # the same for a part cut out of a picture of the shared lens: fewer numbers are free
    lens_rounds: Annotated[int, Range(0, 100)] = 3  # times that lenses are tested and the model is finished again
    split_penalty: Weight = 20.0  # observations that a split must bring

    distortion_rounds: Annotated[int, Range(0, 100)] = (
        2  # times that radial distortion is looked for and keypoints are straightened; 0: never
    )

    # Reconstruction.
    initial_pairs: Annotated[int, Range(1, 1_000)] = 2  # tried per focal start
    sweep_tracks: Annotated[int, Range(10, 1_000_000)] = (
        700  # longest tracks used while choosing focal and initial pair; all of them afterwards
    )
    max_initial_angle_deg: Annotated[float, Range(0, 180, low_open=True)] = (
        16.0  # wider angles earn an initial pair nothing more
    )
    min_angle_deg: Annotated[float, Range(0, 90)] = 0.5  # of the widest pair of rays, for a point to be kept
    register_px: Annotated[float, Range(0, 1000, low_open=True)] = 6.0
    min_register_inliers: Annotated[int, Range(6, 1_000_000)] = 15
    min_register_share: Share = 0.25
    inlier_px: Annotated[float, Range(0, 1000, low_open=True)] = (
        3.0  # reprojection error of an observation that is kept in the end
    )
    triangulate_px: Annotated[float, Range(0, 1000, low_open=True)] = 5.0  # the same while the model grows
    robust_px: Annotated[float, Range(0, 1000, low_open=True)] = (
        1.0  # Cauchy scale in bundle adjustment, at most; in the end it follows the errors
    )
    min_robust_px: Annotated[float, Range(0, 1000, low_open=True)] = 0.3
    min_inlier_px: Annotated[float, Range(0, 1000, low_open=True)] = (
        1.2  # the final threshold follows the errors, too, between this and `inlier_px`
    )
    loose_px: Annotated[float, Range(0, 1000, low_open=True)] = (
        8.0  # last-chance registration (views that match only roughly, such as generated ones)
    )
    min_loose_inliers: Annotated[int, Range(6, 1_000_000)] = 10
    bundle_iterations: Annotated[int, Range(1, 10_000)] = 40

    # Evidence that a camera must have.
    min_agreeing: Share = 0.5  # share of a view's verified matches that agree with the model, or it is left out
    sure_agreeing: Share = 0.7  # the same for a camera that is not called rough
    # Between the model's relative rotations and those of single pairs, whose planes and few matches make them rough: median over pairs.
    max_rotation_gap_deg: Annotated[float, Range(0, 180)] = 20.0
    sure_rotation_gap_deg: Annotated[float, Range(0, 180)] = 9.0  # the same for a camera that is not called rough
    # Predicted error of directions (standard deviation, median over the other views): beyond it a camera is rough.
    max_direction_deg: Annotated[float, Range(0, 180)] = 6.0
    # How far directions move to other cameras that explain the photos about as well (another focal, another slope of a flat surface).
    max_spread_deg: Annotated[float, Range(0, 180)] = 4.0
    # How far directions differ between two halves of the matches: twice the error of the whole, if nothing but chance sets them apart.
    max_halves_deg: Annotated[float, Range(0, 180)] = 2.0
    # A view of its own focal is left out if that leaves the directions to others more open than this.
    max_own_direction_deg: Annotated[float, Range(0, 180)] = 2.0
    refine_known_poses: bool = False  # True: given poses are a start, not the truth
    refine_known_intrinsics: bool = False  # True: a shared factor on the given focals is refined

    def __post_init__(self) -> None:
        check_ranges(self)
        low, high = self.focal_bounds
        if not 0 < low < high:
            raise ValueError(f"focal_bounds must satisfy 0 < low < high, is {self.focal_bounds}")
        if not self.focal_starts or any(not low <= start <= high for start in self.focal_starts):
            raise ValueError(f"focal_starts {self.focal_starts} must lie inside focal_bounds {self.focal_bounds}")
        if not 0 < self.match_ratio <= self.loose_match_ratio <= 1:
            raise ValueError(f"0 < match_ratio {self.match_ratio} <= loose_match_ratio {self.loose_match_ratio} <= 1")


class PairKind(StrEnum):
    """What the verified matches of two views say about the motion between them."""

    UNRELATED = "unrelated"  # too few matches agree on any geometry
    PARALLAX = "parallax"  # an essential matrix explains clearly more than a rotation does
    FLAT = "flat"  # a homography explains nearly all matches: one picture zoomed, cropped or stretched, or one flat surface
    ROTATION = "rotation"  # a pure rotation explains nearly all matches: no depth from this pair


class FocalSource(StrEnum):
    """Where the focal length came from."""

    KNOWN = "known"  # given intrinsics, kept
    REFINED = "refined"  # bundle adjustment
    HINT = "hint"  # given focal, kept
    LINES = "lines"  # vanishing lines of architecture, kept
    SWEPT = "swept"  # the best of the starts, kept because there are too few views to refine it
    TURNED = "turned"  # the one that makes a camera without parallax turn as a rigid body does
    ASSUMED = "assumed"  # nothing, or too little, to estimate it from: the prior


@dataclass(frozen=True, slots=True, kw_only=True)
class PairReport:
    """Matches of one pair of views."""

    view_a: int
    view_b: int
    matches: int
    inliers: int
    kind: PairKind


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewReport:
    """How one view was posed, or why it was not."""

    view: int
    name: str
    registered: bool
    loose: bool  # registered at the last-chance threshold: trust its pose less
    reason: str  # empty when registered in the ordinary way
    features: int
    inliers: int  # observations of triangulated points
    mean_error_px: float  # mean reprojection error of those, in pixels of the given images; NaN without any
    placed_like: int | None  # the view whose pose an unregistered view borrows
    focal_ratio: float  # focal over the long side of the original
    focal_source: FocalSource
    distortion: tuple[float, float]  # k1, k2 that were taken out
    centre_shift: tuple[float, float]  # of the principal point from the original's centre, over its long side
    warnings: tuple[str, ...]  # what a person should know of a view that is used
    agreeing: float  # see `evidence.ViewEvidence`; NaN where it could not be asked
    rotation_gap_deg: float
    direction_sigma_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmReport:
    """What the sparse front-end found, for people and for logs."""

    views: tuple[ViewReport, ...]
    pairs: tuple[PairReport, ...]
    focal_px: float  # of view 0, in pixels of the given images
    focal_ratio: float  # the same over the long side
    focal_source: FocalSource
    focal_sigma: float  # standard deviation of the logarithm by bundle adjustment; NaN if not estimated
    points: int
    median_angle_deg: float  # median triangulation angle; NaN without points
    mean_error_px: float  # NaN without points
    scale: float  # world units here = given units x scale, for known poses
    notes: tuple[str, ...]

    @property
    def registered(self) -> int:
        """Number of views with an estimated (or given) pose."""
        return sum(view.registered for view in self.views)


@dataclass(frozen=True, slots=True, kw_only=True)
class SparseReconstruction:
    """Cameras and triangulated points of S views.

    World frame: camera frame of view 0. Scale: the median depth of the points seen by view 0 is 1 (over all views if view 0
    sees none; untouched if there are no points). Poses of views with ``posed`` False are placeholders.
    Intrinsics and points' pixels are those of pinhole cameras: of the given pictures after ``distortion.straightened``.
    """

    world_from_cam: Float[Tensor, "view 4 4"]
    intrinsics_px: Float[Tensor, "view 3 3"]
    posed: Bool[Tensor, "view"]
    sparse: SparsePoints
    distortion: Distortion | None  # in the given pixels; None if the pictures show none
    report: SfmReport
