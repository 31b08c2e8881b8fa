"""Statistics against statsmodels, scipy, rliable and published numbers."""

import numpy as np
import pandas as pd
import pytest
from scipy import optimize
from scipy import stats as scipy_stats

from pdkit import stats
from pdkit.errors import PdkitError


def table(seeds, solved):
    return pd.DataFrame({"seed": seeds, "success_once": np.isin(seeds, solved), "success_at_end": False, "length": 300})


@pytest.mark.parametrize(("k", "n"), [(0, 10), (1, 10), (15, 148), (97, 200), (200, 200)])
def test_wilson_is_statsmodels_wilson(k, n):
    proportion = pytest.importorskip("statsmodels.stats.proportion")
    rate = stats.wilson(k, n)
    assert (rate.low, rate.high) == pytest.approx(proportion.proportion_confint(k, n, method="wilson"), abs=1e-12)


def test_wilson_published_value():
    """Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 3: 81 of 263."""
    rate = stats.wilson(81, 263)
    assert (round(rate.low, 4), round(rate.high, 4)) == (0.2553, 0.3662)
    assert rate.value == 81 / 263


@pytest.mark.parametrize(("k", "n"), [(-1, 3), (4, 3), (0, 0)])
def test_wilson_refuses_nonsense(k, n):
    with pytest.raises(PdkitError, match="successes"):
        stats.wilson(k, n)


def test_mcnemar_is_the_exact_test():
    contingency = pytest.importorskip("statsmodels.stats.contingency_tables")
    for gained, lost in ((12, 2), (3, 3), (0, 6), (40, 1)):
        expected = contingency.mcnemar([[50, lost], [gained, 9]], exact=True).pvalue
        assert stats.mcnemar(gained, lost) == pytest.approx(expected)
    assert stats.mcnemar(0, 6) == pytest.approx(2 / 64)
    assert stats.mcnemar(0, 0) == 1.0


@pytest.mark.parametrize(
    ("gained", "lost", "n"), [(12, 2, 50), (98, 1, 200), (0, 3, 20), (5, 0, 5), (0, 0, 200), (7, 7, 30)]
)
def test_difference_limits_are_where_the_score_test_rejects(gained, lost, n):
    """By brute force: at each limit the score statistic, its other parameter at maximum likelihood, is 1.96."""
    interval = stats.difference_interval(gained, lost, n)
    assert interval.low <= interval.value <= interval.high
    for d, sign in ((interval.low, 1), (interval.high, -1)):
        if abs(d) > 1 - 1e-6:
            continue
        same = n - gained - lost

        def negative_likelihood(q, d=d, same=same):
            parts = ((gained, q + d), (lost, q), (same, 1 - 2 * q - d))
            return -sum(k * np.log(max(p, 1e-12)) for k, p in parts)

        low, high = max(0.0, -d), (1 - d) / 2
        q = optimize.minimize_scalar(
            negative_likelihood, bounds=(low, high), method="bounded", options={"xatol": 1e-12}
        ).x
        score = (gained - lost - n * d) / np.sqrt(n * (2 * q + d - d * d))
        assert score == pytest.approx(sign * 1.959964, abs=2e-3)


def test_difference_interval_at_the_ends():
    assert stats.difference_interval(20, 0, 20).high == 1.0
    # With every pair gained the score test is that of one proportion, scaled to [-1, 1].
    assert stats.difference_interval(20, 0, 20).low == pytest.approx(2 * stats.wilson(20, 20).low - 1, abs=1e-6)
    assert stats.difference_interval(0, 20, 20).low == -1.0
    nothing = stats.difference_interval(0, 0, 100)
    assert nothing.low == pytest.approx(-nothing.high) and 0 < nothing.high < 0.05


def test_difference_interval_published_value():
    """Fagerland, Lydersen and Laake, Analysis of Contingency Tables (2017), chapter 8: 1 against 7 of 21."""
    interval = stats.difference_interval(1, 7, 21)
    assert (round(interval.low, 3), round(interval.high, 3)) == (-0.517, -0.026)


def test_difference_interval_covers():
    """Simulated: about 95 % of intervals hold the true difference."""
    rng, n, cells = np.random.default_rng(0), 100, (0.45, 0.05)  # gained, lost
    draws = rng.multinomial(n, (*cells, 0.5), size=400)
    hits = [
        interval.low <= 0.4 <= interval.high for interval in (stats.difference_interval(g, k, n) for g, k, _ in draws)
    ]
    assert 0.92 <= np.mean(hits) <= 0.98


