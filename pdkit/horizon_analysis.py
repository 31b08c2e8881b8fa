"""What a longer horizon makes harder: the measurements of notebook 10 (appendix F.1, F.4).

    exploration    episodes and steps until random actions meet the reward, by where episodes start (pdkit/tasks/horizon.py)
    propagation    gradient steps until a corridor is valued right from its end to its first cell
    the sweep      what fine-tuning and the decorator gain over their base policies, by where episodes start

A verdict is a function of measured numbers, so that another run may come to another one.
"""
from __future__ import annotations

import copy
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
import torch.nn.functional as F

from .claims import FLOOR, TooLittle, by_seed, difference, judged_over_tasks, matched, weakest
from .errors import PdkitError, unknown
from .evaluate import Actor
from .rl.networks import Critics
from .rl.replay import NStep, Replay
from .stats import wilson
from .tasks.horizon import horizon_spec, steps_ahead, ways_of
from .tasks.lanes import IDLE
from .tasks.spec import TaskSpec
from .tasks.stack_cube import CUBE
from .tasks.vector import VectorEnv

RECIPE = re.compile(r"(?P<method>\w+),start_fraction=(?P<fraction>[\d.]+)")  # of data/sweeps/horizon.toml


# ---- where episodes start --------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Progress:
    """A number of an observation (obs_dim,) that tells how far an episode has come, and at which the task is solved, where one is."""

    label: str  # with its unit
    of: Callable[[np.ndarray], float]
    solved: float | None = None


PROGRESS: dict[str, dict[str, Progress]] = {  # by task and column of `starts`
    "Door": {
        "reach": Progress("palm to handle (m)", lambda o: float(np.linalg.norm(o[35:38]))),
        "hinge": Progress("door hinge (rad)", lambda o: float(o[28]), 1.35),
    },
    "StackCube": {
        "reach": Progress("gripper to red cube (m)", lambda o: float(np.linalg.norm(o[46:49]))),
        "apart": Progress("red cube to its place (m)", lambda o: float(np.linalg.norm(-o[52:55] - (0, 0, CUBE)))),
    },
}


def starts(spec: TaskSpec, fraction: float, seeds: Sequence[int]) -> pd.DataFrame:
    """One row a seed: ahead and left (steps of the guide before and after the start), and the task's columns of PROGRESS.

    Raises PdkitError for a task that has none.
    """
    if spec.name not in PROGRESS:
        raise unknown("task with starts on the way", spec.name, PROGRESS)
    sim, rows = horizon_spec(spec, fraction).make(), []
    try:
        for seed in seeds:
            length = len(ways_of(spec.name).way(sim, seed)[1])
            observation, ahead = sim.reset(seed), steps_ahead(length, fraction)
            rows.append({"start_fraction": fraction, "seed": seed, "ahead": ahead, "left": length - ahead}
                        | {column: progress.of(observation) for column, progress in PROGRESS[spec.name].items()})
    finally:
        sim.close()
    return pd.DataFrame(rows)


# ---- exploration -----------------------------------------------------------------------------------------------------

def uniform_actions(act_dim: int, seed: int) -> Actor:
    """What SAC from scratch does before it learns: actions drawn uniformly, (N, window, obs_dim) -> (N, 1, act_dim)."""
    rng = np.random.default_rng([seed, 3])
    return lambda windows: rng.uniform(-1, 1, (len(windows), 1, act_dim)).astype(np.float32)


def exploration(spec: TaskSpec, actor: Actor, seeds: Sequence[int], limit: int, *, window: int = 1, lanes: int = 10) -> dict[str, Any]:
    """Episodes that end at success or after `limit` steps: episodes, solved, steps (of all of them), steps_per_reward (inf: none came)."""
    queue, steps, solved = list(seeds)[::-1], 0, 0
    with VectorEnv(spec, min(lanes, len(queue)), lambda lane: queue.pop() if queue else IDLE, window=window, terminate_on_success=True,
                   max_episode_steps=limit) as envs:
        windows, playing = envs.reset(), len(seeds)
        while playing:
            result = envs.step(actor(windows))
            windows, steps = result.windows, steps + int(result.steps.sum())
            playing, solved = playing - len(result.episodes), solved + sum(e.success_once for e in result.episodes)
    return {"episodes": len(seeds), "solved": solved, "steps": steps, "steps_per_reward": steps / solved if solved else np.inf}


