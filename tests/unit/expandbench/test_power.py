"""A tie that arithmetic makes is not reported as a finding."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sceneexpander.adaptation.config import AdaptConfig, PlateauConfig
from sceneexpander.expandbench.power import share_restored, without_power
from sceneexpander.insertion.contradiction import Contradiction
from tests.support.methods import make_method

SHORT, LONG = AdaptConfig(steps=30), AdaptConfig(steps=400)


def reason_of(row: AdaptConfig, reference: AdaptConfig) -> str | None:
    return without_power(make_method(row), make_method(reference))


@pytest.mark.parametrize(
    "change",
    [
        {"restore_interval": 0},
        {"restore_interval": 1},
        {"ema_momentum": 0.99},
        {"plateau": PlateauConfig(window=20)},
        {"restore_interval": 0, "plateau": PlateauConfig(window=20)},
    ],
)
def test_slow_components_have_no_power_in_few_steps_and_have_it_in_the_papers(change: dict[str, object]) -> None:
    reason = reason_of(replace(SHORT, **change), SHORT)  # type: ignore[arg-type]
    assert reason is not None
    assert reason.startswith("no power at 30 steps: ")
    assert reason_of(replace(LONG, **change), LONG) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("change", [{"lambda_gen": 0.0}, {"restore_interval": 0, "lambda_gen": 0.0}])
def test_whatever_else_differs_can_show(change: dict[str, object]) -> None:
    assert reason_of(replace(SHORT, **change), SHORT) is None  # type: ignore[arg-type]


def test_another_correction_can_show() -> None:
    row = make_method(replace(SHORT, restore_interval=0), contradiction=Contradiction(fade=True))
    assert without_power(row, make_method(SHORT)) is None


def test_a_row_with_other_steps_is_another_row() -> None:
    assert reason_of(LONG, SHORT) is None
    assert reason_of(SHORT, SHORT) is None


def test_the_share_is_that_of_independent_draws() -> None:
    assert share_restored(LONG) == pytest.approx(1 - 0.999**40)
    assert share_restored(replace(LONG, restore_interval=0)) == 0
    assert share_restored(replace(SHORT, restore_interval=40)) == 0
