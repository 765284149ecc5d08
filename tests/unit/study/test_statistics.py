"""Numbers that were worked out by hand, and properties that any ranking study must have."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy import ndarray

from sceneexpander.study.statistics import (
    bootstrap_means,
    compare_pairs,
    friedman_test,
    holm,
    kendall_tau,
    kendalls_w,
    percentile_interval,
    scores_from_ranks,
)

# Three people rank four items. Totals 4, 5, 10, 11 lie 3.5, 2.5, 2.5, 3.5 from 7.5: S = 37, W = 12 * 37 / (9 * 60).
RANKS = np.array([[1, 2, 3, 4], [1, 2, 4, 3], [2, 1, 3, 4]])
W = 444 / 540


def scores(ranks: ndarray) -> ndarray:
    return scores_from_ranks(ranks[:, None])[:, 0]


def test_the_first_of_five_scores_five_and_the_last_one() -> None:
    assert scores_from_ranks(np.array([[[1, 2, 3, 4, 5], [5, 4, 3, 2, 1]]])).tolist() == [
        [[5, 4, 3, 2, 1], [1, 2, 3, 4, 5]]
    ]


@pytest.mark.parametrize("ranks", [[1, 1, 4], [0, 2, 4], [2, 2, 2], [1, 2, 4]])
def test_ranks_whose_scores_do_not_add_up_are_named(ranks: list[int]) -> None:
    with pytest.raises(ValueError, match=r"ranks at \(1, 0\) are .*not each of 1 to 3 once"):
        scores_from_ranks(np.array([[[1, 2, 3]], [ranks]]))


def test_kendalls_w_by_hand() -> None:
    assert kendalls_w(RANKS) == pytest.approx(W)
    assert kendalls_w(np.array([[1, 2, 3]] * 5)) == 1
    assert kendalls_w(np.array([[1, 2, 3], [3, 2, 1]])) == 0


def test_friedman_by_hand() -> None:
    found = friedman_test(scores(RANKS), 0)
    assert found is not None
    assert found.statistic == pytest.approx(3 * 3 * W)  # m (n - 1) W
    assert found.kendalls_w == pytest.approx(W)


def test_the_permutation_p_is_the_share_of_all_permutations() -> None:
    orders = list(itertools.permutations(range(3)))
    observed = np.array([[3.0, 2.0, 1.0], [3.0, 1.0, 2.0], [3.0, 2.0, 1.0]])
    totals = [
        np.square(np.sum([row[list(order)] for row, order in zip(observed, chosen, strict=True)], 0)).sum()
        for chosen in itertools.product(orders, repeat=3)
    ]
    exact = np.mean(np.array(totals) >= np.square(observed.sum(0)).sum())
    found = friedman_test(observed, 1)
    assert found is not None
    assert found.p_permutation == pytest.approx(exact, abs=4 * np.sqrt(exact / 9999))
    # Three people who agree on three items do so in 6 of 216 cases.
    agreed = friedman_test(np.array([[3.0, 2.0, 1.0]] * 3), 1)
    assert agreed is not None
    assert agreed.p_permutation == pytest.approx(6 / 216, abs=0.007)


@pytest.mark.parametrize("values", [np.ones((5, 3)), np.array([[1.0, 2, 3]]), np.array([[1.0, 2], [1, 2]])])
def test_where_friedman_means_nothing_there_is_none(values: ndarray) -> None:
    assert friedman_test(values, 0) is None


def test_holm_by_hand() -> None:
    # 4 * 0.005, 3 * 0.01, 2 * 0.03, and 1 * 0.04 is raised to what came before.
    assert holm((0.01, 0.04, 0.03, 0.005)) == pytest.approx((0.03, 0.06, 0.06, 0.02))
    assert holm((0.9, 0.6)) == (1.0, 1.0)
    assert holm(()) == ()


def test_pairs_by_hand() -> None:
    # Of the 16 ways to swap two methods within four people, all and none are as extreme as four who agree.
    values = np.array([[2.0, 1.0]] * 4)
    (pair,) = compare_pairs(values, bootstrap_means(values[:, None], 0), ("a", "b"), 0)
    assert (pair.difference, pair.p, pair.p_holm) == (1.0, 2 / 16, 2 / 16)
    assert pair.interval is not None
    assert (pair.interval.low, pair.interval.high) == (1, 1)


def test_bootstrap_of_two_people_by_hand() -> None:
    # Both draws are the first, both the second, or one of each: 1/4, 1/4, 1/2.
    means = bootstrap_means(np.array([[[1.0]], [[3.0]]]), 0)[:, 0]
    assert np.unique(means).tolist() == [1, 2, 3]
    assert (means == 2).mean() == pytest.approx(0.5, abs=0.02)


def test_the_bootstrap_sees_people_and_scenes() -> None:
    rng = np.random.default_rng(0)
    people, scenes = rng.normal(size=(20, 1, 1)), rng.normal(size=(1, 8, 1))
    grid = np.zeros((20, 8, 1))
    only_people = bootstrap_means(people + grid, 0).std()
    only_scenes = bootstrap_means(scenes + grid, 0).std()
    assert only_people == pytest.approx(people.std() / np.sqrt(20), rel=0.03)
    assert only_scenes == pytest.approx(scenes.std() / np.sqrt(8), rel=0.03)
    both = bootstrap_means(people + scenes, 0).std()
    assert both == pytest.approx(np.hypot(only_people, only_scenes), rel=0.03)


def test_scores_of_a_bootstrap_sample_keep_their_sum() -> None:
    rng = np.random.default_rng(1)
    ranks = np.array([[rng.permutation(5) + 1 for _ in range(4)] for _ in range(9)])
    assert bootstrap_means(scores_from_ranks(ranks), 0).sum(1) == pytest.approx(15)


def test_intervals_cover_the_truth_about_as_often_as_they_say() -> None:
    rng = np.random.default_rng(2)
    hits = 0
    for trial in range(150):
        values = 3 + rng.normal(size=(30, 1, 1)) + 0.8 * rng.normal(size=(1, 12, 1)) + rng.normal(size=(30, 12, 1))
        interval = percentile_interval(bootstrap_means(values, trial, resamples=400)[:, 0])
        hits += interval.low <= 3 <= interval.high
    assert 0.86 <= hits / 150 <= 1  # twelve scenes: the percentile interval is a little narrow


def test_tests_find_nothing_in_noise_as_often_as_they_say() -> None:
    rng = np.random.default_rng(3)
    found = []
    for trial in range(200):
        result = friedman_test(scores(np.array([rng.permutation(4) + 1 for _ in range(10)])), trial, resamples=199)
        assert result is not None
        found.append(result.p_permutation <= 0.05)
    assert np.mean(found) == pytest.approx(0.05, abs=0.045)


def test_kendall_tau_by_hand() -> None:
    assert kendall_tau([1, 2, 3, 4], [1, 2, 4, 3]) == pytest.approx((5 - 1) / 6)
    assert kendall_tau([1, 2, 3], [3, 2, 1]) == pytest.approx(-1)
    assert kendall_tau([1, 1, 1], [1, 2, 3]) is None
    assert kendall_tau([1], [1]) is None
