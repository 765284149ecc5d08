"""Similarities from points and from poses."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from sceneexpander.geometry.randomness import child_generator
from sceneexpander.geometry.rigid import look_at, rigid_from_parts, rotation_from_quat_wxyz
from sceneexpander.geometry.similarity import Similarity, align_poses, umeyama


def random_similarity(seed: int, scale: float = 2.5) -> Similarity:
    generator = child_generator(seed, "similarity")
    rotation = rotation_from_quat_wxyz(torch.randn(4, generator=generator, dtype=torch.float64))
    return Similarity(
        scale=scale, rotation=rotation, translation=torch.randn(3, generator=generator, dtype=torch.float64)
    )


def random_poses(count: int, seed: int) -> torch.Tensor:
    generator = child_generator(seed, "poses")
    quat = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    centres = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return rigid_from_parts(rotation_from_quat_wxyz(quat), centres)


def assert_same(a: Similarity, b: Similarity, atol: float = 1e-9) -> None:
    assert a.scale == pytest.approx(b.scale, abs=atol)
    assert_close(a.rotation, b.rotation, atol=atol, rtol=0)
    assert_close(a.translation, b.translation, atol=atol, rtol=0)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("flat", [False, True])
def test_umeyama_finds_the_similarity(seed: int, flat: bool) -> None:
    truth = random_similarity(seed)
    points = torch.randn(8, 3, generator=child_generator(seed, "points"), dtype=torch.float64)
    if flat:
        points[:, 2] = 0  # in a plane a mirror image fits as well: the rotation must still be proper
    assert_same(umeyama(points, truth.points(points)), truth)


def test_umeyama_is_least_squares() -> None:
    generator = child_generator(0, "noisy")
    points = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    target = random_similarity(1).points(points) + 0.1 * torch.randn(20, 3, generator=generator, dtype=torch.float64)
    best = umeyama(points, target)
    error = float(((best.points(points) - target) ** 2).sum())
    for seed in range(20):
        nudge = 1e-3 * torch.randn(3, generator=child_generator(seed, "nudge"), dtype=torch.float64)
        small = rotation_from_quat_wxyz(torch.cat([torch.ones(1, dtype=torch.float64), nudge]))
        for other in (
            Similarity(scale=best.scale, rotation=small @ best.rotation, translation=best.translation),
            Similarity(scale=best.scale * (1 + float(nudge[0])), rotation=best.rotation, translation=best.translation),
            Similarity(scale=best.scale, rotation=best.rotation, translation=best.translation + nudge),
        ):
            assert float(((other.points(points) - target) ** 2).sum()) > error


def test_umeyama_never_mirrors() -> None:
    points = torch.randn(10, 3, generator=child_generator(0, "mirror"), dtype=torch.float64)
    mirrored = points * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert float(torch.linalg.det(umeyama(points, mirrored).rotation)) == pytest.approx(1)


def test_umeyama_refuses_what_is_not_determined() -> None:
    line = torch.arange(5.0)[:, None] * torch.tensor([[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="one line"):
        umeyama(line, line)
    with pytest.raises(ValueError, match="three or more"):
        umeyama(line[:2], line[:2])


@pytest.mark.parametrize("count", [2, 3, 6])
def test_align_poses_finds_the_similarity(count: int) -> None:
    truth, poses = random_similarity(3), random_poses(count, 4)
    assert_same(align_poses(poses, truth.poses(poses)), truth)


def test_align_poses_on_a_straight_line() -> None:
    eyes = torch.arange(4, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    target = torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64).expand(4, 3)
    poses = look_at(eyes, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    truth = random_similarity(5)
    assert_same(align_poses(poses, truth.poses(poses)), truth)


def test_align_poses_with_a_given_scale() -> None:
    truth, poses = random_similarity(6), random_poses(1, 7)
    assert_same(align_poses(poses, truth.poses(poses), scale=2.5), truth)
    with pytest.raises(ValueError, match="positive scale"):
        align_poses(poses, truth.poses(poses))


def test_inverse_undoes() -> None:
    truth, poses = random_similarity(8), random_poses(3, 9)
    assert_close(truth.inverse().poses(truth.poses(poses)), poses, atol=1e-12, rtol=0)
    points = poses[:, :3, 3]
    assert_close(truth.inverse().points(truth.points(points)), points, atol=1e-12, rtol=0)


def test_enlarging_multiplies_the_target_frame() -> None:
    truth, points = random_similarity(10), random_poses(4, 11)[:, :3, 3]
    assert_close(truth.enlarged(0.4).points(points), 0.4 * truth.points(points), atol=1e-12, rtol=0)


def test_align_poses_finds_a_scale_below_one_and_refuses_one_below_nothing() -> None:
    truth, poses = random_similarity(12, scale=0.3), random_poses(4, 13)
    assert_same(align_poses(poses, truth.poses(poses)), truth)
    mirrored = poses.clone()
    mirrored[:, :3, 3] *= -1  # the same orientations, every centre on the other side
    with pytest.raises(ValueError, match="positive scale"):
        align_poses(poses, mirrored)
