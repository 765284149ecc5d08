"""Everything that is measured of a reconstruction: its one name, its title and unit, which way is better, and what it is measured on.

MLflow groups charts by what stands before the slash and sorts groups and charts by name, so the groups begin with a digit and names with
what is measured: what a person looks at first comes first.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Literal

from sceneexpander.errors import UserError, did_you_mean

Better = Literal["higher", "lower", ""]
ARROWS: dict[Better, str] = {"higher": "\u2191", "lower": "\u2193", "": ""}
DASH = "\u2013"  # stands where there is no number
_NAME = re.compile(r"[a-z][a-z0-9_]*")


class Group(StrEnum):
    """Groups of metrics in the order of their importance; the value is what stands before the slash in MLflow."""

    QUALITY = "1_quality"
    INSERTION = "2_insertion"
    GEOMETRY = "3_geometry"
    LOSS = "4_loss"
    LOOK = "5_look"
    DRIFT = "6_drift"
    COST = "7_cost"
    COUNT = "8_count"
    SPREAD = "9_spread"


GROUP_MEANINGS = {
    Group.QUALITY: "what became of the photos: captured views rendered at their own cameras, against the photos",
    Group.INSERTION: "how well the scene shows the inserted view",
    Group.GEOMETRY: "cameras and depth, against known truth where the scene has it",
    Group.LOSS: "curves of the adaptation, one point per step",
    Group.LOOK: "what the adaptation saw of the whole scene every few steps",
    Group.DRIFT: "how far the weights moved, by module",
    Group.COST: "time and memory",
    Group.COUNT: "how many views and Gaussians",
    Group.SPREAD: "standard deviation over runs with other seeds",
}


class Views(StrEnum):
    """Which views a metric looks at."""

    CAPTURED = "captured"  # the mean over those that have a camera
    INSERTED = "inserted"  # the one of the row's round
    EARLIER = "earlier"  # captured and inserted ones that are older than the row's round
    HELD_OUT = "held_out"  # that no method was given
    TOUR = "tour"  # the frames of the camera path
    NONE = "none"  # the reconstruction or the run as a whole


class Size(StrEnum):
    """At which size its pictures are drawn."""

    STORED = "stored"  # the one that methods are given
    OWN = "own"  # the photo's or picture's own
    HALF = "half"
    DOUBLE = "double"
    QUADRUPLE = "quadruple"


class Region(StrEnum):
    """Which pixels count."""

    ALL = "all"
    OTHERS = "others"  # what Gaussians of other views cover
    NEW = "new"  # what no captured view sees
    SEEN = "seen"  # what a captured view sees
    GAINED = "gained"  # what the insertion added to what was covered before it


@dataclass(frozen=True, slots=True, kw_only=True)
class Scope:
    """What a metric is measured on."""

    views: Views
    size: Size = Size.STORED
    region: Region = Region.ALL

    @property
    def of_insertion(self) -> bool:
        """Without meaning for the scene before the insertion."""
        return self.views is Views.INSERTED or self.region is Region.GAINED


class Shown(IntEnum):
    """Where a metric is shown: each place has those of the places after it as well."""

    TRACKED = 0  # files and MLflow
    TABLE = 1  # the comparison tables
    PAGE = 2  # the report and the saved views of MLflow


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """One number.

    Attributes:
        name: in files, tables of numbers, the benchmark, and in MLflow behind the group; lower-case words and underscores.
        group: what it belongs to.
        title: its heading, without the unit.
        scope: which views, at which size, over which pixels.
        meaning: a sentence for people; needed where the page shows it.
        unit: of the printed number; ``%`` is stored and tracked as a share.
        digits: printed behind the point.
        better: which way.
        shown: the most prominent place that has it.
    """

    name: str
    group: Group
    title: str
    scope: Scope
    meaning: str = ""
    unit: str = ""
    digits: int = 2
    better: Better = ""
    shown: Shown = Shown.TRACKED

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"{self.name!r} is no name of a metric: lower-case letters, digits and '_'")
        if self.shown is Shown.PAGE and not self.meaning:
            raise ValueError(f"{self.name!r} is shown on the page and needs a sentence that says what it means")

    @property
    def tracked(self) -> str:
        """The whole name in MLflow."""
        return f"{self.group}/{self.name}"

    @property
    def heading(self) -> str:
        """Title and unit, where percent signs stand beside the numbers."""
        return f"{self.title}, {self.unit}" if self.unit not in ("", "%") else self.title

    @property
    def column(self) -> str:
        """Title, unit and arrow: the head of a column whose cells are bare numbers."""
        named = f"{self.title}, {self.unit}" if self.unit else self.title
        return f"{named} {ARROWS[self.better]}".rstrip()

    @property
    def factor(self) -> int:
        """What a stored number is multiplied by for its printed unit."""
        return 100 if self.unit == "%" else 1

    def bare(self, value: float, *, sign: bool = False) -> str:
        """A value as it is printed below `column`."""
        return f"{self.factor * value:{'+' if sign else ''}.{self.digits}f}"

    def text(self, value: float | None) -> str:
        """A value as it is printed, percent signs included, other units not; a dash if there is none."""
        if value is None:
            return DASH
        return f"{self.bare(value)} %" if self.unit == "%" else self.bare(value)

    def text_with_unit(self, value: float | None) -> str:
        """The same with every unit, for where no heading says it."""
        return self.text(value) + (f" {self.unit}" if self.unit not in ("", "%") and value is not None else "")


def _at_size(
    scope: Scope, group: Group, where: str, title: str, meanings: tuple[str, str, str, str], shown: str = ""
) -> tuple[Metric, ...]:
    """PSNR, SSIM, the open share and, at the pictures' own size, ST-LPIPS; their names go into ``title``.

    Those with a meaning are on the page; ``shown`` is the one that is in the tables only.
    """

    def metric(kind: str, name: str, label: str, meaning: str, digits: int, unit: str, better: Better) -> Metric:
        place = Shown.PAGE if meaning else Shown.TABLE if kind == shown else Shown.TRACKED
        return Metric(
            name=name,
            group=group,
            title=title.format(label),
            scope=scope,
            meaning=meaning,
            unit=unit,
            digits=digits,
            better=better,
            shown=place,
        )

    psnr, ssim, st_lpips, opened = meanings
    perceptual = metric("st_lpips", f"st_lpips_{where}", "ST-LPIPS", st_lpips, 4, "", "lower")
    return (
        metric("psnr", f"psnr_{where}_db", "PSNR", psnr, 2, "dB", "higher"),
        metric("ssim", f"ssim_{where}", "SSIM", ssim, 3, "", "higher"),
        *((perceptual,) if scope.size is Size.OWN else ()),
        metric("open", f"seen_through_{where}", "Open", opened, 1, "%", "lower"),
    )


_CAPTURED = Scope(views=Views.CAPTURED)
_INSERTED = Scope(views=Views.INSERTED)
_EARLIER = Scope(views=Views.EARLIER)
_HELD_OUT = Scope(views=Views.HELD_OUT)
_NEW_HELD_OUT = Scope(views=Views.HELD_OUT, region=Region.NEW)
_WHOLE = Scope(views=Views.NONE)
_TOUR = Scope(views=Views.TOUR)

QUALITY = (
    *_at_size(
        Scope(views=Views.CAPTURED, size=Size.OWN),
        Group.QUALITY,
        "at_photo_size",
        "{}",
        (
            "Preservation: captured views rendered at the method's own cameras, against the photos in the photos' own pixels; "
            "mean over views.",
            "The same, structural similarity.",
            "The same, shift-tolerant perceptual distance.",
            "Share of what the photos show that one looks through there (alpha below 0.9).",
        ),
    ),
    Metric(
        name="psnr_captured_db",
        group=Group.QUALITY,
        title="PSNR, stored size",
        scope=_CAPTURED,
        unit="dB",
        better="higher",
        meaning="The same at the size that the methods were given.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="ssim_captured",
        group=Group.QUALITY,
        title="SSIM, stored size",
        scope=_CAPTURED,
        digits=3,
        better="higher",
        shown=Shown.TABLE,
    ),
    Metric(
        name="st_lpips_captured",
        group=Group.QUALITY,
        title="ST-LPIPS, stored size",
        scope=_CAPTURED,
        digits=4,
        better="lower",
        shown=Shown.TABLE,
    ),
    *_at_size(
        Scope(views=Views.CAPTURED, size=Size.HALF),
        Group.QUALITY,
        "captured_half_size",
        "{}, half the stored size",
        ("The same from farther away.", "", "", ""),
    ),
    *_at_size(
        Scope(views=Views.CAPTURED, size=Size.DOUBLE),
        Group.QUALITY,
        "captured_double_size",
        "{}, twice the stored size",
        ("", "", "", ""),
        shown="psnr",
    ),
    *_at_size(
        Scope(views=Views.CAPTURED, size=Size.QUADRUPLE),
        Group.QUALITY,
        "captured_quadruple_size",
        "{}, four times the stored size",
        ("", "", "", "The share that one looks through when the pictures are drawn at four times the stored size."),
    ),
    Metric(
        name="psnr_held_out_db",
        group=Group.QUALITY,
        title="PSNR of held-out photos",
        scope=_HELD_OUT,
        unit="dB",
        better="higher",
        meaning="Photos that nothing was made from, each at the camera found for it afterwards; all other PSNRs of photos are of "
        "pictures that the method was given.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="ssim_held_out",
        group=Group.QUALITY,
        title="SSIM of held-out photos",
        scope=_HELD_OUT,
        digits=3,
        better="higher",
        shown=Shown.TABLE,
    ),
    Metric(
        name="st_lpips_held_out",
        group=Group.QUALITY,
        title="ST-LPIPS of held-out photos",
        scope=_HELD_OUT,
        digits=4,
        better="lower",
        shown=Shown.TABLE,
    ),
    Metric(
        name="psnr_held_out_covered_db",
        group=Group.QUALITY,
        title="PSNR of held-out photos where covered",
        scope=_HELD_OUT,
        unit="dB",
        better="higher",
    ),
    Metric(
        name="held_out_covered",
        group=Group.QUALITY,
        title="Held-out photos covered",
        scope=_HELD_OUT,
        unit="%",
        digits=1,
        better="higher",
    ),
    Metric(
        name="psnr_from_others_db",
        group=Group.QUALITY,
        title="PSNR from others",
        scope=Scope(views=Views.CAPTURED, region=Region.OTHERS),
        unit="dB",
        better="higher",
        meaning="Captured views painted only by what other views contributed: low where surfaces are doubled.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="covered_by_others",
        group=Group.QUALITY,
        title="Captured views covered by others",
        scope=Scope(views=Views.CAPTURED, region=Region.OTHERS),
        unit="%",
        digits=1,
    ),
    Metric(
        name="psnr_earlier_inserted_db",
        group=Group.QUALITY,
        title="Earlier insertions' PSNR",
        scope=_EARLIER,
        unit="dB",
        better="higher",
        meaning="Views inserted in earlier rounds, at their own cameras and the stored size, against their pictures; mean over views.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="psnr_worst_earlier_db",
        group=Group.QUALITY,
        title="PSNR of the worst earlier view",
        scope=_EARLIER,
        unit="dB",
        better="higher",
    ),
    Metric(
        name="structure_ghosted",
        group=Group.QUALITY,
        title="Ghosting",
        scope=Scope(views=Views.CAPTURED, region=Region.OTHERS),
        unit="%",
        digits=1,
        better="lower",
        meaning="Share of the photos' structure that the other views' Gaussians do not paint in its place.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="structure_offset",
        group=Group.QUALITY,
        title="Ghosting offset, of the long side",
        scope=Scope(views=Views.CAPTURED, region=Region.OTHERS),
        unit="%",
        better="lower",
    ),
    Metric(
        name="tour_covered",
        group=Group.QUALITY,
        title="Tour covered",
        scope=_TOUR,
        unit="%",
        digits=1,
        better="higher",
        meaning="Share of the tour's pixels that show something.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="tour_covered_gained",
        group=Group.QUALITY,
        title="Tour covered, gained",
        scope=Scope(views=Views.TOUR, region=Region.GAINED),
        unit="%",
        digits=1,
        better="higher",
        meaning="The same less what the scene before the insertion covers.",
        shown=Shown.TABLE,
    ),
    Metric(
        name="tour_registered",
        group=Group.QUALITY,
        title="Tour registered",
        scope=_TOUR,
        unit="%",
        digits=1,
        better="higher",
        meaning="Share of the tour's frames that structure from motion finds a camera for, from the frames alone.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="tour_camera_auc",
        group=Group.QUALITY,
        title="Tour cameras, AUC@10\u00b0",
        scope=_TOUR,
        unit="%",
        digits=1,
        better="higher",
        meaning="How near the cameras found from the frames are to those of the tour.",
        shown=Shown.TABLE,
    ),
    Metric(
        name="tour_tsed",
        group=Group.QUALITY,
        title="Tour TSED",
        scope=_TOUR,
        unit="%",
        digits=1,
        better="higher",
        meaning="Share of consecutive frames whose matches lie on the epipolar lines of the tour's cameras and move with depth.",
        shown=Shown.TABLE,
    ),
    Metric(
        name="tour_steadiness",
        group=Group.QUALITY,
        title="Tour steadiness",
        scope=_TOUR,
        digits=3,
        better="higher",
        meaning="Local correlation of consecutive frames, warped by depth.",
        shown=Shown.TABLE,
    ),
    Metric(
        name="tour_observations",
        group=Group.QUALITY,
        title="Triangulated observations per frame of the tour",
        scope=_TOUR,
        digits=0,
        better="higher",
    ),
    Metric(
        name="tour_rotation_deg",
        group=Group.QUALITY,
        title="Rotation of the tour's registered cameras",
        scope=_TOUR,
        unit="deg",
        digits=1,
        better="lower",
    ),
    Metric(
        name="tour_direction_deg",
        group=Group.QUALITY,
        title="Direction of the tour's registered cameras",
        scope=_TOUR,
        unit="deg",
        digits=1,
        better="lower",
    ),
    Metric(
        name="views_covered",
        group=Group.QUALITY,
        title="Captured views covered",
        scope=_CAPTURED,
        unit="%",
        digits=1,
    ),
    Metric(
        name="share_generated_captured",
        group=Group.QUALITY,
        title="Generated part of the captured views",
        scope=_CAPTURED,
        unit="%",
        digits=1,
    ),
)

INSERTION = (
    *_at_size(
        Scope(views=Views.INSERTED, size=Size.OWN),
        Group.INSERTION,
        "at_picture_size",
        "Inserted {}",
        (
            "Expansion: the scene at the inserted camera against the inserted picture, in that picture's own pixels.",
            "",
            "",
            "",
        ),
    ),
    Metric(
        name="psnr_inserted_db",
        group=Group.INSERTION,
        title="Inserted PSNR, stored size",
        scope=_INSERTED,
        unit="dB",
        better="higher",
        meaning="The same at the size that the methods were given.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="ssim_inserted",
        group=Group.INSERTION,
        title="Inserted SSIM, stored size",
        scope=_INSERTED,
        digits=3,
        better="higher",
        meaning="The same, structural similarity.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="st_lpips_inserted",
        group=Group.INSERTION,
        title="Inserted ST-LPIPS, stored size",
        scope=_INSERTED,
        digits=4,
        better="lower",
        meaning="The same, shift-tolerant perceptual distance.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="psnr_inserted_from_others_db",
        group=Group.INSERTION,
        title="Inserted from others",
        scope=Scope(views=Views.INSERTED, region=Region.OTHERS),
        unit="dB",
        better="higher",
        meaning="The overlap of inserted and captured views: the inserted camera shown only what the captured views contributed.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="inserted_covered_by_others",
        group=Group.INSERTION,
        title="Inserted view covered by others",
        scope=Scope(views=Views.INSERTED, region=Region.OTHERS),
        unit="%",
        digits=1,
    ),
    Metric(
        name="inserted_structure_ghosted",
        group=Group.INSERTION,
        title="Inserted ghosting",
        scope=Scope(views=Views.INSERTED, region=Region.OTHERS),
        unit="%",
        digits=1,
        better="lower",
        meaning="The same of the inserted picture, where the captured views overlap with it.",
        shown=Shown.TABLE,
    ),
    Metric(
        name="inserted_structure_offset",
        group=Group.INSERTION,
        title="Inserted ghosting offset, of the long side",
        scope=Scope(views=Views.INSERTED, region=Region.OTHERS),
        unit="%",
        better="lower",
    ),
    Metric(
        name="inserted_covered",
        group=Group.INSERTION,
        title="Inserted view covered",
        scope=_INSERTED,
        unit="%",
        digits=1,
    ),
    Metric(
        name="share_generated",
        group=Group.INSERTION,
        title="Generated part of the inserted view",
        scope=_INSERTED,
        unit="%",
    ),
    # The benchmark's, at cameras of made worlds that no method was given.
    Metric(
        name="psnr_new_region_db",
        group=Group.INSERTION,
        title="New-region PSNR",
        scope=_NEW_HELD_OUT,
        unit="dB",
        better="higher",
        meaning="What no captured view sees, at the true intended camera, against the consistent picture; black where nothing is drawn.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="new_region_drawn",
        group=Group.INSERTION,
        title="New region drawn",
        scope=_NEW_HELD_OUT,
        unit="%",
        digits=1,
        better="higher",
        meaning="Share of it that the scene shows there.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="new_region_drawn_abs_rel",
        group=Group.INSERTION,
        title="New region's drawn depth error",
        scope=_NEW_HELD_OUT,
        unit="%",
        digits=1,
        better="lower",
        meaning="Relative error of the rendered depth over the drawn part of it.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="psnr_half_way_db",
        group=Group.INSERTION,
        title="Half-way PSNR",
        scope=Scope(views=Views.HELD_OUT),
        unit="dB",
        better="higher",
        meaning="The whole picture at a true camera half-way to the intended one.",
        shown=Shown.PAGE,
    ),
)

GEOMETRY = (
    Metric(
        name="camera_rotation_deg",
        group=Group.GEOMETRY,
        title="Camera error",
        scope=_CAPTURED,
        unit="deg",
        better="lower",
        meaning="Against the known cameras: error of relative rotations between captured views.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="camera_direction_deg",
        group=Group.GEOMETRY,
        title="Camera direction error",
        scope=_CAPTURED,
        unit="deg",
        better="lower",
    ),
    Metric(
        name="camera_ate",
        group=Group.GEOMETRY,
        title="Trajectory error, in the truth's unit",
        scope=_CAPTURED,
        digits=4,
        better="lower",
    ),
    Metric(
        name="depth_abs_rel",
        group=Group.GEOMETRY,
        title="Depth error",
        scope=_CAPTURED,
        unit="%",
        digits=2,
        better="lower",
        meaning="Against the known depth of the captured views, relative, after one common scale.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="depth_within_125",
        group=Group.GEOMETRY,
        title="Depth right within a factor of 1.25",
        scope=_CAPTURED,
        unit="%",
        digits=1,
        better="higher",
    ),
    Metric(
        name="inserted_rotation_deg",
        group=Group.GEOMETRY,
        title="Inserted camera",
        scope=_INSERTED,
        unit="deg",
        better="lower",
        meaning="Rotation of the inserted camera against the one that the picture was really made with.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="inserted_direction_deg",
        group=Group.GEOMETRY,
        title="Inserted camera's direction",
        scope=_INSERTED,
        unit="deg",
        better="lower",
    ),
    Metric(
        name="new_region_abs_rel",
        group=Group.GEOMETRY,
        title="New region's depth error",
        scope=Scope(views=Views.INSERTED, region=Region.NEW),
        unit="%",
        digits=1,
        better="lower",
        meaning="Against the known depth of what no captured view saw.",
        shown=Shown.PAGE,
    ),
    Metric(
        name="new_region_within_125",
        group=Group.GEOMETRY,
        title="New region's depth right within a factor of 1.25",
        scope=Scope(views=Views.INSERTED, region=Region.NEW),
        unit="%",
        digits=1,
        better="higher",
    ),
    Metric(
        name="depth_disagreement",
        group=Group.GEOMETRY,
        title="Depth maps and Gaussians disagree",
        scope=_CAPTURED,
        unit="%",
        digits=1,
        better="lower",
    ),
    Metric(
        name="inserted_depth_disagreement",
        group=Group.GEOMETRY,
        title="Depth map and Gaussians of the inserted view disagree",
        scope=_INSERTED,
        unit="%",
        digits=1,
        better="lower",
    ),
)


def _count(name: str, title: str, scope: Scope = _WHOLE) -> Metric:
    return Metric(name=name, group=Group.COUNT, title=title, scope=scope, digits=0)


COUNTS = (
    _count("views_captured", "Captured views"),
    _count("views_captured_posed", "Captured views with a pose"),
    _count("views_generated", "Generated views"),
    _count("views_held_out", "Held-out photos", _HELD_OUT),
    _count("views_held_out_posed", "Held-out photos with a pose", _HELD_OUT),
    _count("gaussians", "Gaussians"),
    _count("gaussians_generated", "Gaussians from generated views"),
    _count("tour_frames", "Frames of the tour", _TOUR),
    _count("repeats", "Runs with other seeds"),
)


def _looked(kind: str, title: str, digits: int, *, unit: str = "", better: Better = "lower") -> tuple[Metric, ...]:
    """LPIPS, FLIP or CVVDP of each kind of views."""
    places = (
        ("captured", Group.QUALITY, _CAPTURED, "stored size", Shown.TABLE),
        ("held_out", Group.QUALITY, _HELD_OUT, "held-out photos", Shown.TABLE),
        ("inserted", Group.INSERTION, _INSERTED, "inserted view", Shown.TRACKED),
    )
    return tuple(
        Metric(
            name=f"{kind}_{name}",
            group=group,
            title=f"{title}, {where}",
            scope=scope,
            unit=unit,
            digits=digits,
            better=better,
            shown=shown,
        )
        for name, group, scope, where, shown in places
    )


LOOKED = (
    *_looked("lpips", "LPIPS", 3),
    *_looked("flip", "FLIP", 3),
    *_looked("cvvdp", "CVVDP", 2, unit="JOD", better="higher"),
)

# Where the new region is known.
REGIONS = tuple(
    Metric(
        name=name,
        group=Group.INSERTION,
        title=title,
        scope=Scope(views=Views.INSERTED, region=region),
        unit=unit,
        digits=digits,
        better="higher",
    )
    for name, title, region, unit, digits in (
        ("psnr_inserted_new_db", "PSNR of the inserted view's new region", Region.NEW, "dB", 2),
        ("ssim_inserted_new", "SSIM of the inserted view's new region", Region.NEW, "", 3),
        ("psnr_inserted_seen_db", "PSNR of the inserted view's seen region", Region.SEEN, "dB", 2),
        ("ssim_inserted_seen", "SSIM of the inserted view's seen region", Region.SEEN, "", 3),
    )
)

# By a vision-language model, where one was asked: 1 to 5.
JUDGED = (
    Metric(
        name="judge_insertion",
        group=Group.INSERTION,
        title="Judge: insertion satisfaction",
        scope=_TOUR,
        better="higher",
        shown=Shown.TABLE,
    ),
    Metric(
        name="judge_quality",
        group=Group.QUALITY,
        title="Judge: render quality",
        scope=_TOUR,
        better="higher",
        shown=Shown.TABLE,
    ),
)
MEASURED = (*QUALITY, *INSERTION, *GEOMETRY, *LOOKED, *REGIONS, *JUDGED, *COUNTS)
_known = {metric.name: metric for metric in MEASURED}


def register(*metrics: Metric) -> None:
    """Add metrics from outside the package. Raises `ValueError` for a name that another metric has."""
    for metric in metrics:
        if _known.get(metric.name, metric) != metric:
            raise ValueError(f"there is another metric {metric.name!r}")
        _known[metric.name] = metric


def metric_named(name: str, *, where: str = "metrics") -> Metric:
    """The metric of that name. Raises `UserError` with a suggestion if there is none."""
    if name not in _known:
        raise UserError(f"unknown metric {name!r}", where=where, fix=did_you_mean(name, _known))
    return _known[name]


def metrics_named(*names: str) -> tuple[Metric, ...]:
    """The metrics of these names, for a table of one's own."""
    return tuple(metric_named(name) for name in names)


def measured_metrics(*groups: Group, shown: Shown = Shown.TRACKED) -> tuple[Metric, ...]:
    """All that is measured of a reconstruction, registered metrics included.

    Args:
        groups: only of these; none: of all. Metrics come in the order of the groups.
        shown: at least so prominently.
    """
    wanted: Iterable[Group] = groups or Group
    found: Sequence[Metric] = tuple(_known.values())
    return tuple(metric for group in wanted for metric in found if metric.group is group and metric.shown >= shown)
