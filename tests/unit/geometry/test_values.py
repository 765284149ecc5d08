"""The values that travel: Gaussians, priors, their frames and scales, and how results are compared."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch
from torch.testing import assert_close

from sceneexpander.geometry.checks import OutputCheck, compare_tensors
from sceneexpander.geometry.gauge import poses_relative_to, priors_relative_to, scale_camera_vectors
from sceneexpander.geometry.gaussians import (
    SH_DC,
    GaussianCounts,
    Gaussians,
    concatenate,
    rgb_from_sh,
    sh_from_rgb,
)
from sceneexpander.geometry.priors import EVIDENCE_CHANNELS, Priors
from sceneexpander.geometry.randomness import child_generator
from sceneexpander.geometry.rigid import rigid_from_parts, rotation_from_quat_wxyz


def gaussians(count: int, seed: int = 0) -> Gaussians:
    g = child_generator(seed, "gaussians")
    return Gaussians(
        means=torch.randn(count, 3, generator=g),
        quat_wxyz=torch.randn(count, 4, generator=g),
        scales=torch.rand(count, 3, generator=g) + 0.1,
        opacities=torch.rand(count, generator=g),
        sh=torch.randn(count, 4, 3, generator=g),
        source_view=torch.arange(count) % 3,
        generated=torch.arange(count) % 2 == 1,
    )


def poses(count: int) -> torch.Tensor:
    g = child_generator(3, "poses")
    quat = torch.randn(count, 4, generator=g, dtype=torch.float64)
    return rigid_from_parts(rotation_from_quat_wxyz(quat), torch.randn(count, 3, generator=g, dtype=torch.float64))


ROWS = tuple(field.name for field in fields(Gaussians) if isinstance(getattr(gaussians(1), field.name), torch.Tensor))


@pytest.mark.parametrize("pick", [torch.tensor([4, 0, 2]), torch.tensor([True, False, True, True, False])])
def test_selection_takes_the_same_rows_of_everything(pick: torch.Tensor) -> None:
    whole = gaussians(5)
    part = whole.select(pick)
    assert len(part) == 3
    assert len(whole) == 5
    for name in ROWS:
        assert torch.equal(getattr(part, name), getattr(whole, name)[pick])


def test_parts_together_are_the_whole_in_order() -> None:
    whole = gaussians(6)
    again = concatenate([whole.select(torch.arange(2)), whole.select(torch.arange(2, 6))])
    for name in ROWS:
        assert torch.equal(getattr(again, name), getattr(whole, name))
    with pytest.raises(ValueError, match="at least one"):
        concatenate([])


@pytest.mark.wrong_shapes
def test_rows_must_belong_together() -> None:
    for name in ROWS:
        value = getattr(gaussians(4), name)
        with pytest.raises(ValueError, match="rows"):
            replace(gaussians(4), **{name: value[:3]})


def test_detached_values_have_no_history() -> None:
    start = gaussians(2)
    tracked = replace(start, means=start.means.requires_grad_() * 2)
    assert not tracked.detach().means.requires_grad
    assert torch.equal(tracked.detach().means, tracked.means)
    assert tracked.to("cpu").means.device.type == "cpu"


def test_colours_and_coefficients_are_inverse_and_black_is_below_nothing() -> None:
    rgb = torch.tensor([[0.0, 0.5, 1.0]])
    assert_close(rgb_from_sh(sh_from_rgb(rgb)), rgb)
    assert pytest.approx(0.5 / math.sqrt(math.pi), abs=1e-15) == SH_DC  # Y_00
    assert_close(sh_from_rgb(rgb), torch.tensor([[-1.0, 0.0, 1.0]]) * math.sqrt(math.pi))


@pytest.mark.parametrize(("filtered", "merged", "kept"), [(0, 0, 10), (3, 0, 7), (0, 4, 6), (1, 2, 7), (10, 0, 0)])
def test_every_gaussian_is_accounted_for(filtered: int, merged: int, kept: int) -> None:
    line = GaussianCounts(made=10, filtered=filtered, merged=merged, kept=kept).line()
    assert line.startswith("10 Gaussians made")
    assert line.endswith(f", {kept} kept")
    assert (f"{filtered} left out" in line) == bool(filtered)
    assert (f"{merged} merged" in line) == bool(merged)
    for change in ({"made": 11}, {"kept": kept + 1}, {"filtered": filtered + 1}, {"merged": merged - 1}):
        with pytest.raises(ValueError, match="cannot be"):
            GaussianCounts(**{"made": 10, "filtered": filtered, "merged": merged, "kept": kept, **change})
    with pytest.raises(ValueError, match="cannot be"):
        GaussianCounts(made=0, filtered=-1, merged=0, kept=1)


def test_priors_of_some_views_in_any_order() -> None:
    depth = torch.arange(3.0)[:, None, None].expand(3, 2, 2)
    priors = Priors(world_from_cam=poses(3), depth=depth, posed=torch.tensor([True, False, True]))
    some = priors.select([2, 1])
    assert some.depth is not None
    assert some.posed is not None
    assert some.depth[:, 0, 0].tolist() == [2.0, 1.0]
    assert some.posed.tolist() == [True, False]
    assert some.intrinsics_px is None
    assert some.evidence is None
    moved = priors.to("cpu")
    assert moved.depth is not None
    assert torch.equal(moved.depth, depth)
    assert len(EVIDENCE_CHANNELS) == len(set(EVIDENCE_CHANNELS)) == 9


def test_another_frame_moves_all_poses_together_and_nothing_else() -> None:
    depth = torch.rand(3, 2, 2)
    priors = Priors(world_from_cam=poses(3), depth=depth)
    moved = priors_relative_to(priors, 1)
    assert moved.world_from_cam is not None
    assert priors.world_from_cam is not None
    assert moved.depth is depth
    assert_close(moved.world_from_cam[1], torch.eye(4, dtype=torch.float64))
    before, after = priors.world_from_cam, moved.world_from_cam
    for a, b in ((0, 1), (1, 2), (2, 0)):
        assert_close(torch.linalg.inv(after[a]) @ after[b], torch.linalg.inv(before[a]) @ before[b])
    assert_close(poses_relative_to(after, 0), poses_relative_to(before, 0))
    nothing = Priors(depth=depth)
    assert priors_relative_to(nothing, 1) is nothing


def test_scaling_a_camera_vector_leaves_angles_alone() -> None:
    vector = torch.arange(18.0).reshape(2, 9)
    scaled = scale_camera_vectors(vector, 3.0)
    assert_close(scaled[:, :3], 3 * vector[:, :3])
    assert torch.equal(scaled[:, 3:], vector[:, 3:])


def test_streams_belong_to_a_seed_and_a_purpose() -> None:
    def draw(seed: int, purpose: str) -> list[float]:
        return torch.rand(4, generator=child_generator(seed, purpose)).tolist()

    assert draw(1, "a") == draw(1, "a")
    assert len({tuple(draw(*key)) for key in ((1, "a"), (2, "a"), (1, "b"), (12, "a"), (1, "2:a"))}) == 5
    # Recorded: a seed means the same draws in every version.
    assert child_generator(0, "x").initial_seed() == 7919274910726248567


def check(error: float, tolerance: float = 1.0) -> OutputCheck:
    return OutputCheck(name="x", error=error, tolerance=tolerance)


def test_a_check_passes_up_to_its_tolerance_and_never_for_nan() -> None:
    assert check(1.0).ok
    assert check(0.5, 0.5).ok
    assert not check(1.0001).ok
    assert not check(math.nan).ok
    assert check(0.25, 0.5).ratio == 0.5
    assert check(math.nan).ratio == math.inf
    assert check(0.0, 0.0).ratio == 0
    assert check(1e-9, 0.0).ratio == math.inf
    assert check(0.0, 0.0).ok


def test_tensors_are_compared_entry_by_entry_against_both_tolerances() -> None:
    expected = torch.tensor([0.0, 10.0, math.inf])
    found = compare_tensors("x", torch.tensor([0.001, 10.5, math.inf]), expected, atol=0.01, rtol=0.1)
    assert found.error == pytest.approx(max(0.001 / 0.01, 0.5 / (0.01 + 1.0)))
    assert found.ok
    assert not compare_tensors("x", torch.tensor([0.02, 10.0, math.inf]), expected, atol=0.01, rtol=0.1).ok
    assert not compare_tensors("x", torch.tensor([0.0, 10.0, 1.0]), expected, atol=0.01, rtol=0.1).ok
    exact = compare_tensors("x", torch.tensor([0.0, 10.25, math.inf]), expected, atol=0, rtol=0)
    assert (exact.error, exact.tolerance, exact.ok, exact.detail) == (0.25, 0.0, False, "exact")
    assert compare_tensors("x", expected, expected, atol=0, rtol=0).ok
    assert compare_tensors("x", expected[:2], expected, atol=1, rtol=1).error == math.inf
    empty = compare_tensors("x", torch.zeros(0), torch.zeros(0), atol=1, rtol=0)
    assert (empty.error, empty.ok) == (0.0, True)
    relative = compare_tensors("x", torch.tensor([11.0]), torch.tensor([10.0]), atol=0, rtol=0.1)
    assert relative.error == pytest.approx(1.0)
