"""Which recorded comparison speaks to which claim of the paper: `pdkit report --update` writes the verdicts into claims.csv.

A rule here is chosen before its data are seen wherever the paper says enough to choose one; numbers in a rule that are ours are named.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from .ablations import GRID, VERDICTS, action_scales, alpha_works
from .claims import (
    DECORATOR,
    FINE_TUNING,
    LEAST_SEEDS,
    OTHERS,
    TASKS,
    Finding,
    TooLittle,
    best,
    by_seed,
    compared,
    difference,
    efficiency,
    finding,
    first_evaluation,
    judged,
    mean_interval,
    percent,
    points,
    recorded,
    turned,
)
from .demos import sources
from .residual_analysis import late_ratio
from .stats import Interval, wilson

Measure = Callable[[], Finding]
MEASURES: dict[str, Measure] = {}  # first words of a claim -> how it is judged
EIGHT = TASKS["maniskill"] + TASKS["adroit"]


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

def _on_bet(kind: str = "") -> pd.DataFrame:
    """The leaderboard on those tasks (of one kind: adroit, maniskill) where the decorator's own base policy is a BeT."""
    table, _ = recorded("leaderboard")
    bets = set(table.task[(table.recipe == DECORATOR) & (table.policy == "bet")])
    return table[table.task.isin(bets & set(TASKS[kind] if kind else EIGHT))]


@measures("With BeT bases, Policy Decorator")
def _() -> Finding:
    """Ahead of the best of both kinds; the interval is that of the smaller lead."""
    table = _on_bet()
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
    """Against the policy that it starts from."""
    table = _on_bet("adroit")
    rival = best(table, FINE_TUNING)
    end, start = (by_seed(table, rival, column) for column in ("decorated_success", "base_success"))
    interval, values = difference(end, start)
    return finding("leaderboard", values, f"{rival} {percent(end.mean())}, its start {percent(start.mean())}: "
                   f"{100 * interval.value:+.1f} points", points(interval), judged(turned(interval)), TASKS["adroit"])


@measures("The best baseline that fine-tunes BeT reaches 0 %")
def _() -> Finding:
    """The best of those recorded there: none of its seeds solves a test episode."""
    table, _ = recorded("leaderboard")
    table = table[table.task.isin(TASKS["maniskill"])]
    rival = best(table, FINE_TUNING)
    values = by_seed(table, rival, "decorated_success")
    return finding("leaderboard", values, f"{rival} {percent(values.mean())}; largest of its seeds {percent(values.max())}",
                   points(mean_interval(values)), "reproduced" if values.max() == 0 else "not", TASKS["maniskill"])


@measures("The best baseline that does not fine-tune (42.9 %)")
def _() -> Finding:
    """Each method against the policy that it starts from; one from scratch starts from none, so it is measured against the decorator's."""
    table = _on_bet("adroit")
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
    """Considerably: by more than 20 points (ours)."""
    return compared("leaderboard", "ppo_decorator", "ppo_finetune", enough=0.2, paper=("Pen",))


@measures("Policy Decorator with PPO considerably outperforms residual RL")
def _() -> Finding:
    """Considerably: by more than 20 points (ours)."""
    return compared("leaderboard", "ppo_decorator", "ppo_residual_rl", enough=0.2, paper=("Pen",))


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
    """Training success of the first 5,000 steps (ours; before any update), against the base policy's success on test episodes, which are
    longer than training ones: more than 20 points below (ours) counts, so that a base policy that is merely slow does not."""
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
    """Mean |residual| against mean |base action| over the last quarter of each run; and whether success ends below the base policy's."""
    table, curves = recorded("leaderboard")
    ratio = np.log(late_ratio(curves[curves.recipe == "residual_rl"]).set_index(["task", "seed"]).ratio)
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
    """VINN below half of its BeT's success, and FISH below the BeT: both would have to hold.

    On the tasks that FISH is recorded on. Its VINN (and the BeT) are the same policy on the same test episodes in every seed, so the
    interval tells nothing of other demonstrations: that is what the claim of Table 11 is judged by.
    """
    table, _ = recorded("leaderboard")
    vinn, end = by_seed(table, "fish", "base_success"), by_seed(table, "fish", "decorated_success")
    bet = by_seed(table[table.task.isin(set(vinn.index.get_level_values("task")))], DECORATOR, "base_success")
    interval, values = difference(vinn, bet / 2)
    return finding("leaderboard", values, f"VINN {percent(vinn.mean())}, BeT {percent(bet.mean())}, FISH on VINN {percent(end.mean())}",
                   f"VINN less half of BeT: {points(interval)}", "not" if end.mean() >= bet.mean() else judged(turned(interval)),
                   EIGHT)


