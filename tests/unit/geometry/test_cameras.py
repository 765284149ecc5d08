"""Cameras as a value: what must hold for any of them."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneexpander.geometry.camera import project_points
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.lookup import sample_at
from sceneexpander.geometry.rigid import rigid_from_twist
from sceneexpander.geometry.similarity import Similarity

SIZES = st.tuples(st.integers(2, 9), st.integers(2, 9))


def some_cameras(seed: int, height: int = 4, width: int = 6, count: int = 3) -> Cameras:
    generator = torch.Generator().manual_seed(seed)
    poses = torch.stack([rigid_from_twist(torch.randn(6, generator=generator).double()) for _ in range(count)])
    intrinsics = torch.zeros(count, 3, 3)
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = 3 + 5 * torch.rand(2, count, generator=generator)
    intrinsics[:, 0, 2] = width * (0.3 + 0.4 * torch.rand(count, generator=generator))
    intrinsics[:, 1, 2] = height * (0.3 + 0.4 * torch.rand(count, generator=generator))
    intrinsics[:, 2, 2] = 1
    return Cameras(poses, intrinsics.double(), height, width)


def depths(cameras: Cameras, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 1 + torch.rand(len(cameras), cameras.height, cameras.width, generator=generator, dtype=torch.float64)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), size=SIZES)
def test_a_cameras_own_pixels_find_themselves(seed: int, size: tuple[int, int]) -> None:
    cameras = some_cameras(seed, *size)
    depth = depths(cameras, seed)
    points = cameras.unproject(depth)
    content = torch.rand(len(cameras), 2, *size, dtype=torch.float64)
    for index in range(len(cameras)):
        for mode in ("bilinear", "nearest"):
            there, found = cameras[index].look_up(points[index].reshape(-1, 3), content[index : index + 1], mode)
            assert found.in_frame.all()
            torch.testing.assert_close(found.depth[0], depth[index].flatten())
            torch.testing.assert_close(there[0], content[index].flatten(1))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999))
def test_projecting_is_what_the_pinhole_model_says(seed: int) -> None:
    cameras = some_cameras(seed)
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    found = cameras.project(points)
    pixel, z = project_points(points.expand(3, -1, -1), cameras.intrinsics_px, cameras.world_from_cam)
    inside = (z > 1e-6) & (pixel > 0).all(-1) & (pixel[..., 0] < 6) & (pixel[..., 1] < 4)
    assert torch.equal(found.in_frame, inside)
    expected = pixel / torch.tensor([3.0, 2.0]) - 1
    torch.testing.assert_close(found.grid[inside], expected[inside])
    torch.testing.assert_close(found.depth[inside], z[inside])


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), size=SIZES)
def test_the_size_of_pictures_changes_no_place_in_them(seed: int, size: tuple[int, int]) -> None:
    cameras = some_cameras(seed)
    points = cameras.unproject(depths(cameras, seed)).reshape(-1, 3)
    small, large = cameras.project(points), cameras.resized(*size).project(points)
    torch.testing.assert_close(large.grid, small.grid)
    torch.testing.assert_close(large.depth, small.depth)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), scale=st.floats(0.1, 10))
def test_another_frame_shows_the_same_pictures(seed: int, scale: float) -> None:
    cameras = some_cameras(seed)
    motion = rigid_from_twist(torch.randn(6, generator=torch.Generator().manual_seed(seed + 1)).double())
    other = Similarity(scale=scale, rotation=motion[:3, :3], translation=motion[:3, 3])
    points = cameras.unproject(depths(cameras, seed)).reshape(-1, 3)
    here, there = cameras.project(points), cameras.brought(other).project(other.points(points))
    assert torch.equal(there.in_frame, here.in_frame)
    torch.testing.assert_close(there.grid[here.in_frame], here.grid[here.in_frame])
    torch.testing.assert_close(there.depth[here.in_frame], scale * here.depth[here.in_frame])
    back = cameras.brought(other).brought(other.inverse())
    torch.testing.assert_close(back.world_from_cam, cameras.world_from_cam)


def test_a_part_of_cameras_is_cameras() -> None:
    cameras = some_cameras(0)
    assert (len(cameras[1]), len(cameras[-1]), len(cameras[:2]), len(cameras[[2, 0, 0]])) == (1, 1, 2, 3)
    assert torch.equal(cameras[[2, 0]].centres, cameras.centres[[2, 0]])
    kept = cameras[torch.tensor([True, False, True])]
    assert torch.equal(kept.followed_by(cameras[1])[[0, 2, 1]].intrinsics_px, cameras.intrinsics_px)


def test_points_behind_or_beside_a_camera_are_not_in_frame() -> None:
    lens = torch.tensor([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]])
    camera = Cameras(torch.eye(4)[None], lens[None], 4, 6)
    found = camera.project(torch.tensor([[0.0, 0, 2], [0, 0, -2], [9, 0, 2], [0, 0, 0]]))
    assert found.in_frame.tolist() == [[True, False, False, False]]
    assert (found.depth > 0).all(), "a logarithm can be taken of every depth"
    assert sample_at(torch.ones(1, 1, 4, 6), found.grid).isfinite().all()


def test_a_camera_that_comes_again_is_found_and_one_with_another_lens_is_another() -> None:
    cameras = some_cameras(0)
    path = cameras[[0, 1, 2, 1, 0, 2]]
    assert path.find_repeats() == [0, 1, 2, 1, 0, 2]
    longer = path.intrinsics_px.clone()
    longer[4, 0, 0] = torch.nextafter(longer[4, 0, 0], torch.tensor(torch.inf, dtype=longer.dtype))
    assert dataclasses.replace(path, intrinsics_px=longer).find_repeats() == [0, 1, 2, 1, 4, 2]


@pytest.mark.wrong_shapes
def test_what_does_not_go_together_is_refused() -> None:
    cameras = some_cameras(0)
    with pytest.raises(ValueError, match="world_from_cam has shape"):
        dataclasses.replace(cameras, world_from_cam=cameras.world_from_cam[0])
    with pytest.raises(ValueError, match="intrinsics_px has shape"):
        dataclasses.replace(cameras, intrinsics_px=cameras.intrinsics_px[:2])
    with pytest.raises(ValueError, match="pixels"):
        cameras.followed_by(cameras.resized(8, 12))


def test_a_twist_turns_about_its_axis_and_its_negative_undoes_it() -> None:
    quarter = rigid_from_twist(torch.tensor([0.0, 0, torch.pi / 2, 0, 0, 0]))
    torch.testing.assert_close(quarter[:3, :3] @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))
    twist = torch.tensor([0.3, -0.1, 0.2, 1.0, -2.0, 0.5])
    torch.testing.assert_close(rigid_from_twist(twist) @ rigid_from_twist(-twist), torch.eye(4), atol=1e-6, rtol=0)
