"""Which recorded comparison speaks to which claim of the paper: `pdkit report --update` writes the verdicts into claims.csv.

A rule here is chosen before its data are seen wherever the paper says enough to choose one; numbers in a rule that are ours are named.
"""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

from .claims import (
    DECORATOR,
    FINE_TUNING,
    OTHERS,
    TASKS,
    Finding,
    TooLittle,
    best,
    by_seed,
    compared,
    difference,
    finding,
    first_evaluation,
    judged,
    mean_interval,
    percent,
    points,
    recorded,
    turned,
)
from .stats import wilson

Measure = Callable[[], Finding]
MEASURES: dict[str, Measure] = {}  # first words of a claim -> how it is judged
EIGHT = TASKS["maniskill"] + TASKS["adroit"]
GRID = "alpha=0.1,H=20000"  # the ablations' recipe that is the lesson's


def measures(claim: str) -> Callable[[Measure], Measure]:
    """Register how the claim that begins so is judged."""
    def add(function: Measure) -> Measure:
        MEASURES[claim] = function
        return function

    return add


def find(claim: str) -> Finding | None:
    """What is recorded of a claim (its whole sentence), or None where nothing, or too little, is."""
    for start, measure in MEASURES.items():
        if claim.startswith(start):
            try:
                return measure()
            except TooLittle:
                return None
    return None


def updated(claims: pd.DataFrame) -> pd.DataFrame:
    """The table of claims with every verdict that can be computed; the other rows as they are."""
    rows = [row | (vars(found) if (found := find(row["claim"])) else {}) for row in claims.to_dict("records")]
    return pd.DataFrame(rows, columns=claims.columns)


def shown(claims: pd.DataFrame, *sections: str) -> pd.DataFrame:
    """For a notebook: the claims of these sections (such as "E.1") with verdict, what was measured and its interval."""
    chosen = claims[claims.section.map(lambda text: bool(set(text.split(", ")) & set(sections)))]
    return updated(chosen)[["section", "claim", "verdict", "measured", "interval", "seeds"]].reset_index(drop=True)


# ---- the comparison of methods (leaderboard) --------------------------------------------------------------------------

@measures("With BeT bases, Policy Decorator")
def _() -> Finding:
    """Ahead of the best of both kinds; the interval is that of the smaller lead."""
    table, _ = recorded("leaderboard")
    leads = []
    for kind, recipes in (("no fine-tuning", OTHERS), ("fine-tuning", FINE_TUNING)):
        rival = best(table, recipes)
        interval, values = difference(by_seed(table, DECORATOR, "decorated_success"), by_seed(table, rival, "decorated_success"))
        leads.append((interval, values, f"{100 * interval.value:+.1f} points against {rival} (best of {kind})"))
    interval, values, _ = min(leads, key=lambda lead: lead[0].low)
    own = by_seed(table, DECORATOR, "decorated_success").mean()
    return finding("leaderboard", values, f"{percent(own)}: " + ", ".join(lead[2] for lead in leads), points(interval), judged(interval),
                   EIGHT)


@measures("The best baseline that fine-tunes BeT (36.7 %)")
def _() -> Finding:
    table, _ = recorded("leaderboard")
    return compared("leaderboard", best(table, FINE_TUNING), second_column="base_success", sign=-1, paper=TASKS["adroit"])


@measures("The best baseline that does not fine-tune (42.9 %)")
def _() -> Finding:
    """Each method against the policy that it starts from; one from scratch starts from none, so it is measured against the decorator's."""
    table, _ = recorded("leaderboard")
    rival = best(table, OTHERS)
    base = by_seed(table, DECORATOR, "base_success")
    interval, values = difference(by_seed(table, rival, "decorated_success"), base)
    end = by_seed(table, rival, "decorated_success").mean()
    return finding("leaderboard", values, f"{rival} {percent(end)}, BeT base {percent(base.mean())}: {100 * interval.value:+.1f} points",
                   points(interval), judged(turned(interval)), TASKS["adroit"])


@measures("JSRL gives jerky motion")
def _() -> Finding:
    """Jerkier than its guide (the base policy), as a ratio of mean jerk above 1.1 (the tenth is ours)."""
    return _jerk("jsrl", 1.1, 1)


@measures("A bounded residual keeps the motion close")
def _() -> Finding:
    """Close: mean jerk at most 1.25 times the base policy's (the quarter is ours)."""
    return _jerk(DECORATOR, 1.25, -1)


