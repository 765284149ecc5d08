"""Curves of an adaptation as an SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP, _RIGHT = 560.0, 280.0, 78.0, 34.0, 14.0, 12.0
_FEWEST_TO_SMOOTH = 12  # steps; fewer are joined as they are


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Some steps of a run. ``name`` is a class of the style sheet, ``points`` are (step, value), steps counted from 1."""

    name: str
    title: str
    points: tuple[tuple[int, float], ...]


def objective_curves(inserted: Sequence[bool], loss: Sequence[float]) -> list[Curve]:
    """The objective of the steps that also saw the inserted view, and of those that did not: they have different terms to pay for.

    Args:
        inserted: whether each step saw it; a kind of step that never came has no curve.
        loss: of each step.
    """
    steps = list(zip(inserted, loss, strict=True))
    kinds = (("with", "with the inserted view", True), ("without", "captured views alone", False))
    curves = [
        Curve(
            name=name,
            title=title,
            points=tuple(
                (step, value) for step, (seen, value) in enumerate(steps, 1) if seen is wanted and math.isfinite(value)
            ),
        )
        for name, title, wanted in kinds
    ]
    return [curve for curve in curves if curve.points]


def smoothing_window(curve: Curve) -> int:
    """How many of a curve's points are averaged into its line; 1: none."""
    count = len(curve.points)
    return 1 if count < _FEWEST_TO_SMOOTH else max(3, count // 8) | 1


def curve_chart(curves: Sequence[Curve], steps: int) -> str:
    """SVG text: all curves on the same axes, every step a dot and a moving average as line, logarithmic beyond a decade.

    Args:
        curves: what to draw; empty: no text.
        steps: length of the axis.
    """
    if not curves:
        return ""
    values = [value for curve in curves for _, value in curve.points]
    low, high = min(values), max(values)
    logarithmic = low > 0 and high / low > 10

    def height_of(value: float) -> float:
        a, b, v = (math.log10(x) for x in (low, high, value)) if logarithmic else (low, high, value)
        share = 0.5 if b == a else (v - a) / (b - a)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _BOTTOM - _TOP)

    def place_of(step: int) -> float:
        return _LEFT + (step - 1) * (_WIDTH - _LEFT - _RIGHT) / max(steps - 1, 1)

    base = _HEIGHT - _BOTTOM
    middle = math.sqrt(low * high) if logarithmic else (low + high) / 2
    parts = [f'<svg class="curve" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" aria-label="objective per step">']
    for value in sorted({low, middle, high}):
        y = height_of(value)
        parts.append(f'<line class="axis" x1="{_LEFT}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>')
    parts.append(f'<text x="{_LEFT}" y="{base + 22}">step 1</text>')
    parts.append(f'<text x="{_WIDTH - _RIGHT}" y="{base + 22}" text-anchor="end">{steps}</text>')
    for curve in curves:
        line = " ".join(f"{place_of(step):.1f},{height_of(value):.1f}" for step, value in _smoothed(curve))
        dots = "".join(
            f'<circle cx="{place_of(step):.1f}" cy="{height_of(value):.1f}" r="2"/>' for step, value in curve.points
        )
        parts.append(f'<g class="{curve.name}"><title>{curve.title}</title>{dots}<polyline points="{line}"/></g>')
    return "".join([*parts, "</svg>"])


def _smoothed(curve: Curve) -> list[tuple[int, float]]:
    """Means over the window around each point, as far as it lies within the curve."""
    half, found = smoothing_window(curve) // 2, []
    for index, (step, _) in enumerate(curve.points):
        part = [value for _, value in curve.points[max(0, index - half) : index + half + 1]]
        found.append((step, sum(part) / len(part)))
    return found
