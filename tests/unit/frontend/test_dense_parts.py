"""The pieces of the dense base, each against a dull twin or a closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sceneexpander.frontend.fill import interpolate_sparse, pixels_to_nearest, segment_planes, smooth_fill
from sceneexpander.frontend.segments import segment_colours
from sceneexpander.frontend.sgm import COST_SCALE, aggregate, best_hypothesis
from sceneexpander.frontend.sparse_points import SparsePoints
from sceneexpander.geometry.camera import project_points
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rotation_angle_deg
from sceneexpander.training.simulated import perturb_poses, sample_sparse_points


def slow_aggregate(cost: np.ndarray, guide: np.ndarray, near: float, jump: float, contrast: float) -> np.ndarray:
    """Eight path costs pixel by pixel, straight from the recursion."""
    height, planes, width = cost.shape
    total = np.zeros_like(cost, dtype=np.int64)
    for dy, dx in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)]:
        path = np.zeros((height, planes, width), np.int64)
        for y in range(height)[:: dy or 1]:
            for x in range(width)[:: dx or 1]:
                py, px = y - dy, x - dx
                if not (0 <= py < height and 0 <= px < width):
                    path[y, :, x] = cost[y, :, x]
                    continue
                before, floor = path[py, :, px], path[py, :, px].min()
                step = np.float32(jump) / (1 + contrast * np.abs(guide[y, x] - guide[py, px]))
                for k in range(planes):
                    options = [before[k], floor + int(np.rint(step * COST_SCALE))]
                    options += [before[j] + round(near * COST_SCALE) for j in (k - 1, k + 1) if 0 <= j < planes]
                    path[y, k, x] = cost[y, k, x] + min(options) - floor
        total += path
    return total


def test_aggregation_is_the_recursion() -> None:
    rng = np.random.default_rng(0)
    cost = rng.integers(0, 2400, (7, 6, 9)).astype(np.int16)
    guide = rng.random((7, 9)).astype(np.float32)
    fast = aggregate(cost, guide, penalty_near=0.04, penalty_jump=0.35, contrast=12.0, diagonals=True)
    slow = slow_aggregate(cost, guide, 0.04, 0.35, 12.0)
    # The penalty is rounded from float32 arithmetic in both: one unit per path at most.
    assert np.abs(fast - slow).max() <= 8


def test_the_largest_costs_do_not_overflow() -> None:
    cost = np.full((12, 8, 12), int(1.35 * COST_SCALE), np.int16)
    cost[:, 3] = 0
    total = aggregate(
        cost, np.zeros((12, 12), np.float32), penalty_near=0.04, penalty_jump=0.35, contrast=12.0, diagonals=True
    )
    assert total.min() >= 0
    assert (best_hypothesis(total, margin=0.6).index == 3).all()


def test_the_parabola_finds_the_minimum_between_hypotheses() -> None:
    truth = 4.3
    cost = ((np.arange(9) - truth) ** 2 * 100).astype(np.int16)
    best = best_hypothesis(np.tile(cost[None, :, None], (2, 1, 3)), margin=0.1)
    assert (best.index == 4).all()
    assert best.offset == pytest.approx(0.3, abs=0.01)  # costs are whole numbers: 1 in 200
    assert ((best.ambiguity > 0) & (best.ambiguity <= 1)).all()


def test_a_flat_cost_is_fully_ambiguous() -> None:
    best = best_hypothesis(np.full((2, 5, 2), 100, np.int16), margin=0.1)
    assert (best.ambiguity == 1).all()
    assert (best.offset == 0).all()


def test_segments_follow_flat_colours() -> None:
    image = np.full((40, 60, 3), 0.2, np.float32)
    image[:, 30:] = 0.8
    image[10:30, 5:20] = (0.9, 0.1, 0.1)
    image += np.random.default_rng(0).normal(0, 0.01, image.shape).astype(np.float32)
    (labels,) = segment_colours(image, tolerances=(0.8,), min_size=30)
    inner = [labels[13:27, 8:17], labels[3:37, 33:57], labels[33:37, 3:27]]
    assert all(len(np.unique(part)) == 1 for part in inner)
    assert len({int(part[0, 0]) for part in inner}) == 3
    assert set(np.unique(labels)) == set(range(labels.max() + 1))


def test_segments_are_nested_and_not_too_small() -> None:
    image = np.random.default_rng(1).random((30, 40, 3)).astype(np.float32)
    fine, coarse = segment_colours(image, tolerances=(0.5, 2.0), min_size=12)
    assert np.bincount(fine.ravel()).min() >= 12
    assert len(np.unique(fine.ravel().astype(np.int64) * 10000 + coarse.ravel())) == fine.max() + 1
    assert coarse.max() <= fine.max()


def test_segment_planes_survive_outliers() -> None:
    y, x = np.mgrid[0:40, 0:50] + 0.5
    truth = (0.2 + 0.002 * x + 0.001 * y).astype(np.float32)
    rng = np.random.default_rng(0)
    known = rng.random(truth.shape) < 0.05
    value = np.where(known & (rng.random(truth.shape) < 0.3), 0.9, truth).astype(np.float32)
    plane, support = segment_planes(
        np.zeros(truth.shape, np.int32), value, known.astype(np.float32), (0.01, 1.0), tolerance=0.05, min_samples=12
    )
    # The inliers are exact, so is the plane, up to float32.
    assert plane == pytest.approx(truth, rel=1e-3)
    assert 0.6 < float(support[0, 0]) < 0.8


def test_segments_without_samples_have_no_plane() -> None:
    labels = np.repeat(np.arange(2, dtype=np.int32), 20)[None].repeat(20, axis=0)
    weight = np.zeros(labels.shape, np.float32)
    weight[5:15, 2:12] = 1
    _, support = segment_planes(
        labels, np.full(labels.shape, 0.5, np.float32), weight, (0.1, 1.0), tolerance=0.05, min_samples=12
    )
    assert (support[labels == 0] > 0.9).all()
    assert (support[labels == 1] == 0).all()


def test_smooth_fill_keeps_what_is_known_and_stops_at_colour_edges() -> None:
    rgb = np.zeros((30, 40, 3), np.float32)
    rgb[:, 20:] = 1
    value, weight = np.zeros((30, 40), np.float32), np.full((30, 40), 1e-6, np.float32)
    value[10, 5], weight[10, 5] = 1.0, 10
    value[20, 35], weight[20, 35] = 2.0, 10
    filled = smooth_fill(value, weight, rgb, reach_px=20, stiffness=4, colour_sigma=0.04)
    assert filled[:, :20] == pytest.approx(1.0, abs=0.05)
    assert filled[:, 20:] == pytest.approx(2.0, abs=0.05)


def test_smooth_fill_of_a_constant_is_the_constant() -> None:
    rng = np.random.default_rng(0)
    rgb, weight = rng.random((20, 25, 3)).astype(np.float32), rng.random((20, 25)).astype(np.float32) + 0.01
    filled = smooth_fill(np.full((20, 25), -1.5, np.float32), weight, rgb, reach_px=9, stiffness=2, colour_sigma=0.1)
    assert filled == pytest.approx(-1.5, abs=1e-5)


def test_interpolation_passes_near_its_points_and_stays_between_them() -> None:
    xy, value = np.array([[10.0, 10], [50, 30]]), np.array([1.0, 3.0])
    image = interpolate_sparse(xy, value, (40, 64), softness_px=0.5)
    assert image.min() >= 1 - 1e-5
    assert image.max() <= 3 + 1e-5
    assert image[10, 10] == pytest.approx(1, abs=0.05)
    assert image[30, 50] == pytest.approx(3, abs=0.05)


def test_distance_to_the_nearest_point() -> None:
    found = pixels_to_nearest(np.array([[4.5, 6.5]]), (20, 30))
    assert found[6, 4] == 0
    assert found[6, 14] == pytest.approx(10, rel=0.03)  # the 5x5 chamfer mask is accurate to 2 %
    assert (pixels_to_nearest(np.zeros((0, 2)), (3, 4)) == 5).all()


def tilted_views() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(2, 3, 30, 40, generator=generator)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 0, 3] = 0.3
    intrinsics = torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]).repeat(2, 1, 1)
    return images, torch.full((2, 30, 40), 4.0), pose, intrinsics


def test_simulated_points_without_noise_lie_on_the_surface() -> None:
    images, depth, pose, intrinsics = tilted_views()
    points = sample_sparse_points(
        images,
        depth,
        depth > 0,
        Cameras(pose, intrinsics, 30, 40),
        torch.Generator().manual_seed(3),
        per_view=(30, 30),
        depth_noise=0,
        outliers=0,
    )
    assert points.points_world.shape[0] == 60
    assert len(points.view_index) > 60  # most are seen by both views
    assert points.points_world[:, 2] == pytest.approx(4.0, abs=1e-4)
    for view in range(2):
        mine = points.view_index == view
        xy, _ = project_points(points.points_world[points.point_index[mine]], intrinsics[view], pose[view])
        assert xy == pytest.approx(points.pixel_xy[mine], abs=1e-3)


def test_simulated_noise_moves_depth_not_pixels_and_skips_invalid() -> None:
    images, depth, pose, intrinsics = tilted_views()
    depth[:, :15] = torch.inf
    cameras, generator = Cameras(pose, intrinsics, 30, 40), torch.Generator().manual_seed(3)
    points = sample_sparse_points(images, depth, torch.isfinite(depth), cameras, generator, per_view=(40, 40))
    assert bool(torch.isfinite(points.points_world).all())
    assert float(points.pixel_xy[:, 1].min()) >= 15
    assert float(points.points_world[:, 2].std()) > 0.03
    assert float(points.points_world[:, 2].median()) == pytest.approx(4.0, rel=0.03)


def test_perturbed_poses_have_the_asked_size() -> None:
    generator = torch.Generator().manual_seed(0)
    pose = torch.eye(4).repeat(400, 1, 1)
    pose[:, :3, 3] = torch.randn(400, 3, generator=generator)
    moved = perturb_poses(pose, 0.5, 0.02, generator)
    assert torch.equal(moved[0], pose[0])
    angle = rotation_angle_deg(pose[1:, :3, :3], moved[1:, :3, :3])
    # Root mean square of 399 normal angles: 3.5 % standard error.
    assert float(angle.square().mean().sqrt()) == pytest.approx(0.5, rel=0.12)
    step = (moved - pose)[1:, :3, 3].norm(dim=-1).square().mean().sqrt()
    baseline = torch.pdist(pose[:, :3, 3]).mean()
    assert float(step / baseline) == pytest.approx(0.02, rel=0.12)


@pytest.mark.wrong_shapes
def test_observations_must_name_existing_points() -> None:
    one = torch.zeros(1, dtype=torch.long)
    with pytest.raises(ValueError, match="point_index"):
        SparsePoints(points_world=torch.zeros(0, 3), view_index=one, point_index=one, pixel_xy=torch.zeros(1, 2))
    with pytest.raises(ValueError, match="same observations"):
        SparsePoints(points_world=torch.zeros(1, 3), view_index=one, point_index=one, pixel_xy=torch.zeros(2, 2))
