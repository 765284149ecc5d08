"""Dense depth of posed views by classical multi-view stereo, with a calibrated probability that it is right.

Per view: plane sweep over inverse depth (`dense_sweep`), semi-global matching (`sgm`), per-pixel refinement; then a check
across views (`dense_check`); then planes per colour segment and edge-aware smoothing (`fill`), which believe the checked pixels,
until every pixel has a depth; and from all that evidence how likely each depth is right (`confidence`). Views that cannot be
matched (no pose, no sparse points, pure rotation, no partner) get the interpolation of what is known, and no confidence.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from sceneexpander.errors import UserError
from sceneexpander.frontend.confidence import confidence_features, shipped_model
from sceneexpander.frontend.dense_check import Agreement, check_view, without_small_parts
from sceneexpander.frontend.dense_sweep import WORST_COST, WindowMatcher, sweep_offsets, sweep_planes
from sceneexpander.frontend.dense_views import (
    Image32,
    WorkView,
    choose_sources,
    inverse_depth_range,
    plane_inverse_depths,
    prepare_views,
    visible_depths,
)
from sceneexpander.frontend.fill import interpolate_sparse, pixels_to_nearest, segment_planes, smooth_fill
from sceneexpander.frontend.segments import segment_colours
from sceneexpander.frontend.sgm import COST_SCALE, aggregate, best_hypothesis
from sceneexpander.frontend.sparse_points import SparsePoints
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.ranges import Range, Share, Weight, check_ranges

Result = TypeVar("Result")
MOST_PENALTY = 0.8

_FULL_SIZE_PX = 320.0  # long side for which the pixel constants below were tuned


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseConfig:
    """Constants of the dense matcher. Lengths in pixels are at the working resolution."""

    # long side at which matching runs; smaller images are matched as they are
    work_px: Annotated[int, Range(16, 4096)] = 336
    threads: Annotated[int, Range(1, 256)] = 2  # reference views worked on at the same time; does not change the result
    planes: Annotated[int, Range(2, 1024)] = 96  # most depth hypotheses of the sweep
    # fewer planes are used where this step in the widest source needs fewer
    plane_step_px: Annotated[float, Range(0, 100, low_open=True)] = 0.75
    # farthest plane: this over the 98th percentile of sparse depth
    far_factor: Annotated[float, Range(0, 1, low_open=True)] = 0.6
    # nearest plane: this over the 2nd percentile; what is near often has no point
    near_factor: Annotated[float, Range(1, 1000)] = 4.0
    sources: Annotated[int, Range(1, 100)] = 4  # other views matched against each view, at most
    min_parallax_px: Annotated[float, Range(0, 1000)] = 0.25  # sources with less motion per 10 % of depth are not used
    window: Annotated[int, Range(3, 63)] = 7  # side of the correlation window
    prior: Annotated[float, Range(0, 0.8)] = 0.15  # most that a plane pays for contradicting the sparse interpolation
    prior_range: Annotated[float, Range(0, 100, low_open=True)] = 0.7  # log-depth distance at which it pays that
    penalty_near: Annotated[float, Range(0, 1)] = 0.04  # semi-global matching: one hypothesis further
    penalty_jump: Annotated[float, Range(0, 0.8)] = 0.5  # more than one further, on an even surface
    jump_contrast: Annotated[float, Range(0, 10_000)] = 12.0  # lowers the jump penalty across grey-level edges
    # aggregated cost within which another plane counts as nearly as good
    ambiguity_margin: Annotated[float, Range(0, 1.5)] = 0.6
    # window of the refinement, which follows the surface and can be smaller
    refine_window: Annotated[int, Range(3, 63)] = 5
    refine_offsets: Annotated[int, Range(3, 101)] = 7  # hypotheses around the first result
    refine_reach: Annotated[float, Range(0, 10, low_open=True)] = 1.2  # the outermost of them, in planes
    # cross-view check: largest distance after going there and back
    reprojection_px: Annotated[float, Range(0, 1000, low_open=True)] = 1.5
    depth_tolerance: Annotated[float, Range(0, 1, low_open=True)] = 0.04  # and largest relative difference of depth
    max_cost: Annotated[float, Range(0, 2)] = 0.6  # a checked pixel must match better than this
    # smaller checked or confident islands are dropped (at 320 pixels; scaled by area)
    min_part_px: Annotated[int, Range(0, 1_000_000)] = 20
    min_confidence: Share = 0.6  # probability of being within 5 % from which a pixel counts as confident
    # colour segments, fine to coarse
    segment_tolerances: tuple[Annotated[float, Range(0, 255, low_open=True)], ...] = (0.8, 2.0, 4.0)
    min_segment_px: Annotated[int, Range(1, 1_000_000)] = 40  # smallest segment (at 320 pixels; scaled by area)
    # relative error at which a sample stops supporting a segment's plane
    plane_tolerance: Annotated[float, Range(0, 10, low_open=True)] = 0.1
    min_plane_support: Share = 0.6  # planes with less support are not used
    # weight of a fully supported plane in the final fill, per scale
    plane_weights: tuple[Annotated[float, Range(0, 1e6)], ...] = (0.2, 0.1, 0.04)
    # reach of the final fill as a share of the long side
    smooth_reach: Annotated[float, Range(0, 1, low_open=True)] = 0.035
    stiffness: Annotated[float, Range(0, 1e6, low_open=True)] = 4.0  # smoothness of the final fill against weights of 1
    colour_sigma: Annotated[float, Range(0, 10, low_open=True)] = 0.025  # colour step that stops the final fill
    weight_agreed: Weight = 1.0  # checked, two or more other views agree
    weight_checked: Weight = 0.6  # checked, one other view agrees
    weight_raw: Weight = 0.001  # matched but not checked
    # of all sparse points of a view together: many stand close and speak for little around them
    weight_points: Weight = 3000.0
    weight_point: Weight = 60.0  # most of a single one: it speaks for the plain area around it, too
    # sparse points this far (log depth) from checked pixels around them are dropped
    point_conflict: Annotated[float, Range(0, 100)] = 0.1
    weight_interpolation: Annotated[float, Range(1e-9, 1e6)] = 0.0015  # interpolation of the sparse points

    def __post_init__(self) -> None:
        check_ranges(self)
        # Path costs of eight directions are added up in 16 bits.
        if self.prior + self.penalty_jump > MOST_PENALTY:
            total = f"{self.prior} + {self.penalty_jump}"
            raise UserError(
                f"and prior add up to {total}, must be at most {MOST_PENALTY} together", where="penalty_jump"
            )
        if not self.segment_tolerances or len(self.segment_tolerances) != len(self.plane_weights):
            counts = f"{len(self.plane_weights)} weights for {len(self.segment_tolerances)} tolerances"
            raise UserError(f"holds {counts}, must hold one for each", where="plane_weights")


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseDepth:
    """Depth everywhere and how far to believe it.

    ``evidence`` holds `sceneexpander.geometry.priors.EVIDENCE_CHANNELS`, in that order. Values of views that could not be
    matched: agreeing, parallax, plane and gap 0, cost 1.2, ambiguity 1. Pixel lengths are in pixels of the given images.
    """

    depth: Float[Tensor, "view height width"]  # z-depth in the scale of the poses, > 0 everywhere
    confidence: Float[Tensor, "view height width"]  # probability that the depth is within 5 % of the truth; 0 unmatched
    confident: Bool[Tensor, "view height width"]  # where that is at least `DenseConfig.min_confidence`
    evidence: Float[Tensor, "view channel height width"]


@dataclass(frozen=True, slots=True)
class _Filled:
    """Final result of one view, at the working resolution."""

    depth: Image32
    confidence: Image32
    evidence: NDArray[np.float32]  # (channel, height, width); pixel lengths are those of the working resolution


@dataclass(slots=True)
class _Matched:
    """Raw result of matching one view, at the working resolution."""

    inverse_depth: Image32
    cost: Image32
    ambiguity: Image32


def dense_depth(
    images: Float[Tensor, "view 3 height width"],
    cameras: Cameras,
    sparse: SparsePoints,
    config: DenseConfig,
    *,
    posed: Bool[Tensor, "view"] | None = None,
) -> DenseDepth:
    """Depth of every pixel of every view, from images, cameras and sparse points in the same world.

    Args:
        images: RGB in [0, 1].
        cameras: those of ``images``; poses of views that are not ``posed`` are ignored.
        sparse: triangulated points; may be empty.
        posed: False for views whose pose is only a placeholder; all posed by default.

    Raises:
        ValueError: shapes that do not belong together.
    """
    views, matched, interpolated, limits = _match_views(images, cameras, sparse, config, posed)
    depths = [None if m is None else np.reciprocal(m.inverse_depth) for m in matched]

    def finish(s: int) -> _Filled:
        agreement = None if depths[s] is None else _agreement(views, depths, s, config)
        return _fill_view(views, s, matched[s], agreement, interpolated[s], limits[s], config)

    finished = _each(finish, len(views), config.threads)
    return _assemble(finished, (images.shape[-2], images.shape[-1]))


def _match_views(
    images: Float[Tensor, "view 3 height width"],
    cameras: Cameras,
    sparse: SparsePoints,
    config: DenseConfig,
    posed: Bool[Tensor, "view"] | None,
) -> tuple[list[WorkView], list[_Matched | None], list[Image32], list[tuple[float, float]]]:
    """(views at the working resolution, raw matches, interpolations of the points, limits of inverse depth)."""
    count = images.shape[0]
    height, width = images.shape[-2:]
    if (len(cameras), cameras.height, cameras.width) != (count, height, width):
        shown = f"{len(cameras)} cameras of {cameras.height} x {cameras.width}"
        raise ValueError(f"{count} images of {height} x {width} pixels, {shown}")
    is_posed = np.ones(count, bool) if posed is None else posed.cpu().numpy().astype(bool)
    scale = min(1.0, config.work_px / max(height, width))
    size = (max(2, round(height * scale)), max(2, round(width * scale)))
    views = prepare_views(images, cameras, sparse, is_posed, size=size)
    limits = [_limits(views, s, config) for s in range(count)]
    interpolated = [_interpolation(views, s, limits) for s in range(count)]

    def match(s: int) -> _Matched | None:
        return _match_view(views, s, limits[s], interpolated[s], config)

    return views, _each(match, count, config.threads), interpolated, limits


def _agreement(views: list[WorkView], depths: list[Image32 | None], s: int, config: DenseConfig) -> Agreement:
    """What the other views say about the raw depth of a view."""
    return check_view(views, depths, s, reprojection_px=config.reprojection_px, depth_tolerance=config.depth_tolerance)


def _checked(matched: _Matched, agreement: Agreement, config: DenseConfig) -> NDArray[np.bool_]:
    """Pixels of a view that match well and that another view confirms; small islands are chance."""
    checked = (agreement.agreeing >= 1) & (matched.cost < config.max_cost)
    checked &= agreement.parallax > config.min_parallax_px
    area = (max(checked.shape) / _FULL_SIZE_PX) ** 2
    return without_small_parts(checked, max(1, round(config.min_part_px * area)))


def checked_share(
    images: Float[Tensor, "view 3 height width"],
    cameras: Cameras,
    sparse: SparsePoints,
    config: DenseConfig,
    *,
    posed: Bool[Tensor, "view"],
) -> float:
    """Share of all pixels that match another view and lead back: how well cameras fit the pictures. Arguments as `dense_depth`."""
    views, matched = _match_views(images, cameras, sparse, config, posed)[:2]
    depths = [None if m is None else np.reciprocal(m.inverse_depth) for m in matched]
    share = 0.0
    for s, found in enumerate(matched):
        if found is not None:
            agreement = _agreement(views, depths, s, config)
            share += float(_checked(found, agreement, config).mean()) / len(views)
    return share


def _each(work: Callable[[int], Result], count: int, threads: int) -> list[Result]:
    """``work(0..count-1)`` in order, on up to ``threads`` threads (OpenCV and numpy release the interpreter lock)."""
    if threads <= 1 or count <= 1:
        return [work(s) for s in range(count)]
    with ThreadPoolExecutor(max_workers=min(threads, count)) as pool:
        return list(pool.map(work, range(count)))


def _limits(views: list[WorkView], s: int, config: DenseConfig) -> tuple[float, float]:
    """(far, near) inverse depth of a view: from its points, else from all points, else from the distance of the cameras."""
    factors = {"near_factor": config.near_factor, "far_factor": config.far_factor}
    own = inverse_depth_range(visible_depths(views, s), **factors) if views[s].posed else None
    if own is not None:
        return own
    everything = inverse_depth_range(np.concatenate([view.seen_depth for view in views]), **factors)
    if everything is not None:
        return everything
    centres = np.array([view.world_from_cam[:3, 3] for view in views if view.posed]).reshape(-1, 3)
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()) if len(centres) > 1 else 0.0
    typical = 5 * spread if spread > 0 else 1.0
    return 0.5 / typical, 2 / typical


def _interpolation(views: list[WorkView], s: int, limits: list[tuple[float, float]]) -> Image32:
    """Log inverse depth interpolated from the view's sparse points; the middle of its range without any."""
    view = views[s]
    if not len(view.seen_depth):
        far, near = limits[s]
        return np.full(view.grey.shape, 0.5 * (np.log(far) + np.log(near)), np.float32)
    softness = 0.01 * max(view.grey.shape)
    return interpolate_sparse(view.seen_xy, -np.log(view.seen_depth), view.grey.shape, softness_px=softness)


