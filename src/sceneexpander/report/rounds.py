"""What became of every region over the rounds: a heat map of views, the drift of each region since it was new, time and memory."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from sceneexpander.artifacts.metrics import MetricsRow, ViewMetrics
from sceneexpander.artifacts.page import RoundPage

WORST_DRIFT_DB = 3.0  # has the strongest colour
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP, _RIGHT = 560.0, 240.0, 66.0, 34.0, 18.0, 110.0
_LINE_PX = 18.0  # of the labels at the right


@dataclass(frozen=True, slots=True, kw_only=True)
class HeatCell:
    """One view after one round.

    Attributes:
        text: its PSNR; empty: it was not there yet, or has no camera.
        drift_db: change since it was first in the scene, 0 where it is new; None where there is no number.
        strength: of the colour, from 0 to 1.
    """

    text: str = ""
    drift_db: float | None = None
    strength: float = 0.0

    @property
    def lost(self) -> bool:
        """Whether it became worse."""
        return self.drift_db is not None and self.drift_db < 0


@dataclass(frozen=True, slots=True, kw_only=True)
class HeatRow:
    """One view in all columns. ``generated``: it was inserted."""

    name: str
    generated: bool
    cells: tuple[HeatCell, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class HeatColumn:
    """The scene at one time; ``label`` says which. The others are texts, empty where there is none."""

    label: str
    drift: str = ""
    time: str = ""
    cpu_time: str = ""
    memory: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftLine:
    """A region over the rounds: the photos, or one inserted view. ``points`` are (round, change in dB since it was new)."""

    label: str
    generated: bool
    points: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundsShown:
    """The heat map and the drift curves as SVG text, empty with one round."""

    columns: tuple[HeatColumn, ...]
    rows: tuple[HeatRow, ...]
    curve: str


def view_psnr(view: ViewMetrics) -> float | None:
    """PSNR of a view against its picture at the stored size; None without a camera."""
    name = "psnr_inserted_db" if view.generated else "psnr_captured_db"
    return view.values.get(name) if view.posed else None


def rounds_shown(
    rounds: Sequence[RoundPage], rows: Sequence[MetricsRow | None], before: MetricsRow | None, names: Mapping[str, str]
) -> RoundsShown | None:
    """What became of the views; None if nothing was measured.

    Args:
        rounds: in order.
        rows: of the adapted scene after each; None: not known.
        before: of the captured scene.
        names: of the views, for people.
    """
    times: list[tuple[int, MetricsRow, RoundPage | None]] = [] if before is None else [(0, before, None)]
    times += [(item.number, row, item) for item, row in zip(rounds, rows, strict=True) if row is not None]
    if not any(item is not None for _, _, item in times):
        return None
    generated = {view.view_id: view.generated for _, row, _ in times for view in row.views}
    values = [{view.view_id: view_psnr(view) for view in row.views} for _, row, _ in times]
    drifts = _drifts(values)
    columns = tuple(_column(number, page, found) for (number, _, page), found in zip(times, drifts, strict=True))
    lines = _regions([number for number, _, _ in times], drifts, generated, rounds)
    return RoundsShown(
        columns=columns,
        rows=tuple(
            HeatRow(
                name=names.get(view, view),
                generated=is_generated,
                cells=tuple(_cell(value.get(view), found, view) for value, found in zip(values, drifts, strict=True)),
            )
            for view, is_generated in generated.items()
        ),
        curve=drift_chart(lines) if len(rounds) > 1 else "",
    )


def _drifts(values: Sequence[Mapping[str, float | None]]) -> list[dict[str, float]]:
    """At each time the change of every view that has a number since it first had one: 0 where it is new."""
    first: dict[str, float] = {}
    found = []
    for now in values:
        known = {view: value for view, value in now.items() if value is not None}
        found.append({view: value - first.setdefault(view, value) for view, value in known.items()})
    return found


def _column(number: int, page: RoundPage | None, drifts: Mapping[str, float]) -> HeatColumn:
    if page is None:
        return HeatColumn(label="before")
    older = [change for view, change in drifts.items() if view != page.inserted_id]
    runs = page.statistics.values()
    return HeatColumn(
        label=f"round {number}",
        drift=f"{sum(older) / len(older):+.2f}" if older else "",
        time=f"{sum(run.wall_s for run in runs):.0f}" if runs else "",
        cpu_time=f"{sum(busy):.0f}" if (busy := [run.cpu_s for run in runs if run.cpu_s is not None]) else "",
        memory=f"{max(run.peak_rss_mb for run in runs):.0f}" if runs else "",
    )


def _cell(value: float | None, drifts: Mapping[str, float], view: str) -> HeatCell:
    if value is None:
        return HeatCell()
    drift = drifts[view]
    return HeatCell(text=f"{value:.1f}", drift_db=drift, strength=min(abs(drift) / WORST_DRIFT_DB, 1.0))


def _regions(
    numbers: Sequence[int],
    drifts: Sequence[Mapping[str, float]],
    generated: Mapping[str, bool],
    rounds: Sequence[RoundPage],
) -> list[DriftLine]:
    photos = []
    for number, found in zip(numbers, drifts, strict=True):
        changes = [change for view, change in found.items() if not generated[view]]
        if changes:
            photos.append((number, sum(changes) / len(changes)))
    lines = [DriftLine(label="photos", generated=False, points=tuple(photos))]
    for item in rounds:
        points = [
            (n, found[item.inserted_id]) for n, found in zip(numbers, drifts, strict=True) if item.inserted_id in found
        ]
        lines.append(DriftLine(label=f"inserted {item.number}", generated=True, points=tuple(points)))
    return [line for line in lines if line.points]


def drift_chart(lines: Sequence[DriftLine]) -> str:
    """SVG text: change in dB of every region since it was new, over the rounds; 0 is as it was then. Empty without a region."""
    if not lines:
        return ""
    numbers = sorted({number for line in lines for number, _ in line.points})
    values = [value for line in lines for _, value in line.points]
    low, high = min(0.0, *values), max(0.0, *values)
    span = max(high - low, 0.1)

    def place(number: int, value: float) -> tuple[float, float]:
        across = (number - numbers[0]) / max(numbers[-1] - numbers[0], 1)
        up = (value - low) / span
        return _LEFT + across * (_WIDTH - _LEFT - _RIGHT), _HEIGHT - _BOTTOM - up * (_HEIGHT - _BOTTOM - _TOP)

    parts = [f'<svg class="curve" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" aria-label="drift over the rounds">']
    zero = place(numbers[0], 0.0)[1]
    for value in sorted({low, 0.0, high}):
        y = place(numbers[0], value)[1]
        if value and abs(y - zero) < _LINE_PX:
            continue  # its label would lie on the other
        parts.append(f'<line class="axis" x1="{_LEFT}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}"/>')
        shown = f"{value:+.2f}" if value else "0 dB"
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{shown}</text>')
    for number in numbers:
        anchor = "start" if number == numbers[0] else "middle"
        words = str(number) if number else "before"
        parts.append(f'<text x="{place(number, 0)[0]:.1f}" y="{_HEIGHT - 10}" text-anchor="{anchor}">{words}</text>')
    ends = _apart([place(*line.points[-1])[1] for line in lines])
    for line, end in zip(lines, ends, strict=True):
        points = [place(*point) for point in line.points]
        dots = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4"><title>{escape(line.label)}, {_when(number)}: {value:+.2f} dB</title></circle>'
            for (number, value), (x, y) in zip(line.points, points, strict=True)
        )
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        parts.append(f'<g class="{"with" if line.generated else "without"}"><polyline points="{path}"/>{dots}</g>')
        parts.append(f'<text x="{points[-1][0] + 9:.1f}" y="{end + 4:.1f}">{escape(line.label)}</text>')
    return "".join([*parts, "</svg>"])


def _when(number: int) -> str:
    return f"round {number}" if number else "before"


def _apart(heights: Sequence[float]) -> list[float]:
    """The heights, moved as far as labels there need to be read, in the same order from top to bottom."""
    order = sorted(range(len(heights)), key=heights.__getitem__)
    found = list(heights)
    for above, below in itertools.pairwise(order):
        found[below] = max(found[below], found[above] + _LINE_PX)
    over = max(0.0, max(found) - (_HEIGHT - _BOTTOM))
    if over:  # from the bottom upwards again
        found[order[-1]] -= over
        for below, above in zip(order[::-1], order[-2::-1], strict=False):
            found[above] = min(found[above], found[below] - _LINE_PX)
    return found