@measures("VINN on features of the BeT's GPT")
def _() -> Finding:
    """Extremely poorly: below half of the BeT's success on the same demonstrations and episodes (ours). The k and buffer with the largest
    mean count, so that no bad choice of ours makes the claim true."""
    table, _ = recorded("vinn")
    rows = table.assign(recipe="x", task="Door")
    tried = {name: rows[name].mean() for name in rows if name.startswith("vinn.GPT,") and name.endswith(".value")}
    if not tried:
        raise TooLittle("No lookup by the GPT's features is recorded.")
    best_one = max(tried, key=lambda column: tried[column])
    vinn, bet = by_seed(rows, "x", best_one), by_seed(rows, "x", "bet.value")
    interval, values = difference(vinn, bet / 2)
    name = best_one.removeprefix("vinn.").removesuffix(".value")
    return finding("vinn", values, f"{name}, the best of {len(tried)}, {percent(vinn.mean())}; BeT {percent(bet.mean())}",
                   f"VINN less half of BeT: {points(interval)}", judged(turned(interval)), EIGHT)


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
    """A gate that opens over all of the training is less than 10 points (ours) behind one that opens over half of it, and above the base
    policy. The grid's H differ by a factor of two only, which is no wide range: partly at most. H=0 is another claim's (G.1)."""
    table, _ = recorded("ablations")
    wide = "alpha=0.1,H=40000"
    own, ends = by_seed(table, GRID, "decorated_success"), by_seed(table, wide, "decorated_success")
    interval, values = difference(ends, own)
    gain, _ = difference(ends, by_seed(table, wide, "base_success"))
    verdict = min(judged(interval, -0.1), judged(gain), "partly", key=VERDICTS.index)
    return finding("ablations", values, f"H=40000 (all of the training) {percent(ends.mean())}, H=20000 {percent(own.mean())}: "
                   f"{100 * interval.value:+.1f} points; {100 * gain.value:+.1f} over the base policy", points(interval), verdict)


@measures("alpha close to the scale of the demonstrated actions")
def _() -> Finding:
    """The bound of the grid that is closest to the scale works (compare: pdkit/ablations.py). The paper does not say which scale: by the
    size of an action and by that of a step, both must hold; one alone is partly."""
    table, _ = recorded("ablations")
    found = {name: (scale, *alpha_works(table, scale)) for name, scale in action_scales(sources.bundled("Door")).items()}
    known = {verdict for _, verdict, _, _ in found.values()}
    interval = min((behind for _, _, behind, _ in found.values()), key=lambda behind: behind.value)
    told = "; ".join(f"{name} {scale:.2f}: {near.split(',')[0]} {100 * behind.value:+.1f} points against the best bound ({verdict})"
                     for name, (scale, verdict, behind, near) in found.items())
    values = by_seed(table, next(near for *_, near in found.values()), "decorated_success")
    return finding("ablations", values, told, f"the lower one: {points(interval)}", known.pop() if len(known) == 1 else "partly")


@measures("Policy Decorator substantially improves a low-performing BeT")
def _() -> Finding:
    """Substantially: by more than 20 points (ours)."""
    return compared("low_checkpoint", "low", second_column="base_success", enough=0.2)


# ---- Cal-QL, setups A to E (appendix F.3); E is the comparison's cell ---------------------------------------------------

BOTH = "pdkit sweep data/sweeps/calql.toml; pdkit sweep data/sweeps/leaderboard.toml"  # setups A to D, and E


@measures("A critic pre-trained by Cal-QL on demonstrations alone")
def _() -> Finding:
    """Limited: setup E ends less than 10 points (ours) above fine-tuning by SAC with critics from scratch."""
    table, _ = recorded("leaderboard")
    with_it, without = (by_seed(table, recipe, "decorated_success") for recipe in ("calql", "sac_finetune"))
    interval, values = difference(with_it, without)
    return finding("leaderboard", values, f"Cal-QL {percent(with_it.mean())}, SAC fine-tuning {percent(without.mean())}: "
                   f"{100 * interval.value:+.1f} points", points(interval), judged(turned(interval), -0.1))


def _efficiency(first: str, second: str) -> tuple[Interval, pd.Series, str]:
    """Difference of the mean success over all evaluations of the online stage; and in words."""
    _, curves = recorded("calql")
    one, two = efficiency(curves, first), efficiency(curves, second)
    interval, values = difference(one, two)
    return interval, values, f"mean success over the online evaluations {percent(one.mean())} and {percent(two.mean())}"


