"""Generated Gaussians leave space that the photos look through, and their own picture does not notice.

A photo looks along z at a wall four units away. A generated view stands beside it and looks across, where the photo shows nothing behind.
"""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from sceneexpander.artifacts.reconstruction import Reconstruction
from sceneexpander.geometry.agreement import agreement
from sceneexpander.insertion.free_space import leave_free_space
from sceneexpander.splatting import render
from tests.worlds.two_views import HEIGHT, WIDTH, photo_and_generated

WALL = 4.0


def across(x: float, z: float) -> torch.Tensor:
    """A camera at (x, 0, z) that looks along +x."""
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    pose[0, 3], pose[2, 3] = x, z
    return pose


def scene(guess: float, pose: torch.Tensor, *, posed: tuple[bool, bool] = (True, True)) -> Reconstruction:
    """A photo of the wall, and a generated view that takes everything to be ``guess`` away."""
    ramp = torch.linspace(0, 1, WIDTH).expand(HEIGHT, WIDTH)  # which of two neighbours is in front does not show
    return photo_and_generated(
        torch.stack([ramp, 1 - ramp, ramp / 2]).expand(2, 3, HEIGHT, WIDTH),
        torch.stack([torch.full((HEIGHT, WIDTH), WALL), torch.full((HEIGHT, WIDTH), guess)]),
        torch.stack([torch.eye(4), pose]),
        posed=posed,
    )


def in_free_space(made: Reconstruction) -> torch.Tensor:
    """Which generated Gaussians stand before what the photo sees."""
    means = made.gaussians.means[made.gaussians.generated]
    found = agreement(means, made.depth[:1], made.cameras[0])
    return (found.weight < 0.5) & (found.conflict < 0)


BEFORE_THE_WALL = across(
    -1.2, 2.0
)  # looks through the photo's frustum, which is two units wide there, half a unit each side of the wall


def test_what_stands_in_free_space_goes_to_its_far_end() -> None:
    before = scene(1.2, BEFORE_THE_WALL)
    through = in_free_space(before)
    assert float(through.float().mean()) > 0.5
    after = leave_free_space(before)
    assert not bool(in_free_space(after).any())
    x, y, z = after.gaussians.means[after.gaussians.generated][through].unbind(-1)
    # 1 two pixels beyond the edge of the photo's picture: a Gaussian's size. Steps are 2 % of up to four times the half width; some land on
    # the wall before.
    edge = torch.maximum(x.abs() / (z * 22 / 40), y.abs() / (z * 18 / 40))
    on_wall = (z / WALL).log().abs() < 0.05
    assert float((~on_wall).float().mean()) > 0.5
    assert float(edge[~on_wall].min()) >= 1
    assert float(edge[~on_wall].max()) < 1.08


def test_no_gaussian_reaches_into_a_photo_from_beside_it() -> None:
    after = leave_free_space(scene(1.2, BEFORE_THE_WALL))
    both, photo = (
        render(after.gaussians.select(w), after.cameras[0]).rgb[0] for w in (slice(None), ~after.gaussians.generated)
    )
    assert float((both - photo).abs().max()) < 0.1  # 0.3 without the margin


def test_its_own_view_shows_it_as_before_and_the_depth_goes_along() -> None:
    before = scene(1.2, BEFORE_THE_WALL)
    after = leave_free_space(before)
    shown = [render(one.gaussians.select(one.gaussians.generated), one.cameras[1]) for one in (before, after)]
    # Neighbours overlap, and another of them may be in front: a step of the ramp is 0.026, a pixel's depth up to 4 % from the next one's.
    assert torch.allclose(shown[0].rgb, shown[1].rgb, atol=0.05)
    factor = after.depth[1] / before.depth[1]
    assert torch.allclose(shown[1].depth[0] / shown[0].depth[0], factor, rtol=0.1)
    assert float(factor.min()) >= 1
    assert 1.1 < float(factor.max()) < 3  # through the photo's sight, which is two to three units wide on these rays
    points = after.cameras[1].unproject(after.depth[1:]).reshape(-1, 3)
    assert torch.allclose(points, after.gaussians.means[after.gaussians.generated], atol=1e-4)


def test_nothing_else_changes() -> None:
    before = scene(1.2, BEFORE_THE_WALL)
    after = leave_free_space(before)
    own = after.gaussians.generated
    for field in fields(before.gaussians):
        a, b = getattr(before.gaussians, field.name), getattr(after.gaussians, field.name)
        if field.name in ("means", "scales"):
            assert torch.equal(a[~own], b[~own])
            stayed = ~in_free_space(before)
            assert torch.equal(a[own][stayed], b[own][stayed])
        else:
            assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
    assert torch.equal(before.depth[0], after.depth[0])


@pytest.mark.parametrize(
    "untouched",
    [
        pytest.param(scene(1.2, torch.eye(4)), id="photos fill its pixels from behind"),
        pytest.param(scene(5.0, BEFORE_THE_WALL), id="it is out of the photo's sight"),
        pytest.param(scene(1.2, BEFORE_THE_WALL, posed=(True, False)), id="it has no camera"),
        pytest.param(scene(1.2, BEFORE_THE_WALL, posed=(False, True)), id="no photo has a camera"),
    ],
)
def test_what_nothing_contradicts_or_something_fills_stays(untouched: Reconstruction) -> None:
    after = leave_free_space(untouched)
    torch.testing.assert_close(after.gaussians.means, untouched.gaussians.means, rtol=0, atol=0)
    assert torch.equal(after.depth, untouched.depth)


def test_what_is_in_free_space_all_the_way_stays() -> None:
    """A photo of far mountains sees through everything that a view between it and them shows."""
    before = scene(1.0, torch.eye(4))
    far = replace(before, depth=torch.stack([torch.full((HEIGHT, WIDTH), 1e4), before.depth[1]]))
    far = replace(far, gaussians=far.gaussians.select(far.gaussians.generated))
    assert bool(in_free_space(far).all())
    assert torch.equal(leave_free_space(far).gaussians.means, far.gaussians.means)
