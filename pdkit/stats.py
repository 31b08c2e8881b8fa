"""Intervals and comparisons for success rates: pure functions, each with its source.

Rates of one policy: Wilson's score interval. Two independent rates: Newcombe's. Two policies on the same seeds: Tango's score interval
for the difference and McNemar's exact test, both of which use only the seeds on which the two disagree. Several runs on several tasks: the
interquartile mean and the probability of improvement with a stratified bootstrap (Agarwal et al., 2021, "Deep RL at the
edge of the statistical precipice"), as in rliable but with an explicit seed.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import optimize
from scipy import stats as scipy_stats

from .errors import PdkitError


@dataclass(frozen=True)
class Rate:
    """A success rate with its interval."""

    successes: int
    n: int
    low: float
    high: float

    @property
    def value(self) -> float:
        return self.successes / self.n

    def __str__(self) -> str:
        return f"{100 * self.value:.1f} % ({100 * self.low:.1f} to {100 * self.high:.1f}, {self.successes} of {self.n})"


@dataclass(frozen=True)
class Interval:
    """A statistic with its interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Paired:
    """Two policies on the same seeds. The difference is other minus base, in [-1, 1]."""

    column: str
    n: int
    base: Rate
    other: Rate
    difference: float
    low: float
    high: float
    gained: list[int]  # seeds that only the other solves
    lost: list[int]  # seeds that only the base solves
    p: float  # McNemar, exact, two-sided
    method: str = "95 % intervals: Wilson (rates), Tango's score interval (difference); p: McNemar's exact test"

    def as_dict(self) -> dict[str, Any]:
        """JSON types, the rates as {value, low, high, successes, n}."""
        values = asdict(self)
        for name in ("base", "other"):
            values[name]["value"] = getattr(self, name).value
        return values

    def __str__(self) -> str:
        change = f"{100 * self.difference:+.1f} points ({100 * self.low:+.1f} to {100 * self.high:+.1f})"
        return (f"first {self.base}; second {self.other}; difference {change}; "
                f"{len(self.gained)} episodes gained, {len(self.lost)} lost (p = {self.p:.2g})")


def _z(confidence: float) -> float:
    if not 0 < confidence < 1:
        raise PdkitError(f"A confidence level lies between 0 and 1, not at {confidence}.")
    return float(scipy_stats.norm.ppf(0.5 + confidence / 2))


def wilson(successes: int, n: int, confidence: float = 0.95) -> Rate:
    """`successes` of `n` with Wilson's score interval (1927), which stays in [0, 1] and has a width even at 0 and n.

    Raises PdkitError unless 0 <= successes <= n and n >= 1.
    """
    if n < 1 or not 0 <= successes <= n:
        raise PdkitError(f"A success rate needs 0 <= successes <= n and n >= 1, not {successes} of {n}.")
    z, p = _z(confidence), successes / n
    centre = p + z * z / (2 * n)
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = (centre - half) / (1 + z * z / n), (centre + half) / (1 + z * z / n)
    # At 0 and n the limits are 0 and 1 up to rounding.
    return Rate(int(successes), int(n), 0.0 if successes == 0 else float(low), 1.0 if successes == n else float(high))


def newcombe(first: Rate, second: Rate) -> Interval:
    """second - first with the interval of two independent rates that follows from theirs (Newcombe, Statistics in Medicine 17, 1998,
    873: method 10)."""
    change = second.value - first.value
    return Interval(change, change - float(np.hypot(second.value - second.low, first.high - first.value)),
                    change + float(np.hypot(second.high - second.value, first.value - first.low)))


def mcnemar(gained: int, lost: int) -> float:
    """Two-sided exact p that `gained` and `lost` disagreements come from two equally good policies (McNemar, 1947)."""
    if gained + lost == 0:
        return 1.0
    return float(scipy_stats.binomtest(gained, gained + lost, 0.5).pvalue)


def difference_interval(gained: int, lost: int, n: int, confidence: float = 0.95) -> Interval:
    """(gained - lost) / n with Tango's score interval for paired proportions (Statistics in Medicine 17, 1998, 891).

    The limits are the differences d at which the score test of "the true difference is d" has p = 1 - confidence. At
    d = 0 that test is McNemar's by its normal approximation; `mcnemar` is exact and stricter where few disagree: of 60 pairs with 4 gained
    and none lost the interval leaves out 0, with p = 0.125.
    """
    z = _z(confidence)

    def score(d: float) -> float:
        # The probability of "lost" that is most likely when the true difference is d solves a quadratic equation.
        a, b, c = 2 * n, -gained - lost + (2 * n - gained + lost) * d, -lost * d * (1 - d)
        q = (np.sqrt(max(0.0, b * b - 4 * a * c)) - b) / (2 * a)
        variance = n * (2 * q + d * (1 - d))
        return (gained - lost - n * d) / np.sqrt(max(variance, 1e-300))

    estimate, edge = (gained - lost) / n, 1 - 1e-9
    low = -1.0 if lost == n else optimize.brentq(lambda d: score(d) - z, -edge, estimate) if estimate > -edge else -1.0
    high = 1.0 if gained == n else optimize.brentq(lambda d: score(d) + z, estimate, edge) if estimate < edge else 1.0
    return Interval(estimate, float(low), float(high))


