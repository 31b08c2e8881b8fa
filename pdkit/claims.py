"""The rules by which recorded results are judged; pdkit/verdicts applies them to the paper's claims.

Every verdict follows one of few rules, so that no one is tempted to choose the rule that suits a result:

- a comparison is made seed by seed (the same seed is the same draw of networks and batches, the same training and test
  episodes); its value is the mean difference, its interval the 95 % percentile bootstrap over seeds;
- **reproduced**: the whole interval lies on the side that the paper says; **not**: the mean lies on the other side, or the
  whole interval does; **partly**: the right side, but the interval reaches over zero;
- where the claim is about more tasks than were run, "reproduced" counts as **partly**;
- fewer than three seeds are no test.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from .errors import PdkitError
from .recorded import load
from .stats import Interval

LEAST_SEEDS = 3
DECORATOR = "policy_decorator"
FINE_TUNING = ("sac_finetune", "sac_finetune,actor_lr=1e-4", "rlpd_paper", "rot", "calql", "ppo_finetune")  # the policy's own weights move
OTHERS = ("residual_rl", "jsrl", "fish", "rlpd")  # baselines that leave it as it is, or have none
TASKS = {"adroit": ("Door", "Pen", "Hammer", "Relocate"), "maniskill": ("StackCube", "PegInsertionSide", "TurnFaucet", "PushChair")}


class TooLittle(PdkitError):
    """Not enough is recorded to judge."""


@dataclass(frozen=True)
class Finding:
    """What was measured of a claim: the columns of claims.csv after the claim and its section."""

    tasks: str
    seeds: str
    measured: str
    interval: str
    verdict: str
    command: str


# ---- measuring -------------------------------------------------------------------------------------------------------

def by_seed(table: pd.DataFrame, recipe: str, column: str) -> pd.Series:
    """`column` of one recipe by (task, seed). Raises TooLittle below three seeds."""
    if column not in table:
        raise TooLittle(f"No column {column} is recorded.")
    values = table[table.recipe == recipe].set_index(["task", "seed"])[column].dropna()
    if values.index.get_level_values("seed").nunique() < LEAST_SEEDS:
        raise TooLittle(f"Fewer than {LEAST_SEEDS} seeds of {recipe} are recorded.")
    return values


def mean_interval(values: pd.Series) -> Interval:
    """Mean over runs and its 95 % percentile bootstrap interval, runs drawn again within each task; tasks may have other seeds."""
    blocks, rng = [group.to_numpy() for _, group in values.groupby(level="task")], np.random.default_rng(0)
    drawn = np.concatenate([rng.choice(block, (2000, len(block))) for block in blocks], axis=1).mean(axis=1)
    return Interval(float(values.mean()), *map(float, np.quantile(drawn, [0.025, 0.975])))


def difference(first: pd.Series, second: pd.Series) -> tuple[Interval, pd.Series]:
    """Mean of first - second over the seeds that both have, with its interval; and the differences. Raises TooLittle."""
    values = (first - second).dropna()
    if values.index.get_level_values("seed").nunique() < LEAST_SEEDS:
        raise TooLittle(f"Fewer than {LEAST_SEEDS} seeds are recorded on both sides.")
    return mean_interval(values), values


def turned(interval: Interval) -> Interval:
    """Of the opposite difference."""
    return Interval(-interval.value, -interval.high, -interval.low)


def judged(interval: Interval, enough: float = 0.0) -> str:
    """The rule above, for a claim that the value lies above `enough`."""
    if interval.low > enough:
        return "reproduced"
    return "not" if interval.value <= enough or interval.high < enough else "partly"


def best(table: pd.DataFrame, recipes: Sequence[str], column: str = "decorated_success") -> str:
    """The recipe with the largest mean among those with enough seeds. Raises TooLittle when none has."""
    means = {}
    for recipe in recipes:
        try:
            means[recipe] = by_seed(table, recipe, column).mean()
        except TooLittle:
            continue
    if not means:
        raise TooLittle(f"None of {', '.join(recipes)} is recorded with {LEAST_SEEDS} seeds.")
    return max(means, key=means.get)


def first_evaluation(curves: pd.DataFrame, recipe: str) -> pd.Series:
    """Success at the first evaluation during training, by (task, seed)."""
    rows = curves[(curves.recipe == recipe) & curves.success_once.notna()].sort_values("step")
    return by_seed(rows.groupby(["task", "seed"], as_index=False).first().assign(recipe=recipe), recipe, "success_once")


def efficiency(curves: pd.DataFrame, recipe: str) -> pd.Series:
    """Mean success over all evaluations after the first environment step, by (task, seed): how early, and how well, a recipe learns."""
    rows = curves[(curves.recipe == recipe) & (curves.step > 0)]
    if "success_once" not in rows or rows.success_once.isna().all():
        raise TooLittle(f"No evaluations of {recipe} are recorded.")
    return by_seed(rows.groupby(["task", "seed"], as_index=False).success_once.mean().assign(recipe=recipe), recipe, "success_once")


# ---- wording ---------------------------------------------------------------------------------------------------------

def percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def points(interval: Interval) -> str:
    return f"{100 * interval.low:+.1f} to {100 * interval.high:+.1f} points (percentile bootstrap over seeds, 95 %)"


def compared(record: str, first: str, second: str = "", *, column: str = "decorated_success", second_column: str = "", sign: int = 1,
             enough: float = 0.0, paper: Sequence[str] = (), names: tuple[str, str] = ("", "")) -> Finding:
    """A finding of the kind "first is better than second" by `column`.

    Args:
        record: the name of the recorded results.
        second: another recipe; left out: the same one, with `second_column` (such as its base policy's success).
        sign: -1 for "worse than".
        enough: what the difference must exceed.
        paper: the claim's tasks, where it names some.
        names: what both are called, if not by their recipes.
    """
    table, _ = recorded(record)
    one, two = by_seed(table, first, column), by_seed(table, second or first, second_column or column)
    interval, values = difference(one, two)
    a, b = names[0] or first, names[1] or second or "its base policy"
    mine, theirs = (percent(series.loc[values.index].mean()) for series in (one, two))
    return finding(record, values, f"{a} {mine}, {b} {theirs}: {100 * interval.value:+.1f} points", points(interval),
                   judged(interval if sign > 0 else turned(interval), enough), paper)


def finding(record: str, values: pd.Series, measured: str, interval: str, verdict: str, paper: Sequence[str] = ()) -> Finding:
    """A finding from values by (task, seed); "reproduced" counts as partly where tasks of the claim are missing."""
    tasks = list(dict.fromkeys(values.index.get_level_values("task")))
    if verdict == "reproduced" and not set(paper) <= set(tasks):
        verdict = "partly"
    seeds = " ".join(str(seed) for seed in sorted(set(values.index.get_level_values("seed"))))
    return Finding(" ".join(tasks), seeds, measured, interval, verdict, f"pdkit sweep data/sweeps/{record}.toml")


def recorded(name: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """`load`, with TooLittle where nothing is recorded."""
    try:
        return load(name)
    except PdkitError as error:
        raise TooLittle(str(error)) from None
