"""A loss curve as an SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP, _RIGHT = 520.0, 240.0, 52.0, 26.0, 12.0, 12.0


def loss_curve(values: Sequence[float]) -> str:
    """SVG text: the objective of every step, logarithmic if it spans more than a decade."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return ""
    low, high = min(finite), max(finite)
    logarithmic = low > 0 and high / low > 10

    def height_of(value: float) -> float:
        a, b, v = (math.log10(x) for x in (low, high, value)) if logarithmic else (low, high, value)
        share = 0.5 if b == a else (v - a) / (b - a)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _BOTTOM - _TOP)

    pace = (_WIDTH - _LEFT - _RIGHT) / max(len(values) - 1, 1)
    points = " ".join(f"{_LEFT + i * pace:.1f},{height_of(v):.1f}" for i, v in enumerate(values) if math.isfinite(v))
    base = _HEIGHT - _BOTTOM
    labels = [(low, base), (high, _TOP + 8)]
    return "".join(
        [
            f'<svg class="curve" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" aria-label="objective per step">',
            f'<line class="axis" x1="{_LEFT}" y1="{base}" x2="{_WIDTH - _RIGHT}" y2="{base}"/>',
            f'<line class="axis" x1="{_LEFT}" y1="{_TOP}" x2="{_LEFT}" y2="{base}"/>',
            *(f'<text x="4" y="{y:.1f}">{value:.3g}</text>' for value, y in labels),
            f'<text x="{_LEFT}" y="{_HEIGHT - 8}">step 1</text>',
            f'<text x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 8}" text-anchor="end">{len(values)}</text>',
            f'<polyline class="line" points="{points}"/></svg>',
        ]
    )
