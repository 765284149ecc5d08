"""The dense base on worlds with known depth, and on input that leaves it nothing to match."""

from __future__ import annotations

import dataclasses

import dense_scenes as scenes
import pytest
import torch
from torch import Tensor

from sceneexpander.frontend.dense import DenseConfig, DenseDepth, checked_share, dense_depth
from sceneexpander.frontend.sparse_points import SparsePoints
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS
from sceneexpander.training.simulated import perturb_poses, sample_sparse_points

CONFIG = DenseConfig(threads=1)
HEIGHT, WIDTH = 96, 128


def channel(result: DenseDepth, name: str) -> Tensor:
    return result.evidence[:, EVIDENCE_CHANNELS.index(name)]


def points_of(scene: scenes.Scene, *, seed: int = 0, outliers: float = 0.03) -> SparsePoints:
    return sample_sparse_points(
        scene.images,
        scene.depth,
        torch.isfinite(scene.depth),
        scene.cameras,
        torch.Generator().manual_seed(seed),
        per_view=(40, 40),
        outliers=outliers,
    )


def run(scene: scenes.Scene, sparse: SparsePoints, config: DenseConfig = CONFIG, **known: Tensor) -> DenseDepth:
    return dense_depth(scene.images, scene.cameras, sparse, config, **known)


def assert_usable(result: DenseDepth, views: int) -> None:
    """Every pixel has a finite positive depth and evidence within its documented range."""
    assert result.depth.shape[0] == views
    assert bool((torch.isfinite(result.depth) & (result.depth > 0)).all())
    assert bool(torch.isfinite(result.evidence).all())
    for name in ("confident", "agreeing", "ambiguity", "plane"):
        assert 0 <= float(channel(result, name).min()) <= float(channel(result, name).max()) <= 1
    assert 0 <= float(channel(result, "cost").min()) <= float(channel(result, "cost").max()) <= 1.2 + 1e-4
    for name in ("gap", "sparse"):
        assert float(channel(result, name).abs().max()) <= 1
    for name in ("parallax", "distance"):
        assert float(channel(result, name).min()) >= 0
    assert torch.equal(channel(result, "confident") > 0.5, result.confident)


