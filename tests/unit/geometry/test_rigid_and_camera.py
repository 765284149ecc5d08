"""One test per sentence of the conventions."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneexpander.geometry.camera import (
    camera_vector_from_pose,
    fov_rad_from_intrinsics,
    intrinsics_from_fov,
    pixel_centres,
    pose_from_camera_vector,
    project_points,
    resize_intrinsics,
    unproject_depth,
    unproject_to_world,
)
from sceneexpander.geometry.gauge import camera_vectors_relative_to, poses_relative_to, scale_camera_vectors
from sceneexpander.geometry.rigid import (
    look_at,
    quat_wxyz_from_rotation,
    rigid_from_parts,
    rigid_inverse,
    rotation_angle_deg,
    rotation_from_quat_wxyz,
    slerp_wxyz,
    transform_points,
)

seeds = st.integers(0, 2**31 - 1)


def random_pose(seed: int, count: int = 1) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    quat = torch.randn(count, 4, generator=g, dtype=torch.float64)
    if seed % 3 == 0:  # near half turns: the hard case of quaternion extraction
        quat[:, 0] = 1e-4 * quat[:, 0]
    return rigid_from_parts(rotation_from_quat_wxyz(quat), torch.randn(count, 3, generator=g, dtype=torch.float64))


@given(seeds)
@settings(max_examples=50, deadline=None)
def test_inverse_undoes(seed: int) -> None:
    pose = random_pose(seed, 3)
    torch.testing.assert_close(rigid_inverse(pose) @ pose, torch.eye(4, dtype=torch.float64).expand(3, 4, 4))


@given(seeds)
@settings(max_examples=50, deadline=None)
def test_quaternion_round_trip(seed: int) -> None:
    rotation = random_pose(seed, 4)[:, :3, :3]
    quat = quat_wxyz_from_rotation(rotation)
    assert (quat[:, 0] >= 0).all()
    torch.testing.assert_close(rotation_from_quat_wxyz(quat), rotation)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(4, dtype=torch.float64))


def test_quaternions_are_scalar_first() -> None:
    quarter_turn_about_z = torch.tensor([2**-0.5, 0, 0, 2**-0.5])
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(rotation_from_quat_wxyz(quarter_turn_about_z), expected)


@given(seeds, st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_slerp_is_proportional_to_the_angle(seed: int, fraction: float) -> None:
    a, b = quat_wxyz_from_rotation(random_pose(seed, 2)[:, :3, :3])
    middle = slerp_wxyz(a, b, fraction)
    whole = rotation_angle_deg(rotation_from_quat_wxyz(a), rotation_from_quat_wxyz(b))
    part = rotation_angle_deg(rotation_from_quat_wxyz(a), rotation_from_quat_wxyz(middle))
    torch.testing.assert_close(part, whole * fraction, atol=1e-5, rtol=0)


def test_the_camera_looks_along_plus_z_with_y_down() -> None:
    intrinsics = intrinsics_from_fov(torch.tensor(1.0), torch.tensor(1.0), 2, 2)
    points = unproject_depth(torch.full((2, 2), 3.0), intrinsics)
    assert (points[..., 2] == 3).all()
    assert points[0, 0, 1] < 0 < points[1, 0, 1]
    assert points[0, 0, 0] < 0 < points[0, 1, 0]


def test_the_first_pixel_centre_is_at_one_half() -> None:
    centres = pixel_centres(3, 4, like=torch.zeros(()))
    assert centres[0, 0].tolist() == [0.5, 0.5]
    assert centres[2, 3].tolist() == [3.5, 2.5]


def test_depth_is_z_depth_not_ray_length() -> None:
    intrinsics = intrinsics_from_fov(torch.tensor(1.2), torch.tensor(1.0), 6, 8)
    points = unproject_depth(torch.full((6, 8), 2.0), intrinsics)
    assert float(points[0, 0].norm()) > 2.2
    assert (points[..., 2] == 2).all()


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_project_inverts_unproject(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    pose = random_pose(seed)[0]
    fov = torch.rand(2, generator=g, dtype=torch.float64) + 0.4
    intrinsics = intrinsics_from_fov(fov[0], fov[1], 5, 7)
    depth = torch.rand(5, 7, generator=g, dtype=torch.float64) + 0.5
    points = unproject_to_world(depth, intrinsics, pose)
    pixels, z = project_points(points.reshape(-1, 3), intrinsics, pose)
    torch.testing.assert_close(pixels.reshape(5, 7, 2), pixel_centres(5, 7, like=depth))
    torch.testing.assert_close(z.reshape(5, 7), depth)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_camera_vector_round_trip(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    pose = random_pose(seed, 3)
    fov = torch.rand(2, 3, generator=g, dtype=torch.float64) + 0.4
    intrinsics = intrinsics_from_fov(fov[0], fov[1], 60, 80)
    vector = camera_vector_from_pose(pose, intrinsics, 60, 80)
    back, intrinsics_back = pose_from_camera_vector(vector, 60, 80)
    torch.testing.assert_close(back, pose)
    torch.testing.assert_close(intrinsics_back, intrinsics)
    fov_x, fov_y = fov_rad_from_intrinsics(intrinsics, 60, 80)
    torch.testing.assert_close(vector[:, 7], fov_y)
    torch.testing.assert_close(vector[:, 8], fov_x)


def test_the_camera_vector_is_cam_from_world_with_scalar_last() -> None:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    vector = camera_vector_from_pose(pose, intrinsics_from_fov(torch.tensor(1.0), torch.tensor(0.8), 4, 4), 4, 4)
    torch.testing.assert_close(vector, torch.tensor([-1.0, -2, -3, 0, 0, 0, 1, 0.8, 1.0]))


def test_resizing_scales_the_intrinsics_without_half_pixels() -> None:
    intrinsics = intrinsics_from_fov(torch.tensor(1.0), torch.tensor(0.8), 30, 40)
    expected = intrinsics_from_fov(torch.tensor(1.0), torch.tensor(0.8), 60, 80)
    torch.testing.assert_close(resize_intrinsics(intrinsics, 2, 2), expected)


def test_look_at_faces_the_target_and_keeps_up_up() -> None:
    pose = look_at(torch.tensor([0.0, -1, -5]), torch.tensor([0.0, -1, 0]), torch.tensor([0.0, -1, 0]))
    ahead = transform_points(rigid_inverse(pose), torch.tensor([[0.0, -1, 0], [0.0, -2, 0]]))
    torch.testing.assert_close(ahead, torch.tensor([[0.0, 0, 5], [0.0, -1, 5]]))


@pytest.mark.parametrize("reference", [0, 2])
def test_changing_the_reference_view_changes_vectors_and_poses_alike(reference: int) -> None:
    pose = random_pose(5, 4)
    intrinsics = intrinsics_from_fov(torch.full((4,), 1.0).double(), torch.full((4,), 0.8).double(), 6, 8)
    vector = camera_vector_from_pose(pose, intrinsics, 6, 8)
    moved, _ = pose_from_camera_vector(camera_vectors_relative_to(vector, reference), 6, 8)
    torch.testing.assert_close(moved, poses_relative_to(pose, reference))
    torch.testing.assert_close(moved[reference], torch.eye(4, dtype=torch.float64))


def test_scaling_camera_vectors_scales_positions_only() -> None:
    pose = random_pose(7, 2)
    intrinsics = intrinsics_from_fov(torch.full((2,), 1.0).double(), torch.full((2,), 0.8).double(), 6, 8)
    scaled, _ = pose_from_camera_vector(
        scale_camera_vectors(camera_vector_from_pose(pose, intrinsics, 6, 8), 2.5), 6, 8
    )
    torch.testing.assert_close(scaled[:, :3, :3], pose[:, :3, :3])
    torch.testing.assert_close(scaled[:, :3, 3], 2.5 * pose[:, :3, 3])
