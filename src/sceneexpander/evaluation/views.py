"""How well a reconstruction shows the views that it was made from, and how far it covers a navigation.

Everything is rendered at the cameras that the reconstruction itself gives its views, on black: each method has its own gauge, and
true cameras are not known in general. What a high score here does not say: that the geometry is right. A reconstruction whose views
each paint only their own pixels scores well; the numbers "from others" are there to notice that.

Pixels of a picture that do not show the place (`ViewSet.valid`) count in none of the numbers; for ST-LPIPS they are black on both sides.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.metrics import ViewMetrics
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.catalogue import Views, metric_named
from sceneexpander.catalogue.metrics import metrics_named
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.ghosting import find_ghosting
from sceneexpander.evaluation.image import psnr
from sceneexpander.evaluation.likeness import PSNR_CAP_DB
from sceneexpander.evaluation.measure import (
    FEWEST_PIXELS,
    Measure,
    SeenView,
    Subject,
    Values,
    known_values,
    shows_enough,
)
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.similarity import align_views
from sceneexpander.splatting import render

_log = logging.getLogger(__name__)


@torch.no_grad()
def navigation_coverage(
    reconstruction: Reconstruction, path: Cameras, config: EvaluateConfig
) -> Float[Tensor, "frame"]:
    """Share of pixels with alpha above the threshold, for each frame of a navigation in the reconstruction's own frame.

    Coverage gained by an expansion is the difference of the means after and before, on the same frames: see `same_place`. A camera that
    comes again (tours return) is drawn once.
    """
    shares: list[Tensor] = []
    for frame, first in enumerate(path.find_repeats()):
        if first < frame:
            shares.append(shares[first])
            continue
        alpha = render(reconstruction.gaussians, path[frame]).alpha[0]
        shares.append((alpha > config.coverage_alpha).to(torch.float32).mean())
    return torch.stack(shares)


def same_place(
    world_from_cam: Float[Tensor, "frame 4 4"], source: Reconstruction, target: Reconstruction
) -> Float[Tensor, "frame 4 4"]:
    """Cameras given in the frame of ``source`` where they stand in the frame of ``target``.

    The frames are aligned on the captured views that both have, and whose cameras both have estimated if there are such: see
    `align_views`.

    Raises:
        ValueError: the reconstructions share no captured view.
    """
    index = {view_id: i for i, view_id in enumerate(target.view_ids)}
    pairs = [
        (i, index[view_id])
        for i, view_id in enumerate(source.view_ids)
        if view_id in index and not bool(source.generated[i]) and not bool(target.generated[index[view_id]])
    ]
    if not pairs:
        raise ValueError("the reconstructions share no captured view")
    in_source, in_target = ([pair[side] for pair in pairs] for side in (0, 1))
    similarity = align_views(
        source.world_from_cam[in_source],
        source.depth[in_source],
        target.world_from_cam[in_target],
        target.depth[in_target],
        posed=source.posed[in_source] & target.posed[in_target],
    )
    return similarity.poses(world_from_cam)


@torch.no_grad()
def see_views(reconstruction: Reconstruction, views: ViewSet, config: EvaluateConfig) -> tuple[SeenView, ...]:
    """Every view of the reconstruction, drawn at its own camera, beside its picture.

    Raises:
        ValueError: a picture is missing or of another size.
    """
    if reconstruction.depth.shape[1:] != views.images.shape[2:]:
        raise ValueError(
            f"the reconstruction has {tuple(reconstruction.depth.shape[1:])} pixels, the views {views.height, views.width}"
        )
    picture_of = {record.view_id: i for i, record in enumerate(views.records)}
    for view_id in reconstruction.view_ids:
        if view_id not in picture_of:
            raise ValueError(f"no picture of view {view_id!r} was given, only {list(picture_of)}")
    return tuple(
        _see_view(reconstruction, index, views, picture_of[view_id], config)
        for index, view_id in enumerate(reconstruction.view_ids)
    )


@torch.no_grad()
def measure_views(seen: Sequence[SeenView], measures: Sequence[Measure], *, generated: bool) -> tuple[ViewMetrics, ...]:
    """One row per captured (or generated) view, in order.

    Raises:
        ValueError: a measure mixes up captured and inserted views.
    """
    rows = []
    kind = Views.INSERTED if generated else Views.CAPTURED
    for view in seen:
        if view.generated != generated:
            continue
        values: dict[str, float] = {}
        if not shows_enough(view):
            _log.warning(
                "%s: too little of the picture shows the place: no numbers", view.reconstruction.view_ids[view.index]
            )
        else:
            for measure in measures:
                values |= known_values(measure, measure.of_view(view))
        for name in values:
            if metric_named(name).scope.views is not kind:
                raise ValueError(f"{name!r} is not a metric of {kind} views")
        rows.append(
            ViewMetrics(
                view_id=view.reconstruction.view_ids[view.index],
                generated=generated,
                posed=bool(view.reconstruction.posed[view.index]),
                values=values,
            )
        )
    return tuple(rows)


def _see_view(
    reconstruction: Reconstruction, index: int, views: ViewSet, place: int, config: EvaluateConfig
) -> SeenView:
    """A view of a reconstruction drawn at its own camera, beside its picture, which is the one at ``place`` in ``views``."""
    picture = views.images[place]
    valid = None if views.valid is None else views.valid[place]
    camera = (reconstruction.world_from_cam[index : index + 1], reconstruction.intrinsics_px[index : index + 1])
    return SeenView(
        reconstruction=reconstruction,
        index=index,
        picture=picture,
        photo=views.photo(place),
        valid=valid,
        render=render(reconstruction.gaussians, Cameras(*camera, *picture.shape[1:])),
        config=config,
    )


class AtStoredSize(Measure):
    """A view as its own camera shows it, against its picture, at the size that methods are given.

    PSNR is capped (equal images would be infinite). Covered is a pixel with alpha above the threshold. The generated share is the part of
    alpha that Gaussians of generated views contribute. The disagreement of depth is the median of |rendered - per-view depth| / per-view
    depth over covered pixels (0 for optimised methods, whose depth is the rendered one).
    """

    _captured = (
        "psnr_captured_db",
        "ssim_captured",
        "st_lpips_captured",
        "views_covered",
        "share_generated_captured",
        "depth_disagreement",
    )
    _inserted = (
        "psnr_inserted_db",
        "ssim_inserted",
        "st_lpips_inserted",
        "inserted_covered",
        "share_generated",
        "inserted_depth_disagreement",
    )
    metrics = metrics_named(*_captured, *_inserted)

    def of_view(self, view: SeenView) -> Values:
        """All of the view's kind."""
        like, alpha = view.likeness, view.render.alpha[0]
        counted = _counted(view)
        covered = (alpha > view.config.coverage_alpha) & counted
        depth = view.reconstruction.depth[view.index]
        relative = (view.render.depth[0] - depth).abs()[covered] / depth[covered]
        generated = view.render.generated[0]
        values = (
            like.psnr_db,
            like.ssim,
            like.st_lpips,
            _share(covered, counted),
            float((generated * alpha)[counted].sum() / alpha[counted].sum().clamp(min=1e-12)),
            float(relative.median()) if len(relative) else None,
        )
        return dict(zip(self._inserted if view.generated else self._captured, values, strict=True))


