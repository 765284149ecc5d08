"""Features, matches, two-view geometry and tracks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import sfm_worlds as worlds

from sceneexpander.frontend.bundle import rotation_exp
from sceneexpander.frontend.features import Features, detect_features, grey_u8
from sceneexpander.frontend.mapping import solve_pose
from sceneexpander.frontend.matching import Matches, guided_matches, mutual_matches, similarity
from sceneexpander.frontend.sfm_types import SfmConfig
from sceneexpander.frontend.tracks import build_tracks
from sceneexpander.frontend.twoview import (
    PairMatches,
    distinct_positions,
    epipolar_distance,
    fit_fundamental,
    fit_rotation,
    fundamental_from_poses,
    homogeneous_rays,
    relative_pose,
    rotation_focal,
    scaled_focal,
    triangulate_pair,
)


def random_features(seed: int, count: int, pixel_xy: np.ndarray | None = None) -> Features:
    rng = np.random.default_rng(seed)
    descriptors = rng.random((count, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    xy = rng.uniform(0, 500, (count, 2)) if pixel_xy is None else pixel_xy
    return Features(pixel_xy=xy, descriptors=descriptors)


def slightly_different(descriptors: np.ndarray, seed: int) -> np.ndarray:
    """As two sightings of a repeated pattern are: alike, but not equal (equal ones have no distance ratio)."""
    noisy = descriptors + np.random.default_rng(seed).normal(0, 0.01, descriptors.shape).astype(np.float32)
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


def test_keypoints_use_corner_origin_pixels() -> None:
    # A blob centred on the corner shared by four pixels: that is the integer coordinate (40, 30) here.
    y, x = np.mgrid[0:64, 0:96]
    blob = np.exp(-((x + 0.5 - 40.0) ** 2 + (y + 0.5 - 30.0) ** 2) / (2 * 4.0**2))
    image = np.repeat((0.2 + 0.6 * blob)[None], 3, 0).astype(np.float32)
    found = detect_features(grey_u8(image), SfmConfig(equalise=False))
    nearest = np.linalg.norm(found.pixel_xy - [40.0, 30.0], axis=1).min()
    # Detection interpolates extrema to about a tenth of a pixel; the wrong origin would cost 0.7.
    assert nearest < 0.15
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_plain_image_has_no_features(value: float) -> None:
    assert detect_features(grey_u8(np.full((3, 60, 80), value, np.float32)), SfmConfig()).count == 0


def test_mutual_matches_agree_with_the_plain_definition() -> None:
    a, b = random_features(0, 40), random_features(1, 50)
    distance = np.linalg.norm(a.descriptors[:, None] - b.descriptors[None], axis=2)
    expected = {}
    for i in range(40):
        j = int(distance[i].argmin())
        if int(distance[:, j].argmin()) != i:
            continue
        rival = min(np.sort(distance[i])[1], np.sort(distance[:, j])[1])
        if distance[i, j] <= 0.97 * rival:
            expected[(i, j)] = distance[i, j] / rival
    scores = similarity(a, b)
    before = scores.copy()
    found = mutual_matches(scores, 0.97)
    assert expected
    assert dict(zip(zip(found.index_a.tolist(), found.index_b.tolist(), strict=True), found.ratio, strict=True)) == (
        pytest.approx(expected, abs=1e-3)
    )
    np.testing.assert_array_equal(scores, before)


def test_guided_matching_finds_a_repeated_feature_by_its_place() -> None:
    # Every feature of b occurs twice, once on its epipolar line (same row) and once 200 px lower.
    a = random_features(2, 30)
    b = Features(
        pixel_xy=np.concatenate([a.pixel_xy + [15.0, 0.5], a.pixel_xy + [15.0, 200.0]]),
        descriptors=np.concatenate([slightly_different(a.descriptors, 8), slightly_different(a.descriptors, 9)]),
    )
    rows = np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # x_b^T F x_a = y_a - y_b up to sign
    scores = similarity(a, b)
    assert mutual_matches(scores, 0.85).count < 8
    found = guided_matches(scores, a, b, rows, band_px=2.0, max_ratio=0.85, max_distance=0.5)
    assert found.count >= 28  # two features may share a row
    assert (found.index_a == found.index_b).mean() > 0.9


def test_guided_matches_without_candidates_are_none() -> None:
    a, b = random_features(3, 5), random_features(4, 5)
    assert guided_matches(similarity(a, b), a, b, np.eye(3), band_px=1.0, max_ratio=0.8, max_distance=0.01).count == 0


def test_essential_matrix_recovers_motion_among_outliers() -> None:
    world = worlds.point_world(1, views=2, points=150)
    xy_a, xy_b = world.pixel_xy[:, 0].copy(), world.pixel_xy[:, 1].copy()
    rng = np.random.default_rng(2)
    wrong = rng.random(150) < 0.3
    xy_b[wrong] = rng.uniform(0, 500, (int(wrong.sum()), 2))
    found = relative_pose(xy_a, xy_b, *world.intrinsics, threshold_px=1.0, seed=3)
    assert found is not None
    turn, direction = worlds.pose_errors_deg(
        np.stack([np.eye(3), found.rotation]), np.stack([np.zeros(3), found.translation]), world
    )
    # Exact inliers; what remains is MAGSAC's soft use of outliers near their epipolar lines (bundle adjustment follows).
    assert turn[0] < 0.5
    assert direction[0] < 2.0
    assert found.inlier[~wrong].mean() > 0.95
    assert np.linalg.norm(found.translation) == pytest.approx(1.0)


def test_random_matches_are_not_verified() -> None:
    rng = np.random.default_rng(5)
    config = SfmConfig()
    for seed in range(20):
        a, b = rng.uniform(0, 700, (120, 2)), rng.uniform(0, 700, (120, 2))
        assert fit_fundamental(a, b, config, unit_px=1.0, seed=seed) is None


def test_rotation_fit_knows_rotation_from_parallax() -> None:
    world = worlds.point_world(6, views=2)
    rotation = world.rotations[1]
    bearing = world.points / world.points[:, 2:]
    turned = bearing @ rotation.T @ world.intrinsics[0].T
    xy_b = turned[:, :2] / turned[:, 2:]
    found, inlier = fit_rotation(
        world.pixel_xy[:, 0], xy_b, *world.intrinsics, threshold_px=1.0, rng=np.random.default_rng(0)
    )
    assert inlier.all()
    np.testing.assert_allclose(found, rotation, atol=1e-6)
    _, parallax = fit_rotation(
        world.pixel_xy[:, 0], world.pixel_xy[:, 1], *world.intrinsics, threshold_px=1.0, rng=np.random.default_rng(0)
    )
    assert parallax.mean() < 0.3


def test_a_turn_gives_the_focal_and_a_plane_seen_from_two_places_does_not_pass_for_one() -> None:
    rng = np.random.default_rng(3)
    camera = np.array([[420.0, 0, 160], [0, 420, 120], [0, 0, 1]])
    guess = scaled_focal(camera, 0.7)
    xy = rng.uniform([0, 0], [320, 240], (200, 2))
    rotation = rotation_exp(np.array([0.05, 0.2, 0.02]))

    def seen(points: np.ndarray) -> np.ndarray:
        projected = points @ camera.T
        return projected[:, :2] / projected[:, 2:] + rng.normal(0, 0.1, (len(points), 2))

    rays = homogeneous_rays(xy, camera)
    factor = rotation_focal(xy, seen(rays @ rotation.T), guess, (0.4, 2.5), threshold_px=1.0, seed=0)
    assert factor == pytest.approx(1 / 0.7, rel=0.03)
    # A slanted wall and a step aside: also a homography, but no focal makes it a rotation of all matches.
    wall = rays / (1.3 + 0.5 * rays[:, :1] + 0.2 * rays[:, 1:2])
    moved = seen(wall @ rotation.T + np.array([0.25, 0.02, 0.05]))
    factor = rotation_focal(xy, moved, guess, (0.4, 2.5), threshold_px=1.0, seed=0)
    assert factor is not None
    there = scaled_focal(guess, factor)
    _, inlier = fit_rotation(xy, moved, there, there, threshold_px=1.0, rng=rng)
    assert inlier.mean() < 0.6


def test_triangulation_is_exact_and_parallel_rays_are_finite() -> None:
    world = worlds.point_world(7, views=2)
    relative = world.rotations[1] @ world.rotations[0].T
    shift = world.translations[1] - relative @ world.translations[0]
    in_a = world.points @ world.rotations[0].T + world.translations[0]
    in_b = in_a @ relative.T + shift
    points, depths = triangulate_pair(in_a / in_a[:, 2:], in_b / in_b[:, 2:], relative, shift)
    np.testing.assert_allclose(points, in_a, atol=1e-8)
    np.testing.assert_allclose(depths, np.stack([in_a[:, 2], in_b[:, 2]], 1), atol=1e-8)
    ahead = np.array([[0.0, 0.0, 1.0]])
    assert np.isfinite(triangulate_pair(ahead, ahead, np.eye(3), np.array([1.0, 0, 0]))[0]).all()


def test_distinct_positions_drops_repeats() -> None:
    a = np.array([[10.0, 10.0], [10.1, 10.0], [50.0, 50.0]])
    assert distinct_positions(a, a).tolist() == [0, 2]
    assert distinct_positions(np.zeros((0, 2)), np.zeros((0, 2))).tolist() == []


def _pair(a: int, b: int, index_a: list[int], index_b: list[int], ratio: list[float]) -> PairMatches:
    found = Matches(index_a=np.array(index_a), index_b=np.array(index_b), ratio=np.array(ratio))
    return PairMatches(view_a=a, view_b=b, loose=found, tentative=found.count, verified=found)


def test_tracks_chain_and_refuse_contradictions() -> None:
    features = [random_features(view, 4) for view in range(3)]
    pairs = [
        _pair(0, 1, [0, 1], [0, 1], [0.1, 0.2]),
        _pair(1, 2, [0], [0], [0.3]),
        _pair(0, 2, [1, 0], [2, 3], [0.4, 0.9]),  # the last would give track 0 two places in view 2
    ]
    tracks = build_tracks(features, pairs)
    assert tracks.count == 2
    assert tracks.seen.sum(1).tolist() == [3, 3]
    chain = np.flatnonzero((tracks.pixel_xy[:, 0] == features[0].pixel_xy[0]).all(1))[0]
    np.testing.assert_array_equal(tracks.pixel_xy[chain, 2], features[2].pixel_xy[0])


def test_keypoints_at_one_place_are_one_observation() -> None:
    xy = np.array([[10.0, 20.0], [10.0, 20.0], [90.0, 20.0]])
    features = [random_features(view, 3, xy) for view in range(3)]
    tracks = build_tracks(features, [_pair(0, 1, [0], [0], [0.1]), _pair(1, 2, [1], [1], [0.1])])
    assert tracks.count == 1
    assert tracks.seen.all()


def test_no_matches_make_no_tracks() -> None:
    features = [random_features(0, 4), random_features(1, 0)]
    assert build_tracks(features, []).count == 0
    assert build_tracks(features, []).seen.shape == (0, 2)


def test_a_robust_fit_that_gives_up_is_no_match(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV raises when its local optimisation is left without a model; that must not end a reconstruction."""

    def give_up(*_: object, **__: object) -> None:
        raise cv2.error("(-215:Assertion failed) !model.empty() in function 'setModelParameters'")

    for name in ("findFundamentalMat", "findEssentialMat", "findHomography", "solvePnPRansac"):
        monkeypatch.setattr(cv2, name, give_up)
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 300, (2, 40, 2))
    camera = np.array([[300.0, 0, 150], [0, 300.0, 150], [0, 0, 1]])
    assert fit_fundamental(a, b, SfmConfig(), unit_px=1.0, seed=0) is None
    assert relative_pose(a, b, camera, camera, threshold_px=1.0, seed=0) is None
    assert rotation_focal(a, b, camera, (0.5, 2.0), threshold_px=1.0, seed=0) is None
    points = rng.uniform(1, 2, (40, 3))
    assert solve_pose(points, a, camera, threshold_px=1.0, robust_px=1.0, seed=0) is None


def test_the_epipolar_distance_is_zero_for_exact_matches_and_grows_with_the_error() -> None:
    world = worlds.point_world(0, views=2)
    rotation = world.rotations[1] @ world.rotations[0].T
    translation = world.translations[1] - rotation @ world.translations[0]
    fundamental = fundamental_from_poses(rotation, translation, *world.intrinsics)
    a, b = world.pixel_xy[:, 0], world.pixel_xy[:, 1]
    np.testing.assert_allclose(epipolar_distance(fundamental, a, b), 0, atol=1e-6)
    # Across the line of b by 3 px: exactly 3 px from that line.
    lines = np.concatenate([a, np.ones((len(a), 1))], 1) @ fundamental.T
    normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    moved = epipolar_distance(fundamental, a, b + 3 * normals)
    assert (moved >= 3 - 1e-6).all()
