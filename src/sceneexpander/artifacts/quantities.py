"""Everything that is measured, in one table: what it is called in files, in MLflow and on the page, its unit, and which way is better.

MLflow groups charts by what stands before the slash and sorts groups and charts by name, so the names begin with a digit: what a person
looks at first comes first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

from sceneexpander.artifacts.metrics import MetricsRow

Better = Literal["higher", "lower", ""]


class Group(StrEnum):
    """Groups of quantities in the order of their importance; the value is what stands before the slash."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """One number.

    Attributes:
        name: as in `MetricsRow.value`, in a look, or in a step of the adaptation.
        metric: its name in MLflow behind the group.
        group: what it belongs to.
        title: its heading, without the unit.
        meaning: a sentence for people; empty for what is tracked but not shown on the page.
        unit: of the printed number; ``%`` is stored and tracked as a share.
        digits: printed behind the point.
        better: which way.
    """

    name: str
    metric: str
    group: Group
    title: str
    meaning: str = ""
    unit: str = ""
    digits: int = 2
    better: Better = ""

    @property
    def tracked(self) -> str:
        """The whole name in MLflow."""
        return f"{self.group}/{self.metric}"

    @property
    def heading(self) -> str:
        """Title and unit; percent signs stand beside the numbers."""
        return f"{self.title}, {self.unit}" if self.unit not in ("", "%") else self.title

    def text(self, value: float | None) -> str:
        """A value as it is printed, percent signs included, other units not; a dash if there is none."""
        if value is None:
            return "\u2013"
        return f"{100 * value:.{self.digits}f} %" if self.unit == "%" else f"{value:.{self.digits}f}"

    def text_with_unit(self, value: float | None) -> str:
        """The same with every unit, for where no heading says it."""
        return self.text(value) + (f" {self.unit}" if self.unit not in ("", "%") and value is not None else "")


METHOD_TITLES = {
    "captured": "before the insertion, captured photos only",
    "gaussian_splatting": "3DGS per scene, from the backbone's cameras and Gaussians",
    "omnivggt": "OmniVGGT (pixel-aligned Gaussians)",
    "omnivggt_optimised": "OmniVGGT (3DGS from its points and cameras)",
    "ttt3r": "TTT3R (pixel-aligned Gaussians)",
    "ttt3r_optimised": "TTT3R (3DGS from its points and cameras)",
    "backbone": "backbone with the inserted view, unadapted",
    "corrected": "corrections without a step of adaptation",
    "sceneexpander": "SceneExpander (corrections and Algorithm 1)",
    "sceneexpander_optimised": "SceneExpander + post-optimisation (3DGS)",
}


def _at_size(
    part: str, group: Group, where: str, title: str, meanings: tuple[str, str, str, str]
) -> tuple[Quantity, ...]:
    """The numbers of a `SizeMetrics`: PSNR, SSIM, ST-LPIPS and the open share; their names go into ``title``."""
    psnr, ssim, st_lpips, opened = meanings
    return (
        Quantity(
            name=f"{part}.psnr_db",
            metric=f"psnr_{where}_db",
            group=group,
            title=title.format("PSNR"),
            unit="dB",
            better="higher",
            meaning=psnr,
        ),
        Quantity(
            name=f"{part}.ssim",
            metric=f"ssim_{where}",
            group=group,
            title=title.format("SSIM"),
            digits=3,
            better="higher",
            meaning=ssim,
        ),
        Quantity(
            name=f"{part}.st_lpips",
            metric=f"st_lpips_{where}",
            group=group,
            title=title.format("ST-LPIPS"),
            digits=4,
            better="lower",
            meaning=st_lpips,
        ),
        Quantity(
            name=f"{part}.open_share",
            metric=f"seen_through_{where}",
            group=group,
            title=title.format("Open"),
            unit="%",
            digits=1,
            better="lower",
            meaning=opened,
        ),
    )


QUALITY = (
    *_at_size(
        "own",
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
    Quantity(
        name="psnr_db",
        metric="psnr_captured_db",
        group=Group.QUALITY,
        title="PSNR, stored size",
        unit="dB",
        better="higher",
        meaning="The same at the size that the methods were given.",
    ),
    Quantity(
        name="ssim",
        metric="ssim_captured",
        group=Group.QUALITY,
        title="SSIM, stored size",
        digits=3,
        better="higher",
    ),
    Quantity(
        name="st_lpips",
        metric="st_lpips_captured",
        group=Group.QUALITY,
        title="ST-LPIPS, stored size",
        digits=4,
        better="lower",
    ),
    *_at_size(
        "half",
        Group.QUALITY,
        "captured_half_size",
        "{}, half the stored size",
        ("The same from farther away.", "", "", ""),
    ),
    *_at_size("double", Group.QUALITY, "captured_double_size", "{}, twice the stored size", ("", "", "", "")),
    *_at_size(
        "quadruple",
        Group.QUALITY,
        "captured_quadruple_size",
        "{}, four times the stored size",
        ("", "", "", "The share that one looks through when the pictures are drawn at four times the stored size."),
    ),
    Quantity(
        name="others_psnr_db",
        metric="psnr_from_others_db",
        group=Group.QUALITY,
        title="PSNR from others",
        unit="dB",
        better="higher",
        meaning="Captured views painted only by what other views contributed: low where surfaces are doubled.",
    ),
    Quantity(
        name="navigation_coverage",
        metric="tour_covered",
        group=Group.QUALITY,
        title="Tour covered",
        unit="%",
        digits=1,
        better="higher",
        meaning="Share of the tour's pixels that show something.",
    ),
    Quantity(name="coverage", metric="views_covered", group=Group.QUALITY, title="Captured views covered", unit="%"),
)

INSERTION = (
    *_at_size(
        "inserted_own",
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
    Quantity(
        name="inserted_psnr_db",
        metric="psnr_inserted_db",
        group=Group.INSERTION,
        title="Inserted PSNR, stored size",
        unit="dB",
        better="higher",
        meaning="The same at the size that the methods were given.",
    ),
    Quantity(
        name="inserted_ssim",
        metric="ssim_inserted",
        group=Group.INSERTION,
        title="Inserted SSIM",
        digits=3,
        better="higher",
        meaning="The same, structural similarity.",
    ),
    Quantity(
        name="inserted_st_lpips",
        metric="st_lpips_inserted",
        group=Group.INSERTION,
        title="Inserted ST-LPIPS",
        digits=4,
        better="lower",
        meaning="The same, shift-tolerant perceptual distance.",
    ),
    Quantity(
        name="inserted_others_psnr_db",
        metric="psnr_inserted_from_others_db",
        group=Group.INSERTION,
        title="Inserted from others",
        unit="dB",
        better="higher",
        meaning="The overlap of inserted and captured views: the inserted camera shown only what the captured views contributed.",
    ),
    Quantity(
        name="inserted_generated_share",
        metric="share_generated",
        group=Group.INSERTION,
        title="Generated part of the inserted view",
        unit="%",
    ),
)

GEOMETRY = (
    Quantity(
        name="truth.camera_rotation_deg",
        metric="camera_rotation_deg",
        group=Group.GEOMETRY,
        title="Camera error",
        unit="deg",
        better="lower",
        meaning="Against the known cameras: error of relative rotations between captured views.",
    ),
    Quantity(
        name="truth.camera_direction_deg",
        metric="camera_direction_deg",
        group=Group.GEOMETRY,
        title="Camera direction error",
        unit="deg",
        better="lower",
    ),
    Quantity(
        name="truth.camera_ate",
        metric="camera_trajectory_error",
        group=Group.GEOMETRY,
        title="Trajectory error, in the truth's unit",
        digits=4,
        better="lower",
    ),
    Quantity(
        name="truth.depth_abs_rel",
        metric="depth_abs_rel",
        group=Group.GEOMETRY,
        title="Depth error",
        unit="%",
        digits=1,
        better="lower",
        meaning="Against the known depth of the captured views, relative, after one common scale.",
    ),
    Quantity(
        name="truth.depth_within_125",
        metric="depth_within_125",
        group=Group.GEOMETRY,
        title="Depth right within a factor of 1.25",
        unit="%",
        digits=1,
        better="higher",
    ),
    Quantity(
        name="truth.inserted_rotation_deg",
        metric="inserted_rotation_deg",
        group=Group.GEOMETRY,
        title="Inserted camera",
        unit="deg",
        better="lower",
        meaning="Rotation of the inserted camera against the one that the picture was really made with.",
    ),
    Quantity(
        name="truth.inserted_direction_deg",
        metric="inserted_direction_deg",
        group=Group.GEOMETRY,
        title="Inserted camera's direction",
        unit="deg",
        better="lower",
    ),
    Quantity(
        name="truth.new_region_abs_rel",
        metric="new_region_abs_rel",
        group=Group.GEOMETRY,
        title="New region's depth error",
        unit="%",
        digits=1,
        better="lower",
        meaning="Against the known depth of what no captured view saw.",
    ),
    Quantity(
        name="truth.new_region_within_125",
        metric="new_region_within_125",
        group=Group.GEOMETRY,
        title="New region's depth right within a factor of 1.25",
        unit="%",
        digits=1,
        better="higher",
    ),
    Quantity(
        name="depth_disagreement",
        metric="depth_disagreement",
        group=Group.GEOMETRY,
        title="Depth maps and Gaussians disagree",
        unit="%",
        digits=1,
        better="lower",
    ),
)

COUNTS = (
    Quantity(name="captured_views", metric="views_captured", group=Group.COUNT, title="Captured views", digits=0),
    Quantity(
        name="captured_views_posed",
        metric="views_captured_posed",
        group=Group.COUNT,
        title="Captured views with a pose",
        digits=0,
    ),
    Quantity(name="generated_views", metric="views_generated", group=Group.COUNT, title="Generated views", digits=0),
    Quantity(name="gaussians", metric="gaussians", group=Group.COUNT, title="Gaussians", digits=0),
    Quantity(
        name="generated_gaussians",
        metric="gaussians_generated",
        group=Group.COUNT,
        title="Gaussians from generated views",
        digits=0,
    ),
    Quantity(name="navigation_frames", metric="tour_frames", group=Group.COUNT, title="Frames of the tour", digits=0),
    Quantity(name="repeats", metric="repeats", group=Group.COUNT, title="Runs with other seeds", digits=0),
)

# A step of the adaptation. Its objective is two quantities: a step that also sees the inserted view has more terms to pay for.
OBJECTIVES = {
    True: Quantity(
        name="loss",
        metric="objective_with_inserted",
        group=Group.LOSS,
        title="Objective of steps with the inserted view",
        better="lower",
    ),
    False: Quantity(
        name="loss",
        metric="objective_without_inserted",
        group=Group.LOSS,
        title="Objective of steps without it",
        better="lower",
    ),
}
STEPS = (
    Quantity(
        name="anchor_camera",
        metric="anchor_camera",
        group=Group.LOSS,
        title="Cameras of captured views",
        better="lower",
    ),
    Quantity(
        name="anchor_depth", metric="anchor_depth", group=Group.LOSS, title="Depth of captured views", better="lower"
    ),
    Quantity(
        name="anchor_normal",
        metric="anchor_normal",
        group=Group.LOSS,
        title="Normals of captured views",
        better="lower",
    ),
    Quantity(name="gen_camera", metric="inserted_camera", group=Group.LOSS, title="Inserted camera", better="lower"),
    Quantity(name="gen_depth", metric="inserted_depth", group=Group.LOSS, title="Inserted depth", better="lower"),
    Quantity(name="gen_normal", metric="inserted_normal", group=Group.LOSS, title="Inserted normals", better="lower"),
    Quantity(name="drift", metric="weights_regulariser", group=Group.LOSS, title="Regulariser of the weights"),
    Quantity(name="gradient_norm", metric="gradient_norm", group=Group.LOSS, title="Norm of the gradient"),
)
INSERTED_TERMS = ("gen_camera", "gen_depth", "gen_normal")  # not there on steps that do not see the inserted view

DRIFT_ALL = Quantity(
    name="drift",
    metric="all_modules",
    group=Group.DRIFT,
    title="Weights moved",
    digits=3,
    meaning="Norm of the change of all weights since the round began.",
)
# What a look at a running adaptation measures; the drift is the norm over all modules.
LOOKS = (
    Quantity(
        name="captured_psnr",
        metric="psnr_captured_db",
        group=Group.LOOK,
        title="Captured PSNR",
        unit="dB",
        better="higher",
        meaning="Preservation: a few captured views rendered at the model's own cameras, against the photos.",
    ),
    Quantity(
        name="inserted_psnr",
        metric="psnr_inserted_db",
        group=Group.LOOK,
        title="Inserted PSNR",
        unit="dB",
        better="higher",
        meaning="Expansion: the picture above it against the inserted one.",
    ),
    Quantity(
        name="captured_depth_change",
        metric="captured_depth_moved",
        group=Group.LOOK,
        title="Captured depth moved",
        unit="%",
        digits=1,
        better="lower",
        meaning="Depth of the captured views against what the model believed before the insertion: mean absolute log ratio.",
    ),
    Quantity(
        name="head_disagreement",
        metric="heads_disagree",
        group=Group.LOOK,
        title="Heads disagree",
        unit="%",
        digits=1,
        better="lower",
        meaning="Depth that the model tells against the depth at which it puts its Gaussians: mean absolute log ratio.",
    ),
    DRIFT_ALL,
)

PEAK_MEMORY = Quantity(
    name="peak_rss_mb",
    metric="peak_memory_mb",
    group=Group.COST,
    title="Peak memory",
    unit="MB",
    digits=0,
    better="lower",
)
TIME_ALL = Quantity(
    name="wall_s",
    metric="time_all_s",
    group=Group.COST,
    title="Time of all its stages",
    unit="s",
    digits=1,
    better="lower",
)

MEASURED = (*QUALITY, *INSERTION, *GEOMETRY, *COUNTS)  # of a `MetricsRow`
TABLE = (*MEASURED, *OBJECTIVES.values(), *STEPS, *LOOKS, TIME_ALL, PEAK_MEMORY)
_BY_NAME = {item.name: item for item in MEASURED}
_STEPS_BY_NAME = {item.name: item for item in STEPS}
_LOOKS_BY_NAME = {item.name: item for item in LOOKS}


def tracked_row(row: MetricsRow) -> dict[str, float]:
    """What is known of a row, and how far repeated runs lie apart, under their names in MLflow."""
    found = {item.tracked: value for item in MEASURED if (value := row.value(item.name)) is not None}
    found |= {f"{Group.SPREAD}/{_BY_NAME[name].metric}": value for name, value in row.spread.items()}
    # Tables of MLflow print every digit: six say more than enough, the row's file has all.
    return {name: value if value.is_integer() else float(f"{value:.6g}") for name, value in found.items()}


def tracked_step(step: Mapping[str, Any]) -> dict[str, float]:
    """Numbers of one step of an adaptation under their names in MLflow.

    Args:
        step: as logged: ``inserted`` says whether it saw the inserted view; what is not a number of the table is passed over.
    """
    inserted = bool(step["inserted"])
    shown = {name: item for name, item in _STEPS_BY_NAME.items() if inserted or name not in INSERTED_TERMS}
    shown["loss"] = OBJECTIVES[inserted]
    return {item.tracked: float(step[name]) for name, item in shown.items() if name in step}


def drift_of_all(look: Mapping[str, Any]) -> float:
    """Norm of the change of all weights: modules share none, so their norms add up, squared."""
    return math.hypot(*look["drift"].values())


def tracked_look(look: Mapping[str, Any]) -> dict[str, float]:
    """Numbers of one look and the drift of every module under their names in MLflow."""
    numbers = {
        item.tracked: float(look[name])
        for name, item in _LOOKS_BY_NAME.items()
        if item is not DRIFT_ALL and name in look
    }
    moved = {f"{Group.DRIFT}/{module}": float(value) for module, value in look["drift"].items()}
    return numbers | moved | ({DRIFT_ALL.tracked: drift_of_all(look)} if moved else {})


def tracked_cost(stages: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Time of each stage and of all, and the highest peak of memory, under their names in MLflow."""
    if not stages:
        return {}
    times = {f"{Group.COST}/time_{stage}_s": float(entry["wall_s"]) for stage, entry in stages.items()}
    return {
        **times,
        TIME_ALL.tracked: sum(times.values()),
        PEAK_MEMORY.tracked: max(float(entry["peak_rss_mb"]) for entry in stages.values()),
    }