def _jerk(recipe: str, limit: float, sign: int) -> Finding:
    table, _ = recorded("leaderboard")
    ratios = np.log(by_seed(table, recipe, "decorated_jerk") / by_seed(table, recipe, "base_jerk"))
    interval = mean_interval(ratios)
    low, high = np.exp([interval.low, interval.high])
    return finding("leaderboard", ratios, f"mean jerk of {recipe} {np.exp(interval.value):.2f} times the base policy's",
                   f"{low:.2f} to {high:.2f} times (percentile bootstrap over seeds, 95 %)",
                   judged(interval if sign > 0 else turned(interval), sign * float(np.log(limit))))


@measures("SAC from scratch reaches 0 %")
def _() -> Finding:
    table, _ = recorded("leaderboard")
    values = by_seed(table[table.task.isin(TASKS["maniskill"])], "sac_from_scratch", "decorated_success")
    return finding("leaderboard", values, f"sac_from_scratch {percent(values.mean())}; largest of its seeds {percent(values.max())}",
                   points(mean_interval(values)), "reproduced" if values.max() == 0 else "not", TASKS["maniskill"])


@measures("Policy Decorator with PPO in place of SAC improves")
def _() -> Finding:
    return compared("leaderboard", "ppo_decorator", second_column="base_success", paper=("Pen",))


@measures("Policy Decorator with PPO considerably outperforms PPO fine-tuning")
def _() -> Finding:
    return compared("leaderboard", "ppo_decorator", "ppo_finetune", paper=("Pen",))


@measures("Policy Decorator with PPO considerably outperforms residual RL")
def _() -> Finding:
    return compared("leaderboard", "ppo_decorator", "ppo_residual_rl", paper=("Pen",))


@measures("Fine-tuning baselines unlearn")
def _() -> Finding:
    """Each fine-tuning method at its first evaluation against the policy that it started from; the one that keeps most decides."""
    table, curves = recorded("leaderboard")
    drops = {}
    for recipe in FINE_TUNING:
        try:
            drops[recipe] = difference(first_evaluation(curves, recipe), by_seed(table, recipe, "base_success"))
        except TooLittle:
            continue
    if not drops:
        raise TooLittle("No fine-tuning method is recorded.")
    mildest = max(drops, key=lambda recipe: drops[recipe][0].value)
    interval, values = drops[mildest]
    told = ", ".join(f"{recipe} {100 * drop.value:+.1f}" for recipe, (drop, _) in drops.items())
    return finding("leaderboard", values, f"points at the first evaluation against the start: {told}", f"{mildest}: {points(interval)}",
                   judged(turned(interval)))


@measures("Once unlearned, a policy is very hard to relearn")
def _() -> Finding:
    """Of the fine-tuning runs that stood below half of their start at the first evaluation: how many end below the start."""
    table, curves = recorded("leaderboard")
    lost, back = [], 0
    for recipe in FINE_TUNING:
        try:
            early, start = first_evaluation(curves, recipe), by_seed(table, recipe, "base_success")
        except TooLittle:
            continue
        ends = by_seed(table, recipe, "decorated_success")
        low = early[early < start / 2].index
        lost.append(ends.loc[low])
        back += int((ends.loc[low] >= start.loc[low]).sum())
    if sum(map(len, lost)) < 3:
        raise TooLittle("Fewer than three runs had unlearned.")
    values = pd.concat(lost)
    rate = wilson(len(values) - back, len(values))
    return finding("leaderboard", values, f"{len(values) - back} of {len(values)} unlearned runs end below their start",
                   f"{percent(rate.low)} to {percent(rate.high)} of such runs (Wilson, 95 %)",
                   "reproduced" if rate.low > 0.5 else "not" if rate.value < 0.5 else "partly")


@measures("Residual RL fails early")
def _() -> Finding:
    """Training success of the first 5,000 steps (ours), against the base policy's success."""
    table, curves = recorded("leaderboard")
    rows = curves[(curves.recipe == "residual_rl") & curves.train_success.notna() & (curves.step <= 5_100)]
    early = by_seed(rows.groupby(["task", "seed"], as_index=False).train_success.mean().assign(recipe="residual_rl"), "residual_rl",
                    "train_success")
    interval, values = difference(early, by_seed(table, "residual_rl", "base_success"))
    first = table.loc[table.recipe == "residual_rl", "first_reward_step"]
    return finding("leaderboard", values, f"training success in the first 5,000 steps {percent(early.mean())}; first reward after "
                   f"{first.median():,.0f} steps (median; {int(first.isna().sum())} of {len(first)} runs never)", points(interval),
                   judged(turned(interval), 0.2))


