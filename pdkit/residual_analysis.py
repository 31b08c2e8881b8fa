"""Why residual RL and FISH fail, or do not: the measurements of notebook 11 (appendix G).

    stray       distance of the hand from where the base policy alone has it, at the same step from the same seed (m)
    size ratio  mean |residual| / mean |base action| over the last quarter of a run (or another part), as executed
    lookup      success of nearest neighbours by features, k and exclusion buffer (Tables 11 to 13, whose numbers our copy lacks)
    transport   what FISH's reward gives a whole episode, and whether it tells solved episodes from failed ones

A verdict is a function of measured numbers, so that another run may come to another one.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from .decorator import DecoratorConfig, compose, gate
from .demos.format import Demos, from_episodes
from .errors import PdkitError, unknown
from .policies import Policy
from .rl.ot import OTReward
from .stats import Paired, Rate, probability_of_improvement
from .tasks.lanes import IDLE
from .tasks.spec import TaskSpec
from .tasks.vector import VectorEnv

HANDS = {"Door": slice(29, 32), "StackCube": slice(25, 28)}  # where observations have the position of palm or gripper, in m
FEATURES = ("raw", "GPT", "FiLM")  # what VINN looks up by here; pictures (Table 13) are lesson 15's


# ---- the first episodes ----------------------------------------------------------------------------------------------

class Disturbed:
    """A base policy with the residuals of a loop that has learned nothing: uniform in [-1, 1], bounded and gated as at environment
    step `step`. With alpha 1 and H 0 these are residual RL's first episodes. Raises PdkitError for a base policy that acts in chunks."""

    def __init__(self, base: Policy, config: DecoratorConfig, step: int, seed: int = 0):
        if base.chunk != 1:
            raise PdkitError(f"Random residuals are added to one action at a time, and this {base.kind} policy decides on {base.chunk} at "
                             "once: take one with chunk=1.")
        self.base, self.config, self.step, self.window, self.chunk = base, config, step, base.window, 1
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Restart the draws of residuals and gate, and the base policy's own."""
        self.rng = np.random.default_rng([seed, 4])
        self.base.reset(seed)

    def act(self, windows: np.ndarray) -> np.ndarray:
        """Action chunks (N, 1, act_dim) for windows (N, window, obs_dim); the environment clips them."""
        base = self.base.act(windows)[:, 0]
        residual = self.rng.uniform(-1, 1, base.shape).astype(np.float32)
        return compose(self.config, base, gate(self.config, residual, self.step, self.rng))[:, None]


@dataclass(frozen=True)
class Trace:
    """One whole episode, without pictures."""

    seed: int
    observations: np.ndarray  # (T + 1, obs_dim), the first one included
    success: np.ndarray  # (T,) bool, judged after each step

    @property
    def solved(self) -> bool:
        return bool(self.success.any())


def traces(spec: TaskSpec, policy: Any, seeds: Sequence[int], *, limit: int | None = None, success_tail: int = 0,
           lanes: int = 25) -> list[Trace]:
    """An episode of `policy` (with act and window) from each seed, in their order, of at most `limit` steps; it ends `success_tail` steps
    after its first success (0: it does not). What the policy draws goes on from where its `reset` left it."""
    queue, found = [*seeds][::-1], {}
    with VectorEnv(spec, min(lanes, len(queue)), lambda lane: queue.pop() if queue else IDLE, window=policy.window,
                   max_episode_steps=limit, success_tail=success_tail) as envs:
        windows = envs.reset()
        seen, solved = [[w[-1]] for w in windows], [[] for _ in windows]
        while len(found) < len(seeds):
            result = envs.step(policy.act(windows))
            windows = result.windows
            for lane in np.flatnonzero(result.steps):
                seen[lane].append(result.final_windows[lane, -1])
                solved[lane].append(bool(result.reward[lane]))
            for e in result.episodes:
                found[e.seed] = Trace(e.seed, np.stack(seen[e.lane]), np.array(solved[e.lane], bool))
                seen[e.lane], solved[e.lane] = [windows[e.lane, -1]], []
    return [found[seed] for seed in seeds]


def outcomes(episodes: Sequence[Trace]) -> pd.DataFrame:
    """One row a seed, as `evaluate` gives it: seed, success_once, length."""
    return pd.DataFrame([{"seed": t.seed, "success_once": t.solved, "length": len(t.success)} for t in episodes])


def stray(reference: Sequence[Trace], others: Sequence[Trace], task: str) -> np.ndarray:
    """Distance in m between the hands of two policies, (episodes, steps + 1), cut at the shortest episode.

    Raises PdkitError when they are not episodes from the same seeds, and for a task that HANDS does not know.
    """
    if task not in HANDS:
        raise unknown("task with a hand to follow", task, HANDS)
    if [t.seed for t in reference] != [t.seed for t in others]:
        raise PdkitError("Two policies stray from each other only in episodes from the same seeds, in the same order.")
    length = min(len(t.observations) for t in (*reference, *others))
    apart = [(a.observations[:length] - b.observations[:length])[:, HANDS[task]] for a, b in zip(reference, others, strict=True)]
    return np.linalg.norm(np.stack(apart), axis=-1)