class FromOthers(Measure):
    """A view painted only by Gaussians that came from *other* views, over the pixels that those cover.

    A picture that agrees with its neighbours scores high, doubled contours (ghosting) score low. Ghosting itself: `find_ghosting`.
    """

    _captured = ("covered_by_others", "psnr_from_others_db", "structure_ghosted", "structure_offset")
    _inserted = (
        "inserted_covered_by_others",
        "psnr_inserted_from_others_db",
        "inserted_structure_ghosted",
        "inserted_structure_offset",
    )
    metrics = metrics_named(*_captured, *_inserted)

    def of_view(self, view: SeenView) -> Values:
        """Share that is covered, PSNR and ghosting there; nothing for the only view."""
        whole = view.reconstruction
        if not view.config.cross_view or len(whole.view_ids) < 2:
            return {}
        others = whole.gaussians.select(whole.gaussians.source_view != view.index)
        found = self._seen_by(others, view)
        return dict(zip(self._inserted if view.generated else self._captured, found, strict=True))

    def _seen_by(self, others: Gaussians, view: SeenView) -> tuple[float | None, ...]:
        if not len(others):
            return 0.0, None, None, None
        whole, index, counted = view.reconstruction, view.index, _counted(view)
        camera = (whole.world_from_cam[index : index + 1], whole.intrinsics_px[index : index + 1])
        seen = render(others, Cameras(*camera, *view.picture.shape[1:]))
        covered = (seen.alpha[0] > view.config.coverage_alpha) & counted
        if int(covered.sum()) < FEWEST_PIXELS:
            return _share(covered, counted), None, None, None
        # Divided by alpha: what is compared is the colour that is there, not the black behind it.
        colour = seen.rgb[0] / seen.alpha[0].clamp(min=1e-6)
        ghosts = find_ghosting(view.picture, colour, covered) if view.config.ghosting else None
        return (
            _share(covered, counted),
            min(psnr(colour, view.picture, covered), PSNR_CAP_DB),
            None if ghosts is None else ghosts.ghosted,
            None if ghosts is None else ghosts.offset,
        )


class TourCoverage(Measure):
    """How much of the camera path's frames shows something."""

    metrics = metrics_named("tour_covered", "tour_frames")

    def of_scene(self, subject: Subject) -> Values:
        """Mean share over the frames, and their number."""
        path = subject.navigation
        if path is None:
            return {"tour_frames": 0}
        frames = navigation_coverage(subject.reconstruction, path, subject.config)
        return {"tour_covered": float(frames.double().mean()), "tour_frames": len(frames)}


def _counted(view: SeenView) -> Bool[Tensor, "height width"]:
    if view.valid is not None:
        return view.valid
    return torch.ones_like(view.render.alpha[0], dtype=torch.bool)


def _share(covered: Bool[Tensor, "height width"], counted: Bool[Tensor, "height width"]) -> float:
    return float(covered[counted].double().mean())
