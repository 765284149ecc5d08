"""Generated Gaussians of new space reach their neighbours: a floor that one view alone shows, seen from above it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.camera import pixel_centres
from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.rigid import rotation_from_quat_wxyz
from sceneexpander.insertion.gap_filling import close_gaps
from sceneexpander.splatting import render
from tests.worlds.two_views import HEIGHT, INTRINSICS, WIDTH, photo_and_generated

AWAY = torch.eye(4)  # the captured camera looks the other way and sees nothing of the floor
AWAY[0, 0] = AWAY[2, 2] = -1.0
# Two units above the floor, four ahead of the generated view, looking straight down.
ABOVE = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, -1], [0, -1, 0, 4], [0, 0, 0, 1]])


def floor() -> torch.Tensor:
    """Depth of a floor one unit below the camera, as far as 12 units."""
    v = pixel_centres(HEIGHT, WIDTH, like=INTRINSICS)[..., 1]
    return (40.0 / (v - 16).clamp(min=40 / 12)).clamp(max=12.0)


def wall(step: float) -> torch.Tensor:
    """Depth 2, and 2 + ``step`` in the right half."""
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    depth[:, WIDTH // 2 :] += step
    return depth


def scene(depth: torch.Tensor, captured_pose: torch.Tensor = AWAY, *, posed: bool = True) -> Reconstruction:
    """A captured view (grey, the same depth map) and a generated one at the origin."""
    return photo_and_generated(
        torch.full((2, 3, HEIGHT, WIDTH), 0.5),
        torch.stack([depth, depth]),
        torch.stack([captured_pose, torch.eye(4)]),
        posed=(True, posed),
    )


def covariances(reconstruction: Reconstruction) -> torch.Tensor:
    g = reconstruction.gaussians
    axes = rotation_from_quat_wxyz(g.quat_wxyz.double()) * g.scales.double()[:, None]
    return axes @ axes.transpose(1, 2)


def least_alpha(reconstruction: Reconstruction) -> float:
    """The most transparent pixel of the floor from above."""
    shown = render(reconstruction.gaussians, Cameras(ABOVE[None], INTRINSICS[None], HEIGHT, WIDTH))
    return float(shown.alpha.min())


def test_the_floor_is_closed_from_another_camera() -> None:
    before = scene(floor())
    assert least_alpha(before) < 0.8
    assert least_alpha(close_gaps(before, 0.7)) > 0.9


def test_nothing_but_shapes_of_generated_gaussians_changes_and_none_shrinks() -> None:
    before = scene(floor())
    after = close_gaps(before, 0.7)
    a, b = before.gaussians, after.gaussians
    for name in ("means", "opacities", "sh", "source_view", "generated"):
        assert torch.equal(getattr(a, name), getattr(b, name))
    assert torch.equal(a.scales[~a.generated], b.scales[~a.generated])
    assert torch.equal(a.quat_wxyz[~a.generated], b.quat_wxyz[~a.generated])
    grown = covariances(after) - covariances(before)
    size = covariances(before).diagonal(dim1=1, dim2=2).sum(-1)
    assert float((torch.linalg.eigvalsh(grown)[:, 0] / size).min()) > -1e-5  # float32 of what is stored
    assert float(grown[a.generated].diagonal(dim1=1, dim2=2).sum(-1).max()) > 0


def test_gaussians_do_not_reach_over_an_edge() -> None:
    at_edge = [row * WIDTH + column for row in range(HEIGHT) for column in (WIDTH // 2 - 1, WIDTH // 2)]
    flat, step = close_gaps(scene(wall(0.0)), 0.7), close_gaps(scene(wall(2.0)), 0.7)
    width = [covariances(r)[HEIGHT * WIDTH :][at_edge][:, 2, 2].sqrt().max() for r in (flat, step)]
    # Two units lie between the two walls; neither side's Gaussians grow towards the other one.
    assert float(width[1]) < 0.1
    assert float(width[0]) < 0.1


def test_what_a_photo_fills_is_left_alone() -> None:
    before = scene(floor(), torch.eye(4))

    def grown(start: Reconstruction) -> float:
        return float((covariances(close_gaps(start, 0.7)) - covariances(start)).diagonal(dim1=1, dim2=2).sum())

    assert grown(before) < 0.2 * grown(scene(floor()))


@pytest.mark.parametrize("seed", [0, 1])
def test_the_order_of_the_gaussians_does_not_matter(seed: int) -> None:
    before = scene(floor())
    order = torch.randperm(len(before.gaussians), generator=torch.Generator().manual_seed(seed))
    shuffled = close_gaps(replace(before, gaussians=before.gaussians.select(order)), 0.7)
    assert torch.allclose(covariances(close_gaps(before, 0.7))[order], covariances(shuffled), atol=1e-6)


def test_missing_gaussians_leave_a_hole_that_is_not_bridged() -> None:
    """A model that leaves Gaussians out (a confidence filter) is no reason to smear its neighbours over the hole."""
    before = scene(wall(0.0))
    index = torch.arange(len(before.gaussians))
    column = index % WIDTH
    hole = (index >= HEIGHT * WIDTH) & (column >= 15) & (column < 25)
    rest = close_gaps(replace(before, gaussians=before.gaussians.select(~hole)), 0.7)
    shown = render(rest.gaussians, Cameras(torch.eye(4)[None], INTRINSICS[None], HEIGHT, WIDTH))
    assert float(shown.alpha[0, 8:24, 18:22].max()) < 0.05


def test_without_reach_camera_or_generated_view_it_is_the_same_object() -> None:
    before = scene(floor())
    assert close_gaps(before, 0.0) is before
    unposed = scene(floor(), posed=False)
    assert close_gaps(unposed, 0.7) is unposed
    captured = replace(before, generated=torch.zeros(2, dtype=torch.bool))
    assert close_gaps(captured, 0.7) is captured
