"""Colour segments by graph merging.

The criterion is Felzenszwalb and Huttenlocher 2004, "Efficient graph-based image segmentation", eq. 2-4. Instead of visiting
the edges one by one, all components merge along their cheapest edge at once (Boruvka's rounds), which vectorises: about
ten rounds of array operations on a shrinking list of edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Labels = NDArray[np.int32]


@dataclass(slots=True)
class _Graph:
    """A partition of the pixels and the edges between different parts, sorted by colour difference."""

    label: Labels  # (pixel,) component of every pixel
    internal: NDArray[np.float64]  # (component,) largest colour difference inside
    size: NDArray[np.float64]  # (component,) pixels
    a: Labels  # (edge,) components at either end
    b: Labels
    weight: NDArray[np.float32]  # (edge,) ascending


def segment_colours(rgb: NDArray[np.float32], *, tolerances: tuple[float, ...], min_size: int) -> list[Labels]:
    """Partitions of an image, one (height, width) label map per tolerance, finest first; labels count from 0.

    Args:
        rgb: (height, width, 3) in [0, 1].
        tolerances: ascending; larger values merge more (colour difference times pixels). Each partition starts from
            the one before, so the segments are nested.
        min_size: smaller segments join their most similar neighbour.
    """
    height, width = rgb.shape[:2]
    graph = _pixel_graph(cv2.GaussianBlur(rgb, (0, 0), 0.8))
    partitions = []
    for tolerance in tolerances:
        while _merge(graph, _within_tolerance(graph, tolerance)):
            pass
        while _merge(graph, np.minimum(graph.size[graph.a], graph.size[graph.b]) < min_size):
            pass
        partitions.append(graph.label.reshape(height, width))
    return partitions


def _pixel_graph(rgb: NDArray[np.float32]) -> _Graph:
    height, width = rgb.shape[:2]
    index = np.arange(height * width, dtype=np.int32).reshape(height, width)
    ends = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    colours = [(rgb[:, :-1], rgb[:, 1:]), (rgb[:-1], rgb[1:])]
    weight = np.concatenate([np.sqrt(((p - q) ** 2).sum(-1)).ravel() for p, q in colours])
    order = np.argsort(weight, kind="stable")
    a = np.concatenate([p.ravel() for p, _ in ends])[order]
    b = np.concatenate([q.ravel() for _, q in ends])[order]
    pixels = height * width
    return _Graph(
        label=index.ravel(), internal=np.zeros(pixels), size=np.ones(pixels), a=a, b=b, weight=weight[order]
    )


def _within_tolerance(graph: _Graph, tolerance: float) -> NDArray[np.bool_]:
    bound = graph.internal + tolerance / graph.size
    return graph.weight <= np.minimum(bound[graph.a], bound[graph.b])


def _merge(graph: _Graph, allowed: NDArray[np.bool_]) -> bool:
    """Merge every component along its cheapest edge where that edge is allowed; False when nothing merged."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    components = len(graph.size)
    edges = np.arange(len(graph.weight))
    cheapest = np.full(components, len(edges))
    # Edges are sorted, so writing them backwards leaves each component its cheapest one.
    cheapest[graph.b[::-1]] = edges[::-1]
    from_a = np.full(components, len(edges))
    from_a[graph.a[::-1]] = edges[::-1]
    np.minimum(cheapest, from_a, out=cheapest)
    chosen = np.unique(cheapest[cheapest < len(edges)])
    chosen = chosen[allowed[chosen]]
    if not len(chosen):
        return False
    a, b = graph.a[chosen], graph.b[chosen]
    joined = coo_matrix((np.ones(len(chosen), np.int8), (a, b)), shape=(components, components))
    count, renamed = connected_components(joined, directed=False)
    renamed = renamed.astype(np.int32)
    internal, size = np.zeros(count), np.bincount(renamed, weights=graph.size, minlength=count)
    np.maximum.at(internal, renamed, graph.internal)
    np.maximum.at(internal, renamed[a], graph.weight[chosen])
    graph.label, graph.internal, graph.size = renamed[graph.label], internal, size
    graph.a, graph.b = renamed[graph.a], renamed[graph.b]
    between = graph.a != graph.b
    graph.a, graph.b, graph.weight = graph.a[between], graph.b[between], graph.weight[between]
    return True
