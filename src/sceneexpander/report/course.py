"""What the page says about the course of a round: the verdict on the inserted view, the adaptation's looks, the fit of the Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sceneexpander.artifacts.quantities import DRIFT_ALL, LOOKS, Quantity, drift_of_all
from sceneexpander.report.words import method_words

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


def looks_shown(looks: Mapping[str, Any] | None) -> LooksShown | None:
    """The gathered looks of a round, one card each; None if there was none."""
    if looks is None:
        return None
    first = looks["entries"][0]
    return LooksShown(
        cards=tuple(
            LookCard(
                heading=f"after step {look['step']}" if look["step"] else "before the first step",
                render=look["pictures"].get("inserted"),
                depth=look["pictures"].get("depth"),
                numbers=tuple(_number(item, look, None if look is first else first) for item in LOOKS),
            )
            for look in looks["entries"]
        ),
        meanings=tuple((item.title, item.meaning) for item in LOOKS),
        warnings=tuple(looks["warnings"]),
    )


def _value(look: Mapping[str, Any], item: Quantity) -> float:
    return drift_of_all(look) if item is DRIFT_ALL else float(look[item.name])


def _number(item: Quantity, look: Mapping[str, Any], first: Mapping[str, Any] | None) -> LookNumber:
    value, gain = _value(look, item), ""
    # The other numbers are differences already.
    if first is not None and item.better == "higher":
        gained = round(value - _value(first, item), item.digits) + 0.0  # no negative zero
        gain = f"{gained:+.{item.digits}f}"
    return LookNumber(label=item.title, text=item.text_with_unit(value), gain=gain)


def verdict(acceptance: Mapping[str, Any] | None) -> Verdict | None:
    """What was found out about the inserted view before anything was adapted; None if nothing was."""
    if acceptance is None:
        return None
    if acceptance["reasons"]:
        reasons = "; ".join(acceptance["reasons"])
        return Verdict(
            text=f"The inserted view fits badly, which was known before the adaptation: {reasons}. It was inserted all the same.",
            refused=True,
        )
    parts = [f"captured views see {100 * acceptance['overlap']:.0f} % of it"]
    depth, colour = acceptance["depth_conflict"], acceptance["colour_conflict"]
    if depth is not None:
        parts.append(f"its depth differs from theirs by {100 * depth:.1f} %")
    if colour is not None:
        parts.append(f"its colours by {100 * colour:.1f} %")
    parts.append(f"it turns captured cameras by {acceptance['cameras_moved_deg']:.2f} degrees at most")
    return Verdict(
        text=f"Before the adaptation, the inserted view was found to fit: {', '.join(parts)}.", refused=False
    )


def was_fitted(method: Mapping[str, Any]) -> bool:
    """Whether a fit of the method's Gaussians to their pictures was kept."""
    refinement = method["refinement"]
    return refinement is not None and refinement["after"] < refinement["before"]


def fits(methods: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each method whose Gaussians were fitted to their pictures: what that changed."""
    return [
        f"Gaussians of {method_words(item['name'], item['model']).label}: {_fit(item['refinement'])}"
        for item in methods
        if item["refinement"] is not None
    ]


def _fit(refinement: Mapping[str, Any]) -> str:
    steps, before, after = refinement["steps"], refinement["before"], refinement["after"]
    if after < before:
        return f"photometric loss {before:.4f} to {after:.4f} in {steps} steps"
    return f"kept as they were, {steps} steps did not lower the photometric loss of {before:.4f}"
