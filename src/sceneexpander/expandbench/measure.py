"""What one reconstruction of a benchmark scene got right: preserved pictures, and truth in the captured and in the new region."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.truth import SceneTruth
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.evaluation.config import EvaluateConfig
from sceneexpander.evaluation.evaluate import evaluate
from sceneexpander.evaluation.image import psnr
from sceneexpander.expandbench.prepared import placement_in
from sceneexpander.expandbench.scenes import BenchScene, TrueView
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.splatting import render

_COVERED = 0.5  # alpha from which on a pixel counts as drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchNumbers:
    """Numbers of one reconstruction by the names of the catalogue; what is not defined there is left out.

    All of a `MetricsRow`, and what is seen of the expanded region from the *true* intended camera, placed in the reconstruction by the
    captured cameras, over what no captured view sees: ``psnr_new_region_db`` against the consistent picture (black where nothing is
    drawn, so missing content costs), ``new_region_drawn``, and ``new_region_drawn_abs_rel``, the relative error of the rendered depth
    over the drawn pixels. ``psnr_half_way_db``: the whole picture at a camera half-way there, which no method was given.
    """

    values: Mapping[str, float]

    def value(self, name: str) -> float | None:
        """A number by name; None if it is not known."""
        return self.values.get(name)


def measure(
    reconstruction: Reconstruction,
    views: ViewSet,
    truth: SceneTruth,
    scene: BenchScene,
    config: EvaluateConfig | None = None,
) -> BenchNumbers:
    """Measure a reconstruction of the scene's captured views, with or without the inserted one.

    Args:
        reconstruction: captured views first, in the scene's order.
        views: pictures of at least the reconstruction's views.
        truth: of those views, see `BenchScene.insert`.
        scene: the scene.
        config: what else is measured; None: everything.
    """
    row = evaluate(
        reconstruction,
        views,
        EvaluateConfig() if config is None else config,
        scene=scene.name,
        round_number=1,
        seed=0,
        truth=truth,
    )
    new_psnr, drawn, new_depth = _seen_truly(reconstruction, scene, scene.intended, scene.intended.new_region)
    everywhere = torch.ones_like(scene.between.new_region)
    between_psnr, _, _ = _seen_truly(reconstruction, scene, scene.between, everywhere)
    seen = {
        "psnr_new_region_db": new_psnr,
        "new_region_drawn": drawn,
        "new_region_drawn_abs_rel": new_depth,
        "psnr_half_way_db": between_psnr,
    }
    return BenchNumbers(values={**row.values, **{name: value for name, value in seen.items() if value is not None}})


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
    seen = render(reconstruction.gaussians, Cameras(placed, view.intrinsics_px[None], height, width))
    return seen.rgb[0], seen.alpha[0], seen.depth[0], float(placement.scale)
