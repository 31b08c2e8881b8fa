"""Seeded evaluation: every seed runs one whole episode, one row each, so that two policies compare seed by seed."""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from .errors import PdkitError
from .seeds import own_random_numbers, reported_seeds, selection_seeds
from .smoothness import Motions
from .tasks.lanes import IDLE
from .tasks.spec import TaskSpec
from .tasks.vector import VectorEnv

Actor = Callable[..., np.ndarray]  # windows (N, window, obs_dim) -> action chunks (N, chunk, act_dim)


def timed(act: Actor) -> Actor:
    """Marks an `act` that depends on the time: it is also given the steps since each episode's start, (N,) int64."""
    act.timed = True
    return act


def ask(act: Actor, windows: np.ndarray, elapsed: np.ndarray) -> np.ndarray:
    """Action chunks (N, chunk, act_dim) for windows (N, window, obs_dim), the time told to those that depend on it."""
    return act(windows, elapsed) if getattr(act, "timed", False) else act(windows)


def evaluate(spec: TaskSpec, actor: Actor, seeds: Sequence[int], *, window: int = 1, chunk: int = 1, num_envs: int = 10,
             workers: int = 0, max_episode_steps: int | None = None, progress: Callable[[int, int], None] | None = None) -> pd.DataFrame:
    """One row a seed, in the order of `seeds`: seed, success_once, success_at_end, length, action_change, jerk (see smoothness.py).

    Episodes run to the time limit whether or not they are solved (a success can be lost again), and each of the seeds is
    counted: stopping at the first n episodes to finish would favour short, successful ones (facts.md 1.5, trap 4).
    """
    if not len(seeds):
        raise PdkitError("An evaluation needs at least one episode.")
    if len(set(seeds)) < len(seeds):
        raise PdkitError("An evaluation needs seeds that differ: each stands for one episode.")
    queue = list(seeds)[::-1]
    num_envs = min(num_envs, len(queue))
    rows: dict[int, dict] = {}
    elapsed = np.zeros(num_envs, np.int64)
    # Long enough to see every step of a chunk, for the measures of motion; the actor sees its own window of it.
    with VectorEnv(spec, num_envs, lambda lane: queue.pop() if queue else IDLE, window=max(window, chunk), chunk=chunk, workers=workers,
                   max_episode_steps=max_episode_steps) as envs:
        windows = envs.reset()
        motions = Motions(spec, windows)
        while len(rows) < len(seeds):
            actions = ask(actor, windows[:, -window:], elapsed)
            result = envs.step(actions)
            motions.add(actions, result.steps, result.final_windows)
            windows, elapsed = result.windows, np.where(result.done, 0, elapsed + result.steps)
            for e in result.episodes:
                rows[e.seed] = dict(seed=e.seed, success_once=e.success_once, success_at_end=e.success_at_end, length=e.length,
                                    **motions.end(e.lane, windows[e.lane]))
            if result.episodes and progress:
                progress(len(rows), len(seeds))
    return pd.DataFrame([rows[s] for s in seeds])


def selection_scores(spec: TaskSpec, policy: Any, episodes: int, seed: int, num_envs: int = 10) -> dict[str, float]:
    """success_once and success_at_end of a policy on the first `episodes` selection seeds; nothing without episodes.

    Random numbers that the policy draws follow from `seed`, and training goes on with its own.
    """
    if not episodes:
        return {}
    with own_random_numbers():
        policy.reset(seed)
        table = evaluate(spec, policy.act, selection_seeds(episodes), window=policy.window, chunk=policy.chunk, num_envs=num_envs)
    return {"success_once": float(table.success_once.mean()), "success_at_end": float(table.success_at_end.mean())}


def reported(policy: Any, spec: TaskSpec, episodes: int, draw: int) -> pd.DataFrame:
    """`evaluate` on the first so many test seeds. A policy that samples acts on random numbers of its own in each run (`draw`): with the
    same ones in all, a base policy's luck with them would look like what every run lost or gained."""
    policy.reset(draw)
    return evaluate(spec, policy.act, reported_seeds(episodes), window=policy.window, chunk=policy.chunk, num_envs=50)


def outcome(name: str, table: pd.DataFrame) -> dict[str, float | None]:
    """Means over the test episodes, as columns of the row."""
    means = table[["success_once", "success_at_end", "action_change", "jerk"]].mean()
    jerk = None if math.isnan(means.jerk) else round(means.jerk, 1)
    return {f"{name}_success": round(means.success_once, 4), f"{name}_success_at_end": round(means.success_at_end, 4),
            f"{name}_action_change": round(means.action_change, 4), f"{name}_jerk": jerk}