def _match_view(
    views: list[WorkView], s: int, limits: tuple[float, float], expected: Image32, config: DenseConfig
) -> _Matched | None:
    """Raw depth of one view, or None where there is nothing to match against."""
    sources = choose_sources(views, s, limit=config.sources, min_parallax_px=config.min_parallax_px)
    view = views[s]
    if not sources or min(view.grey.shape) < config.window:
        return None
    planes = plane_inverse_depths(view, sources, *limits, most=config.planes, step_px=config.plane_step_px)
    matcher = WindowMatcher(view, views, sources, config.window)
    has_points = len(view.seen_depth) > 0
    volume = sweep_planes(
        matcher, planes, expected if has_points else None, prior=config.prior, prior_range=config.prior_range
    )
    penalties = {
        "penalty_near": config.penalty_near,
        "penalty_jump": config.penalty_jump,
        "contrast": config.jump_contrast,
    }
    best = best_hypothesis(aggregate(volume, view.grey, diagonals=True, **penalties), margin=config.ambiguity_margin)
    step = float(planes[1] - planes[0])
    first = (planes[0] + step * (best.index + best.offset)).astype(np.float32)

    base = cv2.medianBlur(first, 5)
    offsets = np.linspace(-config.refine_reach, config.refine_reach, config.refine_offsets) * step
    matcher = WindowMatcher(view, views, sources, config.refine_window)
    volume, hypotheses = sweep_offsets(matcher, base, offsets)
    refined = best_hypothesis(aggregate(volume, view.grey, diagonals=False, **penalties), margin=1.0)
    at = refined.index[:, None]
    inverse_depth = np.take_along_axis(hypotheses, at, axis=1)[:, 0]
    inverse_depth += refined.offset * np.float32(offsets[1] - offsets[0])
    cost = np.take_along_axis(volume, at, axis=1)[:, 0].astype(np.float32) / np.float32(COST_SCALE)
    floor = np.float32(0.5 * limits[0])
    return _Matched(inverse_depth=np.maximum(inverse_depth, floor), cost=cost, ambiguity=best.ambiguity)


