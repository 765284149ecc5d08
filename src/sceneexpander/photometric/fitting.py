"""The fit of a reconstruction's Gaussians to its pictures, as far as each pixel is believed."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.refine import refine
from sceneexpander.photometric.report import FitReport


def fit_to_views(
    reconstruction: Reconstruction,
    views: ViewSet,
    config: RefineConfig,
    *,
    weights: Float[Tensor, "view height width"] | None = None,
    seed: int,
    device: torch.device | str = "cpu",
    on_step: Callable[[int, float], None] | None = None,
) -> tuple[Reconstruction, FitReport | None]:
    """The reconstruction with its Gaussians fitted to the pictures they were made from, see `refine`.

    ``weights`` say how far each pixel is believed; None: all alike. Pixels that do not show the place count nothing.
    """
    if views.valid is not None:
        shown = views.valid.to(reconstruction.depth)
        weights = shown if weights is None else weights * shown
    return refine(
        reconstruction,
        views.images,
        config,
        photos=views.photos,
        weights=weights,
        seed=seed,
        device=device,
        on_step=on_step,
    )
