"""What straight lines say about the focal length without any match between views.

Rooms and buildings are full of lines along three orthogonal directions. Where the lines of one direction meet is its vanishing point, and
three vanishing points of orthogonal directions tie the focal length down. Per view, line segments are found and the box (three
orthogonal directions) that explains most of their length is searched for at every focal length of a grid; over the views of a set that
share a focal the shares explained are added up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.frontend.features import grey_u8

Array = NDArray[np.float64]

FOCAL_GRID: tuple[float, ...] = tuple(float(x) for x in np.geomspace(0.3, 3.0, 30))
_LONG_SIDE_PX = 1024  # larger images are scaled down to this before lines are looked for
_MIN_LENGTH = 0.03  # of the long side
_MOST_PIECES, _MOST_SEGMENTS = 800, 250  # the longest are kept, before and after joining
_JOIN_DEG, _JOIN_ACROSS, _JOIN_ALONG = 1.5, 0.002, 0.03  # of the long side, for pieces of one line
_TOLERANCE_DEG = 2.0  # between a segment and the direction to its vanishing point
_FINE_DEG = 1.2  # the same after the search
_SAMPLES = 1000  # triples of segments drawn, before those that name one twice are dropped
_HYPOTHESES = 250  # per focal length of the grid
_REFINED = 3  # best hypotheses that are refined
_MIN_SEGMENTS = 12
_BOOTSTRAPS = 100
_SURE_SIGMA = 0.15  # views whose own focal is less certain do not speak about how far views are apart
_LEAST_SIGMA = 0.04  # lens distortion, a principal point that is not in the middle
_OPTIMISM = 1.3  # segments are not independent of each other


@dataclass(frozen=True, slots=True, kw_only=True)
class Segments:
    """Straight line segments of one view, in long sides from the middle of the picture."""

    start: Array  # (N, 2)
    end: Array  # (N, 2)

    @property
    def count(self) -> int:
        """Number of segments."""
        return len(self.start)

    @property
    def length(self) -> Array:
        """(N,) in long sides."""
        return np.linalg.norm(self.end - self.start, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class FocalEvidence:
    """A focal length that the lines of a set of views agree on.

    Attributes:
        focal_ratio: over the long side.
        sigma: of its logarithm; from drawing the segments again, and from how far the views are apart.
        per_view: (focal, sigma) of each view alone; None where there are too few lines.
        focals: the grid.
        curve: (focal,) mean over the views of the share of line length explained.
    """

    focal_ratio: float
    sigma: float
    per_view: tuple[tuple[float, float] | None, ...]
    focals: Array
    curve: Array


def find_segments(image: Float[Tensor, "3 height width"]) -> Segments:
    """The longest straight segments of a picture; pieces of one line are joined."""
    grey = grey_u8(image.detach().cpu().numpy())
    scale = min(1.0, _LONG_SIDE_PX / max(grey.shape))
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    if found is None:
        return Segments(start=np.zeros((0, 2)), end=np.zeros((0, 2)))
    height, width = grey.shape
    lines = found.reshape(-1, 4).astype(np.float64) + 0.5  # pixel centres are at .5
    lines = (lines - np.array([width, height, width, height]) / 2) / max(height, width)
    lines = lines[np.linalg.norm(lines[:, 2:] - lines[:, :2], axis=1) > 0.4 * _MIN_LENGTH]
    lines = _joined(lines)
    length = np.linalg.norm(lines[:, 2:] - lines[:, :2], axis=1)
    keep = np.argsort(-length, kind="stable")[:_MOST_SEGMENTS]
    lines = lines[keep][length[keep] >= _MIN_LENGTH]
    return Segments(start=lines[:, :2], end=lines[:, 2:])


def _joined(lines: Array) -> Array:
    """Pieces of one straight line as one segment: the longest piece gives the direction, others extend it."""
    length = np.linalg.norm(lines[:, 2:] - lines[:, :2], axis=1)
    order = np.argsort(-length, kind="stable")[:_MOST_PIECES]
    lines, length = lines[order], length[order]
    seeds = min(len(lines), 2 * _MOST_SEGMENTS)
    start, along = lines[:, :2], (lines[:, 2:] - lines[:, :2]) / length[:, None]
    offset = lines.reshape(1, -1, 2, 2) - start[:seeds, None, None]  # (seed, piece, end, 2)
    axis = along[:seeds, None]
    parallel = np.abs(along[:, 0] * axis[..., 1] - along[:, 1] * axis[..., 0]) < np.sin(np.deg2rad(_JOIN_DEG))
    axis = axis[:, :, None]
    across = np.abs(offset[..., 0] * axis[..., 1] - offset[..., 1] * axis[..., 0]).max(-1)
    alike = parallel & (across < _JOIN_ACROSS)
    free = np.ones(len(lines), bool)
    joined = []
    for k in range(seeds):
        if not free[k]:
            continue
        free[k] = False
        low, high = 0.0, float(length[k])
        pieces = np.flatnonzero(alike[k] & free)
        position = offset[k, pieces] @ along[k]
        nearest, farthest = position.min(1, initial=np.inf), position.max(1, initial=-np.inf)
        while len(pieces):
            close = (nearest < high + _JOIN_ALONG) & (farthest > low - _JOIN_ALONG)
            if not close.any():
                break
            free[pieces[close]] = False
            low, high = min(low, float(nearest[close].min())), max(high, float(farthest[close].max()))
            pieces, nearest, farthest = pieces[~close], nearest[~close], farthest[~close]
        joined.append(np.concatenate([start[k] + low * along[k], start[k] + high * along[k]]))
    return np.stack(joined) if joined else np.zeros((0, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lines:
    """Segments in the form the search needs."""

    middle: Array  # (N, 2)
    step: Array  # (N, 2), unit
    line: Array  # (N, 3): a x + b y + c = 0
    weight: Array  # (N,), sums to one
    samples: NDArray[np.int64]  # (hypothesis, 3)


def _lines(segments: Segments) -> _Lines | None:
    if segments.count < _MIN_SEGMENTS:
        return None
    middle = (segments.start + segments.end) / 2
    step = (segments.end - segments.start) / segments.length[:, None]
    normal = np.stack([-step[:, 1], step[:, 0]], -1)
    line = np.concatenate([normal, -(normal * middle).sum(1, keepdims=True)], 1)
    weight = np.minimum(segments.length, 0.3)
    weight = weight / weight.sum()
    rng = np.random.default_rng(0)
    samples = rng.choice(segments.count, (_SAMPLES, 3), p=weight)
    ordered = np.sort(samples, axis=1)
    samples = samples[(ordered[:, 1:] != ordered[:, :-1]).all(1)]
    return _Lines(middle=middle, step=step, line=line, weight=weight, samples=samples)


def _off(lines: _Lines, directions: Array, focal: float) -> Array:
    """(..., N): squared sine of the angle between every segment and the way to the vanishing point of each direction (..., 3)."""
    point = directions * np.array([focal, focal, 1.0])
    way_x = point[..., 0:1] - point[..., 2:3] * lines.middle[:, 0]
    way_y = point[..., 1:2] - point[..., 2:3] * lines.middle[:, 1]
    cross = way_x * lines.step[:, 1] - way_y * lines.step[:, 0]
    return cross * cross / np.maximum(way_x * way_x + way_y * way_y, 1e-18)


def _share(lines: _Lines, frames: Array, focal: float, tolerance_deg: float) -> Array:
    """(...): weighted share of the segments that frames (..., 3, 3) with directions in columns explain."""
    off = _off(lines, np.swapaxes(frames, -1, -2), focal).min(-2)
    return np.maximum(0.0, 1 - off / np.sin(np.deg2rad(tolerance_deg)) ** 2) @ lines.weight


def _hypotheses(lines: _Lines, focal: float, most: int) -> Array:
    """Frames (H, 3, 3) from triples of segments, best first."""
    samples = lines.samples[:most]
    normals = lines.line * np.array([focal, focal, 1.0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.cross(normals[samples[:, 0]], normals[samples[:, 1]])
    second = np.cross(first, normals[samples[:, 2]])
    size_first, size_second = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
    usable = (size_first > 1e-6) & (size_second > 1e-9)
    first, second = first[usable] / size_first[usable, None], second[usable] / size_second[usable, None]
    frames = np.stack([first, second, np.cross(first, second)], -1)
    scores = _share(lines, frames, focal, _TOLERANCE_DEG)
    return frames[np.argsort(-scores, kind="stable")]


def _search(lines: _Lines, focal: float, start: Array | None) -> tuple[Array, float]:
    """The best frame at a focal, and its share at the fine tolerance; ``start`` is tried, too."""
    frames = _hypotheses(lines, focal, _HYPOTHESES)[:_REFINED]
    if start is not None:
        frames = np.concatenate([start[None], frames])
    best, best_score = np.eye(3), -1.0
    for candidate in frames:
        frame = _refined(lines, candidate, focal)
        score = float(_share(lines, frame, focal, _FINE_DEG))
        if score > best_score:
            best, best_score = frame, score
    return best, best_score


def _refined(lines: _Lines, frame: Array, focal: float) -> Array:
    """Turned a little so that the segments of each direction point at its vanishing point better."""
    limit = np.sin(np.deg2rad(_TOLERANCE_DEG)) ** 2
    normals = lines.line * np.array([focal, focal, 1.0])
    for _ in range(4):
        off = _off(lines, frame.T, focal)  # (3, N)
        axis = off.argmin(0)
        close = np.maximum(0.0, 1 - off[axis, np.arange(len(axis))] / limit)
        direction = frame[:, axis].T  # (N, 3)
        point = direction * np.array([focal, focal, 1.0])
        way = np.linalg.norm(point[:, :2] - point[:, 2:] * lines.middle, axis=1)
        # residual = sine of the angle = normal . direction / |way|; a small turn w changes the direction by w x direction.
        rows = np.cross(direction, normals) / np.maximum(way, 1e-9)[:, None]
        residual = (direction * normals).sum(1) / np.maximum(way, 1e-9)
        weight = lines.weight * close
        matrix = (rows * weight[:, None]).T @ rows + 1e-9 * np.eye(3)
        turn = -np.linalg.solve(matrix, (rows * weight[:, None]).T @ residual)
        angle = float(np.linalg.norm(turn))
        if angle > 0.1:
            turn *= 0.1 / angle
        frame = cv2.Rodrigues(turn)[0] @ frame
        if angle < 1e-5:
            break
    return frame


def _fit(lines: _Lines, frame: Array, focal: float) -> Array:
    """(N,) in [0, 1]: how well a frame explains each segment."""
    off = _off(lines, frame.T, focal).min(0)
    return np.maximum(0.0, 1 - off / np.sin(np.deg2rad(_FINE_DEG)) ** 2)


def vanishing_focal(images: Sequence[Tensor] | Tensor) -> FocalEvidence | None:
    """The focal length, in long sides, that the lines of views of one lens agree on; None where they say nothing.

    Args:
        images: one or more pictures (3, height, width), RGB in [0, 1]; the sizes may differ. Principal points are the middles.
    """
    lines = [_lines(find_segments(image)) for image in images]
    grids = [None if view is None else _Grid.make(view) for view in lines]
    useful = [grid for grid in grids if grid is not None]
    if not useful:
        return None
    focals = np.array(FOCAL_GRID)
    curve = np.mean([grid.share @ grid.weight for grid in useful], axis=0)
    if int(curve.argmax()) in (0, len(focals) - 1):
        return None
    middle = _peak(curve, focals)
    drawn = [grid.drawn() for grid in useful]
    spread = _spread(np.mean(drawn, axis=0), middle, focals)
    alone: list[tuple[float, float] | None] = []
    for grid in grids:
        own = None if grid is None else _peak(grid.share @ grid.weight, focals)
        alone.append(
            None
            if grid is None or own is None
            else (own, float(np.hypot(_LEAST_SIGMA, _spread(grid.drawn(), own, focals))))
        )
    sure = [(np.log(own / middle), sigma) for own, sigma in filter(None, alone) if sigma < _SURE_SIGMA]
    apart = 0.0
    if len(sure) > 1:
        off, weight = np.array([s[0] for s in sure]), np.array([1 / s[1] ** 2 for s in sure])
        apart = float(np.sqrt((weight @ off**2) / weight.sum() / len(sure)))
    return FocalEvidence(
        focal_ratio=middle,
        sigma=float(np.sqrt(_LEAST_SIGMA**2 + spread**2 + apart**2)),
        per_view=tuple(alone),
        focals=focals,
        curve=curve,
    )


def _spread(drawn: Array, middle: float, focals: Array) -> float:
    """Root mean square of the logarithm of the peaks of drawn curves (draw, focal) about ``middle``."""
    peaks = np.array([_peak(row, focals) for row in drawn])
    return _OPTIMISM * float(np.sqrt(np.mean(np.log(peaks / middle) ** 2)))


def _peak(curve: Array, focals: Array) -> float:
    """The focal of the highest value, between grid points by a parabola."""
    k = int(curve.argmax())
    if k in (0, len(curve) - 1):
        return float(focals[k])
    left, here, right = curve[k - 1 : k + 2]
    bend = left - 2 * here + right
    step = 0.0 if bend >= 0 else 0.5 * (left - right) / bend
    return float(np.exp(np.log(focals[k]) + step * np.log(focals[1] / focals[0])))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Grid:
    """How well every segment of one view is explained at every focal of the grid."""

    share: Array  # (focal, N)
    weight: Array  # (N,)

    @classmethod
    def make(cls, lines: _Lines) -> _Grid:
        found: list[tuple[Array, float]] = []
        for focal in FOCAL_GRID:
            found.append(_search(lines, focal, found[-1][0] if found else None))
        for k in range(len(FOCAL_GRID) - 2, -1, -1):  # what was found late may be better earlier, too
            frame = _refined(lines, found[k + 1][0], FOCAL_GRID[k])
            score = float(_fit(lines, frame, FOCAL_GRID[k]) @ lines.weight)
            if score > found[k][1]:
                found[k] = (frame, score)
        share = np.stack([_fit(lines, frame, focal) for (frame, _), focal in zip(found, FOCAL_GRID, strict=True)])
        return cls(share=share, weight=lines.weight)

    def drawn(self) -> Array:
        """(draw, focal): the curve when the segments are drawn again."""
        weight = self.weight * np.random.default_rng(0).poisson(1.0, (_BOOTSTRAPS, len(self.weight)))
        return (weight / np.maximum(weight.sum(1, keepdims=True), 1e-9)) @ self.share.T
