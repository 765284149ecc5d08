"""A tie that arithmetic makes is not reported as a finding."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sceneexpander.adaptation.config import AdaptConfig, PlateauConfig
from sceneexpander.expandbench.power import touched, without_power

SHORT, LONG = AdaptConfig(steps=30), AdaptConfig(steps=400)


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
    reason = without_power(replace(SHORT, **change), SHORT)  # type: ignore[arg-type]
    assert reason is not None
    assert reason.startswith("no power at 30 steps: ")
    assert without_power(replace(LONG, **change), LONG) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("change", [{"lambda_gen": 0.0}, {"trust": True}, {"restore_interval": 0, "lambda_gen": 0.0}])
def test_whatever_else_differs_can_show(change: dict[str, object]) -> None:
    assert without_power(replace(SHORT, **change), SHORT) is None  # type: ignore[arg-type]


def test_a_row_with_other_steps_is_another_row() -> None:
    assert without_power(LONG, SHORT) is None
    assert without_power(SHORT, SHORT) is None


def test_the_share_is_that_of_independent_draws() -> None:
    assert touched(LONG) == pytest.approx(1 - 0.999**40)
    assert touched(replace(LONG, restore_interval=0)) == 0
    assert touched(replace(SHORT, restore_interval=40)) == 0
