"""What one reconstruction of a benchmark scene got right: preserved pictures, and truth in the captured and in the new region."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from sceneexpander.evaluation.image import psnr
from sceneexpander.evaluation.truth import SceneTruth
from sceneexpander.expandbench.prepared import placement_in
from sceneexpander.expandbench.scenes import BenchScene, TrueView
from sceneexpander.splatting import render

_COVERED = 0.5  # alpha from which on a pixel counts as drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchNumbers:
    """Numbers of one reconstruction. None: not defined there (e.g. the inserted view before the insertion).

    Captured region: ``psnr_db``, ``ssim``, ``st_lpips`` and ``others_psnr_db`` as in `MetricsRow`, and the first with ``own_open_share`` at
    the resolution of the pictures (twice the stored size); camera errors between captured
    views; depth error of the captured views after one common scale. Expanded region, at the *true* intended camera placed in the
    reconstruction by the captured cameras, over what no captured view sees: ``new_psnr_db`` against the consistent picture (black
    where nothing is drawn, so missing content costs), ``new_coverage``, and relative error of the rendered depth over
    the drawn pixels. ``between_psnr_db``: the whole picture at a camera half-way there, which no method was given.
    """

    own_psnr_db: float | None
    own_open_share: float | None
    psnr_db: float
    ssim: float
    st_lpips: float | None
    others_psnr_db: float | None
    camera_rotation_deg: float | None
    camera_direction_deg: float | None
    depth_abs_rel: float | None
    inserted_psnr_db: float | None
    inserted_rotation_deg: float | None
    inserted_direction_deg: float | None
    new_psnr_db: float
    new_coverage: float
    new_depth_abs_rel: float | None
    between_psnr_db: float

    def plain(self) -> dict[str, float | None]:
        """By name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def measure(reconstruction: Reconstruction, views: ViewSet, truth: SceneTruth, scene: BenchScene) -> BenchNumbers:
    """Measure a reconstruction of the scene's captured views, with or without the inserted one.

    Args:
        reconstruction: captured views first, in the scene's order.
        views: pictures of at least the reconstruction's views.
        truth: of those views, see `BenchScene.insert`.
        scene: the scene.
    """
    row = evaluate(
        reconstruction,
        views,
        EvaluateConfig(),
        scene=scene.name,
        round_number=1,
        seed=0,
        truth=truth,
    )
    known = row.truth
    assert known is not None  # noqa: S101 - truth was given
    new_psnr, coverage, new_depth = _seen_truly(reconstruction, scene, scene.intended, scene.intended.new_region)
    everywhere = torch.ones_like(scene.between.new_region)
    between_psnr, _, _ = _seen_truly(reconstruction, scene, scene.between, everywhere)
    return BenchNumbers(
        own_psnr_db=row.value("own.psnr_db"),
        own_open_share=row.value("own.open_share"),
        psnr_db=row.psnr_db,
        ssim=row.ssim,
        st_lpips=row.st_lpips,
        others_psnr_db=row.others_psnr_db,
        camera_rotation_deg=known.camera_rotation_deg,
        camera_direction_deg=known.camera_direction_deg,
        depth_abs_rel=known.depth_abs_rel,
        inserted_psnr_db=row.inserted_psnr_db,
        inserted_rotation_deg=known.inserted_rotation_deg,
        inserted_direction_deg=known.inserted_direction_deg,
        new_psnr_db=new_psnr,
        new_coverage=coverage,
        new_depth_abs_rel=new_depth,
        between_psnr_db=between_psnr,
    )


def _seen_truly(
    reconstruction: Reconstruction, scene: BenchScene, view: TrueView, where: Bool[Tensor, "height width"]
) -> tuple[float, float, float | None]:
    """(PSNR over ``where``, share of it that is drawn, mean relative depth error over its drawn pixels with a surface)."""
    picture, alpha, depth, scale = picture_at(reconstruction, scene, view)
    drawn = (alpha > _COVERED) & where
    solid = drawn & (view.depth > 0)
    error = (depth[solid] / scale - view.depth[solid]).abs() / view.depth[solid]
    coverage = float(drawn.sum()) / max(float(where.sum()), 1.0)
    return psnr(picture, view.image, where), coverage, float(error.double().mean()) if error.numel() else None


def picture_at(
    reconstruction: Reconstruction, scene: BenchScene, view: TrueView
) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "height width"], Float[Tensor, "height width"], float]:
    """(RGB on black, alpha, depth, scene units per metre) of a reconstruction at a true camera."""
    placement = placement_in(reconstruction, scene)
    placed = placement.poses(view.world_from_cam[None].double()).float()
    height, width = view.image.shape[1:]
    seen = render(reconstruction.gaussians, placed, view.intrinsics_px[None], height, width)
    return seen.rgb[0], seen.alpha[0], seen.depth[0], float(placement.scale)
