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