@measures("Residual RL fails later")
def _() -> Finding:
    """Mean |residual| against mean |base action| over the last quarter of training; and whether success ends below the base policy's."""
    table, curves = recorded("leaderboard")
    rows = curves[(curves.recipe == "residual_rl") & curves.residual_size.notna()]
    late = rows[rows.step > 0.75 * rows.step.max()].groupby(["task", "seed"])[["residual_size", "base_size"]].mean()
    ratio = np.log(late.residual_size / late.base_size)
    if ratio.index.get_level_values("seed").nunique() < 3:
        raise TooLittle("Fewer than three seeds of residual_rl.")
    size = mean_interval(ratio)
    success, _ = difference(by_seed(table, "residual_rl", "decorated_success"), by_seed(table, "residual_rl", "base_success"))
    larger, worse = judged(size), judged(turned(success))
    verdict = larger if larger == worse else "partly" if "not" not in (larger, worse) or "reproduced" in (larger, worse) else "not"
    low, high = np.exp([size.low, size.high])
    return finding("leaderboard", ratio, f"mean |residual| {np.exp(size.value):.2f} times mean |base action| in the last quarter; "
                   f"success {100 * success.value:+.1f} points against the base policy",
                   f"{low:.2f} to {high:.2f} times; {points(success)}", verdict)


@measures("FISH fails mainly because")
def _() -> Finding:
    """VINN below half of its BeT's success, and FISH below the BeT: both would have to hold."""
    table, _ = recorded("leaderboard")
    bet, vinn = by_seed(table, DECORATOR, "base_success"), by_seed(table, "fish", "base_success")
    interval, values = difference(vinn, bet / 2)
    end = by_seed(table, "fish", "decorated_success")
    return finding("leaderboard", values, f"VINN {percent(vinn.mean())}, BeT {percent(bet.mean())}, FISH on VINN {percent(end.mean())}",
                   f"VINN less half of BeT: {points(interval)}", "not" if end.mean() >= bet.mean() else judged(turned(interval)))


# ---- ablations -------------------------------------------------------------------------------------------------------

@measures("A residual policy that sees the observation alone")
def _() -> Finding:
    return compared("ablations", GRID, "actor_input=obs+base", names=("observation alone", "with the base action"))


@measures("A critic that sees the sum of base and residual action does better than one that sees both")
def _() -> Finding:
    return compared("ablations", GRID, "critic_input=concat", names=("sum", "side by side"), paper=("StackCube",))


@measures("A critic that sees the sum of base and residual action does better than one that sees the residual")
def _() -> Finding:
    return compared("ablations", GRID, "critic_input=residual", names=("sum", "residual alone"), paper=("StackCube",))


@measures("Reducing H to 0")
def _() -> Finding:
    return compared("ablations", "alpha=0.1,H=0", GRID, sign=-1, names=("H 0", "H 20,000"))


@measures("Increasing alpha to 1")
def _() -> Finding:
    return compared("ablations", "alpha=1.0,H=20000", GRID, sign=-1, names=("alpha 1", "alpha 0.1"))


@measures("H has a wide workable range")
def _() -> Finding:
    """No H of the grid falls behind the lesson's by more than 10 points (ours); the one that lies furthest behind decides."""
    table, _ = recorded("ablations")
    own, gaps = by_seed(table, GRID, "decorated_success"), {}
    for recipe in ("alpha=0.1,H=0", "alpha=0.1,H=40000"):
        gaps[recipe] = difference(by_seed(table, recipe, "decorated_success"), own)
    interval, values = min(gaps.values(), key=lambda gap: gap[0].value)
    told = ", ".join(f"{recipe.split(',')[1]} {100 * gap.value:+.1f} points" for recipe, (gap, _) in gaps.items())
    return finding("ablations", values, f"against H=20000 ({percent(own.mean())}): {told}", points(interval), judged(interval, -0.1))


@measures("Policy Decorator substantially improves a low-performing BeT")
def _() -> Finding:
    """Substantially: by more than 20 points (ours)."""
    return compared("low_checkpoint", "low", second_column="base_success", enough=0.2)


# ---- notebooks with five seeds (unlearning, warm start) ----------------------------------------------------------------

def _unlearning(task: str) -> pd.DataFrame:
    table, _ = recorded("unlearning")
    return table[table.task == task].assign(recipe="x")