def _fill_view(
    views: list[WorkView],
    s: int,
    matched: _Matched | None,
    agreement: Agreement | None,
    interpolated: Image32,
    limits: tuple[float, float],
    config: DenseConfig,
) -> _Filled:
    """Depth, evidence and confidence of one view."""
    view = views[s]
    shape = view.grey.shape
    area = (max(shape) / _FULL_SIZE_PX) ** 2
    checked = np.zeros(shape, bool)
    value = interpolated.copy()
    weight = np.full(shape, config.weight_interpolation, np.float32)
    if matched is not None and agreement is not None:
        checked = _checked(matched, agreement, config)
        trust = np.where(agreement.agreeing >= 2, config.weight_agreed, config.weight_checked)
        trust = np.where(checked, trust, config.weight_raw).astype(np.float32)
        value, weight = _blend(value, weight, np.log(matched.inverse_depth), trust)
    known = np.where(checked, weight, 0).astype(np.float32)
    known_value = value.copy()
    row, column, log_inverse = _credible_points(view, checked, value, config.point_conflict)
    if len(row):
        of_point = min(config.weight_point, config.weight_points / len(row))
        known_value[row, column], known[row, column] = log_inverse, of_point
        value, weight = _blend(value, weight, *_spread_points(row, column, log_inverse, of_point, shape))
    score = np.zeros(shape, np.float32)
    if known.any():
        min_size = max(4, round(config.min_segment_px * area))
        tolerances = tuple(t * area**0.5 for t in config.segment_tolerances)
        partitions = segment_colours(view.rgb, tolerances=tolerances, min_size=min_size)
        for labels, plane_weight in zip(partitions, config.plane_weights, strict=True):
            plane, support = segment_planes(
                labels, np.exp(known_value), known, limits, tolerance=config.plane_tolerance, min_samples=12
            )
            support = np.where(support > config.min_plane_support, support, 0)
            value, weight = _blend(value, weight, np.log(plane), plane_weight * support)
            score = np.maximum(score, support)
    reach = config.smooth_reach * max(shape)
    filled = smooth_fill(
        value, weight, view.rgb, reach_px=reach, stiffness=config.stiffness, colour_sigma=config.colour_sigma
    )
    evidence = _evidence(view, matched, agreement, score=score, filled=filled, interpolated=interpolated)
    confidence = np.zeros(shape, np.float32)
    if matched is not None and agreement is not None:
        confidence = shipped_model()(confidence_features(evidence, agreement.agreeing))
    confident = without_small_parts(confidence >= config.min_confidence, max(1, round(config.min_part_px * area)))
    evidence[EVIDENCE_CHANNELS.index("confident")] = confident
    return _Filled(np.exp(-filled), confidence, evidence)