# ---- propagation -----------------------------------------------------------------------------------------------------

def corridor_rows(length: int, n_step: int, gamma: float) -> list[np.ndarray]:
    """One walk along a corridor of `length` steps as replay rows: cell i is a one-hot vector, reward 1 for the last step, then it ends.

    One-hot cells are told apart wholly, so no value leaks to a neighbour by likeness: what arrives came through the target.
    """
    cells, nothing, collect = np.eye(length + 1, dtype=np.float32), np.zeros(1, np.float32), NStep(1, n_step, gamma)
    return [row for i in range(length) for row in
            collect.push(0, cells[i], nothing, nothing, float(i == length - 1), cells[i + 1], nothing, i == length - 1, i == length - 1)]


def propagation(length: int, n_step: int = 1, *, gamma: float = 0.97, tau: float = 0.01, lr: float = 1e-3, hidden: int = 64,
                batch: int = 64, seed: int = 0, most: int = 20_000) -> int | None:
    """Updates until every cell's value is within a quarter of the exact gamma^(steps to the end - 1), looked up every 5; None if `most`
    were not enough.

    The lesson's critic, target average and n-step rows on `corridor_rows`; there is only one action, so nothing else is learned. All
    cells are asked for, because a network may pass by the right value of a single one by chance.
    """
    rows = corridor_rows(length, n_step, gamma)
    replay = Replay(len(rows), length + 1, 1)
    replay.add(rows)
    torch.manual_seed(seed)
    critic = Critics(length + 1, hidden, 2, 1, True)
    target, generator = copy.deepcopy(critic).requires_grad_(False), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(critic.parameters(), lr=lr, fused=True)
    cells, exact = torch.eye(length + 1)[:length], gamma ** torch.arange(length - 1, -1, -1.0)
    for update in range(1, most + 1):
        data = replay.unpack(replay.draw(batch, generator))
        with torch.no_grad():
            y = data["reward"] + data["discount"] * target(data["next_obs"])[0]
        optimizer.zero_grad(set_to_none=True)
        F.mse_loss(critic(data["obs"])[0], y).backward()
        optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(list(target.parameters()), list(critic.parameters()), tau)
            if update % 5 == 0 and bool(((critic(cells)[0] - exact).abs() <= 0.25 * exact).all()):
                return update
    return None


# ---- the recorded sweep ----------------------------------------------------------------------------------------------

def by_fraction(table: pd.DataFrame) -> pd.DataFrame:
    """Rows of data/results/horizon.csv with method, start_fraction and gain (success of the result minus that of its base policy).

    Raises PdkitError when a recipe is not METHOD,start_fraction=NUMBER.
    """
    found = [RECIPE.fullmatch(str(recipe)) for recipe in table.recipe]
    if not all(found):
        raise PdkitError("These results are not those of data/sweeps/horizon.toml: a recipe is not called METHOD,start_fraction=NUMBER.")
    return table.assign(method=[m["method"] for m in found], start_fraction=[float(m["fraction"]) for m in found],
                        gain=table.decorated_success - table.base_success)


def end_gains(table: pd.DataFrame, method: str = "sac_finetune") -> tuple[pd.Series, pd.Series]:
    """Gains of `by_fraction` rows of one method by (task, seed), of runs that have both: on the whole task, and from the latest start.
    Raises TooLittle."""
    rows = table[table.method == method]
    ends = rows.start_fraction.min(), rows.start_fraction.max()
    if rows.empty or ends[0] == ends[1]:
        raise TooLittle(f"Fewer than two horizons of {method} are recorded.")
    whole, short = (by_seed(rows[rows.start_fraction == end].assign(recipe=method), method, "gain") for end in ends)
    return matched(whole, short)


