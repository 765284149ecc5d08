"""What viewers know about cameras: up, sizes, and the common frame of several methods."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.geometry.rigid import look_at, rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.viewer.cameras import ShownCameras, alignment, frustum_length, up_direction
from tests.worlds.row_of_views import reconstruction


def cameras_around(up: torch.Tensor, count: int = 4) -> ShownCameras:
    """Cameras on an arc, upright with respect to ``up``, looking at the origin from 3 away; the last one is generated."""
    flat = ShownCameras.of(reconstruction("backbone", [float(i) for i in range(count)], generated=1))
    side = torch.nn.functional.normalize(torch.linalg.cross(up, torch.tensor([0.3, 0.5, 0.9])), dim=0)
    ahead = torch.linalg.cross(up, side)
    angles = torch.linspace(-0.4, 0.4, count)[:, None]
    eyes = 3 * (torch.cos(angles) * side + torch.sin(angles) * ahead) + 0.8 * up
    return replace(flat, world_from_cam=look_at(eyes, torch.zeros(3), up))


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
def test_up_is_what_is_up_in_the_photos(up: tuple[float, float, float]) -> None:
    # The cameras look down a little, each in its own direction; on the arc what is left of that is below 20 degrees.
    found = up_direction(cameras_around(torch.tensor(up)))
    assert float(found @ torch.tensor(up)) > 0.94
    assert float(found.norm()) == pytest.approx(1, abs=1e-6)


def test_up_ignores_the_generated_view_and_survives_cameras_that_cancel() -> None:
    upright = ShownCameras.of(reconstruction("backbone", [0.0, 1.0, 2.0], generated=1))
    poses = upright.world_from_cam.clone()
    poses[2, :3, :3] = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    assert up_direction(replace(upright, world_from_cam=poses)).tolist() == pytest.approx([0, -1, 0])
    poses[1, :3, :3] = poses[2, :3, :3]
    assert up_direction(replace(upright, world_from_cam=poses)).tolist() == pytest.approx([0, -1, 0])


def test_methods_meet_by_their_captured_cameras() -> None:
    main = cameras_around(torch.tensor([0.0, -1.0, 0.0]))
    rotation = rotation_from_quat_wxyz(torch.tensor([0.9, 0.1, -0.3, 0.2]))
    own = Similarity(scale=1.7, rotation=rotation, translation=torch.tensor([0.4, -2.0, 1.0]))
    moved = main.transformed(own)
    # The inserted camera is what methods disagree about: it must not take part.
    poses = moved.world_from_cam.clone()
    poses[3, :3, 3] += 5
    found = alignment(replace(moved, world_from_cam=poses), main)
    assert found.scale == pytest.approx(1 / 1.7, rel=1e-4)
    back = moved.transformed(found)
    torch.testing.assert_close(back.world_from_cam[:3], main.world_from_cam[:3], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(back.focus, main.focus, atol=1e-4, rtol=1e-4)


def test_nothing_moves_what_already_agrees_or_shares_nothing() -> None:
    main = cameras_around(torch.tensor([0.0, -1.0, 0.0]))
    for other in (main, replace(main, view_ids=("a", "b", "c", "d"))):
        found = alignment(other, main)
        assert found.scale == 1.0
        assert torch.equal(found.rotation, torch.eye(3))


def test_one_shared_camera_fixes_the_frame_but_not_the_scale() -> None:
    main = ShownCameras.of(reconstruction("captured", [0.5]))
    found = alignment(ShownCameras.of(reconstruction("backbone", [0.9])), main)
    assert found.scale == 1.0
    torch.testing.assert_close(found.translation, torch.tensor([-0.4, 0.0, 0.0]))


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
def test_frusta_scale_with_the_scene(scale: float) -> None:
    length = frustum_length(ShownCameras.of(reconstruction("captured", [0.0, 0.4, 0.8], scale=scale)))
    assert length == pytest.approx(0.35 * 0.4 * scale, rel=1e-5)
    alone = frustum_length(ShownCameras.of(reconstruction("captured", [0.0], scale=scale)))
    assert alone == pytest.approx(0.12 * 2 * scale, rel=1e-5)