def _credible_points(
    view: WorkView, checked: NDArray[np.bool_], log_inverse_depth: Image32, conflict: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Image32]:
    """(row, column, log inverse depth) of the sparse points that agree with the checked pixels around them.

    A point is judged only where more than half of the 5x5 pixels are checked: beside a depth edge both may be right.
    """
    column, row = view.seen_xy[:, 0].astype(np.int64), view.seen_xy[:, 1].astype(np.int64)
    log_inverse = -np.log(view.seen_depth).astype(np.float32)
    share = cv2.blur(checked.astype(np.float32), (5, 5))
    nearby = cv2.blur(np.where(checked, log_inverse_depth, 0).astype(np.float32), (5, 5)) / np.maximum(share, 1e-6)
    contradicted = (share[row, column] > 0.5) & (np.abs(nearby[row, column] - log_inverse) > conflict)
    keep = ~contradicted
    return row[keep], column[keep], log_inverse[keep]


def _spread_points(
    row: NDArray[np.int64], column: NDArray[np.int64], value: Image32, weight: float, shape: tuple[int, int]
) -> tuple[Image32, Image32]:
    """(mean value, weight) images of points spread over 3x3 pixels: one pixel could be cut off by its own colour edges."""
    total, sums = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            at = np.clip(row + dy, 0, shape[0] - 1), np.clip(column + dx, 0, shape[1] - 1)
            np.add.at(total, at, np.float32(weight / 9))
            np.add.at(sums, at, np.float32(weight / 9) * value)
    return (sums / np.maximum(total, 1e-9)).astype(np.float32), total


