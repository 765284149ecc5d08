"""What the page says about the course of a round: the verdict on the inserted view, the adaptation's looks, the fit of the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sceneexpander.artifacts.page import Judgement, LookPage, LooksPage, MethodPage, Refinement
from sceneexpander.catalogue import LOOKS, Metric
from sceneexpander.catalogue.course import DRIFT_ALL, drift_of_all
from sceneexpander.report.words import method_label

FITTED = "Its Gaussians were fitted to its pictures: PSNR, SSIM and ST-LPIPS are those of pictures it was fitted to."


@dataclass(frozen=True, slots=True, kw_only=True)
class LookNumber:
    """One number of one look with its unit, and what was gained since the first look (empty: nothing to compare)."""

    label: str
    text: str
    gain: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LookCard:
    """One look: when, the inserted view's pictures (None where one was not kept), and its numbers."""

    heading: str
    render: str | None
    depth: str | None
    numbers: tuple[LookNumber, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LooksShown:
    """Looks side by side, what their numbers mean, and what they warn of."""

    cards: tuple[LookCard, ...]
    meanings: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The verdict on an inserted view in a sentence, and whether it is a warning."""

    text: str
    refused: bool


def looks_shown(looks: LooksPage | None) -> LooksShown | None:
    """The gathered looks of a round, one card each; None if there was none."""
    if looks is None:
        return None
    first = looks.looks[0]
    return LooksShown(
        cards=tuple(
            LookCard(
                heading=f"after step {look.step}" if look.step else "before the first step",
                render=look.pictures.get("inserted"),
                depth=look.pictures.get("depth"),
                numbers=tuple(_number(item, look, None if look is first else first) for item in LOOKS),
            )
            for look in looks.looks
        ),
        meanings=tuple((item.title, item.meaning) for item in LOOKS),
        warnings=looks.warnings,
    )


def _value(look: LookPage, item: Metric) -> float:
    return drift_of_all(look.drift) if item is DRIFT_ALL else look.values[item.name]


def _number(item: Metric, look: LookPage, first: LookPage | None) -> LookNumber:
    value, gain = _value(look, item), ""
    # The other numbers are differences already.
    if first is not None and item.better == "higher":
        gained = round(value - _value(first, item), item.digits) + 0.0  # no negative zero
        gain = f"{gained:+.{item.digits}f}"
    return LookNumber(label=item.title, text=item.text_with_unit(value), gain=gain)


def verdict(judgement: Judgement | None) -> Verdict | None:
    """What was found out about the inserted view before anything was adapted; None if nothing was."""
    if judgement is None:
        return None
    if judgement.reasons:
        reasons = "; ".join(judgement.reasons)
        return Verdict(
            text=f"The inserted view fits badly, which was known before the adaptation: {reasons}. It was inserted all the same.",
            refused=True,
        )
    parts = [f"captured views see {100 * judgement.overlap:.0f} % of it"]
    if judgement.depth_conflict is not None:
        parts.append(f"its depth differs from theirs by {100 * judgement.depth_conflict:.1f} %")
    if judgement.colour_conflict is not None:
        parts.append(f"its colours by {100 * judgement.colour_conflict:.1f} %")
    parts.append(f"it turns captured cameras by {judgement.cameras_moved_deg:.2f} degrees at most")
    return Verdict(
        text=f"Before the adaptation, the inserted view was found to fit: {', '.join(parts)}.", refused=False
    )


def fits(methods: Sequence[MethodPage]) -> list[str]:
    """A line for each method whose Gaussians were fitted to their pictures: what that changed."""
    return [
        f"Gaussians of {method_label(item.name, item.model)}: {_fit(item.refinement)}"
        for item in methods
        if item.refinement is not None
    ]


def _fit(refinement: Refinement) -> str:
    steps, before, after = refinement.steps, refinement.before, refinement.after
    if refinement.kept:
        return f"photometric loss {before:.4f} to {after:.4f} in {steps} steps"
    return f"kept as they were, {steps} steps did not lower the photometric loss of {before:.4f}"
