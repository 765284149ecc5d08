"""The fit of a round's Gaussians believes only what shows the place."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.insertion.contradiction import pixel_trust
from sceneexpander.photometric.config import RefineConfig
from sceneexpander.photometric.fitting import fit_to_views
from tests.worlds.spoiled import TRUTH, VIEWS, spoiled
from tests.worlds.wall import own_pictures


@pytest.mark.parametrize("doubt", [True, False])
def test_bars_teach_nothing(doubt: bool) -> None:
    misleading, valid = VIEWS.images.clone(), torch.ones(TRUTH.depth.shape, dtype=torch.bool)
    height = misleading.shape[2] // 2
    misleading[:, :, :height], valid[:, : height + 6] = 0.0, False
    shown = []
    for mask in (valid, None):
        views = replace(VIEWS, images=misleading, valid=mask)
        start = spoiled()
        trust = pixel_trust(start, views.images) if doubt else None
        result, _ = fit_to_views(start, views, RefineConfig(visits=10), weights=trust, seed=0)
        shown.append(float(own_pictures(result).images[:2, :, : height - 8].mean()))
    assert shown[0] > shown[1] + 0.03
