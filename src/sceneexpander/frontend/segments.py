"""Colour segments by statistical region merging.

The criterion is Nock and Nielsen 2004, "Statistical region merging": two regions merge while their mean colours differ by no
more than the sampling error of regions of their sizes. Means, unlike the cheapest edge between two regions, do not leak
through a soft corner. Instead of visiting the edges one by one, all regions merge along their cheapest edge at once
(Boruvka's rounds), which vectorises: about ten rounds of array operations on a shrinking graph.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Labels = NDArray[np.int32]


@dataclass(slots=True)
class _Graph:
    """A partition of the pixels and which regions touch."""

    label: Labels  # (pixel,) region of every pixel
    colour: NDArray[np.float64]  # (region, 3) sum of the colours
    size: NDArray[np.float64]  # (region,) pixels
    a: NDArray[np.int64]  # (edge,) the smaller region index
    b: NDArray[np.int64]  # (edge,) the larger one


def segment_colours(rgb: NDArray[np.float32], *, tolerances: tuple[float, ...], min_size: int) -> list[Labels]:
    """Partitions of an image, one (height, width) label map per tolerance, finest first; labels count from 0.

    Args:
        rgb: (height, width, 3) in [0, 1].
        tolerances: ascending spreads of colour within a surface; regions A and B merge while their means differ by at most
            ``tolerance * sqrt(1 / |A| + 1 / |B|)``. Each partition starts from the one before: the segments are nested.
        min_size: smaller segments join their most similar neighbour.
    """
    height, width = rgb.shape[:2]
    graph = _pixel_graph(cv2.GaussianBlur(rgb, (0, 0), 0.7))
    partitions = []
    for tolerance in tolerances:
        while _merge(graph, tolerance=tolerance):
            pass
        while _merge(graph, min_size=min_size):
            pass
        partitions.append(graph.label.reshape(height, width))
    return partitions


def _pixel_graph(rgb: NDArray[np.float32]) -> _Graph:
    height, width = rgb.shape[:2]
    index = np.arange(height * width).reshape(height, width)
    return _Graph(
        label=index.ravel().astype(np.int32),
        colour=rgb.reshape(-1, 3).astype(np.float64),
        size=np.ones(height * width),
        a=np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()]),
        b=np.concatenate([index[:, 1:].ravel(), index[1:].ravel()]),
    )


def _merge(graph: _Graph, *, tolerance: float | None = None, min_size: int = 0) -> bool:
    """Merge every region along its cheapest edge where that is allowed; False when nothing merged."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    mean = graph.colour / graph.size[:, None]
    difference = np.sqrt(((mean[graph.a] - mean[graph.b]) ** 2).sum(-1))
    if tolerance is None:
        allowed = np.minimum(graph.size[graph.a], graph.size[graph.b]) < min_size
    else:
        allowed = difference <= tolerance * np.sqrt(1 / graph.size[graph.a] + 1 / graph.size[graph.b])
    candidates = np.flatnonzero(allowed)
    if not len(candidates):
        return False
    regions = len(graph.size)
    order = candidates[np.argsort(difference[candidates], kind="stable")]
    # In ascending order, written backwards: each region keeps its cheapest edge.
    rank = np.arange(len(order))
    cheapest, from_b = np.full(regions, len(order)), np.full(regions, len(order))
    cheapest[graph.a[order[::-1]]] = rank[::-1]
    from_b[graph.b[order[::-1]]] = rank[::-1]
    np.minimum(cheapest, from_b, out=cheapest)
    chosen = order[np.unique(cheapest[cheapest < len(order)])]
    a, b = graph.a[chosen], graph.b[chosen]
    joined = coo_matrix((np.ones(len(chosen), np.int8), (a, b)), shape=(regions, regions))
    count, renamed = connected_components(joined, directed=False)
    graph.label = renamed[graph.label].astype(np.int32)
    graph.size = np.bincount(renamed, weights=graph.size, minlength=count).astype(np.float64)
    graph.colour = np.stack([np.bincount(renamed, weights=c, minlength=count) for c in graph.colour.T], axis=-1)
    a, b = renamed[graph.a].astype(np.int64), renamed[graph.b].astype(np.int64)
    between = a != b
    a, b = a[between], b[between]
    pair = np.unique(np.minimum(a, b) * count + np.maximum(a, b))
    graph.a, graph.b = pair // count, pair % count
    return True
