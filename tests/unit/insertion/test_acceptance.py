"""Judging a candidate: a true view of the scene is accepted, and each way of being wrong is named."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.geometry.priors import Priors
from sceneexpander.insertion.acceptance import Acceptance, AcceptanceLimits, captured_moved, judge_candidate
from tests.worlds.realigned import VIEWS, moved

World = tuple[Priors, Anchors, torch.Tensor]


def judge(world: World, joint: Priors, picture: torch.Tensor | None = None) -> Acceptance:
    priors, anchors, images = world
    shown = images[VIEWS] if picture is None else picture
    return judge_candidate(priors.select(range(VIEWS)), joint, anchors, images[:VIEWS], shown, AcceptanceLimits())


def test_a_true_view_in_another_scale_is_accepted(world: World) -> None:
    found = judge(world, moved(world[0], 0.0, 2.0))
    assert found.accepted, found.reasons
    assert found.overlap > 0.2
    assert found.depth_conflict is not None
    assert found.depth_conflict < 0.02
    assert found.cameras_moved_deg < 0.01


def test_wrong_depth_is_named(world: World) -> None:
    priors = world[0]
    assert priors.depth is not None
    depth = priors.depth.clone()
    depth[VIEWS] *= 0.7
    found = judge(world, replace(priors, depth=depth))
    assert any("depth" in reason for reason in found.reasons)


def test_another_picture_is_named(world: World) -> None:
    noise = torch.rand(world[2][VIEWS].shape, generator=torch.Generator().manual_seed(0))
    found = judge(world, world[0], noise)
    assert found.colour_conflict is not None
    assert found.colour_conflict > AcceptanceLimits().max_colour_conflict
    assert any("colours" in reason for reason in found.reasons)


def test_a_view_that_turns_the_captured_cameras_is_named(world: World) -> None:
    priors = world[0]
    assert priors.world_from_cam is not None
    turned = moved(priors.select([0, 2, VIEWS, 1]), 2.0, 1.0).select([0, 3, 1, 2])  # the second captured camera
    found = judge(world, turned)
    assert found.cameras_moved_deg == pytest.approx(2.0, abs=0.01)
    assert any("captured camera" in reason for reason in found.reasons)


def test_a_view_without_a_camera_is_named(world: World) -> None:
    found = judge(world, replace(world[0], posed=torch.tensor([True] * VIEWS + [False])))
    assert not found.accepted
    assert found.depth_conflict is None
    assert any("no camera" in reason for reason in found.reasons)


def test_what_the_insertion_moves_is_the_mean_log_change_of_captured_depth(world: World) -> None:
    _, anchors, _ = world
    depth = anchors.depth.clone()
    assert captured_moved(anchors, depth) == 0
    depth[1] *= 1.2
    depth[2] /= 1.5
    whole = (math.log(1.2) + math.log(1.5)) / VIEWS
    assert captured_moved(anchors, depth) == pytest.approx(whole, rel=1e-4)
    placeholder = torch.tensor([True, True, False])
    assert captured_moved(anchors, depth, placeholder) == pytest.approx(math.log(1.2) / 2, rel=1e-4)
    nothing = torch.zeros(VIEWS, dtype=torch.bool)
    assert captured_moved(anchors, depth, nothing) == pytest.approx(whole, rel=1e-4)


def test_a_turn_is_measured_between_cameras_that_were_estimated_both_times(world: World) -> None:
    """Not against a first view that is a placeholder, nor of one."""
    priors = world[0]
    assert priors.world_from_cam is not None
    turned = moved(priors.select([1, 2, VIEWS, 0]), 20.0, 1.0).select([3, 0, 1, 2])  # the first captured camera
    lost = replace(turned, posed=torch.tensor([False] + [True] * VIEWS))
    assert judge(world, turned).cameras_moved_deg == pytest.approx(20.0, abs=0.05)
    found = judge(world, lost)
    assert found.cameras_moved_deg < 0.01
    # Estimates in two frames turn nothing.
    about = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    other = replace(lost, world_from_cam=about @ lost.world_from_cam)
    assert judge(world, other).cameras_moved_deg < 0.05
