"""Mutual nearest neighbours with a ratio test, and matching again inside a known epipolar band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from sceneexpander.frontend.features import Features


@dataclass(frozen=True, slots=True, kw_only=True)
class Matches:
    """M correspondences between two views; each feature occurs at most once. ``ratio`` in [0, 1], smaller is surer."""

    index_a: Int[np.ndarray, " match"]
    index_b: Int[np.ndarray, " match"]
    ratio: Float[np.ndarray, " match"]

    @property
    def count(self) -> int:
        """Number of correspondences."""
        return int(self.index_a.shape[0])

    def select(self, keep: np.ndarray) -> Matches:
        """The subset given by a boolean mask or an index array."""
        return Matches(index_a=self.index_a[keep], index_b=self.index_b[keep], ratio=self.ratio[keep])

    def joined(self, other: Matches, *, offset_a: int = 0, offset_b: int = 0) -> Matches:
        """These and others, whose indices are shifted."""
        return Matches(
            index_a=np.concatenate([self.index_a, other.index_a + offset_a]),
            index_b=np.concatenate([self.index_b, other.index_b + offset_b]),
            ratio=np.concatenate([self.ratio, other.ratio]),
        )

    @classmethod
    def empty(cls) -> Matches:
        """No correspondences."""
        none = np.zeros(0, np.int64)
        return cls(index_a=none, index_b=none, ratio=np.zeros(0))


def similarity(a: Features, b: Features) -> Float[np.ndarray, "described_a described_b"]:
    """Cosine similarity of all descriptor pairs, float32."""
    return a.descriptors @ b.descriptors.T


def mutual_matches(scores: Float[np.ndarray, "feature_a feature_b"], max_ratio: float) -> Matches:
    """Mutual nearest neighbours whose distance ratio to the second nearest is at most ``max_ratio`` in both directions."""
    if min(scores.shape) < 2:
        return Matches.empty()
    columns = np.ascontiguousarray(scores.T)  # reductions along the contiguous axis are several times faster
    b_of_a, a_of_b = scores.argmax(1), columns.argmax(1)
    index_a = np.flatnonzero(a_of_b[b_of_a] == np.arange(len(scores)))
    index_b = b_of_a[index_a]
    best = scores[index_a, index_b]
    rival = np.maximum(_best_other(scores[index_a], index_b), _best_other(columns[index_b], index_a))
    ratio = descriptor_distance(best) / np.maximum(descriptor_distance(rival), 1e-6)
    keep = ratio <= max_ratio
    return Matches(index_a=index_a[keep], index_b=index_b[keep], ratio=ratio[keep].astype(np.float64))


def guided_matches(
    scores: Float[np.ndarray, "described_a described_b"],
    a: Features,
    b: Features,
    fundamental: Float[np.ndarray, "3 3"],
    *,
    band_px: float,
    max_ratio: float,
    max_distance: float,
) -> Matches:
    """Mutual matches among the candidates within ``band_px`` of each other's epipolar lines (x_b^T F x_a = 0).

    The ratio test then compares only with rivals in the band, which brings back matches that repeat elsewhere in the image.
    With few rivals that proves little, so descriptors must also be nearer than ``max_distance`` in absolute terms.
    """
    points_a = np.concatenate([a.pixel_xy[: a.described], np.ones((a.described, 1))], 1)
    points_b = np.concatenate([b.pixel_xy[: b.described], np.ones((b.described, 1))], 1)
    lines_b, lines_a = points_a @ fundamental.T, points_b @ fundamental
    norm_b = np.maximum(np.linalg.norm(lines_b[:, :2], axis=1), 1e-12)  # of the lines in b, one per point of a
    norm_a = np.linalg.norm(lines_a[:, :2], axis=1)
    # Single precision: errors of a few hundredths of a pixel, at half the memory traffic of the full table.
    distance_b = np.abs((lines_b / norm_b[:, None]).astype(np.float32) @ points_b.astype(np.float32).T)
    near = (distance_b < band_px) & (scores > 1 - max_distance**2 / 2)
    index_a, index_b = np.nonzero(near)
    in_band_a = distance_b[index_a, index_b] * norm_b[index_a] < band_px * norm_a[index_b]
    index_a, index_b = index_a[in_band_a], index_b[in_band_a]
    value = scores[index_a, index_b]
    best_a, rival_a = _best_two(index_a, value, a.described)
    best_b, rival_b = _best_two(index_b, value, b.described)
    # Candidates are unique pairs, so "is the best of its row and of its column" is mutual nearest neighbour.
    mutual = (best_a[index_a] == np.arange(len(value))) & (best_b[index_b] == np.arange(len(value)))
    index_a, index_b, value = index_a[mutual], index_b[mutual], value[mutual]
    # A rival further than the candidate threshold was never listed: it is at least that far away.
    rival = np.maximum(np.maximum(rival_a[index_a], rival_b[index_b]), 1 - max_distance**2 / 2)
    ratio = descriptor_distance(value) / np.maximum(descriptor_distance(rival), 1e-6)
    keep = ratio <= max_ratio
    return Matches(index_a=index_a[keep], index_b=index_b[keep], ratio=ratio[keep].astype(np.float64))


def descriptor_distance(cosine: np.ndarray) -> np.ndarray:
    """Euclidean distance of unit descriptors."""
    return np.sqrt(np.maximum(2 - 2 * cosine, 0.0))


def _best_other(rows: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Largest entry per row when column ``best`` is left out (``rows`` is overwritten)."""
    rows[np.arange(len(rows)), best] = -1.0
    return rows.max(1) if len(rows) else np.zeros(0, rows.dtype)


def _best_two(group: np.ndarray, value: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Per group: position of its largest value (-1 if empty) and its second largest value (-1 if none)."""
    order = np.lexsort((-value, group))
    sorted_group = group[order]
    first = np.ones(len(order), bool)
    first[1:] = sorted_group[1:] != sorted_group[:-1]
    best = np.full(groups, -1, np.int64)
    best[sorted_group[first]] = order[first]
    second = np.zeros(len(order), bool)
    second[1:] = first[:-1] & ~first[1:]
    rival = np.full(groups, -1.0, np.float64)
    rival[sorted_group[second]] = value[order[second]]
    return best, rival
