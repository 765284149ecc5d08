"""Who sees what in which order: balanced designs, drawn from the study's seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sceneexpander.geometry.randomness import child_generator
from sceneexpander.study.spec import Criterion

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedScreen:
    """One screen: a scene, a criterion, and the methods of videos A, B, C, ..."""

    scene: str
    criterion: Criterion
    methods: tuple[str, ...]


def make_numpy_generator(seed: int, purpose: str) -> np.random.Generator:
    """NumPy's counterpart of `child_generator`: depends on seed and purpose alone."""
    return np.random.default_rng(child_generator(seed, purpose).initial_seed())


def williams_square(count: int) -> list[tuple[int, ...]]:
    """Rows of a Williams design: each item is at each place, and right after each other item, equally often.

    ``count`` rows if that is even or 1, else twice as many, of which either half is a Latin square.

    Source: E. J. Williams, Experimental designs balanced for the estimation of residual effects of treatments, 1949.
    """
    first = [(place + 1) // 2 if place % 2 else (count - place // 2) % count for place in range(count)]
    rows = [tuple((item + shift) % count for item in first) for shift in range(count)]
    return rows if count % 2 == 0 or count == 1 else rows + [row[::-1] for row in rows]


def balanced_orders(items: Sequence[T], count: int, rng: np.random.Generator) -> list[tuple[T, ...]]:
    """``count`` random orders in which, however many they are, each item is at each place equally often up to one.

    Rows of Williams designs with freshly drawn names, a Latin square at a time.
    """
    size = len(items)
    orders: list[tuple[T, ...]] = []
    while len(orders) < count:
        named = [items[index] for index in rng.permutation(size)]
        rows = williams_square(size)
        for start in range(0, len(rows), size):
            orders += [tuple(named[item] for item in rows[start + row]) for row in rng.permutation(size)]
    return orders[:count]


def plan_screens(
    scenes: Sequence[str], catches: Sequence[str], methods: Sequence[str], participants: int, seed: int
) -> list[list[PlannedScreen]]:
    """The screens of each participant.

    Scenes are in balanced order; both screens of a scene follow each other, for half of the participants insertion satisfaction comes
    first; the order of the videos is drawn anew for each screen. Catch scenes stand somewhere after the first scene.
    """
    scene_orders = balanced_orders(scenes, participants, make_numpy_generator(seed, "study/scenes"))
    criteria = balanced_orders(list(Criterion), participants, make_numpy_generator(seed, "study/criteria"))
    videos = {
        (scene, criterion): balanced_orders(
            methods, participants, make_numpy_generator(seed, f"study/videos/{scene}/{criterion.value}")
        )
        for scene in (*scenes, *catches)
        for criterion in Criterion
    }
    places = make_numpy_generator(seed, "study/catches")
    plans = []
    for index in range(participants):
        order = list(scene_orders[index])
        for catch in catches:
            order.insert(int(places.integers(1, len(order) + 1)), catch)
        plans.append(
            [
                PlannedScreen(scene=scene, criterion=criterion, methods=videos[scene, criterion][index])
                for scene in order
                for criterion in criteria[index]
            ]
        )
    return plans
