"""What a bound allows: a demonstrator corrects the base policy as far as the bound lets it, with nothing to be learned.

    executed action   a = a_base(o) + clip(a_demonstrator(o) - a_base(o), -alpha s, alpha s),   s the task's alpha_scale

The demonstrator is the task's scripted expert, or else the agent that made the demonstrations. Where this succeeds and the decorator does
not, the bound is not what holds it back; where it fails, a better correction inside the bound may still exist, since the
demonstrator does not know what the base does next.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from .decorated import load_decorated
from .demos.experts import EXPERTS, Watching
from .errors import PdkitError
from .files import DATA
from .policies import Policy
from .profiles import online_config
from .seeds import own_random_numbers
from .stats import wilson
from .tasks.horizon import Guide, Scripted
from .tasks.spec import Sim, TaskSpec


def demonstrator(task: str, sim: Sim) -> Guide:
    """Who shows the way on a task; `sim` is the simulation it will act in. Raises PdkitError for a task without one."""
    if task in EXPERTS:
        expert = EXPERTS[task]()
        if isinstance(expert, Watching):
            expert.watch(sim)
        return Scripted(expert)
    return load_decorated(DATA / "checkpoints" / task / "demonstrator")


def bound(task: str, alpha: float) -> np.ndarray | float:
    """The largest correction of each action dimension, (act_dim,) or one number for all, with the lesson's alpha_scale of the task."""
    scale = online_config(task, "lesson").decorator.alpha_scale
    return alpha * np.float32(scale) if scale else alpha


def solved(sim: Sim, base: Policy, guide: Guide, limit: np.ndarray | float, seed: int, steps: int) -> bool:
    """Whether the corrected base policy solves the episode of `seed` within `steps`."""
    base.reset(seed)
    guide.reset(seed)
    windows = np.repeat(sim.reset(seed)[None], max(base.window, guide.window), axis=0)
    for _ in range(steps):
        action, better = (policy.act(windows[None, -policy.window:])[0, 0] for policy in (base, guide))
        observation, success = sim.step(np.clip(action + np.clip(better - action, -limit, limit), -1, 1).astype(np.float32))
        if success:
            return True
        windows = np.concatenate([windows[1:], observation[None]])
    return False


def by_bound(spec: TaskSpec, base: Policy, alphas: Sequence[float], seeds: Sequence[int],
             progress: Callable[[float, int], None] | None = None) -> pd.DataFrame:
    """Success within the episode by the bound, one row an alpha (0: the base policy alone).

    Columns: task, alpha, episodes, success with Wilson's 95 % interval (low, high). `progress` is told the bound and the episodes done.
    Raises PdkitError for a base policy that decides on several actions at once, of another task, and for bounds outside [0, 1].
    """
    if base.chunk > 1:
        raise PdkitError("An oracle corrects single actions; name a base policy that decides on one action at a time.")
    if (base.config["obs_dim"], base.config["act_dim"]) != (spec.obs_dim, spec.act_dim):
        raise PdkitError(f"This policy is for another robot or other observations than those of {spec.name}: name one of the task.")
    if not len(alphas) or any(not 0 <= alpha <= 1 for alpha in alphas):
        wrong = ", ".join(f"{alpha:g}" for alpha in alphas if not 0 <= alpha <= 1) or "nothing"
        raise PdkitError(f"A bound of the correction lies between 0 and 1; {wrong} does not.")
    rows, sim = [], spec.make()
    try:
        guide = demonstrator(spec.name, sim)
        for alpha in alphas:
            count = 0
            for done, seed in enumerate(seeds, 1):
                with own_random_numbers():
                    count += solved(sim, base, guide, bound(spec.name, alpha), seed, spec.max_episode_steps)
                if progress:
                    progress(alpha, done)
            rate = wilson(count, len(seeds))
            rows.append(dict(task=spec.name, alpha=alpha, episodes=len(seeds), success=rate.value, low=rate.low, high=rate.high))
    finally:
        sim.close()
    return pd.DataFrame(rows)
