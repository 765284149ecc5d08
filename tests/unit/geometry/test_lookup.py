"""Points of the world looked up in views."""

from __future__ import annotations

import torch

from sceneexpander.geometry.camera import unproject_to_world
from sceneexpander.geometry.lookup import project_to_views, sample_at
from sceneexpander.geometry.rigid import rigid_inverse

HEIGHT, WIDTH = 4, 6
INTRINSICS = torch.tensor([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]])


def test_a_views_own_pixels_find_themselves_whatever_its_pose() -> None:
    pose = torch.eye(4)
    pose[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -0.3, 0.1], [0.3, 0, -0.2], [-0.1, 0.2, 0]]))
    pose[:3, 3] = torch.tensor([1.0, -2.0, 0.5])
    depth = 1 + torch.rand(1, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    content = torch.rand(1, 2, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    points = unproject_to_world(depth, INTRINSICS[None], pose[None]).reshape(-1, 3)
    grid, z, in_frame = project_to_views(points, rigid_inverse(pose)[None], INTRINSICS[None], HEIGHT, WIDTH)
    assert in_frame.all()
    torch.testing.assert_close(z[0], depth.flatten())
    for mode in ("bilinear", "nearest"):
        torch.testing.assert_close(sample_at(content, grid, mode), content.flatten(2), atol=1e-4, rtol=0)


def test_points_behind_or_beside_a_view_are_not_in_frame() -> None:
    points = torch.tensor([[0.0, 0, 2], [0, 0, -2], [9, 0, 2], [0, 0, 0]])
    grid, z, in_frame = project_to_views(points, torch.eye(4)[None], INTRINSICS[None], HEIGHT, WIDTH)
    assert in_frame.tolist() == [[True, False, False, False]]
    assert (z > 0).all(), "a logarithm can be taken of every depth"
    assert sample_at(torch.ones(1, 1, HEIGHT, WIDTH), grid).isfinite().all()
