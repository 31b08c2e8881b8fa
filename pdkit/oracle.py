"""What a bound allows: a demonstrator corrects the base policy as far as the bound lets it, with nothing to be learned.

    executed action   a = clip(a_base(o) + clip(a_demonstrator(o) - a_base(o), -alpha s, alpha s), -1, 1),   s the task's alpha_scale

The demonstrator is the task's scripted expert, or else the agent that made the demonstrations. Where this succeeds and the decorator does
not, the bound leaves room for better corrections; where it fails, a better correction inside the bound may still exist, since the
demonstrator does not know what the base does next. It may know more than a residual policy, though: some scripted experts remember what
they did before, and that of TurnFaucet looks into the simulation.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from .demos.experts import EXPERTS, Watching
from .errors import PdkitError
from .policies import Policy
from .profiles import online_config
from .stats import wilson
from .tasks import horizon
from .tasks.horizon import Guide, walk
from .tasks.spec import Sim, TaskSpec


class Corrected:
    """A base policy whose every action a guide corrects by at most `limit`, (act_dim,) or a number; a `Guide` itself."""

    def __init__(self, base: Policy, guide: Guide, limit: np.ndarray | float):
        self.base, self.guide, self.limit = base, guide, limit
        self.window = max(base.window, guide.window)

    def reset(self, seed: int) -> None:
        self.base.reset(seed)
        self.guide.reset(seed)

    def act(self, windows: np.ndarray) -> np.ndarray:
        action, better = (policy.act(windows[:, -policy.window:]) for policy in (self.base, self.guide))
        return action + np.clip(better - action, -self.limit, self.limit)


def demonstrator(task: str, sim: Sim) -> Guide:
    """Who shows the way on a task; `sim` is the simulation it will act in. Raises PdkitError for a task without one."""
    if task not in EXPERTS:
        return horizon.demonstrator(task)
    guide = horizon.scripted(task)
    if isinstance(guide.expert, Watching):
        guide.expert.watch(sim)
    return guide


def bound(task: str, alpha: float) -> np.ndarray | float:
    """The largest correction of each action dimension, (act_dim,) or one number for all, with the lesson's alpha_scale of the task."""
    scale = online_config(task, "lesson").decorator.alpha_scale
    return alpha * np.float32(scale) if scale else alpha


def by_bound(spec: TaskSpec, base: Policy, alphas: Sequence[float], seeds: Sequence[int],
             progress: Callable[[int, int], None] | None = None) -> pd.DataFrame:
    """Success within the episode by the bound, one row an alpha (0: the base policy alone).

    Columns: task, alpha, episodes, success with Wilson's 95 % interval (low, high). `progress` is told the episodes done and of how
    many, over all bounds. Raises PdkitError for a base policy that decides on several actions at once, of another task, and for bounds
    outside [0, 1].
    """
    if base.chunk > 1:
        raise PdkitError("An oracle corrects single actions; name a base policy that decides on one action at a time.")
    if (base.config["obs_dim"], base.config["act_dim"]) != (spec.obs_dim, spec.act_dim):
        raise PdkitError(f"This policy is for another robot or other observations than those of {spec.name}: name one of the task.")
    if not len(alphas) or any(not 0 <= alpha <= 1 for alpha in alphas):
        wrong = ", ".join(f"{alpha:g}" for alpha in alphas if not 0 <= alpha <= 1) or "nothing"
        raise PdkitError(f"A bound of the correction lies between 0 and 1; {wrong} does not.")
    rows, done, sim = [], 0, spec.make()
    try:
        guide = demonstrator(spec.name, sim)
        for alpha in alphas:
            corrected, count = Corrected(base, guide, bound(spec.name, alpha)), 0
            for seed in seeds:
                count += walk(sim, corrected, seed, spec.max_episode_steps) is not None
                done += 1
                if progress:
                    progress(done, len(alphas) * len(seeds))
            rate = wilson(count, len(seeds))
            rows.append(dict(task=spec.name, alpha=alpha, episodes=len(seeds), success=rate.value, low=rate.low, high=rate.high))
    finally:
        sim.close()
    return pd.DataFrame(rows)
