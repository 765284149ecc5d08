"""What cameras resolve, and that nothing is made narrower than that."""

from __future__ import annotations

import torch

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.sampling import BAND_LIMIT_PX, band_limited, finest_pixel

AHEAD = torch.eye(4)


def lens(focal: float) -> torch.Tensor:
    return torch.tensor([[focal, 0, 50.0], [0, focal, 50.0], [0, 0, 1]])


def test_the_finest_of_the_cameras_that_see_a_point_counts() -> None:
    behind = AHEAD.clone()
    behind[2, 3] = 10.0  # stands behind the points and sees none of them
    poses, lenses = torch.stack([AHEAD, AHEAD, behind]), torch.stack([lens(100.0), lens(400.0), lens(9000.0)])
    points = torch.tensor([[0.0, 0.0, 2.0], [0.9, 0.0, 2.0], [30.0, 0.0, 2.0]])
    pixel = finest_pixel(points, [Cameras(poses, lenses, 100, 100)])
    # The long lens sees the first point only; the last one is in no picture.
    torch.testing.assert_close(pixel, torch.tensor([2.0 / 400, 2.0 / 100, 0.0]))


def test_a_picture_of_more_pixels_resolves_more() -> None:
    point = torch.tensor([[0.0, 0.0, 3.0]])
    one = finest_pixel(point, [Cameras(AHEAD[None], lens(100.0)[None], 100, 100)])
    camera = Cameras(AHEAD[None], lens(100.0)[None], 100, 100)
    torch.testing.assert_close(finest_pixel(point, [camera.resized(200, 200)]), one / 2)
    torch.testing.assert_close(finest_pixel(point, [camera, camera.resized(200, 200)]), one / 2)


def test_the_limit_holds_on_every_axis_and_leaves_wide_ones_alone() -> None:
    scales = torch.tensor([[1e-6, 0.01, 10.0]])
    limited = band_limited(scales, torch.tensor([0.02]))
    assert bool((limited >= BAND_LIMIT_PX * 0.02).all())
    assert float(limited[0, 2]) < 10.0001
    assert limited.argsort(-1).tolist() == scales.argsort(-1).tolist()  # the shortest axis stays the normal