@pytest.fixture(scope="module")
def room() -> scenes.Scene:
    return scenes.render(scenes.room(3), scenes.arc(3, 1.0), 0.9 * WIDTH, HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def wall() -> scenes.Scene:
    return scenes.render([scenes.wall(4.0, 7)], scenes.arc(3, 0.8), 0.9 * WIDTH, HEIGHT, WIDTH)


def test_a_plane_is_recovered(wall: scenes.Scene) -> None:
    result = run(wall, points_of(wall, outliers=0.0))
    error = (result.depth / wall.depth - 1).abs()
    # One plane of the sweep moves a pixel by at most 0.75; 0.25 px of 0.8 x 115 / 4 = 23 px of disparity is 1 %.
    assert float(error.median()) < 0.01
    assert float(error.mean()) < 0.02
    assert float(result.confident.float().mean()) > 0.8
    assert_usable(result, 3)


def test_a_depth_step_keeps_its_place() -> None:
    board = scenes.Rectangle(corner=(-0.4, -3, 2.0), edge_u=(0.8, 0, 0), edge_v=(0, 6, 0), seed=5)
    scene = scenes.render([scenes.wall(5.0, 4), board], scenes.arc(3, 0.6, (0, 0, 3.0)), 0.9 * WIDTH, HEIGHT, WIDTH)
    result = run(scene, points_of(scene))
    near_truth = scene.depth[1] < 3.0
    near_found = result.depth[1] < 3.0
    # Half of a 7 px window at either side of the board's two edges, of its 46 px width: intersection over union > 0.8.
    overlap = float((near_truth & near_found).sum() / (near_truth | near_found).sum())
    assert overlap > 0.8
    inner = torch.zeros_like(near_truth)
    inner[8:-8, 8:-8] = True
    sure = result.confident[1] & inner
    assert bool(sure.any())
    error = (result.depth[1] / scene.depth[1] - 1).abs()[sure]
    assert float((error < 0.1).float().mean()) > 0.9


def test_matching_beats_interpolation_and_the_mask_is_worth_having(room: scenes.Scene) -> None:
    result = run(room, points_of(room))
    interpolated = result.depth * channel(result, "sparse").exp()

    def error(depth: Tensor) -> Tensor:
        return (depth / room.depth - 1).abs()

    assert float(error(result.depth).mean()) < 0.7 * float(error(interpolated).mean())
    sure = result.confident
    assert 0.3 < float(sure.float().mean()) < 1
    assert float(error(result.depth)[sure].mean()) < float(error(result.depth)[~sure].mean())


def test_wrong_sparse_points_do_not_carry_it_away(room: scenes.Scene) -> None:
    clean = run(room, points_of(room))
    dirty = run(room, points_of(room, outliers=0.4))
    assert_usable(dirty, 3)
    median_error = float((dirty.depth / room.depth - 1).abs().median())
    # Images still speak where there is texture: half of the pixels stay close to the truth.
    assert median_error < 0.1 + float((clean.depth / room.depth - 1).abs().median())


def test_wrong_poses_lower_the_confident_share(room: scenes.Scene) -> None:
    sparse = points_of(room)
    generator = torch.Generator().manual_seed(1)
    wrong = dataclasses.replace(room, world_from_cam=perturb_poses(room.world_from_cam, 4.0, 0.1, generator))
    right_share = float(run(room, sparse).confident.float().mean())
    result = run(wrong, sparse)
    assert_usable(result, 3)
    # The points are still right here, and what follows from them: half of the pixels stay within 5 % of the truth, of 90 %.
    assert float(result.confident.float().mean()) < 0.8 * right_share


def test_cameras_that_fit_have_the_larger_checked_share(room: scenes.Scene) -> None:
    sparse = points_of(room)
    posed = torch.ones(3, dtype=torch.bool)

    def share(poses: Tensor, known: Tensor = posed) -> float:
        cameras = dataclasses.replace(room.cameras, world_from_cam=poses)
        return checked_share(room.images, cameras, sparse, CONFIG, posed=known)

    right = share(room.world_from_cam)
    assert right > 0.5
    # Two degrees are 8 of 230 pixels here: what still matches is surfaces along the motion.
    wrong = perturb_poses(room.world_from_cam, 2.0, 0.1, torch.Generator().manual_seed(1))
    assert share(wrong) < 0.7 * right
    assert share(room.world_from_cam, torch.tensor([True, True, False])) < right, "views without a pose confirm nothing"
    assert share(room.world_from_cam, torch.tensor([True, False, False])) == 0


def test_confidence_is_a_probability_and_the_mask_its_threshold(room: scenes.Scene) -> None:
    result = run(room, points_of(room))
    assert 0 <= float(result.confidence.min()) <= float(result.confidence.max()) <= 1
    assert bool((result.confidence[result.confident] >= CONFIG.min_confidence).all())
    dropped = (result.confidence >= CONFIG.min_confidence) & ~result.confident
    assert float(dropped.float().mean()) < 0.05, "small islands alone"
    unmatched = run(room, points_of(room), posed=torch.tensor([True, True, False]))
    assert float(unmatched.confidence[2].max()) == 0


def test_threads_and_repetition_do_not_change_a_bit(room: scenes.Scene) -> None:
    sparse = points_of(room)
    first = run(room, sparse)
    for threads in (1, 3):
        again = run(room, sparse, DenseConfig(threads=threads))
        assert torch.equal(first.depth, again.depth)
        assert torch.equal(first.evidence, again.evidence)


def test_one_view(room: scenes.Scene) -> None:
    alone = scenes.Scene(
        images=room.images[:1],
        depth=room.depth[:1],
        world_from_cam=room.world_from_cam[:1],
        intrinsics_px=room.intrinsics_px[:1],
    )
    sparse = points_of(alone)
    result = run(alone, sparse)
    assert_usable(result, 1)
    assert not bool(result.confident.any())
    assert float((channel(result, "distance").exp() - 1).min()) < 1  # the points still count


def test_no_points_gives_a_smooth_guess(room: scenes.Scene) -> None:
    result = run(room, SparsePoints.empty())
    assert_usable(result, 3)


def test_no_points_and_one_view() -> None:
    image = torch.rand(1, 3, 40, 56, generator=torch.Generator().manual_seed(0))
    intrinsics = torch.tensor([[[50.0, 0, 28], [0, 50, 20], [0, 0, 1]]])
    result = dense_depth(image, Cameras(torch.eye(4)[None], intrinsics, 40, 56), SparsePoints.empty(), CONFIG)
    assert_usable(result, 1)
    assert not bool(result.confident.any())


def test_pure_rotation_is_not_matched() -> None:
    poses = scenes.arc(3, 0.8)
    poses[:, :3, 3] = 0
    scene = scenes.render([scenes.wall(4.0, 7)], poses, 0.9 * WIDTH, HEIGHT, WIDTH)
    result = run(scene, points_of(scene, outliers=0.0))
    assert_usable(result, 3)
    assert not bool(result.confident.any())
    # Three per cent of noise on the points, averaged: their interpolation is what is left.
    assert float((result.depth / scene.depth - 1).abs().median()) < 0.05


def test_an_unposed_view_is_left_out(room: scenes.Scene) -> None:
    posed = torch.tensor([True, True, False])
    nonsense = room.world_from_cam.clone()
    nonsense[2, :3, 3] = torch.tensor([100.0, -3.0, 7.0])
    result = run(dataclasses.replace(room, world_from_cam=nonsense), points_of(room), posed=posed)
    assert_usable(result, 3)
    assert not bool(result.confident[2].any())
    assert bool(result.confident[0].any())
    ratio = float(result.depth[2].median() / result.depth[:2].median())
    assert 1 / 3 < ratio < 3  # in the scale of the others


def test_a_plain_image_is_usable() -> None:
    scene = scenes.render([scenes.wall(4.0, 7, contrast=0.0)], scenes.arc(3, 0.8), 0.9 * WIDTH, HEIGHT, WIDTH)
    result = run(scene, points_of(scene, outliers=0.0))
    assert_usable(result, 3)
    assert float((result.depth / scene.depth - 1).abs().median()) < 0.05


def test_large_images_are_matched_small_and_answered_large(wall: scenes.Scene) -> None:
    result = run(wall, points_of(wall, outliers=0.0), DenseConfig(threads=1, work_px=80))
    assert result.depth.shape == wall.depth.shape
    assert_usable(result, 3)
    assert float((result.depth / wall.depth - 1).abs().median()) < 0.03


def test_pictures_and_cameras_that_do_not_belong_together_are_refused(wall: scenes.Scene) -> None:
    for cameras in (wall.cameras[:2], wall.cameras.resized(HEIGHT // 2, WIDTH // 2)):
        with pytest.raises(ValueError, match=f"3 images of {HEIGHT} x {WIDTH} pixels, {len(cameras)} cameras of"):
            dense_depth(wall.images, cameras, SparsePoints.empty(), CONFIG)