# ---- verdicts --------------------------------------------------------------------------------------------------------

def exploration_verdict(table: pd.DataFrame) -> tuple[str, list[str]]:
    """"With a longer horizon, random exploration meets the sparse reward less often", from rows start_fraction, episodes, solved.

    reproduced: the rate at the longest horizon lies below that at the shortest, Wilson intervals apart, and no horizon between has an
    interval wholly above that of a shorter one. partly: the ends are ordered so, but their intervals overlap, or something between is not.
    not: the ends are not ordered so. untested: fewer than two horizons, or hardly any reward at any, so that no order could show.
    """
    rows = table.sort_values("start_fraction")
    rates = [wilson(int(r.solved), int(r.episodes)) for r in rows.itertuples()]
    said = [f"start at {f:g} of the way: {rate}" for f, rate in zip(rows.start_fraction, rates, strict=True)]
    if len(rates) < 2 or max(rate.value for rate in rates) < FLOOR:
        return "untested", said
    turns = any(longer.low > shorter.high for longer, shorter in zip(rates[:-1], rates[1:], strict=True))
    if rates[0].value >= rates[-1].value:
        return "not", said
    return ("reproduced" if rates[0].high < rates[-1].low and not turns else "partly"), said


def propagation_verdict(table: pd.DataFrame) -> tuple[str, list[str]]:
    """"With a longer horizon, the reward takes longer to propagate", from rows length, seed, updates (missing: never within the budget).

    reproduced: the slowest run of each length is faster than the fastest of the next. partly: only the means, or only the ends, are
    ordered so. not: not even the ends. untested: fewer than two lengths.
    """
    updates = table.assign(updates=table.updates.astype(float).fillna(np.inf)).groupby("length").updates
    least, most, mean = updates.min(), updates.max(), updates.mean()
    said = [f"{length} steps: {mean[length]:,.0f} updates ({least[length]:,.0f} to {most[length]:,.0f})" for length in mean.index]
    if len(mean) < 2:
        return "untested", said
    if all(most.iloc[i] < least.iloc[i + 1] for i in range(len(mean) - 1)):
        return "reproduced", said
    return ("partly" if most.iloc[0] < least.iloc[-1] or mean.is_monotonic_increasing else "not"), said


def failure_verdict(table: pd.DataFrame, method: str = "sac_finetune") -> tuple[str, list[str]]:
    """"A long task horizon is a key factor in the failure of fine-tuning" (F.4), from `by_fraction` rows of one method.

    By the rules of pdkit/claims.py, seed by seed: it fails where the whole interval of its gain over the base policy lies below 0.
    reproduced: it fails on the whole task, not from the latest start, and the difference of the two gains lies above 0 with its whole
    interval. partly: the mean difference lies above 0. not: it does not. untested: too few horizons or seeds. Starts in between do not
    count: how many points can be lost there depends on how good the base policy is.
    """
    said = [f"start at {f:g} of the way: base {part.base_success.mean():.0%}, gain {100 * part.gain.mean():+.0f} points ({len(part)} seeds)"
            for f, part in table[table.method == method].groupby("start_fraction")]
    try:
        whole, short = end_gains(table, method)
        interval, values = difference(short, whole)
    except TooLittle:
        return "untested", said
    said.append(f"latest start less the whole task: {100 * interval.value:+.0f} points ({100 * interval.low:+.0f} to "
                f"{100 * interval.high:+.0f})")
    fails, fails_short = (judged_over_tasks(-gains.loc[values.index]) == "reproduced" for gains in (whole, short))
    return weakest(judged_over_tasks(values), "reproduced" if fails and not fails_short else "partly"), said
