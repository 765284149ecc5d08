"""Camera paths: smooth, exact at their keys, well defined for degenerate keys."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import look_at, quat_wxyz_from_rotation, rotation_angle_deg, rotation_from_quat_wxyz
from sceneexpander.geometry.trajectory import focus_depth, mean_up, navigation, orbit, shortest_path_order, spiral

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def random_cameras(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    eye = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    target = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64) + 0.5 * torch.randn(
        count, 3, generator=generator, dtype=torch.float64
    )
    focal = 80 + 40 * torch.rand(count, generator=generator, dtype=torch.float64)
    k = torch.zeros(count, 3, 3, dtype=torch.float64)
    k[:, 0, 0] = k[:, 1, 1] = focal
    k[:, 0, 2], k[:, 1, 2], k[:, 2, 2] = 50, 40, 1
    return look_at(eye, target, UP), k


def flown(poses: Tensor, k: Tensor, frames: int, order: Sequence[int]) -> tuple[Tensor, Tensor]:
    path = navigation(Cameras(poses, k, 80, 100), frames, order)
    assert (path.height, path.width) == (80, 100)
    return path.world_from_cam, path.intrinsics_px


def frame_of(path: Tensor, pose: Tensor) -> tuple[int, float]:
    error = (path - pose).abs().flatten(1).amax(1)
    return int(error.argmin()), float(error.min())


@pytest.mark.parametrize("frames", [6, 7, 25, 120])
def test_navigation_meets_every_key_in_order(frames: int) -> None:
    poses, k = random_cameras(6)
    order = [2, 0, 5, 1, 4, 3]
    path, path_k = flown(poses, k, frames, order)
    assert path.shape == (frames, 4, 4)
    hits = [frame_of(path, poses[key]) for key in order]
    assert max(error for _, error in hits) < 1e-12  # float64 rounding
    at = [index for index, _ in hits]
    assert at == sorted(set(at))
    assert (at[0], at[-1]) == (0, frames - 1)
    torch.testing.assert_close(path_k[at], k[order])


def test_navigation_velocity_is_continuous_and_zero_at_the_ends() -> None:
    poses, k = random_cameras(5)
    sizes = {}
    for frames in (401, 1601):
        path, path_k = flown(poses, k, frames, range(5))
        quats = quat_wxyz_from_rotation(path[:, :3, :3])
        quats = (
            quats * torch.cumprod(torch.cat([torch.ones(1), torch.sign((quats[1:] * quats[:-1]).sum(-1))]), 0)[:, None]
        )
        values = torch.cat([path[:, :3, 3], quats, path_k[:, 0, :1] / 100], 1)
        velocity = values.diff(dim=0) * (frames - 1)
        sizes[frames] = (velocity.norm(dim=-1).max(), velocity.diff(dim=0).norm(dim=-1).max(), velocity[[0, -1]].norm())
    # Jumps of a continuous velocity shrink with the step (by four), those of a discontinuous one would stay.
    assert sizes[1601][0] == pytest.approx(float(sizes[401][0]), rel=0.05)
    assert sizes[1601][1] < 0.35 * sizes[401][1]
    assert sizes[1601][2] < 0.35 * sizes[401][2]


def test_navigation_poses_are_rigid_and_stay_near_their_keys() -> None:
    poses, k = random_cameras(8, seed=3)
    path, _ = flown(poses, k, 200, range(8))
    rotation = path[:, :3, :3]
    identity = torch.eye(3, dtype=path.dtype).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.transpose(-1, -2), identity)
    low, high = poses[:, :3, 3].amin(0), poses[:, :3, 3].amax(0)
    room = 0.5 * (high - low)  # splines overshoot a little, not by the size of the scene
    assert ((path[:, :3, 3] > low - room) & (path[:, :3, 3] < high + room)).all()


def test_navigation_with_coinciding_keys_pauses_without_leaving() -> None:
    poses, k = random_cameras(3)
    path, _ = flown(poses, k, 60, [0, 1, 1, 2, 1, 0])
    assert torch.isfinite(path).all()
    same = (path - poses[1]).abs().flatten(1).amax(1) < 1e-12
    assert same.sum() >= 3
    still, _ = flown(poses, k, 10, [1, 1, 1])
    torch.testing.assert_close(still, poses[1].expand(10, 4, 4))


def test_navigation_turns_by_half_turns_and_pure_rotations() -> None:
    half = rotation_from_quat_wxyz(torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [1, 0, 1, 0]], dtype=torch.float64))
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, :3, :3] = half
    _, k = random_cameras(3)
    path, _ = flown(poses, k, 41, [0, 1, 2, 0])
    assert torch.isfinite(path).all()
    assert max(frame_of(path, pose)[1] for pose in poses) < 1e-12
    step = rotation_angle_deg(path[:-1, :3, :3], path[1:, :3, :3])
    assert step.max() < 40


def test_navigation_with_few_frames_and_single_keys() -> None:
    poses, k = random_cameras(4)
    few, _ = flown(poses, k, 2, range(4))
    torch.testing.assert_close(few, poses[[0, 3]])
    one, _ = flown(poses, k, 1, range(4))
    torch.testing.assert_close(one[0], poses[0])
    single, single_k = flown(poses, k, 5, [2])
    torch.testing.assert_close(single, poses[2].expand(5, 4, 4))
    torch.testing.assert_close(single_k, k[2].expand(5, 3, 3))


def test_navigation_refuses_nonsense() -> None:
    poses, k = random_cameras(3)
    with pytest.raises(ValueError, match="at least one key"):
        flown(poses, k, 5, [])
    with pytest.raises(ValueError, match="outside"):
        flown(poses, k, 5, [0, 3])
    with pytest.raises(ValueError, match="not finite"):
        flown(poses * torch.nan, k, 5, [0, 1])


def test_shortest_path_is_the_best_of_all_orders() -> None:
    for seed in range(4):
        poses, _ = random_cameras(6, seed)
        centres = poses[:, :3, 3]

        def length(order: tuple[int, ...] | list[int], centres: Tensor = centres) -> float:
            return float((centres[list(order)].diff(dim=0)).norm(dim=-1).sum())

        everything = [length(order) for order in itertools.permutations(range(6))]
        found = shortest_path_order(poses)
        assert sorted(found) == list(range(6))
        assert length(found) <= min(everything) + 1e-9
        ended = shortest_path_order(poses, last=4)
        assert ended[-1] == 4
        best = min(length(o) for o in itertools.permutations(range(6)) if o[-1] == 4)
        assert length(ended) <= best + 1e-9


def test_long_paths_are_nearly_shortest() -> None:
    # 24 cameras on a circle with a gap: the shortest path goes round from one side of the gap to the other.
    angle = torch.linspace(0, 1.9 * math.pi, 24)[torch.randperm(24, generator=torch.Generator().manual_seed(1))]
    poses = torch.eye(4).repeat(24, 1, 1)
    poses[:, 0, 3], poses[:, 1, 3] = torch.cos(angle), torch.sin(angle)
    walked = angle[shortest_path_order(poses)]
    assert torch.equal(walked, walked.sort().values) or torch.equal(walked.flip(0), walked.sort().values)


def test_shortest_path_of_a_row_of_cameras_walks_along_it() -> None:
    poses = torch.eye(4).repeat(6, 1, 1)
    poses[:, 0, 3] = torch.tensor([3.0, 0.0, 5.0, 1.0, 4.0, 2.0])
    assert shortest_path_order(poses) in ([1, 3, 5, 0, 4, 2], [2, 4, 0, 5, 3, 1])
    assert shortest_path_order(poses[:1]) == [0]
    assert sorted(shortest_path_order(torch.eye(4).repeat(4, 1, 1))) == [0, 1, 2, 3]


def test_orbit_carries_its_camera_around_the_target() -> None:
    pose, target = random_cameras(1)[0][0], torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    path = orbit(pose, target, 12, up=3 * UP)
    torch.testing.assert_close(path[0], pose)
    away = pose[:3, 3] - target
    eye = path[:, :3, 3] - target
    torch.testing.assert_close(eye.norm(dim=-1), away.norm().expand(12))
    torch.testing.assert_close(eye @ UP, (away @ UP).expand(12))  # as high as the camera
    # The target stays where it is in the picture, and equal steps bring the camera back where it began.
    seen = torch.einsum("fji,fj->fi", path[:, :3, :3], -eye)
    torch.testing.assert_close(seen, (pose[:3, :3].T @ -away).expand(12, 3))
    step = rotation_angle_deg(path[:, :3, :3], path.roll(-1, 0)[:, :3, :3])
    torch.testing.assert_close(step, torch.full((12,), 30.0, dtype=torch.float64))


def test_part_of_an_orbit_swings_to_both_sides() -> None:
    pose, target = random_cameras(1)[0][0], torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    path = orbit(pose, target, 40, up=UP, turn_rad=math.radians(50))
    turned = rotation_angle_deg(pose[:3, :3].expand(40, 3, 3), path[:, :3, :3])
    assert float(turned.max()) == pytest.approx(25)
    assert int(turned.argmax()) == 10
    torch.testing.assert_close(path[20], pose)
    apart = rotation_angle_deg(path[10, :3, :3], path[30, :3, :3])
    assert float(apart) == pytest.approx(50)


def test_orbit_refuses_nonsense() -> None:
    pose = random_cameras(1)[0][0]
    for changes in ({"frames": 0}, {"turn_rad": 0.0}, {"turn_rad": 7.0}, {"up": 0 * UP}):
        values = {"frames": 5, "up": UP, "turn_rad": 1.0} | changes
        with pytest.raises(ValueError, match="orbit with"):
            orbit(pose, UP, values.pop("frames"), **values)  # type: ignore[arg-type]


def test_spiral_starts_and_ends_at_its_camera_and_keeps_the_focus() -> None:
    pose = random_cameras(1)[0][0]
    path = spiral(pose, 4.0, 0.3, 50)
    torch.testing.assert_close(path[0], pose)
    torch.testing.assert_close(path[-1], pose)
    focus = pose[:3, 3] + 4 * pose[:3, 2]
    sight = torch.nn.functional.normalize(focus - path[:, :3, 3], dim=-1)
    torch.testing.assert_close(path[:, :3, 2], sight)
    distance = (path[:, :3, 3] - pose[:3, 3]).norm(dim=-1)
    assert 0.25 < distance.max() < 0.36


def test_up_is_the_mean_of_the_cameras_and_the_first_ones_where_they_cancel() -> None:
    poses, _ = random_cameras(5)
    up = mean_up(poses)
    assert float(up.norm()) == pytest.approx(1)
    mean = -poses[:, :3, 1].mean(0)
    torch.testing.assert_close(up, mean / mean.norm())
    turned = poses[:1].clone()
    turned[:, :3, :2] *= -1  # upside down
    against = torch.cat([poses[:1], turned])
    torch.testing.assert_close(mean_up(against), -poses[0, :3, 1])
    nearly = torch.cat([poses[:1].expand(11, 4, 4), turned.expand(9, 4, 4)])  # what is left has a tenth of the length
    torch.testing.assert_close(mean_up(nearly.flip(0)), poses[0, :3, 1], msg="the first one decides")


def test_one_turns_around_the_median_of_the_middle() -> None:
    """Whatever is at the border, on any side, does not matter; in the middle the median does, for each view alone."""
    depth = torch.full((2, 16, 24), 100.0)
    depth[0, 4:12, 6:18] = 3.0
    depth[1, 4:12, 6:18] = torch.arange(96.0).reshape(8, 12) + 1
    assert focus_depth(depth).tolist() == [3.0, 48.0]
    for rows, columns in ((slice(0, 4), slice(None)), (slice(12, 16), slice(None)), (slice(None), slice(0, 6))):
        other = depth.clone()
        other[:, rows, columns] = 0.5
        assert torch.equal(focus_depth(other), focus_depth(depth))
