"""Verified matches of new pictures with those of a scene that is finished: nothing about the scene's cameras is asked or changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sceneexpander.frontend.features import lie_in
from sceneexpander.frontend.memory import MatchMemory
from sceneexpander.frontend.sfm_setup import prepare
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.twoview import match_and_verify


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewTies:
    """Pixels of the given images in which two views show the same points."""

    old: int
    new: int
    old_xy: Float[np.ndarray, "match 2"]
    new_xy: Float[np.ndarray, "match 2"]


def match_across(
    images: Float[Tensor, "view 3 height width"],
    config: SfmConfig,
    *,
    old: int,
    generator: torch.Generator,
    feature_images: Float[Tensor, "view 3 feature_height feature_width"] | None = None,
    valid: Bool[Tensor, "view height width"] | None = None,
    memory: MatchMemory | None = None,
) -> list[ViewTies]:
    """Match each view from number ``old`` on with each before it; pairs that no epipolar geometry verifies are left out.

    Args:
        images: RGB in [0, 1], of pinhole cameras; results are in their pixels.
        config: as of the front-end.
        old: how many of the views are the scene's.
        generator: source of the seed of robust fits.
        feature_images: the same views at a higher resolution, for features only.
        valid: which pixels of ``images`` show the place.
        memory: keypoints of before; what is found is added.
    """
    setup = prepare(images, feature_images, config, generator, None, valid)
    memory = MatchMemory() if memory is None else memory
    features = [
        found.select(lie_in(mask, found.pixel_xy))
        for grey, mask in zip(setup.greys, setup.shown, strict=True)
        for found in (memory.detect_features(grey, config),)
    ]
    ties = []
    for new in range(old, len(features)):
        for view in range(old):
            matches = match_and_verify(view, new, features, config, unit_px=setup.unit_px, seed=setup.seed).verified
            if matches.count:
                ties.append(
                    ViewTies(
                        old=view,
                        new=new,
                        old_xy=features[view].pixel_xy[matches.index_a] * setup.scale_xy,
                        new_xy=features[new].pixel_xy[matches.index_b] * setup.scale_xy,
                    )
                )
    return ties