def _blend(value: Image32, weight: Image32, other: Image32, other_weight: Image32) -> tuple[Image32, Image32]:
    """Weighted mean of two estimates and its weight."""
    total = weight + other_weight
    return (value * weight + other * other_weight) / total, total.astype(np.float32)


def _evidence(
    view: WorkView,
    matched: _Matched | None,
    agreement: Agreement | None,
    *,
    score: Image32,
    filled: Image32,
    interpolated: Image32,
) -> NDArray[np.float32]:
    """The channels of `EVIDENCE_CHANNELS`; "confident" is still empty, "agreeing" a count, lengths of the working resolution."""
    shape = view.grey.shape
    none = np.zeros(shape, np.float32)
    channels: dict[str, NDArray[np.float32]] = {
        "confident": none,
        "agreeing": none if agreement is None else agreement.agreeing,
        "cost": np.full(shape, WORST_COST, np.float32) if matched is None else matched.cost,
        "ambiguity": np.ones(shape, np.float32) if matched is None else matched.ambiguity,
        "parallax": none if agreement is None else np.log1p(agreement.parallax),
        "plane": score,
        "gap": none if matched is None else np.clip(filled - np.log(matched.inverse_depth), -1, 1),
        "sparse": np.clip(filled - interpolated, -1, 1),
        "distance": np.log1p(pixels_to_nearest(view.seen_xy, shape)),
    }
    return np.stack([channels[name] for name in EVIDENCE_CHANNELS])


