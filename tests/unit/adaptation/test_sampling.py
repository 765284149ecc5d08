from collections import Counter

import pytest

from sceneexpander.adaptation.config import AdaptConfig, Gauge, SubsetRule
from sceneexpander.adaptation.sampling import sample_batch, subset_sizes


@pytest.mark.parametrize(
    ("captured", "sizes"), [(1, (1,)), (2, (2,)), (3, (2,)), (4, (3, 2)), (5, (4, 3, 2)), (9, (8, 7, 6))]
)
def test_subset_sizes_follow_the_paper_and_stay_usable(captured: int, sizes: tuple[int, ...]) -> None:
    assert subset_sizes(captured) == sizes


@pytest.mark.parametrize("captured", [1, 2, 3, 4, 8])
def test_the_first_view_is_never_dropped_by_default(captured: int) -> None:
    seen = set()
    for step in range(200):
        batch = sample_batch(captured, AdaptConfig(), seed=3, step=step)
        assert batch.captured[0] == 0
        assert list(batch.captured) == sorted(set(batch.captured))
        assert len(batch.captured) in subset_sizes(captured)
        seen |= set(batch.captured)
    assert seen == set(range(captured)), "every captured view takes its turn"


def test_realign_may_drop_the_first_view() -> None:
    config = AdaptConfig(gauge=Gauge.REALIGN)
    firsts = {sample_batch(5, config, seed=0, step=step).captured[0] for step in range(100)}
    assert len(firsts) > 1


@pytest.mark.parametrize("p", [0.0, 0.5, 1.0])
def test_the_inserted_view_appears_with_probability_p(p: float) -> None:
    config = AdaptConfig(insertion_probability=p)
    share = sum(sample_batch(4, config, seed=1, step=s).inserted for s in range(1000)) / 1000
    assert abs(share - p) <= 3 * (p * (1 - p) / 1000) ** 0.5


def test_a_draw_depends_on_seed_and_step_only() -> None:
    config = AdaptConfig()
    assert sample_batch(6, config, seed=5, step=17) == sample_batch(6, config, seed=5, step=17)
    draws = {sample_batch(6, config, seed=seed, step=17) for seed in range(20)}
    assert len(draws) > 1


def test_rule_all_takes_every_view() -> None:
    config = AdaptConfig(subset=SubsetRule.ALL)
    assert sample_batch(5, config, seed=0, step=1).captured == (0, 1, 2, 3, 4)


@pytest.mark.parametrize("gauge", list(Gauge))
def test_every_size_and_every_subset_of_a_size_is_as_likely(gauge: Gauge) -> None:
    """Of those that hold the first view, where it is kept."""
    draws = 1500
    found = Counter(sample_batch(5, AdaptConfig(gauge=gauge), seed=2, step=step).captured for step in range(draws))
    for size, subsets in {4: 4, 3: 6, 2: 4}.items() if gauge is Gauge.KEEP_FIRST else {4: 5, 3: 10, 2: 10}.items():
        counts = [count for subset, count in found.items() if len(subset) == size]
        assert len(counts) == subsets
        share = 1 / 3 / subsets
        for count in counts:
            assert abs(count / draws - share) < 4 * (share / draws) ** 0.5


@pytest.mark.parametrize("gauge", list(Gauge))
@pytest.mark.parametrize("subset", list(SubsetRule))
def test_without_a_photo_there_is_nothing_to_draw(gauge: Gauge, subset: SubsetRule) -> None:
    config = AdaptConfig(gauge=gauge, subset=subset)
    assert sample_batch(1, config, seed=0, step=0).captured == (0,)
    with pytest.raises(ValueError, match="at least one captured view is needed, got 0"):
        sample_batch(0, config, seed=0, step=0)


def test_the_inserted_view_comes_as_often_with_every_rule() -> None:
    for step in range(50):
        drawn = {sample_batch(4, AdaptConfig(subset=rule), seed=7, step=step).inserted for rule in SubsetRule}
        assert len(drawn) == 1
