"""From partial depth to depth everywhere: sparse interpolation, planes per colour segment, edge-aware smoothing.

All depths here are inverse depths: a plane in space is a linear function of the pixel there.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneexpander.frontend.dense_views import Array64, Image32
from sceneexpander.frontend.segments import Labels


def interpolate_sparse(xy: Array64, value: Array64, shape: tuple[int, int], *, softness_px: float) -> Image32:
    """Inverse-distance interpolation of scattered values; ``softness_px`` blends points closer together than that.

    Evaluated on every fourth pixel and enlarged: the result is smooth anyway. Needs at least one point.
    """
    height, width = shape
    rows, columns = max(2, -(-height // 4)), max(2, -(-width // 4))
    y = (np.arange(rows) + 0.5) * height / rows
    x = (np.arange(columns) + 0.5) * width / columns
    squared_x = (x[:, None] - xy[:, 0]) ** 2
    squared_y = (y[:, None] - xy[:, 1]) ** 2
    squared = (squared_y[:, None] + squared_x[None] + softness_px**2).astype(np.float32)
    weight = 1 / (squared * np.sqrt(squared))
    coarse = (weight @ value.astype(np.float32)) / weight.sum(-1)
    return cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)


def pixels_to_nearest(xy: Array64, shape: tuple[int, int]) -> Image32:
    """Distance of every pixel to the nearest of the given pixels; the image diagonal when there are none."""
    height, width = shape
    if not len(xy):
        return np.full(shape, np.hypot(height, width), np.float32)
    free = np.ones(shape, np.uint8)
    free[xy[:, 1].astype(int), xy[:, 0].astype(int)] = 0
    return cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5)


def smooth_fill(
    value: Image32,
    weight: Image32,
    rgb: Image32,
    *,
    reach_px: float,
    stiffness: float,
    colour_sigma: float,
    rounds: int = 3,
    relaxations: int = 3,
) -> Image32:
    """The image u that minimises ``sum weight (u - value)^2 + stiffness sum exp(-colour step / sigma) (u_p - u_q)^2``.

    First guess by the fast global smoother (Min et al. 2014, "Fast global image smoothing based on weighted least
    squares", eq. 13, with smoothness ``reach_px ** 2``), applied to the weighted values and to the weights: it carries known
    values across large gaps, but blurs where many are known. Line relaxation, rows and columns in turn, then
    settles the guess on the minimum. ``weight`` must be positive.
    """
    across = np.exp(-np.sqrt(((rgb[:, 1:] - rgb[:, :-1]) ** 2).mean(-1)) / colour_sigma).astype(np.float64)
    down = np.exp(-np.sqrt(((rgb[1:] - rgb[:-1]) ** 2).mean(-1)) / colour_sigma).T.astype(np.float64)
    stacked = np.stack([value.astype(np.float64) * weight, weight.astype(np.float64)])
    ones = np.ones(value.shape)
    for k in range(rounds):
        smoothness = 1.5 * 4 ** (rounds - 1 - k) / (4**rounds - 1) * reach_px**2
        stacked = _solve_rows(stacked, ones, smoothness * across)
        stacked = _solve_rows(stacked.transpose(0, 2, 1), ones.T, smoothness * down).transpose(0, 2, 1)
    guess = stacked[0] / stacked[1]
    data, known = weight.astype(np.float64), value.astype(np.float64) * weight
    across, down = stiffness * across, stiffness * down
    for _ in range(relaxations):
        guess = _relax_rows(guess, known, data, across, down.T)
        guess = _relax_rows(guess.T, known.T, data.T, down, across.T).T
    return guess.astype(np.float32)


def _relax_rows(guess: Array64, known: Array64, data: Array64, across: Array64, down: Array64) -> Array64:
    """Solve every row exactly, its neighbouring rows held at ``guess``."""
    right, diagonal = known.copy(), data.copy()
    right[1:] += down * guess[:-1]
    right[:-1] += down * guess[1:]
    diagonal[1:] += down
    diagonal[:-1] += down
    return _solve_rows(right[None], diagonal, across)[0]


def _solve_rows(images: Array64, data: Array64, coupling: Array64) -> Array64:
    """Solve (diag(data) + L) u = f along every row; L is the path Laplacian with weights ``coupling`` (height, width - 1)."""
    from scipy.linalg.lapack import dptsv

    channels, height, width = images.shape
    links = np.zeros((height, width))
    links[:, :-1] = coupling
    diagonal = data + links
    diagonal[:, 1:] += coupling
    # All rows as one system: the link from the end of a row to the start of the next is zero.
    right = np.asfortranarray(images.reshape(channels, -1).T)
    _, _, solved, _ = dptsv(diagonal.ravel(), -links.ravel()[:-1], right, overwrite_b=True)
    return np.ascontiguousarray(solved.T).reshape(channels, height, width)


def segment_planes(
    labels: Labels,
    inverse_depth: Image32,
    weight: Image32,
    limits: tuple[float, float],
    *,
    tolerance: float,
    min_samples: int,
    hypotheses: int = 32,
    most_samples: int = 96,
) -> tuple[Image32, Image32]:
    """Robust plane of each segment, fitted to the pixels with positive weight (random consensus, then least squares).

    Pixels within two pixels of a border vote for the neighbouring segment as well: edges in colour and in matched depth
    rarely coincide exactly.

    Args:
        labels: (height, width) segment of every pixel, from 0.
        inverse_depth: known where ``weight`` > 0.
        limits: (far, near) inverse depths; plane values beyond them do not count.
        tolerance: relative error at which a sample stops supporting a plane.

    Returns:
        (inverse depth of the plane, support in [0, 1]); support is 0 where the segment has no plane.
    """
    segments = int(labels.max()) + 1
    segment, x, y, w, weights = _samples(labels, inverse_depth, weight)
    counts = np.bincount(segment, minlength=segments)
    chosen = np.flatnonzero(counts >= min_samples)
    if not len(chosen):
        return np.ones(labels.shape, np.float32), np.zeros(labels.shape, np.float32)
    starts = np.concatenate([[0], np.cumsum(counts)])[chosen]
    counts = counts[chosen]
    # At most `most_samples` per segment, evenly spaced through its list, in one padded (segment, sample) table.
    taken = np.minimum(counts, most_samples)
    slot = np.arange(most_samples)
    position = starts[:, None] + np.minimum((slot * counts[:, None]) // taken[:, None], counts[:, None] - 1)
    x, y, w = x[position], y[position], w[position]
    weights = weights[position] * (slot < taken[:, None])
    plane, support = _fit_planes(x, y, w, weights, taken, tolerance, hypotheses)

    table = np.zeros((segments, 3))
    table[chosen] = plane
    supports = np.zeros(segments)
    supports[chosen] = support
    height, width = labels.shape
    a, b, c = (table[:, i][labels] for i in range(3))
    filled = a * (np.arange(width) + 0.5) + b * (np.arange(height) + 0.5)[:, None] + c
    inside = (filled >= limits[0]) & (filled <= limits[1])
    score = np.where(inside, supports[labels], 0)
    return np.clip(filled, *limits).astype(np.float32), score.astype(np.float32)


def _samples(
    labels: Labels, inverse_depth: Image32, weight: Image32
) -> tuple[NDArray[np.int64], Array64, Array64, Array64, Array64]:
    """(segment, x, y, inverse depth, weight) of the votes, sorted by segment."""
    rows, columns = np.nonzero(weight > 0)
    height, width = labels.shape
    own = labels[rows, columns]
    segment, index = [own], [np.arange(len(rows))]
    for dy, dx in ((0, 2), (0, -2), (2, 0), (-2, 0)):
        other = labels[np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)]
        crossing = np.flatnonzero(other != own)
        segment.append(other[crossing])
        index.append(crossing)
    all_segments, all_index = np.concatenate(segment).astype(np.int64), np.concatenate(index)
    order = np.argsort(all_segments, kind="stable")
    rows, columns = rows[all_index[order]], columns[all_index[order]]
    return (
        all_segments[order],
        columns.astype(np.float64) + 0.5,
        rows.astype(np.float64) + 0.5,
        inverse_depth[rows, columns].astype(np.float64),
        weight[rows, columns].astype(np.float64),
    )


def _fit_planes(
    x: Array64,
    y: Array64,
    w: Array64,
    weight: Array64,
    taken: NDArray[np.int64],
    tolerance: float,
    hypotheses: int,
) -> tuple[Array64, Array64]:
    """Planes w = a x + b y + c of (segment, sample) tables: ((segment, 3), support of each)."""
    segments = len(x)
    # A fixed stream: the same input gives the same planes, whatever ran before.
    draw = np.random.default_rng(0).random((segments, hypotheses, 3))
    pick = (draw * taken[:, None, None]).astype(np.int64)
    each = np.arange(segments)[:, None, None]
    px, py, pw = x[each, pick], y[each, pick], w[each, pick]
    ux, uy, uw = (p[..., 1] - p[..., 0] for p in (px, py, pw))
    vx, vy, vw = (p[..., 2] - p[..., 0] for p in (px, py, pw))
    area = ux * vy - uy * vx
    flat = np.abs(area) < 1.0  # nearly collinear: no plane
    safe = np.where(flat, 1, area)
    a, b = np.where(flat, 0, (uw * vy - vw * uy) / safe), np.where(flat, 0, (vw * ux - uw * vx) / safe)
    planes = np.stack([a, b, pw[..., 0] - a * px[..., 0] - b * py[..., 0]], -1)
    total = weight.sum(-1)

    def support_of(candidates: Array64) -> tuple[Array64, Array64]:
        """((segment, candidate, sample) truncated weights, (segment, candidate) mean support)."""
        predicted = candidates[..., :1] * x[:, None] + candidates[..., 1:2] * y[:, None] + candidates[..., 2:]
        residual = (predicted - w[:, None]) / (tolerance * w[:, None])
        inlier = np.maximum(0, 1 - residual**2) * weight[:, None]
        return inlier, inlier.sum(-1) / total[:, None]

    _, scores = support_of(planes)
    best = planes[np.arange(segments), scores.argmax(-1)]
    for _ in range(2):
        inlier, score = support_of(best[:, None])
        refined = _weighted_planes(x, y, w, inlier[:, 0] / (tolerance * w) ** 2)
        _, refined_score = support_of(refined[:, None])
        best = np.where(refined_score > score, refined, best)
    _, score = support_of(best[:, None])
    return best, score[:, 0]


def _weighted_planes(x: Array64, y: Array64, w: Array64, weight: Array64) -> Array64:
    """Weighted least-squares planes of (segment, sample) tables, slightly regularised towards constant inverse depth."""
    total = np.maximum(weight.sum(-1, keepdims=True), 1e-12)
    mean_x, mean_y, mean_w = ((weight * v).sum(-1, keepdims=True) / total for v in (x, y, w))
    dx, dy, dw = x - mean_x, y - mean_y, w - mean_w
    share = weight / total
    ridge = 0.5  # squared pixels: bounds the slope of a segment whose samples lie on a line
    xx, yy, xy = (share * dx * dx).sum(-1) + ridge, (share * dy * dy).sum(-1) + ridge, (share * dx * dy).sum(-1)
    xw, yw = (share * dx * dw).sum(-1), (share * dy * dw).sum(-1)
    determinant = xx * yy - xy * xy
    a, b = (xw * yy - yw * xy) / determinant, (yw * xx - xw * xy) / determinant
    return np.stack([a, b, mean_w[:, 0] - a * mean_x[:, 0] - b * mean_y[:, 0]], -1)