def _assemble(finished: list[_Filled], size: tuple[int, int]) -> DenseDepth:
    """Results of all views at the size of the given images."""
    height, width = size
    count = len(finished)
    channels = {name: k for k, name in enumerate(EVIDENCE_CHANNELS)}
    depth, confidence = (np.empty((count, height, width), np.float32) for _ in range(2))
    evidence = np.empty((count, len(channels), height, width), np.float32)
    for s, view in enumerate(finished):
        work_depth, work_evidence = view.depth, view.evidence
        pixels = max(size) / max(work_depth.shape)
        work_evidence[channels["agreeing"]] /= max(count - 1, 1)
        for name in ("parallax", "distance"):
            lengths = np.expm1(work_evidence[channels[name]]) * np.float32(pixels)
            work_evidence[channels[name]] = np.log1p(lengths)
        if work_depth.shape == size:
            depth[s], confidence[s], evidence[s] = work_depth, view.confidence, work_evidence
            continue
        depth[s] = np.exp(cv2.resize(np.log(work_depth), (width, height), interpolation=cv2.INTER_LINEAR))
        confidence[s] = cv2.resize(view.confidence, (width, height), interpolation=cv2.INTER_LINEAR)
        for k in range(len(channels)):
            evidence[s, k] = cv2.resize(work_evidence[k], (width, height), interpolation=cv2.INTER_NEAREST)
    return DenseDepth(
        depth=torch.from_numpy(depth),
        confidence=torch.from_numpy(confidence),
        confident=torch.from_numpy(evidence[:, channels["confident"]] > 0.5),
        evidence=torch.from_numpy(evidence),
    )