def early_verdict(plain: Paired, guarded: Paired) -> tuple[str, list[str]]:
    """"Random residual actions take the agent so far from the base policy that it meets no success" (G.1), from two comparisons with the
    base policy alone on the same episodes: residual RL's first episodes, and the decorator's.

    reproduced: the interval of the paired difference lies below 0 and no episode is solved. partly: it lies below 0, but some are solved.
    not: it reaches 0. untested: the base policy itself solves nothing. What the decorator does is told beside it and decides nothing.
    """
    falls = plain.high < 0
    verdict = "untested" if not plain.base.successes else "not" if not falls else "partly" if plain.other.successes else "reproduced"
    return verdict, [f"{name}: {pair.other}; against the base policy alone {100 * pair.difference:+.0f} points ({100 * pair.low:+.0f} to "
                     f"{100 * pair.high:+.0f})" for name, pair in (("residual RL", plain), ("decorator", guarded))]


# ---- over training ---------------------------------------------------------------------------------------------------

def size_ratio(curves: pd.DataFrame, after: float = 0.75) -> pd.DataFrame:
    """mean |residual| / mean |base action| of each run behind this share of its steps, by default in the last quarter: task, recipe, seed,
    ratio."""
    if "residual_size" not in curves:  # nothing is recorded, or by a loop that did not log it
        return pd.DataFrame(columns=["task", "recipe", "seed", "ratio"]).astype({"ratio": float})
    rows = curves[curves.residual_size.notna()]
    by = rows.groupby(["task", "recipe", "seed"])
    late = rows[rows.step > after * by.step.transform("max")].groupby(["task", "recipe", "seed"])[["residual_size", "base_size"]].mean()
    return (late.residual_size / late.base_size).rename("ratio").reset_index()


# ---- nearest neighbours ----------------------------------------------------------------------------------------------

def part_of(demos: Demos, num: int, seed: int) -> Demos:
    """`num` demonstrations, others for each seed until they come round: seed s begins with number s * num. Raises PdkitError."""
    if not 1 <= num <= demos.num:
        raise PdkitError(f"These {demos.task} demonstrations hold {demos.num} episodes, so num_demos must be 1 to {demos.num}, not {num}.")
    chosen = [(seed * num + i) % demos.num for i in range(num)]
    episodes = [demos.episode(i) | {"seed": int(demos.seeds[i])} for i in chosen]
    return from_episodes(demos.task, episodes, label=demos.label, how=demos.how, command=demos.command, **demos.extra)


def lookups(ks: Sequence[int], exclusion: int) -> dict[str, dict[str, Any]]:
    """The rows of the VINN table, by name: features with each k, and with k 1 and the exclusion buffer (0: without that row).

    Raises PdkitError for a k below 1 or a repeated one.
    """
    if not ks or min(ks) < 1 or len(set(ks)) < len(ks) or exclusion < 0:
        raise PdkitError(f"ks must be different numbers of neighbours (1 or more) and exclusion 0 or more, not {list(ks)} and {exclusion}.")
    settings = {f"k={k}": dict(k=k) for k in ks} | ({f"k=1,exclusion={exclusion}": dict(k=1, exclusion=exclusion)} if exclusion else {})
    return {f"{features},{name}": {"features": features} | values for features in FEATURES for name, values in settings.items()}


def poor_verdict(rates: dict[str, Rate], bet: Rate, features: str = "GPT", whose: str = "BeT") -> tuple[str, list[str]]:
    """"VINN on these features performs extremely poorly" (G.2.1), from success rates by the names of `lookups` and the BeT's (on pictures
    another policy's, called `whose`).

    Extremely poor means below half of the BeT's success on the same episodes (ours); the *best* k and buffer of the features
    counts, so that no bad choice of ours makes the claim true. reproduced: its Wilson interval lies below that half; partly: only its
    value does; not: it does not. untested: the BeT itself solves nothing.
    """
    best, rate = max(((name, r) for name, r in rates.items() if name.startswith(features + ",")), key=lambda item: item[1].value)
    half = bet.value / 2
    verdict = "untested" if not bet.successes else "reproduced" if rate.high < half else "partly" if rate.value < half else "not"
    return verdict, [f"best of these features, {best}: {rate}; half of the {whose}'s {100 * bet.value:.0f} % is {100 * half:.0f} %"]


# ---- the reward of FISH ----------------------------------------------------------------------------------------------

def transport(reward: OTReward, groups: dict[str, Sequence[Trace]]) -> tuple[pd.DataFrame, list[np.ndarray]]:
    """Reward of whole episodes by optimal transport, unscaled: a row an episode (who, seed, solved, steps, total, error), and its rewards
    (T,). `total` is minus the mean cost of a step, `error` the largest relative one of a demonstrated observation's mass."""
    rows, rewards = [], []
    reward.scale = 1.0  # the loop's factor is set by its first episode and would make these numbers depend on it
    for who, episodes in groups.items():
        for t in episodes:
            rewards.append(reward(t.observations))
            rows.append({"who": who, "seed": t.seed, "solved": t.solved, "steps": len(t.success), "total": float(rewards[-1].sum()),
                         "error": reward.error})
    return pd.DataFrame(rows), rewards


def telling(table: pd.DataFrame) -> float:
    """Probability that a solved episode gets a larger total than a failed one (ties: half); NaN without one of both kinds."""
    solved, failed = (table.total[table.solved == kind].to_numpy()[:, None] for kind in (True, False))
    return probability_of_improvement(solved, failed) if len(solved) and len(failed) else float("nan")


def one_of_each(table: pd.DataFrame) -> dict[str, int]:
    """Rows of the first solved and the first failed episode, "solved" and "failed", as far as there are any."""
    kinds = {"solved": table.solved.to_numpy(bool), "failed": ~table.solved.to_numpy(bool)}
    return {name: int(np.argmax(rows)) for name, rows in kinds.items() if rows.any()}
