"""How well a reconstruction shows the views that it was made from, and how far it covers a navigation.

Everything is rendered at the cameras that the reconstruction itself gives its views, on black: each method has its own gauge, and
true cameras are not known in general. What a high score here does not say: that the geometry is right. A reconstruction whose views
each paint only their own pixels scores well; the ``others_`` columns of `ViewMetrics` are there to notice that.

Pixels of a picture that do not show the place (`ViewSet.valid`) count in none of the numbers; for ST-LPIPS they are black on both sides.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.metrics import SIZES, ViewMetrics
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.image import psnr, ssim
from sceneexpander.evaluation.perceptual import st_lpips
from sceneexpander.evaluation.sizes import PSNR_CAP_DB, at_sizes
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.geometry.similarity import align_views
from sceneexpander.splatting import Render, render

_FEWEST_PIXELS = 64  # fewer covered pixels say nothing about a picture


def preservation(reconstruction: Reconstruction, views: ViewSet, config: EvaluateConfig) -> tuple[ViewMetrics, ...]:
    """One row per captured view of the reconstruction: rendered there, compared with the captured picture."""
    return _rows(reconstruction, views, config, generated=False)


def insertion_fidelity(
    reconstruction: Reconstruction, views: ViewSet, config: EvaluateConfig
) -> tuple[ViewMetrics, ...]:
    """The same for the generated views, in order; empty if the reconstruction has none."""
    return _rows(reconstruction, views, config, generated=True)


@torch.no_grad()
def navigation_coverage(
    reconstruction: Reconstruction,
    world_from_cam: Float[Tensor, "frame 4 4"],
    intrinsics_px: Float[Tensor, "frame 3 3"],
    height: int,
    width: int,
    config: EvaluateConfig,
) -> Float[Tensor, "frame"]:
    """Share of pixels with alpha above the threshold, for each frame of a navigation in the reconstruction's own frame.

    Coverage gained by an expansion is the difference of the means after and before, on the same frames: see `same_place`.
    """
    shares = [
        _see(reconstruction.gaussians, pose[None], intrinsics[None], height, width, config).alpha[0]
        for pose, intrinsics in zip(world_from_cam, intrinsics_px, strict=True)
    ]
    return (torch.stack(shares) > config.coverage_alpha).to(torch.float32).mean(dim=(1, 2))


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
def _rows(
    reconstruction: Reconstruction, views: ViewSet, config: EvaluateConfig, *, generated: bool
) -> tuple[ViewMetrics, ...]:
    if reconstruction.depth.shape[1:] != views.images.shape[2:]:
        raise ValueError(
            f"the reconstruction has {tuple(reconstruction.depth.shape[1:])} pixels, the views {views.height, views.width}"
        )
    picture_of = {record.view_id: i for i, record in enumerate(views.records)}
    rows = []
    for index, view_id in enumerate(reconstruction.view_ids):
        if bool(reconstruction.generated[index]) != generated:
            continue
        if view_id not in picture_of:
            raise ValueError(f"no picture of view {view_id!r} was given, only {list(picture_of)}")
        place = picture_of[view_id]
        valid = None if views.valid is None else views.valid[place]
        if valid is not None and int(valid.sum()) < _FEWEST_PIXELS:
            valid = None
        sizes = at_sizes(reconstruction, index, views.photo(place), valid, config, ("own",) if generated else SIZES)
        rows.append(replace(_row(reconstruction, index, views.images[place], valid, config), **sizes))  # type: ignore[arg-type]
    return tuple(rows)


def _row(
    reconstruction: Reconstruction,
    index: int,
    picture: Float[Tensor, "3 height width"],
    valid: Bool[Tensor, "height width"] | None,
    config: EvaluateConfig,
) -> ViewMetrics:
    gaussians = reconstruction.gaussians
    camera = (reconstruction.world_from_cam[index : index + 1], reconstruction.intrinsics_px[index : index + 1])
    height, width = picture.shape[1:]
    seen = _see(gaussians, *camera, height, width, config)
    alpha = seen.alpha[0]
    counted = torch.ones_like(alpha, dtype=torch.bool) if valid is None else valid
    covered = (alpha > config.coverage_alpha) & counted
    depth = reconstruction.depth[index]
    relative = (seen.depth[0] - depth).abs()[covered] / depth[covered]
    others_coverage, others_psnr = None, None
    if config.cross_view and len(reconstruction.view_ids) > 1:
        others = gaussians.select(gaussians.source_view != index)
        others_coverage, others_psnr = _seen_by_others(others, camera, picture, counted, config)
    return ViewMetrics(
        view_id=reconstruction.view_ids[index],
        generated=bool(reconstruction.generated[index]),
        posed=bool(reconstruction.posed[index]),
        psnr_db=min(psnr(seen.rgb[0], picture, valid), PSNR_CAP_DB),
        ssim=ssim(seen.rgb[0], picture, valid),
        coverage=_share(covered, counted),
        generated_share=float((seen.generated[0] * alpha)[counted].sum() / alpha[counted].sum().clamp(min=1e-12)),
        depth_disagreement=float(relative.median()) if len(relative) else None,
        others_coverage=others_coverage,
        others_psnr_db=others_psnr,
        st_lpips=st_lpips(seen.rgb[0] * counted, picture * counted) if config.st_lpips else None,
    )


def _share(covered: Bool[Tensor, "height width"], counted: Bool[Tensor, "height width"]) -> float:
    return float(covered[counted].double().mean())


def _seen_by_others(
    others: Gaussians,
    camera: tuple[Tensor, Tensor],
    picture: Float[Tensor, "3 height width"],
    counted: Bool[Tensor, "height width"],
    config: EvaluateConfig,
) -> tuple[float, float | None]:
    if not len(others):
        return 0.0, None
    seen = _see(others, *camera, picture.shape[1], picture.shape[2], config)
    covered = (seen.alpha[0] > config.coverage_alpha) & counted
    if int(covered.sum()) < _FEWEST_PIXELS:
        return _share(covered, counted), None
    # Divided by alpha: what is compared is the colour that is there, not the black behind it.
    colour = seen.rgb[0] / seen.alpha[0].clamp(min=1e-6)
    return _share(covered, counted), min(psnr(colour, picture, covered), PSNR_CAP_DB)


def _see(
    gaussians: Gaussians,
    world_from_cam: Float[Tensor, "1 4 4"],
    intrinsics_px: Float[Tensor, "1 3 3"],
    height: int,
    width: int,
    config: EvaluateConfig,
) -> Render:
    """One view, on black."""
    return render(gaussians, world_from_cam, intrinsics_px, height, width)
