"""Feature tracks: which keypoints of which views show the same point, from pairwise matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sceneexpander.frontend.features import Features
from sceneexpander.frontend.twoview import PairMatches


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracks:
    """T tracks over S views as dense tables (meant for tens of views). ``pixel_xy`` is meaningless where not ``seen``."""

    pixel_xy: Float[np.ndarray, "track view 2"]
    seen: Bool[np.ndarray, "track view"]

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.seen.shape[0])

    def longest(self, count: int) -> Tracks:
        """The ``count`` tracks that most views see; earlier ones first among equals."""
        rows = np.sort(np.argsort(-self.seen.sum(1), kind="stable")[:count])
        return Tracks(pixel_xy=self.pixel_xy[rows], seen=self.seen[rows])


def build_tracks(features: Sequence[Features], pairs: Sequence[PairMatches]) -> Tracks:
    """Join verified matches into tracks, surest first, refusing joins that would give a track two places in one view.

    Keypoints at the same place (SIFT repeats one per dominant orientation) count as one.
    """
    views = len(features)
    node_of, node_view, node_xy = _nodes(features)
    edges = [
        (node_of[pair.view_a][pair.verified.index_a], node_of[pair.view_b][pair.verified.index_b], pair.verified.ratio)
        for pair in pairs
        if pair.verified.count
    ]
    if not edges:
        return Tracks(pixel_xy=np.zeros((0, views, 2)), seen=np.zeros((0, views), bool))
    first, second, ratio = (np.concatenate(column) for column in zip(*edges, strict=True))
    order = np.argsort(ratio, kind="stable")
    parent = list(range(len(node_view)))
    members = [1 << int(view) for view in node_view]  # bit set of the views of a track, kept at its root

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for a, b in zip(first[order].tolist(), second[order].tolist(), strict=True):
        root_a, root_b = root(a), root(b)
        if root_a != root_b and not members[root_a] & members[root_b]:
            parent[root_b] = root_a
            members[root_a] |= members[root_b]
    used = np.unique(np.concatenate([first, second]))
    roots = np.array([root(int(node)) for node in used])
    names, track = np.unique(roots, return_inverse=True)
    pixel_xy, seen = np.zeros((len(names), views, 2)), np.zeros((len(names), views), bool)
    pixel_xy[track, node_view[used]] = node_xy[used]
    seen[track, node_view[used]] = True
    long_enough = seen.sum(1) >= 2
    return Tracks(pixel_xy=pixel_xy[long_enough], seen=seen[long_enough])


def _nodes(features: Sequence[Features]) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """(node of each feature per view, view of each node, pixel of each node); one node per distinct place."""
    node_of: list[np.ndarray] = []
    views: list[np.ndarray] = []
    places: list[np.ndarray] = []
    total = 0
    for view, found in enumerate(features):
        if found.count == 0:
            node_of.append(np.zeros(0, np.int64))
            continue
        place, index = np.unique(found.pixel_xy, axis=0, return_inverse=True)
        node_of.append(index.reshape(-1) + total)
        views.append(np.full(len(place), view))
        places.append(place)
        total += len(place)
    if not places:
        return node_of, np.zeros(0, np.int64), np.zeros((0, 2))
    return node_of, np.concatenate(views), np.concatenate(places)
