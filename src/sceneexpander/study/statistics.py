"""Statistics of rankings: means with intervals, Friedman's test, Kendall's W and tau, paired tests.

Participants are the independent units of all tests: what one person says about several scenes is averaged first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int, Real
from numpy import ndarray
from scipy import stats

from sceneexpander.study.design import make_numpy_generator

RESAMPLES = 9_999
_CHUNK = 1_000  # permutations at a time, so that memory stays small with many participants


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """Ends of a 95 % interval."""

    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Friedman:
    """Friedman's test over participants.

    Attributes:
        statistic: chi-squared with correction for ties (scipy).
        p_chi2: by its asymptotic distribution.
        p_permutation: by permuting methods within participants, ``(1 + extreme) / (1 + permutations)``.
        kendalls_w: agreement of participants on the methods, ``statistic / (participants * (methods - 1))``.
        participants: the blocks.
    """

    statistic: float
    p_chi2: float
    p_permutation: float
    kendalls_w: float
    participants: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two methods compared: mean of the first one's scores minus the second one's; p of a two-sided paired permutation test."""

    first: str
    second: str
    difference: float
    interval: Interval | None
    p: float
    p_holm: float


def scores_from_ranks(
    ranks: Int[ndarray, "participant scene method"],
) -> Float[ndarray, "participant scene method"]:
    """Rank 1 of k becomes score k, rank k becomes 1 (the paper's 5 to 1).

    Raises:
        ValueError: a ranking is not each of 1 to k once, so that scores would not add up to k (k + 1) / 2; names the first one.
    """
    count = ranks.shape[-1]
    wrong = (np.sort(ranks, axis=-1) != np.arange(1, count + 1)).any(-1)
    if wrong.any():
        place = tuple(int(index) for index in np.argwhere(wrong)[0])
        raise ValueError(f"ranks at {place} are {ranks[place].tolist()}, not each of 1 to {count} once")
    return (count + 1 - ranks).astype(np.float64)


def bootstrap_means(
    scores: Float[ndarray, "participant scene method"], seed: int, *, resamples: int = RESAMPLES
) -> Float[ndarray, "resample method"]:
    """Means of two-way cluster bootstrap samples: participants and scenes are drawn with replacement, independently.

    Intervals from them hold for other people and other scenes, and are rather too wide than too narrow.

    Source: A. B. Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1(2), 2007.
    """
    people, scenes, methods = scores.shape
    rng = make_numpy_generator(seed, "study/bootstrap")
    by_person = rng.multinomial(people, np.full(people, 1 / people), size=resamples) / people
    by_scene = rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=resamples) / scenes
    over_people = (by_person @ scores.reshape(people, -1)).reshape(resamples, scenes, methods)
    means: Float[ndarray, "resample method"] = np.einsum("rsm,rs->rm", over_people, by_scene)
    return means


def percentile_interval(values: Float[ndarray, " resample"]) -> Interval:
    """The middle 95 %."""
    low, high = np.percentile(values, [2.5, 97.5])
    return Interval(low=float(low), high=float(high))


def friedman_test(
    scores: Float[ndarray, "participant method"], seed: int, *, resamples: int = RESAMPLES
) -> Friedman | None:
    """Do methods differ? None with fewer than two participants or three methods, or if everybody calls all of them equal.

    Args:
        scores: mean over scenes of each participant's scores.
        seed: of the permutations.
        resamples: number of permutations.
    """
    people, methods = scores.shape
    if people < 2 or methods < 3 or not np.ptp(scores, axis=1).any():
        return None
    statistic, p_chi2 = stats.friedmanchisquare(*scores.T)
    ranks = stats.rankdata(scores, axis=1)
    # With ties as they are, the statistic grows with this sum alone.
    observed = np.square(ranks.sum(0)).sum()
    rng = make_numpy_generator(seed, "study/friedman")
    extreme = 0
    for start in range(0, resamples, _CHUNK):
        size = min(_CHUNK, resamples - start)
        shuffled = rng.permuted(np.broadcast_to(ranks, (size, people, methods)), axis=2)
        extreme += int((np.square(shuffled.sum(1)).sum(1) >= observed - 1e-9).sum())
    return Friedman(
        statistic=float(statistic),
        p_chi2=float(p_chi2),
        p_permutation=(1 + extreme) / (1 + resamples),
        kendalls_w=float(statistic) / (people * (methods - 1)),
        participants=people,
    )


def kendalls_w(ranks: Real[ndarray, "rater item"]) -> float:
    """Agreement of rankings without ties, from 0 to 1: ``12 S / (m^2 (n^3 - n))``.

    Source: M. G. Kendall and B. Babington Smith, The problem of m rankings, 1939.
    """
    raters, items = ranks.shape
    totals = ranks.sum(0)
    return float(12 * np.square(totals - totals.mean()).sum() / (raters**2 * (items**3 - items)))


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """P values adjusted for their number, in their order (S. Holm, A simple sequentially rejective multiple test procedure, 1979)."""
    adjusted = [0.0] * len(p_values)
    reached = 0.0
    for done, index in enumerate(sorted(range(len(p_values)), key=lambda index: p_values[index])):
        reached = max(reached, min(1.0, (len(p_values) - done) * p_values[index]))
        adjusted[index] = reached
    return tuple(adjusted)


def compare_pairs(
    scores: Float[ndarray, "participant method"],
    means: Float[ndarray, "resample method"],
    methods: Sequence[str],
    seed: int,
    *,
    resamples: int = RESAMPLES,
) -> tuple[Pair, ...]:
    """All pairs of methods, p values adjusted by `holm`.

    The test swaps the methods of a pair within participants (exactly if there are few, else by drawing).

    Args:
        scores: mean over scenes of each participant's scores.
        means: of `bootstrap_means`.
        methods: their names.
        seed: of the draws.
        resamples: number of draws.
    """
    pairs = list(combinations(range(len(methods)), 2))
    differences = np.stack([scores[:, first] - scores[:, second] for first, second in pairs], axis=1)
    p_values = [1.0] * len(pairs)
    if len(scores) > 1:
        tested = stats.permutation_test(
            (differences,),
            np.mean,
            permutation_type="samples",
            vectorized=True,
            n_resamples=resamples,
            batch=max(1, 2_000_000 // differences.size),
            axis=0,
            rng=make_numpy_generator(seed, "study/pairs"),
        )
        p_values = [min(1.0, float(p)) for p in tested.pvalue]
    return tuple(
        Pair(
            first=methods[first],
            second=methods[second],
            difference=float(differences[:, index].mean()),
            interval=percentile_interval(means[:, first] - means[:, second]) if len(scores) > 1 else None,
            p=p_values[index],
            p_holm=adjusted,
        )
        for index, ((first, second), adjusted) in enumerate(zip(pairs, holm(p_values), strict=True))
    )


def kendall_tau(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Kendall's tau-b; None where one side says everything is equal, or there are fewer than two values."""
    if len(first) < 2:
        return None
    tau = float(stats.kendalltau(first, second).statistic)
    return tau if math.isfinite(tau) else None
