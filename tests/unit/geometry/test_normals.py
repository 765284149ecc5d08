"""Normals of depth maps: planes have the normal that algebra gives them, and no normal looks away from its camera."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from sceneexpander.geometry.normals import face_camera, normals_from_depth, viewing_rays
from sceneexpander.geometry.randomness import child_generator

HEIGHT, WIDTH = 8, 12
INTRINSICS = torch.tensor([[[9.0, 0, 5], [0, 7, 3.5], [0, 0, 1]], [[11.0, 0, 6], [0, 11, 4], [0, 0, 1]]])


def plane_depth(normal: torch.Tensor, offset: float) -> torch.Tensor:
    """z-depth of the plane n . x = offset: offset / (n . ray)."""
    rays = viewing_rays(INTRINSICS, HEIGHT, WIDTH)
    return offset / (rays @ normal)


def test_rays_go_through_pixel_centres() -> None:
    rays = viewing_rays(INTRINSICS, HEIGHT, WIDTH)
    assert rays.shape == (2, HEIGHT, WIDTH, 3)
    assert_close(rays[0, 0, 0], torch.tensor([(0.5 - 5) / 9, (0.5 - 3.5) / 7, 1.0]))
    assert_close(rays[1, 7, 11], torch.tensor([(11.5 - 6) / 11, (7.5 - 4) / 11, 1.0]))
    pixels = rays @ INTRINSICS.transpose(-1, -2)[:, None]
    assert_close(pixels[1, 2, 3], torch.tensor([3.5, 2.5, 1.0]))


@pytest.mark.parametrize(
    "tilt", [(0.0, 0.0, 1.0), (0.3, -0.2, 1.0), (-0.25, 0.35, 1.0), (0.0, 0.4, 1.0), (0.4, 0.0, 1.0)]
)
@pytest.mark.parametrize("smoothing", [0, 1, 3])
def test_a_plane_has_its_own_normal_everywhere(tilt: tuple[float, float, float], smoothing: int) -> None:
    normal = torch.nn.functional.normalize(torch.tensor(tilt), dim=0)
    found = normals_from_depth(plane_depth(normal, 4.0), INTRINSICS, smoothing=smoothing)
    # Towards the camera, to within the tiny pull towards it.
    assert_close(found, (-normal).expand_as(found), atol=1e-4, rtol=0)


def test_only_neighbours_count_and_smoothing_averages_three_by_three() -> None:
    depth = torch.full((1, HEIGHT, WIDTH), 3.0)
    depth[0, 4, 6] += 0.2
    flat = torch.tensor([0.0, 0.0, -1.0])
    sharp = normals_from_depth(depth, INTRINSICS[:1], smoothing=0)[0]
    bent = (sharp - flat).norm(dim=-1) > 1e-3
    cross = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    cross[[3, 5, 4, 4], [6, 6, 5, 7]] = True
    assert torch.equal(bent, cross), "central differences: the pixel itself is between its neighbours"
    smooth = normals_from_depth(depth, INTRINSICS[:1], smoothing=1)[0]
    mean = torch.nn.functional.normalize(sharp[2:5, 5:8].reshape(9, 3).mean(0), dim=0)
    assert_close(smooth[3, 6], mean, atol=1e-4, rtol=0)


def test_facing_mirrors_what_looks_away_and_leaves_the_rest() -> None:
    rays = viewing_rays(INTRINSICS[:1], HEIGHT, WIDTH)
    raw = torch.randn(1, HEIGHT, WIDTH, 3, generator=child_generator(0, "normals"))
    raw = torch.nn.functional.normalize(raw, dim=-1)
    faced = face_camera(raw, rays)
    along = (faced * rays).sum(-1)
    assert bool((along <= 0).all())
    assert_close(faced.norm(dim=-1), torch.ones(1, HEIGHT, WIDTH))
    away = (raw * rays).sum(-1) > 0
    assert bool(away.any())
    assert bool((~away).any())
    assert_close(faced[~away], raw[~away], atol=1e-5, rtol=0)
    mirrored = raw - 2 * (raw * rays).sum(-1, keepdim=True) / rays.square().sum(-1, keepdim=True) * rays
    assert_close(faced[away], mirrored[away], atol=1e-5, rtol=0)
    assert_close(face_camera(faced, rays), faced, atol=1e-5, rtol=0)


def test_nothing_becomes_a_direction() -> None:
    rays = viewing_rays(INTRINSICS[:1], HEIGHT, WIDTH)
    faced = face_camera(torch.zeros_like(rays), rays)
    assert_close(faced, -torch.nn.functional.normalize(rays, dim=-1), atol=1e-6, rtol=0)