def paired(base: pd.DataFrame, other: pd.DataFrame, column: str = "success_once") -> Paired:
    """Compare two evaluate() tables over the same seeds (the order does not matter).

    Raises PdkitError when the seeds differ, repeat, or `column` is missing.
    """
    for name, table in (("first", base), ("second", other)):
        missing = [c for c in ("seed", column) if c not in table.columns]
        if missing:
            raise PdkitError(f"The {name} table has no column {missing[0]!r}; it must come from evaluate().")
        if not len(table) or table.seed.duplicated().any():
            raise PdkitError(f"The {name} table must hold every seed once, and at least one.")
    first, second = (table.set_index("seed")[column].astype(bool).sort_index() for table in (base, other))
    if not first.index.equals(second.index):
        alone = len(first.index.symmetric_difference(second.index))
        raise PdkitError(f"A paired comparison needs the same seeds on both sides; {alone} seeds are on one side only.")
    gained, lost = first.index[~first & second].tolist(), first.index[first & ~second].tolist()
    n, interval = len(first), difference_interval(len(gained), len(lost), len(first))
    return Paired(column, n, wilson(int(first.sum()), n), wilson(int(second.sum()), n), interval.value, interval.low,
                  interval.high, gained, lost, mcnemar(len(gained), len(lost)))


def _runs_by_tasks(scores: Any) -> np.ndarray:
    scores = np.asarray(scores, float)
    if scores.ndim < 2 or not scores.size or not np.isfinite(scores).all():
        raise PdkitError(f"Scores must be a (runs x tasks) array of finite numbers, not of shape {scores.shape}.")
    return scores


def mean(scores: Any) -> Any:
    """Mean of all numbers of a (runs x tasks) array, or of each of many, (..., runs, tasks)."""
    return _runs_by_tasks(scores).mean(axis=(-2, -1))


def iqm(scores: Any) -> Any:
    """Interquartile mean of a (runs x tasks) array: the mean of the middle half of all its numbers; of many, (..., runs, tasks), one each.
    """
    scores = _runs_by_tasks(scores)
    return scipy_stats.trim_mean(scores.reshape(*scores.shape[:-2], -1), 0.25, axis=-1)


def probability_of_improvement(scores: Any, other: Any) -> Any:
    """Probability that a run of `scores` beats one of `other`, both (runs x tasks), on a random task (ties: half); of many, (..., runs,
    tasks), one each."""
    scores, other = _runs_by_tasks(scores), _runs_by_tasks(other)
    if scores.shape[-1] != other.shape[-1]:
        raise PdkitError(f"Both sides need the same tasks, not {scores.shape[-1]} and {other.shape[-1]}.")
    first, second = scores[..., :, None, :], other[..., None, :, :]
    return np.mean((first > second) + 0.5 * (first == second), axis=(-3, -2, -1))


def stratified_bootstrap(statistic: Callable[..., Any], *scores: Any, seed: int, repetitions: int = 2000,
                         confidence: float = 0.95) -> Interval:
    """`statistic(*scores)` with a percentile interval, for one or two (runs x tasks) arrays.

    Runs are drawn with replacement within each task (the strata), so a task keeps its weight. `seed` is explicit: the
    same call gives the same interval. With fewer than about 5 runs such intervals are too narrow. The statistic is asked once for all
    repetitions, of (repetitions, runs, tasks), and gives a value for each, as `mean`, `iqm` and `probability_of_improvement` do. Raises
    PdkitError for one that does not.
    """
    _z(confidence)  # rejects a level outside (0, 1)
    arrays = [_runs_by_tasks(s) for s in scores]
    rng = np.random.default_rng(seed)
    drawn = [rng.integers(len(array), size=(repetitions, *array.shape)) for array in arrays]
    values = statistic(*[np.take_along_axis(array[None], rows, axis=1) for array, rows in zip(arrays, drawn, strict=True)])
    if np.shape(values) != (repetitions,):
        raise PdkitError("A statistic that is bootstrapped gives a value for each (runs x tasks) array of (repetitions, runs, tasks): say "
                         "over which axes, as stats.mean does.")
    low, high = np.quantile(values, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return Interval(float(statistic(*arrays)), float(low), float(high))
