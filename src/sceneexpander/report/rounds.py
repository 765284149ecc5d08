"""What became of every region over the rounds: a heat map of views, the drift since each was new, time and memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from sceneexpander.artifacts.metrics import MetricsRow, ViewMetrics
from sceneexpander.artifacts.page import RoundPage

WORST_DRIFT_DB = 3.0  # has the strongest colour
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP, _RIGHT = 560.0, 220.0, 56.0, 30.0, 14.0, 12.0


@dataclass(frozen=True, slots=True, kw_only=True)
class HeatCell:
    """One view after one round.

    Attributes:
        text: its PSNR; empty: it was not there yet, or has no camera.
        drift_db: change since it was first in the scene; None where there is no number.
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
    """All views after one round, and what the round took; ``label`` says which."""

    label: str
    cells: tuple[HeatCell, ...]
    drift: str
    time: str
    memory: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundsShown:
    """The heat map (``columns`` are views: name, whether generated) and the drift curve as SVG text, empty with one round."""

    columns: tuple[tuple[str, bool], ...]
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
    measured: list[tuple[str, MetricsRow | None, RoundPage | None]] = []
    if before is not None:
        measured.append(("before", before, None))
    measured += [(f"round {item.number}", row, item) for item, row in zip(rounds, rows, strict=True) if row is not None]
    if not any(item is not None for _, _, item in measured):
        return None
    kinds = {view.view_id: view.generated for _, row, _ in measured if row is not None for view in row.views}
    first: dict[str, float] = {}
    shown: list[HeatRow] = []
    drifts: list[tuple[int, float]] = []
    for label, row, page in measured:
        values = {view.view_id: view_psnr(view) for view in row.views} if row is not None else {}
        older = [value - first[view] for view, value in values.items() if value is not None and view in first]
        drift = sum(older) / len(older) if older else None
        for view, value in values.items():
            if value is not None:
                first.setdefault(view, value)
        cells = tuple(_cell(values.get(view), first.get(view)) for view in kinds)
        runs = page.statistics.values() if page is not None else ()
        shown.append(
            HeatRow(
                label=label,
                cells=cells,
                drift="" if drift is None else f"{drift:+.2f} dB",
                time=f"{sum(run.wall_s for run in runs):.0f} s" if runs else "",
                memory=f"{max(run.peak_rss_mb for run in runs):.0f} MB" if runs else "",
            )
        )
        if page is not None and drift is not None:
            drifts.append((page.number, drift))
    columns = tuple((names.get(view, view), generated) for view, generated in kinds.items())
    return RoundsShown(columns=columns, rows=tuple(shown), curve=drift_chart(drifts) if len(drifts) > 1 else "")


def _cell(value: float | None, first: float | None) -> HeatCell:
    if value is None or first is None:
        return HeatCell()
    drift = value - first
    return HeatCell(text=f"{value:.1f}", drift_db=drift, strength=min(abs(drift) / WORST_DRIFT_DB, 1.0))


def drift_chart(drifts: Sequence[tuple[int, float]]) -> str:
    """SVG text: mean change in dB of all views that are older than a round, over the rounds."""
    low = min(0.0, *(value for _, value in drifts))
    high = max(0.0, *(value for _, value in drifts))
    span = max(high - low, 0.1)
    rounds = [number for number, _ in drifts]

    def place(number: int, value: float) -> tuple[float, float]:
        across = (number - rounds[0]) / max(rounds[-1] - rounds[0], 1)
        up = (value - low) / span
        return _LEFT + across * (_WIDTH - _LEFT - _RIGHT), _HEIGHT - _BOTTOM - up * (_HEIGHT - _BOTTOM - _TOP)

    parts = [f'<svg class="curve" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" aria-label="drift over rounds">']
    for value in sorted({low, 0.0, high}):
        y = place(rounds[0], value)[1]
        parts.append(f'<line class="axis" x1="{_LEFT}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:+.2f}</text>')
    points = [place(*item) for item in drifts]
    for (number, value), (x, y) in zip(drifts, points, strict=True):
        anchor = "start" if number == rounds[0] else "end" if number == rounds[-1] else "middle"
        parts.append(f'<text x="{x:.1f}" y="{_HEIGHT - 10}" text-anchor="{anchor}">round {number}</text>')
        title = escape(f"round {number}: {value:+.2f} dB")
        parts.append(f'<g class="without"><circle cx="{x:.1f}" cy="{y:.1f}" r="4"><title>{title}</title></circle></g>')
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return "".join([*parts, f'<g class="without"><polyline points="{line}"/></g></svg>'])
