"""Gaussians that come, go and move: provenance and momentum follow their rows, and the picture survives where it should."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch

from sceneexpander.geometry.cameras import Cameras
from sceneexpander.geometry.gaussians import Gaussians
from sceneexpander.optimisation.config import DensityConfig
from sceneexpander.optimisation.density import CloneAndSplit, Relocation, Schedule, shared_appearance
from sceneexpander.optimisation.splats import thin_gaussians
from sceneexpander.splatting import render
from tests.worlds.few_splats import CONFIG, five, generator, moved, seen, splats_of
from tests.worlds.random_gaussians import cameras, intrinsics, random_gaussians


def test_there_and_back() -> None:
    start = random_gaussians(50)
    back = splats_of(start).gaussians()
    torch.testing.assert_close(back.means, start.means)
    torch.testing.assert_close(back.scales, start.scales)
    torch.testing.assert_close(back.opacities, start.opacities.clamp(max=0.99))
    torch.testing.assert_close(back.sh, start.sh)
    assert torch.equal(back.source_view, start.source_view)
    assert torch.equal(back.generated, start.generated)


@pytest.mark.parametrize("degree", [0, 2])
def test_colours_take_the_degree_that_was_asked_for(degree: int) -> None:
    splats = splats_of(random_gaussians(5), sh_degree=degree)
    assert splats.gaussians().sh.shape[1] == (degree + 1) ** 2
    assert splats.colours(0).shape[1] == 1
    assert splats.colours(3).shape[1] == (degree + 1) ** 2


def test_rows_keep_their_momentum_and_origin_and_new_ones_start_at_rest() -> None:
    splats = splats_of(random_gaussians(4))
    moved(splats)
    before = {name: value.clone() for name, value in splats.state().items()}
    rows, fresh = torch.tensor([2, 0, 2]), torch.tensor([False, False, True])
    splats.rearrange(rows, fresh)
    after = splats.state()
    for name, value in before.items():
        if name.endswith("/step"):
            assert after[name] == value
        elif "/" in name:
            assert torch.equal(after[name][:2], value[rows[:2]])
            assert not after[name][2].any()
        else:
            assert torch.equal(after[name], value[rows])
    assert not splats.params["generated"].requires_grad
    moved(splats)
    assert len(splats) == 3


def test_small_ones_are_cloned_large_ones_split_transparent_ones_go() -> None:
    splats, control = splats_of(five()), CloneAndSplit(CONFIG, 10, extent=1.0)
    pull = torch.tensor([1.0, 1.0, 0.01, 1.0, 1.0])
    control.observe(splats, seen(pull, torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0])), 1)
    control.change(splats, 1, mean_rate=0.0, generator=generator())
    result = splats.gaussians()
    assert result.source_view.tolist() == [0, 2, 4, 0, 1, 1]
    assert result.generated.tolist() == [True, False, False, True, True, True]
    start = five()
    torch.testing.assert_close(result.means[3], start.means[0])
    torch.testing.assert_close(result.scales[4:], start.scales[[1, 1]] / 1.6)
    offsets = result.means[4:] - start.means[1]
    assert (offsets.norm(dim=-1) > 0).all()
    assert (offsets.norm(dim=-1) < 5 * 0.5 * math.sqrt(3)).all()


def test_where_room_is_short_the_strongest_pull_wins() -> None:
    splats = splats_of(replace(five(), opacities=torch.full((5,), 0.8)))
    control = CloneAndSplit(replace(CONFIG, max_gaussians=6), 10, extent=1.0)
    control.observe(splats, seen(torch.tensor([1.0, 0.2, 0.3, 2.0, 0.4])), 1)
    control.change(splats, 1, mean_rate=0.0, generator=generator())
    assert splats.gaussians().source_view.tolist() == [0, 1, 2, 3, 4, 3]


def test_pulls_are_means_over_the_pictures_that_saw_the_gaussian() -> None:
    splats, control = splats_of(five()), CloneAndSplit(replace(CONFIG, gradient=0.5), 10, extent=1.0)
    weak, strong = torch.full((5,), 0.2), torch.full((5,), 0.9)
    control.observe(splats, seen(weak), 1)
    control.observe(splats, seen(strong, torch.tensor([1.0, 0, 0, 0, 0])), 2)
    control.change(splats, 2, mean_rate=0.0, generator=generator())
    assert splats.gaussians().source_view.tolist() == [0, 1, 2, 4, 0], "(0.2 + 0.9) / 2 is above, 0.2 is not"


def test_a_reset_lowers_opacities_and_their_momentum() -> None:
    splats, control = splats_of(five()), CloneAndSplit(replace(CONFIG, every=100, reset_every=2), 10, extent=1.0)
    moved(splats)
    control.change(splats, 2, mean_rate=0.0, generator=generator())
    assert float(splats.gaussians().opacities.max()) <= 2 * CONFIG.min_opacity + 1e-6
    assert not splats.state()["opacities/exp_avg"].any()
    assert splats.state()["means/exp_avg"].any()


def test_the_schedule_is_in_shares_of_the_steps() -> None:
    schedule = Schedule.of(DensityConfig(start=0.1, stop=0.5, every=10), 100)
    assert [step for step in range(1, 101) if schedule.due(step)] == [20, 30, 40, 50]


def double_sum(opacity: float, copies: int) -> tuple[float, float]:
    """Eq. 9 of the 3DGS-MCMC paper, term by term."""
    each = 1 - (1 - opacity) ** (1 / copies)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * each ** (k + 1) / math.sqrt(k + 1)
        for i, k in itertools.product(range(1, copies + 1), range(copies))
        if k < i
    )
    return each, opacity / total


@pytest.mark.parametrize("copies", [1, 2, 5, 20, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.97])
def test_shared_appearance_is_the_papers_equation(opacity: float, copies: int) -> None:
    each, factor = shared_appearance(torch.tensor([opacity]), torch.tensor([copies]))
    expected = double_sum(opacity, copies)
    assert float(each) == pytest.approx(expected[0], rel=1e-5)
    assert float(factor) == pytest.approx(expected[1], rel=1e-4)
    assert 1 - (1 - float(each)) ** copies == pytest.approx(opacity, rel=1e-5)


def one_live_and_dead(dead: int) -> Gaussians:
    start = random_gaussians(1 + dead, sh_coefficients=1)
    scales = torch.full((1 + dead, 3), 0.2)
    opacities = torch.tensor([0.6] + [1e-3] * dead)
    generated = torch.tensor([True] + [False] * dead)
    return replace(start, scales=scales, opacities=opacities, generated=generated)


def test_the_dead_move_to_the_living_and_the_picture_stays() -> None:
    start, control = one_live_and_dead(3), Relocation(replace(CONFIG, growth=0.0, noise=0.0, min_opacity=0.005), 10)
    splats = splats_of(start, sh_degree=0)
    control.change(splats, 1, mean_rate=1.0, generator=generator())
    result = splats.gaussians()
    assert result.source_view.tolist() == [int(start.source_view[0])] * 4
    assert result.generated.all(), "what moved shows what the living one showed"
    torch.testing.assert_close(result.means, start.means[:1].expand(4, 3))
    camera = (cameras(1), intrinsics(1, 40, 60), 40, 60)
    before, after = render(start.select(torch.tensor([0])), Cameras(*camera)), render(result, Cameras(*camera))
    assert float((before.rgb - after.rgb).abs().max()) < 0.02 < 0.1 * float(before.rgb.max())


def test_the_set_grows_to_its_cap() -> None:
    config = replace(CONFIG, growth=0.5, max_gaussians=13, noise=0.0)
    splats, control = splats_of(replace(random_gaussians(10), opacities=torch.full((10,), 0.5))), Relocation(config, 10)
    sizes = []
    for step in (1, 2, 3):
        control.change(splats, step, mean_rate=1.0, generator=generator())
        sizes.append(len(splats))
    assert sizes == [13, 13, 13]


def test_noise_moves_the_transparent_within_their_shape() -> None:
    start = replace(
        random_gaussians(2), scales=torch.tensor([[1.0, 1e-4, 1e-4]] * 2), opacities=torch.tensor([0.99, 0.002])
    )
    splats = splats_of(start)
    Relocation(replace(CONFIG, every=100, noise=1.0), 10).change(splats, 1, mean_rate=0.1, generator=generator())
    solid, faint = (splats.gaussians().means - start.means).norm(dim=-1).tolist()
    assert solid < 1e-9
    assert 1e-3 < faint < 1


def test_thinning_keeps_what_is_covered() -> None:
    start = random_gaussians(1000)
    kept = thin_gaussians(start, 250, generator())
    assert len(kept) == 250
    rows = [(start.means == mean).all(-1).nonzero()[0, 0] for mean in kept.means]
    torch.testing.assert_close(kept.scales, 2 * start.scales[rows])
    assert torch.equal(kept.source_view, start.source_view[rows])
    assert thin_gaussians(start, 1000, generator()) is start
