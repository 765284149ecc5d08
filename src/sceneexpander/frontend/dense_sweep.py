"""Photometric cost of depth hypotheses: zero-mean normalised cross-correlation of warped source views."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneexpander.frontend.dense_views import Array64, Image32, Source, WorkView
from sceneexpander.frontend.sgm import COST_SCALE, Volume16

NEUTRAL_COST = 0.75  # of a hypothesis outside a source's frame: worse than a fair match, better than a clash
WORST_COST = 1.2
_VARIANCE_FLOOR = 2e-4  # squared grey levels: below it a window has no texture worth correlating
_PAD = 2  # pixels of repeated border around a source, so that windows at its edge see no artificial step
_OUTSIDE = -1.0  # grey value that marks pixels outside the source


class WindowMatcher:
    """Correlates square windows of one reference image with warped sources. Holds scratch images: one per thread."""

    def __init__(self, reference: WorkView, views: list[WorkView], sources: list[Source], window: int) -> None:
        self._grey = reference.grey
        self._window = (window, window)
        self._sources = sources
        self._padded = [
            cv2.copyMakeBorder(views[s.view].grey, _PAD, _PAD, _PAD, _PAD, cv2.BORDER_REPLICATE) for s in sources
        ]
        self._mean = cv2.boxFilter(self._grey, -1, self._window)
        variance = cv2.sqrBoxFilter(self._grey, cv2.CV_32F, self._window) - self._mean**2
        self._inverse_std = (1 / np.sqrt(np.maximum(variance, 0) + _VARIANCE_FLOOR)).astype(np.float32)
        height, width = self._grey.shape
        self._warped, self._product, self._square = (np.empty((height, width), np.float32) for _ in range(3))
        self._map_x, self._map_y, self._map_z = (np.empty((height, width), np.float32) for _ in range(3))
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        self._rays = [self._linear_forms(source, x, y) for source in sources]

    @staticmethod
    def _linear_forms(source: Source, x: Array64, y: Array64) -> list[Image32]:
        return [(row[0] * x + row[1] * y + row[2]).astype(np.float32) for row in source.matrix]

    def plane_cost(self, inverse_depth: float) -> Image32:
        """(height, width) cost of the fronto-parallel plane at this inverse depth, over the better half of the sources."""
        height, width = self._grey.shape
        costs = []
        for source, padded, rays in zip(self._sources, self._padded, self._rays, strict=True):
            homography = source.matrix.copy()
            homography[:, 2] += inverse_depth * source.shift
            # OpenCV counts pixels from their centres; the padded source starts _PAD pixels earlier.
            into_padded = np.array([[1, 0, _PAD - 0.5], [0, 1, _PAD - 0.5], [0, 0, 1]])
            from_index = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
            cv2.warpPerspective(
                padded,
                into_padded @ homography @ from_index,
                (width, height),
                self._warped,
                cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                cv2.BORDER_CONSTANT,
                _OUTSIDE,
            )
            corner_z = rays[2][:: height - 1, :: width - 1] + inverse_depth * source.shift[2]
            if corner_z.min() <= 0:
                self._warped[rays[2] + np.float32(inverse_depth * source.shift[2]) <= 0] = _OUTSIDE
            costs.append(self._correlate())
        return _mean_of_better_half(costs)

    def surface_cost(self, inverse_depth: Image32) -> Image32:
        """(height, width) cost of a hypothesis that varies from pixel to pixel."""
        costs = []
        for source, padded, rays in zip(self._sources, self._padded, self._rays, strict=True):
            for form, shift, out in zip(rays, source.shift, (self._map_x, self._map_y, self._map_z), strict=True):
                np.multiply(inverse_depth, np.float32(shift), out=out)
                out += form
            behind = self._map_z <= 1e-6
            self._map_z[behind] = 1
            for image in (self._map_x, self._map_y):
                image /= self._map_z
                image += np.float32(_PAD - 0.5)
            self._map_x[behind] = -10
            cv2.remap(padded, self._map_x, self._map_y, cv2.INTER_LINEAR, self._warped, cv2.BORDER_CONSTANT, _OUTSIDE)
            costs.append(self._correlate())
        return _mean_of_better_half(costs)

    def _correlate(self) -> Image32:
        """clip(1 - ZNCC) of the reference with the warped image, `NEUTRAL_COST` outside the source."""
        outside = self._warped < 0
        np.maximum(self._warped, 0, out=self._warped)
        np.multiply(self._warped, self._grey, out=self._product)
        mean = cv2.boxFilter(self._warped, -1, self._window)
        square = cv2.sqrBoxFilter(self._warped, cv2.CV_32F, self._window, self._square)
        covariance = cv2.boxFilter(self._product, -1, self._window)
        covariance -= np.multiply(mean, self._mean, out=self._product)
        covariance *= self._inverse_std
        mean *= mean
        square -= mean
        np.maximum(square, 0, out=square)
        square += np.float32(_VARIANCE_FLOOR)
        np.sqrt(square, out=square)
        covariance /= square
        cost = np.subtract(1, covariance, out=covariance)
        np.clip(cost, 0, WORST_COST, out=cost)
        cost[outside] = NEUTRAL_COST
        return cost


def _mean_of_better_half(costs: list[Image32]) -> Image32:
    """Mean of the smaller half (rounded up) per pixel: a source that does not see the surface is outvoted."""
    if len(costs) == 1:
        return costs[0]
    if len(costs) == 2:
        return np.minimum(costs[0], costs[1])
    if len(costs) == 3:
        total = costs[0] + costs[1]
        total += costs[2]
        total -= np.maximum(np.maximum(costs[0], costs[1]), costs[2])
        total *= np.float32(0.5)
        return total
    # Whole images are compared with each other: many times faster than sorting every pixel's few costs.
    keep = (len(costs) + 1) // 2
    least: list[Image32] = []  # ascending, per pixel
    for cost in costs:
        left = cost
        for place, best in enumerate(least):
            left, least[place] = np.maximum(best, left), np.minimum(best, left)
        if len(least) < keep:
            least.append(left)
    total = least[0] + least[1]
    for cost in least[2:]:
        total += cost
    total /= np.float32(keep)
    return total


def sweep_planes(
    matcher: WindowMatcher, planes: Array64, expected: Image32 | None, *, prior: float, prior_range: float
) -> Volume16:
    """Cost volume (height, plane, width) in units of 1 / `COST_SCALE`.

    ``expected`` is a weak belief in log inverse depth: a plane pays up to ``prior`` for being ``prior_range`` away from it.
    """
    first = matcher.plane_cost(float(planes[0]))
    height, width = first.shape
    volume = np.empty((height, len(planes), width), np.int16)
    for k, plane in enumerate(planes):
        cost = first if k == 0 else matcher.plane_cost(float(plane))
        if expected is not None:
            distance = np.abs(expected - np.float32(np.log(plane)))
            distance *= np.float32(prior / prior_range)
            cost += np.minimum(distance, np.float32(prior), out=distance)
        cost *= np.float32(COST_SCALE)
        volume[:, k] = cost
    return volume


def sweep_offsets(matcher: WindowMatcher, base: Image32, offsets: Array64) -> tuple[Volume16, NDArray[np.float32]]:
    """Cost volume of the surface ``base`` (inverse depth) moved by each offset, and the hypotheses (height, offset, width)."""
    hypotheses = base[:, None, :] + offsets.astype(np.float32)[None, :, None]
    np.maximum(hypotheses, np.float32(1e-6) * np.float32(np.median(base)), out=hypotheses)
    volume = np.empty(hypotheses.shape, np.int16)
    for k in range(len(offsets)):
        cost = matcher.surface_cost(np.ascontiguousarray(hypotheses[:, k]))
        cost *= np.float32(COST_SCALE)
        volume[:, k] = cost
    return volume, hypotheses
