"""Orders are balanced, random, and the same for the same seed."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from sceneexpander.study.design import balanced_orders, plan_screens, williams_square
from sceneexpander.study.spec import Criterion


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 9])
def test_a_williams_design_balances_places_and_neighbours(count: int) -> None:
    rows = williams_square(count)
    assert all(sorted(row) == list(range(count)) for row in rows)
    assert {Counter(column)[item] for column in zip(*rows, strict=True) for item in range(count)} == {
        len(rows) // count
    }
    if count > 1:
        neighbours = Counter(pair for row in rows for pair in pairwise(row))
        assert len(neighbours) == count * (count - 1)
        assert len(set(neighbours.values())) == 1


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("people", [1, 7, 39])
def test_each_item_is_at_each_place_equally_often_up_to_one(count: int, people: int) -> None:
    orders = balanced_orders(range(count), people, np.random.default_rng(0))
    for column in zip(*orders, strict=True):
        seen = [Counter(column)[item] for item in range(count)]
        assert max(seen) - min(seen) <= 1


def test_everybody_sees_every_scene_once_under_each_criterion() -> None:
    plans = plan_screens(["x", "y", "z"], ["catch"], ["a", "b", "c", "d"], 9, 0)
    for plan in plans:
        assert Counter((item.scene, item.criterion) for item in plan) == Counter(
            (scene, criterion) for scene in ("x", "y", "z", "catch") for criterion in Criterion
        )
        assert all(sorted(item.methods) == ["a", "b", "c", "d"] for item in plan)
        # Both screens of a scene follow each other, in the participant's order of criteria.
        assert [item.scene for item in plan[::2]] == [item.scene for item in plan[1::2]]
        assert len({item.criterion for item in plan[::2]}) == 1
        assert plan[0].scene != "catch"
    first = Counter(plan[0].criterion for plan in plans)
    assert sorted(first.values()) == [4, 5]
    assert len({item.methods for plan in plans for item in plan}) > 10


def test_orders_depend_on_the_seed_alone() -> None:
    arguments = (["x", "y"], ["catch"], ["a", "b", "c"], 6)
    assert plan_screens(*arguments, 4) == plan_screens(*arguments, 4)
    assert plan_screens(*arguments, 4) != plan_screens(*arguments, 5)
