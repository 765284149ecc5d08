"""The fit of a reconstruction's Gaussians to pictures of which the generated ones may be doubted."""

from __future__ import annotations

from collections.abc import Callable

import torch

from sceneexpander.adaptation.consistency import pixel_trust
from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.artifacts.views import ViewSet
from sceneexpander.optimisation.config import RefineConfig
from sceneexpander.optimisation.refine import RefineReport
from sceneexpander.reconstruction.fitting import fitted


def refined(
    reconstruction: Reconstruction,
    views: ViewSet,
    config: RefineConfig,
    *,
    doubt_generated: bool,
    seed: int,
    device: torch.device | str = "cpu",
    on_step: Callable[[int, float], None] | None = None,
) -> tuple[Reconstruction, RefineReport | None]:
    """The reconstruction with its Gaussians fitted to the pictures they were made from, see `fitted`.

    With ``doubt_generated`` a generated picture is believed where no captured view sees the place or one agrees (`pixel_trust`);
    otherwise it counts like a photo, as for the baseline, which does not know better.
    """
    weights = None
    if config.visits and doubt_generated and bool(reconstruction.generated.any()):
        weights = pixel_trust(reconstruction, views.images)
    return fitted(reconstruction, views, config, weights=weights, seed=seed, device=device, on_step=on_step)