@measures("After 100 updates with a random critic")
def _() -> Finding:
    """Success falls while the cube is still lifted in most episodes in which it was (most: more than half, ours)."""
    rows = _unlearning("StackCube")
    before, after, lifts, kept = (by_seed(rows, "x", name) for name in (
        "success.before.value", "success.random critic, 100.value", "lifted.before", "lifted.random critic, 100"))
    fall, values = difference(before, after)
    share = mean_interval(kept / lifts)
    both = {judged(fall), judged(share, 0.5)}
    return finding("unlearning", values, f"success {percent(before.mean())} before, {percent(after.mean())} after; cube lifted "
                   f"{percent(lifts.mean())} before, {percent(kept.mean())} after", f"fall {points(fall)}",
                   both.pop() if len(both) == 1 else "partly")


@measures("After 200 updates with a random critic")
def _() -> Finding:
    """The cube is lifted in less than half of the episodes in which it was."""
    rows = _unlearning("StackCube")
    lifts, kept = by_seed(rows, "x", "lifted.before"), by_seed(rows, "x", "lifted.random critic, 200")
    share = mean_interval(kept / lifts)
    return finding("unlearning", kept, f"cube lifted {percent(lifts.mean())} before, {percent(kept.mean())} after",
                   f"{percent(share.low)} to {percent(share.high)} of what it was (percentile bootstrap over seeds, 95 %)",
                   judged(turned(share), -0.5))


@measures("The BeT modified for fine-tuning")
def _() -> Finding:
    """Like the original: the mean difference, with its interval, lies within 10 points (ours)."""
    rows = _unlearning("Door")
    ours, theirs = by_seed(rows, "x", "original.other.value"), by_seed(rows, "x", "original.base.value")
    interval, values = difference(ours, theirs)
    inside = -0.1 < interval.low and interval.high < 0.1
    return finding("unlearning", values, f"modified {percent(ours.mean())}, original {percent(theirs.mean())}: "
                   f"{100 * interval.value:+.1f} points", points(interval),
                   "reproduced" if inside else "partly" if abs(interval.value) < 0.1 else "not", EIGHT)


@measures("Gradients of a randomly initialised critic")
def _() -> Finding:
    """Noise: the mean cosine with the direction that would help, over five random critics a run, does not differ from 0 by 0.1 (ours)."""
    table, _ = recorded("unlearning")
    values, drift = (by_seed(table.assign(recipe="x"), "x", name) for name in ("cosine_random", "drift.random critic"))
    interval = mean_interval(values)
    inside = max(abs(interval.low), abs(interval.high)) < 0.1
    return finding("unlearning", values, f"mean cosine with the improving direction {interval.value:+.3f}; drift after 200 updates "
                   f"{drift.mean():.3f} of the action's unit", f"cosine {interval.low:+.3f} to {interval.high:+.3f} (percentile bootstrap "
                   "over seeds, 95 %)", "reproduced" if inside and drift.min() > 0 else "partly" if abs(interval.value) < 0.1 else "not")


@measures("Warm-starting the critic makes")
def _() -> Finding:
    """Massively: the temperature more than doubles, and more than twice as much as without a warm start; |Q| likewise (notebook 07)."""
    table, _ = recorded("warm_start")
    rows = table.assign(recipe="x", task="Door")
    rises = np.log2(by_seed(rows, "x", "runs.warm.temperature") / np.maximum(1.0, by_seed(rows, "x", "runs.vanilla.temperature")))
    q = np.log2(by_seed(rows, "x", "runs.warm.q") / by_seed(rows, "x", "runs.vanilla.q"))
    first, second = mean_interval(rises), mean_interval(q)
    both = {judged(first, 1.0), judged(second, 1.0)}
    return finding("warm_start", rises, f"temperature {2 ** first.value:.2f} times, mean |Q| {2 ** second.value:.1f} times what they are "
                   "without a warm start", f"{2 ** first.low:.2f} to {2 ** first.high:.2f} and {2 ** second.low:.1f} to "
                   f"{2 ** second.high:.1f} times (percentile bootstrap over seeds, 95 %)",
                   both.pop() if len(both) == 1 else "partly")


@measures("With a warm start and a fixed entropy coefficient, the training of the critic is very unstable")
def _() -> Finding:
    """Unstable: mean |Q| leaves what rewards alone can be worth (ours; the paper shows the critic's loss)."""
    table, _ = recorded("warm_start")
    rows = table.assign(recipe="x", task="Door")
    ratio = np.log(by_seed(rows, "x", "runs.fixed.q") / by_seed(rows, "x", "rewards_alone"))
    interval = mean_interval(ratio)
    low, high = np.exp([interval.low, interval.high])
    return finding("warm_start", ratio, f"largest mean |Q| {np.exp(interval.value):.1f} times the largest worth of rewards",
                   f"{low:.1f} to {high:.1f} times (percentile bootstrap over seeds, 95 %)", judged(interval))