def test_paired_counts_and_seeds():
    seeds = list(range(100, 110))
    result = stats.paired(table(seeds, [100, 101, 102]), table(seeds[::-1], [101, 102, 103, 104, 105]))
    assert (result.gained, result.lost) == ([103, 104, 105], [100])
    assert (result.base.successes, result.other.successes, result.n) == (3, 5, 10)
    assert result.difference == pytest.approx(0.2)
    assert result.low < 0 < result.high and result.p == pytest.approx(stats.mcnemar(3, 1))
    assert result.as_dict()["other"]["value"] == 0.5
    assert "3 episodes gained, 1 lost" in str(result)


def test_paired_refuses_other_seeds_and_columns():
    with pytest.raises(PdkitError, match="2 seeds"):
        stats.paired(table([1, 2], []), table([1, 3], []))
    with pytest.raises(PdkitError, match="'success'"):
        stats.paired(table([1], []), table([1], []), "success")
    with pytest.raises(PdkitError, match="once"):
        stats.paired(table([1, 1], []), table([1, 1], []))


def test_iqm_and_improvement_are_rliables():
    metrics = pytest.importorskip("rliable.metrics")
    rng = np.random.default_rng(3)
    x, y = rng.random((6, 5)), np.round(rng.random((7, 5)), 1)
    x[2] = np.round(x[2], 1)
    assert stats.iqm(x) == pytest.approx(metrics.aggregate_iqm(x))
    assert stats.probability_of_improvement(x, y) == pytest.approx(metrics.probability_of_improvement(x, y))
    assert stats.probability_of_improvement(x, x) == pytest.approx(0.5)


def test_bootstrap_is_seeded_stratified_and_about_right():
    rng = np.random.default_rng(0)
    scores = rng.normal(0, 1, (40, 3)) + [0, 10, 20]
    first = stats.stratified_bootstrap(stats.mean, scores, seed=1)
    assert (
        first
        == stats.stratified_bootstrap(stats.mean, scores, seed=1)
        != stats.stratified_bootstrap(stats.mean, scores, seed=2)
    )
    # Within tasks the spread is 1; a bootstrap that mixed tasks would see a spread of 8.
    error = 1.96 * np.sqrt(np.mean(scores.var(axis=0)) / scores.size)
    assert first.value == pytest.approx(scores.mean())
    assert first.high - first.low == pytest.approx(2 * error, rel=0.12)
    # Tasks whose runs go together are drawn apart all the same.
    alike = np.repeat(rng.normal(size=(40, 1)), 3, axis=1)
    apart = stats.stratified_bootstrap(stats.mean, alike, seed=1)
    assert apart.high - apart.low == pytest.approx(2 * 1.96 * alike.std() / np.sqrt(alike.size), rel=0.15)
    worse = scores - 1
    chance = stats.stratified_bootstrap(stats.probability_of_improvement, scores, worse, seed=0, repetitions=200)
    assert chance.low < chance.value < chance.high
    assert chance.value == pytest.approx(
        np.mean([scipy_stats.mannwhitneyu(a, b).statistic / 1600 for a, b in zip(scores.T, worse.T, strict=True)])
    )


def test_a_statistic_that_makes_one_number_of_all_repetitions_is_refused():
    """Its interval would have no width."""
    for statistic in (np.mean, lambda scores: np.median(scores, axis=-1)):
        with pytest.raises(PdkitError, match="over which axes"):
            stats.stratified_bootstrap(statistic, np.arange(6.0).reshape(3, 2), seed=0)


def test_many_arrays_at_once_give_what_each_gives():
    first, second = np.random.default_rng(0).random((2, 7, 5, 3))
    for statistic in (stats.mean, stats.iqm):
        assert statistic(first) == pytest.approx([statistic(one) for one in first])
    assert stats.probability_of_improvement(first, second) == pytest.approx(
        [stats.probability_of_improvement(*pair) for pair in zip(first, second, strict=True)])


def test_bad_scores_are_refused():
    for bad in ([1, 2], [[1, np.nan]], np.zeros((0, 2))):
        with pytest.raises(PdkitError, match="runs x tasks"):
            stats.iqm(bad)
