"""What lesson 04 looks at: families of base policies under one protocol, whether demonstrations leave a choice, and how far the best of
several evaluations flatters.

    doubt       variance of the actions that were demonstrated near an observation, as a share of that of all actions: 0, the observation
                decides; 1, it tells nothing
    split       how much of a variance is explained by two groups: 1, two ways and nothing between; 0.64 for a normal distribution
    best_of     the success that the best of several evaluations of equally good checkpoints shows on average
"""
from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy import stats as scipy_stats

from .demos.format import Demos
from .errors import PdkitError
from .evaluate import evaluate
from .gradient_steps import gradient_step, make_optimizer
from .imitate import ImitateConfig, Windows, imitate, untrained
from .policies import POLICIES, Policy
from .tasks.spec import TaskSpec


@dataclass(frozen=True)
class Family:
    """A kind of policy as the lesson trains it."""

    kind: str  # one of POLICIES
    steps: int  # gradient steps
    config: dict[str, Any] = field(default_factory=dict)  # where it differs from the kind's defaults
    training: dict[str, Any] = field(default_factory=dict)  # where its training differs from the others'

    def settings(self, checkpoints: int, episodes: int, steps: int = 0, seed: int = 0) -> ImitateConfig:
        """Its training with so many checkpoints, each tested on `episodes` selection episodes; `steps` 0: its own number."""
        steps = steps or self.steps
        own = POLICIES[self.kind].recipe | self.training
        return replace(ImitateConfig(**own), iterations=steps, eval_every=max(1, steps // checkpoints), eval_episodes=episodes, seed=seed)


# Small enough for minutes. A Diffusion Policy learns with its own rates, averaged weights and batch; all else is the same for all.
FAMILIES = {
    "MLP": Family("mlp", 300),
    "BC-RNN": Family("rnn", 400, dict(hidden=96)),
    "CNN": Family("cnn", 200),
    "BeT": Family("bet", 300, dict(embed=48, features=64)),
    "Diffusion Policy": Family("diffusion", 400, dict(dims=[32, 64], horizon=8, prediction="v_prediction"),
                               dict(lr=1e-3, lr_warmup=100, batch=128)),
}


def fresh(family: Family, demos: Demos, spec: TaskSpec, seed: int = 0) -> Policy:
    """An untrained policy of a family with the demonstrations' statistics."""
    torch.manual_seed(seed)
    policy = untrained(family.kind, spec, family.config)
    policy.fit_statistics(demos.observations, demos.actions, seed)
    return policy


def costs(families: Mapping[str, Family], demos: Demos, spec: TaskSpec, *, lanes: int = 25, repeats: int = 5) -> pd.DataFrame:
    """A row a family: parameters, window, chunk, ms_gradient_step (its own batch) and ms_step, what a primitive step of one environment
    costs when `lanes` act together. Medians of `repeats` after a first go."""
    rows = []
    for name, family in families.items():
        policy, config = fresh(family, demos, spec), family.settings(1, 0)
        batch = Windows(demos, policy.window, True, policy.horizon, spec.resting).sample(config.batch, torch.Generator().manual_seed(0))
        optimizer = make_optimizer(policy.train(), config)
        learning = _milliseconds(partial(gradient_step, policy.loss, optimizer, "cpu", config.bf16, *batch), repeats)
        acting = _milliseconds(partial(policy.eval().act, np.zeros((lanes, policy.window, spec.obs_dim), np.float32)), repeats)
        rows.append({"family": name, "parameters": sum(p.numel() for p in policy.parameters()), "window": policy.window,
                     "chunk": policy.chunk, "batch": config.batch, "ms_gradient_step": learning,
                     "ms_step": acting / lanes / policy.chunk})
    return pd.DataFrame(rows)


def _milliseconds(run: Callable[[], object], repeats: int) -> float:
    run()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - started)
    return 1e3 * float(np.median(seconds))


# ---- do demonstrations leave a choice? -------------------------------------------------------------------------------

def neighbours(demos: Demos, num: int, queries: int = 400, seed: int = 0) -> np.ndarray:
    """Actions (queries, num, act_dim) demonstrated where other episodes come closest to a demonstrated observation, by observations in
    standard units: at most one of each other episode, the nearest episodes first. The queries are drawn at random, each step at most once.

    Raises PdkitError when there are too few episodes.
    """
    if demos.num <= num:
        raise PdkitError(f"{num} neighbours, one an episode, need more than {num} demonstrations, not {demos.num}.")
    observations = np.concatenate([e["observations"][:-1] for e in demos.episodes()])
    std = observations.std(axis=0)
    points = torch.from_numpy((observations - observations.mean(axis=0)) / np.where(std < 1e-4, 1.0, std))
    episode = np.repeat(np.arange(demos.num), demos.lengths)
    chosen = np.random.default_rng(seed).permutation(len(points))[:queries]
    distances, starts = torch.cdist(points[chosen], points).numpy(), np.cumsum(demos.lengths) - demos.lengths
    closest = np.minimum.reduceat(distances, starts, axis=1)  # (queries, episodes)
    closest[np.arange(len(chosen)), episode[chosen]] = np.inf
    found = np.empty((len(chosen), num), np.int64)
    for row, others in enumerate(np.argsort(closest, axis=1)[:, :num]):
        found[row] = [starts[e] + distances[row, starts[e]: starts[e] + demos.lengths[e]].argmin() for e in others]
    return demos.actions[found]


def doubt(actions: np.ndarray, everything: np.ndarray) -> np.ndarray:
    """Variance (summed over dimensions) among the neighbours' actions (queries, num, act_dim), as a share of that of all (N, act_dim)."""
    return actions.var(axis=1).sum(axis=-1) / everything.var(axis=0).sum()


def along_first(actions: np.ndarray) -> np.ndarray:
    """Neighbours' actions (queries, num, act_dim) along the direction in which they differ most, in standard units: (queries, num)."""
    centred = actions - actions.mean(axis=1, keepdims=True)
    direction = np.linalg.svd(centred, full_matrices=False)[2][:, 0]
    along = np.einsum("qnd,qd->qn", centred, direction)
    return along / np.maximum(along.std(axis=1, keepdims=True), 1e-9)


def split(values: np.ndarray) -> float:
    """Share of the variance of numbers (N,) that the best division into two groups explains; 0 where all are the same."""
    ordered = np.sort(np.asarray(values, float))
    total = ordered.var()
    if total == 0:
        return 0.0
    n, counts, sums = len(ordered), np.arange(1, len(ordered)), np.cumsum(ordered - ordered.mean())[:-1]
    return float((sums**2 / counts / (n - counts)).max() / total)


# ---- checkpoints and their selection ---------------------------------------------------------------------------------

def best_of(success: float, episodes: int, checkpoints: int) -> float:
    """What the best of `checkpoints` evaluations shows on average, when each policy truly solves a share `success` and has `episodes`
    episodes of its own: E max = sum over k of k / n * (F(k)^m - F(k - 1)^m), F being the binomial distribution's.

    Raises PdkitError unless 0 <= success <= 1 and both numbers are at least 1.
    """
    if not 0 <= success <= 1 or episodes < 1 or checkpoints < 1:
        raise PdkitError(f"best_of needs a success from 0 to 1 and at least one episode and checkpoint, not {success}, {episodes} and "
                         f"{checkpoints}.")
    at_most = scipy_stats.binom.cdf(np.arange(-1, episodes + 1), episodes, success) ** checkpoints
    return float(np.diff(at_most) @ np.arange(episodes + 1) / episodes)


def learned(family: Family, demos: Demos, spec: TaskSpec, config: ImitateConfig,
            test: Sequence[int]) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Train a policy of a family as `config` says.

    Returns its curve (step, seconds, success on the selection episodes), and the checkpoint that was selected: step, selected (its
    success on the selection episodes), test (on the seeds `test`), test_at_end, episodes (of the test).
    """
    policy, history = imitate(family.kind, demos, config, family.config, spec=spec)
    curve = pd.DataFrame({"step": row["iteration"], "seconds": row["seconds"], "success": row["success_once"]} for row in history)
    policy.reset(config.seed)
    table = evaluate(spec, policy.act, test, window=policy.window, chunk=policy.chunk, num_envs=25)
    best = curve.loc[curve.success.idxmax()]  # the first of equals, as `imitate` keeps it
    return curve, {"step": int(best.step), "selected": float(best.success), "test": float(table.success_once.mean()),
                   "test_at_end": float(table.success_at_end.mean()), "episodes": len(table)}


def recorded_curves(table: pd.DataFrame) -> pd.DataFrame:
    """The curves in recorded rows of notebook 04, whose columns are called curves.FAMILY.STEP: family, seed, step, success."""
    columns = [name for name in table if name.startswith("curves.")]
    rows = [{"family": name.split(".")[1], "seed": row["seed"], "step": int(name.split(".")[2]), "success": row[name]}
            for _, row in table.iterrows() for name in columns]
    return pd.DataFrame(rows, columns=["family", "seed", "step", "success"]).dropna(ignore_index=True).sort_values(
        ["family", "seed", "step"], ignore_index=True)


def optimism(table: pd.DataFrame) -> pd.DataFrame:
    """Of recorded rows of notebook 04 (columns chosen.FAMILY.selected and .test): family, seed, selected, test."""
    names = [name.split(".")[1] for name in table if name.startswith("chosen.") and name.endswith(".selected")]
    rows = [{"family": name, "seed": row["seed"], "selected": row[f"chosen.{name}.selected"], "test": row[f"chosen.{name}.test"]}
            for _, row in table.iterrows() for name in names]
    return pd.DataFrame(rows, columns=["family", "seed", "selected", "test"]).dropna(ignore_index=True)
