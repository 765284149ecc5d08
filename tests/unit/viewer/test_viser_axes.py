"""Our conventions in viser's words."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sceneexpander.geometry.gaussians import sh_from_rgb
from sceneexpander.geometry.rigid import look_at, rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity
from sceneexpander.splatting.video import GENERATED_TINT
from sceneexpander.viewer.cameras import ShownCameras
from sceneexpander.viewer.viser_axes import (
    LEAST_STD_PX,
    TINT_STRENGTH,
    enlargement,
    viser_camera,
    viser_picture,
    viser_splats,
    widen_gaussians,
)
from tests.worlds.row_of_views import HEIGHT, WIDTH, reconstruction

STAY = Similarity(scale=1.0, rotation=torch.eye(3), translation=torch.zeros(3))


def test_a_camera_keeps_its_axes_and_its_lens() -> None:
    pose = look_at(torch.tensor([1.0, -2.0, 0.5]), torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.1, -1.0, 0.2]))
    lens = torch.tensor([[30.0, 0, 14.0], [0, 40.0, 10.5], [0, 0, 1]])
    cameras = replace(
        ShownCameras.of(reconstruction("captured", [0.0])), world_from_cam=pose[None], intrinsics_px=lens[None]
    )
    camera = viser_camera(cameras, 0)
    rotation = rotation_from_quat_wxyz(torch.tensor(camera.wxyz))
    # Columns: where right, down and forward point. The asymmetric pose tells them apart.
    torch.testing.assert_close(rotation, pose[:3, :3], atol=1e-5, rtol=0)
    assert camera.position == pytest.approx((1.0, -2.0, 0.5))
    ahead = torch.tensor(camera.look_at) - pose[:3, 3]
    torch.testing.assert_close(ahead, float(cameras.focus[0]) * pose[:3, 2], atol=1e-5, rtol=0)
    # The corner of the picture, by viser's lens: tan(fov / 2) up, aspect times that to the side.
    up = math.tan(camera.fov / 2)
    assert up == pytest.approx(HEIGHT / 2 / 40)
    assert up * camera.aspect == pytest.approx(WIDTH / 2 / 30)


def test_gaussians_become_covariances_in_the_common_frame() -> None:
    gaussians = reconstruction("captured", [0.0]).gaussians.select(torch.arange(1))
    quat = torch.tensor([[0.8, 0.2, -0.4, 0.4]])
    gaussians = replace(gaussians, quat_wxyz=quat, scales=torch.tensor([[0.3, 0.1, 0.02]]))
    turn = rotation_from_quat_wxyz(torch.tensor([0.5, 0.5, 0.1, -0.7]))
    move = Similarity(scale=2.0, rotation=turn, translation=torch.tensor([1.0, 2.0, 3.0]))
    splats = viser_splats(gaussians, move)
    axes = turn @ rotation_from_quat_wxyz(quat)[0]
    covariance = torch.from_numpy(splats.covariances[0])
    for i, scale in enumerate((0.3, 0.1, 0.02)):
        torch.testing.assert_close(covariance @ axes[:, i], (2 * scale) ** 2 * axes[:, i], atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.from_numpy(splats.centers), move.points(gaussians.means))
    assert splats.opacities.shape == (1, 1)


def test_tint_and_opacity() -> None:
    gaussians = reconstruction("captured", [0.0]).gaussians.select(torch.arange(2))
    colours = torch.tensor([[0.2, 0.4, 0.6], [0.2, 0.4, 0.6]])
    gaussians = replace(gaussians, sh=sh_from_rgb(colours)[:, None], generated=torch.tensor([False, True]))
    splats = viser_splats(gaussians, STAY, tint=True, opacity=0.5)
    expected = (1 - TINT_STRENGTH) * colours[1] + TINT_STRENGTH * torch.tensor(GENERATED_TINT)
    np.testing.assert_allclose(splats.rgbs, torch.stack([colours[0], expected]).numpy(), atol=1e-6)
    np.testing.assert_allclose(splats.opacities[:, 0], 0.5 * gaussians.opacities.numpy(), atol=1e-6)


def test_small_scenes_keep_their_shapes_as_16_bit_floats() -> None:
    gaussians = reconstruction("captured", [0.0], scale=0.01).gaussians.select(torch.arange(50))
    gaussians = replace(gaussians, scales=gaussians.scales * torch.tensor([1.0, 0.7, 0.2]))
    factor = enlargement(gaussians)
    assert float(gaussians.scales.median()) * factor == pytest.approx(0.05)
    sent = viser_splats(gaussians, STAY.enlarged(factor)).covariances
    diagonal = sent[:, [0, 1, 2], [0, 1, 2]]
    np.testing.assert_allclose(diagonal.astype(np.float16), diagonal, rtol=2e-3)
    plain = viser_splats(gaussians, STAY).covariances[:, [0, 1, 2], [0, 1, 2]]
    assert np.abs(plain.astype(np.float16) / plain - 1).max() > 0.02, "what it is for"
    assert enlargement(gaussians.select(torch.arange(0))) == 1.0


def test_enlarging_a_similarity_enlarges_its_target() -> None:
    turn = rotation_from_quat_wxyz(torch.tensor([0.5, 0.5, 0.1, -0.7]))
    move = Similarity(scale=2.0, rotation=turn, translation=torch.tensor([1.0, 2.0, 3.0]))
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(move.enlarged(3.0).points(points), 3 * move.points(points))


def test_narrow_gaussians_are_widened_in_the_view_that_made_them() -> None:
    scene = reconstruction("captured", [0.0, 0.4])
    flat = torch.tensor([[0.01, 0.001, 0.3], [0.5, 0.4, 0.002]])
    gaussians = replace(scene.gaussians.select(torch.arange(2)), scales=flat)
    found = widen_gaussians(gaussians, ShownCameras.of(scene)).scales
    least = LEAST_STD_PX * 2.0 / 25.0  # depth 2, focal length 25
    expected = torch.tensor([[least, 0.001, 0.3], [0.5, 0.4, 0.002]])
    torch.testing.assert_close(found, expected)


def test_pictures_become_bytes_with_channels_last() -> None:
    picture = torch.zeros(3, 2, 5)
    picture[0, 1, 4], picture[2, 0, 0] = 1.0, 0.5
    shown = viser_picture(picture)
    assert (shown.shape, shown.dtype) == ((2, 5, 3), np.uint8)
    assert shown[1, 4].tolist() == [255, 0, 0]
    assert shown[0, 0].tolist() == [0, 0, 128]
