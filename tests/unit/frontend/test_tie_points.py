"""Matches of pictures that join a finished scene."""

from __future__ import annotations

import torch

from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig
from sceneexpander.frontend.tie_points import match_across
from sceneexpander.geometry.camera import project_points, unproject_to_world
from sceneexpander.synthetic import make_views

CONFIG = SfmConfig(max_features=600, learned=LearnedUse.NEVER)


def test_ties_are_the_same_points_of_the_place_in_pixels_of_the_given_pictures() -> None:
    views = make_views(1, views=3, height=180, width=240, kind="room", split="test")
    noise = torch.rand(1, 3, 180, 240, generator=torch.Generator().manual_seed(0))
    small = torch.nn.functional.interpolate(torch.cat([views.images, noise]), scale_factor=0.5, mode="area")
    ties = match_across(
        small,
        CONFIG,
        old=2,
        generator=torch.Generator().manual_seed(0),
        feature_images=torch.cat([views.images, noise]),
    )
    assert {(tie.old, tie.new) for tie in ties} == {(0, 2), (1, 2)}, (
        "noise is tied to nothing, old views not to each other"
    )
    points = unproject_to_world(views.depth, views.intrinsics_px, views.world_from_cam)
    for tie in ties:
        here = torch.from_numpy(2 * tie.old_xy)
        column, row = here.floor().long().unbind(-1)
        there, _ = project_points(points[tie.old][row, column], views.intrinsics_px[2], views.world_from_cam[2])
        apart = (there - torch.from_numpy(2 * tie.new_xy)).norm(dim=-1)
        assert len(apart) >= 15
        assert float((apart < 3).double().mean()) > 0.8