@measures("Cal-QL needs negative trajectories")
def _() -> Finding:
    """A lot: A is ahead of B by more than 10 points (ours) of the mean success over the evaluations of the online stage."""
    interval, values, told = _efficiency("calql_a", "calql_b")
    return finding("calql", values, f"A and B: {told}", points(interval), judged(interval, 0.1))


@measures("SAC in place of Cal-QL online costs slightly in sample efficiency")
def _() -> Finding:
    """Slightly: less than 10 points (ours) of the mean success over the online evaluations; and C's last policies exceed 90 %."""
    interval, values, told = _efficiency("calql_b", "calql_c")
    ends = by_seed(recorded("calql")[0], "calql_c", "decorated_success")
    high = mean_interval(ends)
    both = {judged(turned(interval), -0.1), judged(high, 0.9)}
    return finding("calql", values, f"B and C: {told}; C ends at {percent(ends.mean())}",
                   f"cost {points(interval)}; C {percent(high.low)} to {percent(high.high)}", both.pop() if len(both) == 1 else "partly")


@measures("SAC in place of Cal-QL online saves significant wall-clock time")
def _() -> Finding:
    """Significant: B's training takes more than 1.25 times as long as C's (ours), the offline stage that both share included."""
    table, _ = recorded("calql")
    ratios = np.log(by_seed(table, "calql_b", "train_minutes") / by_seed(table, "calql_c", "train_minutes")).dropna()
    if ratios.index.get_level_values("seed").nunique() < LEAST_SEEDS:
        raise TooLittle("Fewer than three seeds are recorded on both sides.")
    interval = mean_interval(ratios)
    value, low, high = np.exp([interval.value, interval.low, interval.high])
    return finding("calql", ratios, f"training with Cal-QL online (B) takes {value:.2f} times as long as with SAC (C)",
                   f"{low:.2f} to {high:.2f} times (percentile bootstrap over seeds, 95 %)", judged(interval, float(np.log(1.25))))


@measures("A large GPT actor does worse than a small MLP actor")
def _() -> Finding:
    return compared("calql", "calql_d", "calql_c", sign=-1, names=("GPT (D)", "MLP (C)"))


@measures("A pre-trained BeT actor outperforms a randomly initialised GPT actor")
def _() -> Finding:
    """E and D come from two sweeps with the same budget, seeds and test episodes."""
    bet = by_seed(recorded("leaderboard")[0], "calql", "decorated_success")
    gpt = by_seed(recorded("calql")[0], "calql_d", "decorated_success")
    interval, values = difference(bet, gpt)
    found = finding("calql", values, f"BeT (E) {percent(bet.mean())}, GPT (D) {percent(gpt.mean())}: {100 * interval.value:+.1f} points",
                    points(interval), judged(interval))
    return replace(found, command=BOTH)


# ---- the architecture of the critic (appendix F.5.1) -------------------------------------------------------------------

def _gain(recipe: str) -> tuple[Interval, pd.Series]:
    """What runs of this architecture gain over the policy that they started from."""
    table, _ = recorded("q_architectures")
    return difference(by_seed(table, recipe, "decorated_success"), by_seed(table, recipe, "base_success"))


def _largest_gain(method: str, kinds: Sequence[str]) -> tuple[Interval, pd.Series, str]:
    """That of the architecture with the largest mean; and all of them in words."""
    found = {kind: _gain(f"{method},critic_backbone={kind}") for kind in kinds}
    told = ", ".join(f"{kind} {100 * interval.value:+.1f}" for kind, (interval, _) in found.items())
    interval, values = max(found.values(), key=lambda gain: gain[0].value)
    return interval, values, f"points gained over the base policy: {told}"


@measures("SAC fine-tuning with an MLP critic slightly improves")
def _() -> Finding:
    """Slightly: above 0; a mean gain of more than 20 points (ours) is more than the claim says, and counts as partly."""
    interval, values, told = _largest_gain("sac_finetune", ["mlp"])
    verdict = judged(interval)
    return finding("q_architectures", values, told, points(interval),
                   "partly" if verdict == "reproduced" and interval.value > 0.2 else verdict)


@measures("SAC fine-tuning with a critic on the shared or a separate GPT backbone")
def _() -> Finding:
    """No improvement: even the larger of the two gains stays below 5 points (ours)."""
    interval, values, told = _largest_gain("sac_finetune", ["shared", "separate"])
    return finding("q_architectures", values, told, f"the larger one: {points(interval)}", judged(turned(interval), -0.05))


@measures("PPO fine-tuning performs poorly with all three")
def _() -> Finding:
    """Poorly: even the best of the three ends below the base policy."""
    interval, values, told = _largest_gain("ppo_finetune", ["mlp", "shared", "separate"])
    return finding("q_architectures", values, told, f"the best one: {points(interval)}", judged(turned(interval)))


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
