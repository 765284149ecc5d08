"""Plans: the meter against arithmetic, fake runs against real ones, and the command line."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from torch import nn

from sceneexpander.adaptation.config import AdaptConfig, EngineConfig, MomentsForm
from sceneexpander.cli.plan import main, parse, request_of
from sceneexpander.models.protocol import ALL_HEADS, GEOMETRY_HEADS
from sceneexpander.models.worldmirror import WorldMirror
from sceneexpander.planning import Meter, PlanRequest, adaptation_cost, inference_cost, step_views
from sceneexpander.planning import simulate as simulations
from sceneexpander.planning.models import planned_model
from sceneexpander.planning.simulate import StepCost
from tests.support.tiny_worldmirror import TINY

SAVING = EngineConfig(checkpoint_activations=True, views_per_chunk=1)


def _request(model: str = "worldmirror", **changes: object) -> PlanRequest:
    planned = planned_model("mini" if model == "mini" else "worldmirror/tiny")
    config = replace(TINY, gaussian=replace(TINY.gaussian, merge=False))
    request = PlanRequest(
        build=planned.build if model == "mini" else lambda: WorldMirror(config),
        prepared=planned.prepared,
        views=4,
        height=56,
        width=56,
        config=AdaptConfig(),
        gpu=False,
    )
    return replace(request, **changes)


@pytest.fixture(scope="module")
def plain() -> StepCost:
    return adaptation_cost(_request())


@pytest.fixture(scope="module")
def saving() -> StepCost:
    return adaptation_cost(_request(config=AdaptConfig(engine=SAVING)))


def test_the_meter_counts_storages_once_and_forgets_released_ones() -> None:
    with Meter() as meter:
        first = torch.zeros(1000)
        view = first[:10]
        assert meter.now == 4000
        second = first + 1
        assert (meter.now, meter.peak) == (8000, 8000)
        del first
        assert meter.now == 8000, "a view keeps its storage"
        del view, second
        assert (meter.now, meter.peak) == (0, 8000)


def test_the_meter_counts_products_and_attention() -> None:
    with Meter() as meter:
        torch.zeros(3, 5) @ torch.zeros(5, 7)
    assert meter.flops == 2 * 3 * 5 * 7
    query = torch.zeros(1, 2, 10, 4, requires_grad=True)
    with Meter() as meter:
        nn.functional.scaled_dot_product_attention(query, query, query).sum().backward()
    products = 2 * 2 * 10 * 10 * 4  # of one of the products of two heads
    assert meter.flops == (2 + 5) * products
    layer = nn.Linear(6, 4)
    with Meter() as meter, torch.inference_mode():
        layer(torch.zeros(3, 6))
    assert meter.flops == 2 * 3 * 6 * 4


def test_a_fake_run_needs_what_a_real_one_does(
    plain: StepCost, saving: StepCost, monkeypatch: pytest.MonkeyPatch
) -> None:
    embedded = adaptation_cost(_request("mini"))
    monkeypatch.setattr(simulations, "_fake", torch.enable_grad)  # the same code on tensors with numbers
    lean = AdaptConfig(engine=SAVING)
    for fake, request in ((plain, _request()), (saving, _request(config=lean)), (embedded, _request("mini"))):
        real = adaptation_cost(request)
        assert fake.flops == real.flops > 0
        assert fake.adapted == real.adapted
        assert fake.peak_bytes == pytest.approx(real.peak_bytes, rel=0.02)
        assert fake.steady_bytes == pytest.approx(real.steady_bytes, rel=0.02)


def test_a_plan_knows_the_weights(plain: StepCost) -> None:
    # Student whole; teacher, theta_0, two moments and the gradient of what is adapted.
    assert plain.peak_bytes > 4 * plain.parameters + 5 * 4 * plain.adapted
    assert plain.host_bytes == 0
    engine = EngineConfig(start_on_host=True, moments=MomentsForm.INT8)
    lean = adaptation_cost(_request(config=AdaptConfig(engine=engine), gpu=True))
    assert lean.host_bytes == 4 * plain.adapted
    # theta_0 is elsewhere, and two moments take a byte each, with a scale per 128.
    saved = plain.steady_bytes - lean.steady_bytes
    assert saved == pytest.approx((4 + 8 - 2 * (1 + 4 / 128)) * plain.adapted, rel=0.01)


def test_recomputing_saves_memory_and_costs_operations(plain: StepCost, saving: StepCost) -> None:
    activations, kept = (cost.peak_bytes - cost.steady_bytes for cost in (plain, saving))
    assert kept < 0.75 * activations
    assert 1.1 * plain.flops < saving.flops < 1.6 * plain.flops


def test_a_step_is_planned_at_its_largest_batch() -> None:
    assert [step_views(views, AdaptConfig()) for views in (2, 3, 4, 9)] == [2, 3, 3, 8]


def test_reconstruction_costs_less_without_heads() -> None:
    few, all_heads = (inference_cost(_request(), heads) for heads in (GEOMETRY_HEADS, ALL_HEADS))
    assert 0 < few.flops < all_heads.flops
    assert few.peak_bytes < all_heads.peak_bytes


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("nonsense", "is not KEY=VALUE"),
        ("view=9", "did you mean 'views'"),
        ("views=1", "a whole number from 2 to 64"),
        ("views=nine", "a whole number from 2 to 64"),
        ("width=500", "give 490"),
        ("views=1000000000", "a whole number from 2 to 64"),
        ("views=" + "9" * 5000, "a whole number from 2 to 64"),
        ("views=²", "a whole number from 2 to 64"),
        ("width=14000000", "a whole number from 1 to 4096"),
        ("height=0", "a whole number from 1 to 4096"),
        ("tflops=1e999", "above 0 and at most"),
        ("adapt.steps=" + "9" * 5000, "too many digits"),
        ("model=" + "x" * 5000, "unknown model"),
        ("x" * 5000 + "=1", "unknown key"),
        ("model=worldmiror/large", "did you mean 'worldmirror/large'"),
        ("options=gpu42", "options=gpu42"),
        ("tflops=-1", "a number above 0"),
        ("adapt.precison=bf16", "did you mean 'adapt.precision'"),
        ("adapt.steps=many", "adapt.steps"),
        ("--jsn", "did you mean '--json'"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_2(argument: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([argument])
    assert ended.value.code == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert message in shown.err


def test_the_command_prints_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    main(["model=worldmirror/tiny", "views=3", "width=42", "height=28", "tflops=2", "--json"])
    plan = json.loads(capsys.readouterr().out)
    assert plan["peak_gb"] > 0
    assert plan["flops_per_step"] > 0
    assert plan["seconds_per_step"] == pytest.approx(plan["flops_per_step"] / 2e12, abs=1e-3)
    assert (plan["options"], plan["views"], plan["height"]) == ("gpu24", 3, 28)


def test_the_profile_for_24_gb_is_what_is_planned_by_default() -> None:
    config = request_of(parse(["model=worldmirror/tiny", "width=56"])).config
    assert config.engine == EngineConfig(
        checkpoint_activations=True, views_per_chunk=1, start_on_host=True, moments=MomentsForm.INT8
    )
    assert config.precision == "bf16"
    assert config.steps == 400


def test_the_plain_way_is_planned_as_such() -> None:
    request = request_of(parse(["model=worldmirror/tiny", "width=56", "options=paper"]))
    assert request.resident_anchor
    assert request.all_heads
    assert request.config.engine == EngineConfig(checkpoint_activations=True)
