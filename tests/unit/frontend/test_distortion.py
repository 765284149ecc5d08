"""Radial distortion as a map between pixels, and found in matches."""

from __future__ import annotations

from dataclasses import replace

import cv2
import dense_scenes as scenes
import numpy as np
import pytest
import sfm_worlds as worlds
import torch
from test_epipolar import model_of, noisy

from sceneexpander.frontend import search, sfm
from sceneexpander.frontend.distortion import Distortion
from sceneexpander.frontend.lens_tests import find_distortion
from sceneexpander.frontend.mapping import Mapping
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig

MATRIX = np.array([[600.0, 0, 390.0], [0, 590.0, 280.0], [0, 0, 1.0]])
LENSES = [(-0.22, 0.05), (0.12, 0.0), (-0.3, 0.1), (0.0, 0.0), (-0.06, 0.0)]


def lens(*k: tuple[float, float]) -> Distortion:
    return Distortion(intrinsics=np.tile(MATRIX, (len(k), 1, 1)), k=np.array(k))


@pytest.mark.parametrize("k", LENSES)
def test_the_inverse_brings_pixels_back(k: tuple[float, float]) -> None:
    xy = np.random.default_rng(0).uniform([0, 0], [768, 576], (500, 2))
    there = lens(k).undistorted(0, xy)
    np.testing.assert_allclose(lens(k).distorted(0, there), xy, atol=1e-6)


@pytest.mark.parametrize("k", LENSES)
def test_it_is_opencvs_model(k: tuple[float, float]) -> None:
    xy = np.random.default_rng(1).uniform([100, 100], [700, 500], (50, 2))
    rays = np.concatenate([(xy - MATRIX[:2, 2]) / MATRIX[[0, 1], [0, 1]], np.ones((50, 1))], 1)
    theirs, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), MATRIX, np.array([*k, 0.0, 0.0]))
    np.testing.assert_allclose(lens(k).distorted(0, xy), theirs[:, 0], atol=1e-6)


def test_coefficients_follow_the_focal() -> None:
    xy = np.random.default_rng(2).uniform([0, 0], [768, 576], (50, 2))
    one = lens((-0.2, 0.04))
    longer = MATRIX.copy()
    longer[[0, 1], [0, 1]] *= 1.3
    other = Distortion(intrinsics=longer[None], k=one.coefficients_at(0, longer)[None])
    np.testing.assert_allclose(other.distorted(0, xy), one.distorted(0, xy), atol=1e-9)


@pytest.mark.parametrize("k", [(-0.22, 0.05), (0.15, 0.0)])
def test_straight_lines_are_straight_again(k: tuple[float, float]) -> None:
    height, width = 300, 400
    matrix = np.array([[380.0, 0, 200], [0, 380.0, 150], [0, 0, 1]])
    bent = Distortion(intrinsics=matrix[None], k=np.array([k]))
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    seen_at = bent.undistorted(0, np.stack([columns.ravel(), rows.ravel()], 1)).reshape(height, width, 2)
    # A smooth pattern as a pinhole camera sees it, looked up where the bent lens shows it.
    pattern = lambda xy: 0.5 + 0.5 * np.sin(xy[..., 0] / 15) * np.cos(xy[..., 1] / 20)  # noqa: E731
    image = torch.from_numpy(pattern(seen_at)).float().repeat(1, 3, 1, 1)
    straight, seen = bent.straightened(image)
    expected = torch.from_numpy(pattern(np.stack([columns, rows], -1))).float()
    inner = seen[0] & (torch.nn.functional.max_pool2d((~seen).float(), 5, 1, 2)[0] == 0)
    # Twice bilinear on waves of 90 pixels and more: half a grey level of 255, some more at steep flanks.
    assert float((straight[0, 0] - expected).abs()[inner].max()) < 0.02
    assert bool(seen.all()) == (k[0] < 0), "only a cushion leaves the frame's border empty"


def seen_bent(k1: float) -> Mapping:
    """A finished model of pinhole cameras over what a bent lens shows, with errors of keypoints."""
    world = worlds.point_world(70, points=300)
    bent = Distortion(intrinsics=world.intrinsics, k=np.tile([k1, 0.0], (5, 1)))
    return model_of(noisy(replace(world, pixel_xy=bent.distorted_tracks(world.pixel_xy))))[0]


@pytest.mark.parametrize("k1", [-0.06, 0.06, 0.15])
def test_a_bent_lens_is_found_in_matches_that_no_camera_helped_to_find(k1: float) -> None:
    mapping = seen_bent(k1)
    found = find_distortion(mapping, None)
    assert found is not None
    assert found.k[0, 0] == pytest.approx(k1, abs=0.025)
    assert found.intrinsics[0, 0, 0] == pytest.approx(650.0, rel=0.01)
    straight = mapping.copy()
    raw = mapping.tracks.pixel_xy
    pinhole = np.stack([found.undistorted(view, raw[:, view]) for view in range(5)], 1)
    straight.tracks = replace(mapping.tracks, pixel_xy=pinhole)
    straight.finish(refine_focal=True)
    assert find_distortion(straight, found) is None, "what was found already is not found again"


def test_a_straight_lens_is_left_alone() -> None:
    assert find_distortion(seen_bent(0.0), None) is None


def test_matches_found_by_cameras_are_not_asked_for_distortion(monkeypatch: pytest.MonkeyPatch) -> None:
    """They lie in the epipolar bands of pinhole cameras and agree with those."""
    asked: list[int] = []
    monkeypatch.setattr(search, "match_guided", lambda pair, *_, **__: replace(pair, verified=Matches.empty()))
    monkeypatch.setattr(sfm, "find_distortion", lambda mapping, _: asked.append(mapping.tracks.count))
    scene = scenes.render(scenes.room(1), scenes.arc(3, 1.4), 290.0, 240, 320)
    config = SfmConfig(max_features=1000, learned=LearnedUse.NEVER, focal_starts=(0.9,), choose_most_views=1)
    sfm.estimate_cameras(scene.images, config, generator=torch.Generator().manual_seed(0))
    assert asked
    assert min(asked) > 100
