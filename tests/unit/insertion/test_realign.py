"""Realignment of the inserted camera, against a textured world whose cameras are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage
import torch

from sceneexpander.artifacts.anchors import Anchors
from sceneexpander.geometry.priors import Priors
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.insertion.realign import _BLURS_PX, Realign, RealignReport, _blur_picture, realign
from tests.worlds.realigned import VIEWS, moved


def run(
    world: tuple[Priors, Anchors, torch.Tensor], joint: Priors, mode: Realign
) -> tuple[Priors, RealignReport | None]:
    priors, anchors, images = world
    captured = priors.select(range(VIEWS))
    generator = torch.Generator().manual_seed(0)
    return realign(captured, joint, anchors, images[:VIEWS], images[VIEWS], mode, generator=generator)


def test_none_is_the_very_same_priors(world: tuple[Priors, Anchors, torch.Tensor]) -> None:
    joint = moved(world[0], 0.0, 2.0)
    assert run(world, joint, Realign.NONE)[0] is joint


def test_hold_keeps_the_captured_views_and_brings_the_inserted_one_along(world) -> None:
    priors = world[0]
    held, report = run(world, moved(priors, 0.0, 3.0), Realign.HOLD)
    assert report is None
    assert torch.equal(held.world_from_cam[:VIEWS], priors.world_from_cam[:VIEWS])
    assert torch.equal(held.depth[:VIEWS], priors.depth[:VIEWS])
    assert torch.allclose(held.world_from_cam[-1], priors.world_from_cam[-1], atol=1e-4)
    assert torch.allclose(held.depth[-1], priors.depth[-1], rtol=1e-4)


def test_refine_turns_the_camera_back(world) -> None:
    priors = world[0]
    wrong = moved(priors, 2.0, 1.0)
    refined, report = run(world, wrong, Realign.REFINE)
    assert report is not None
    assert report.accepted
    before = rotation_angle_deg(wrong.world_from_cam[-1, :3, :3], priors.world_from_cam[-1, :3, :3])
    after = rotation_angle_deg(refined.world_from_cam[-1, :3, :3], priors.world_from_cam[-1, :3, :3])
    assert float(before) == pytest.approx(2.0, abs=0.01)
    pixel_deg = torch.rad2deg(torch.atan(1 / priors.intrinsics_px[-1, 0, 0]))
    assert float(after) < float(pixel_deg)
    assert report.error_after < report.error_before


def test_refine_leaves_a_view_without_a_pose_alone(world) -> None:
    wrong = moved(world[0], 2.0, 1.0)
    unposed = Priors(
        world_from_cam=wrong.world_from_cam,
        intrinsics_px=wrong.intrinsics_px,
        depth=wrong.depth,
        evidence=wrong.evidence,
        posed=torch.tensor([True] * VIEWS + [False]),
    )
    held, report = run(world, unposed, Realign.REFINE)
    assert report is None
    assert torch.allclose(held.world_from_cam[-1], wrong.world_from_cam[-1], atol=1e-4)


@pytest.mark.parametrize("sigma", _BLURS_PX)
def test_the_blur_is_the_gaussian_of_its_width_with_the_border_repeated(sigma: float) -> None:
    picture = torch.rand(3, 40, 52, generator=torch.Generator().manual_seed(0))
    radius = int(3 * sigma) + 1
    expected = [
        scipy.ndimage.gaussian_filter(channel, sigma, mode="nearest", radius=radius) for channel in picture.numpy()
    ]
    torch.testing.assert_close(_blur_picture(picture, sigma), torch.from_numpy(np.stack(expected)), atol=1e-5, rtol=0)
