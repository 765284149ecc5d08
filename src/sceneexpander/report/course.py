"""What the page says about the course of a round: the verdict on the inserted view, the adaptation's looks, the fit of the Gaussians."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sceneexpander.report.words import LOOK_COLUMNS, Column, method_words

FITTED = "Its Gaussians were fitted to its pictures: PSNR, SSIM and ST-LPIPS are those of pictures it was fitted to."


@dataclass(frozen=True, slots=True, kw_only=True)
class LookCell:
    """One number of one look, and what was gained since the first one (empty: nothing to compare)."""

    text: str
    gain: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LookRow:
    """One number of all looks."""

    label: str
    meaning: str
    cells: tuple[LookCell, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LooksTable:
    """Looks side by side: headings, the inserted view's pictures (None where one was not kept), numbers, and what they warn of."""

    headings: tuple[str, ...]
    renders: tuple[str | None, ...]
    depths: tuple[str | None, ...]
    rows: tuple[LookRow, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The verdict on an inserted view in a sentence, and whether it is a warning."""

    text: str
    refused: bool


def looks_table(looks: Mapping[str, Any] | None) -> LooksTable | None:
    """The gathered looks of a round as a table with a column per look; None if there was none."""
    if looks is None:
        return None
    entries = looks["entries"]
    return LooksTable(
        headings=tuple(f"after step {look['step']}" if look["step"] else "before the first step" for look in entries),
        renders=tuple(look["pictures"].get("inserted") for look in entries),
        depths=tuple(look["pictures"].get("depth") for look in entries),
        rows=tuple(_row(column, [_value(look, column.name) for look in entries]) for column in LOOK_COLUMNS),
        warnings=tuple(looks["warnings"]),
    )


def _value(look: Mapping[str, Any], name: str) -> float:
    # Modules share no weight, so the norms by module add up, squared, to that of everything.
    return math.hypot(*look["drift"].values()) if name == "drift" else float(look[name])


def _row(column: Column, values: Sequence[float]) -> LookRow:
    cells = []
    for index, value in enumerate(values):
        # The other numbers are differences already.
        gained = index > 0 and column.better == "higher"
        gain = round(value - values[0], column.digits) + 0.0  # no negative zero
        cells.append(LookCell(text=column.text(value), gain=f"{gain:+.{column.digits}f}" if gained else ""))
    return LookRow(label=column.label, meaning=column.meaning, cells=tuple(cells))


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
