"""What lesson 03 looks at: a fork where averaging fails, actions on their way to noise and back, one network sampled in several ways."""
from __future__ import annotations

import time

import numpy as np
import pandas as pd
import torch

from .demos import Demos
from .evaluate import evaluate
from .policies import DiffusionPolicy, Policy
from .probes import PROBES, ForkSim
from .seeds import reported_seeds
from .stats import Rate, paired, wilson
from .tasks.spec import TaskSpec


def fork_demos(num: int, noise: float = 0.1, seed: int = 0) -> Demos:
    """Demonstrations of the fork probe: half of them pass above the obstacle, half below, whatever was seen at the start.

    `noise` is the standard deviation of what is added to the actions (1 is a quarter of the way to the obstacle).
    """
    rng, sim, episodes = np.random.default_rng(seed), ForkSim(), []
    for number in range(num):
        side = 1 if number % 2 else -1
        observations, actions, success = [sim.reset(seed + number)], [], []
        while not any(success) and len(actions) < PROBES["fork"].max_episode_steps:
            position = observations[-1].astype(np.float64)
            goal = np.array([1.0, 0.65 * side]) if position[0] < 0.9 else np.array([2.2, 0.0])
            way = (goal - position) / max(np.abs(goal - position).max(), 0.25)  # straight at full speed, slower when near
            actions.append(np.clip(way + rng.normal(0, noise, 2), -1, 1).astype(np.float32))
            observation, solved = sim.step(actions[-1])
            observations.append(observation)
            success.append(solved)
        episodes.append((np.stack(observations), np.stack(actions), np.array(success)))
    observations, actions, success = (np.concatenate(parts) for parts in zip(*episodes, strict=True))
    return Demos("fork", "scripted", "towards a point beside the obstacle, then behind it", "pdkit.diffusion_analysis.fork_demos",
                 observations, actions, success, np.array([len(e[1]) for e in episodes]), np.arange(seed, seed + num))


def paths(policy: Policy, seeds: range, spec: TaskSpec = PROBES["fork"]) -> list[np.ndarray]:
    """Positions (T + 1, obs_dim) of an episode of `policy` from each seed, until the limit or the first success."""
    policy.reset(seeds[0])
    out = []
    for seed in seeds:
        sim = spec.make()
        seen, solved = [sim.reset(seed)], False
        while not solved and len(seen) <= spec.max_episode_steps:
            window = np.stack([seen[max(0, len(seen) - policy.window + k)] for k in range(policy.window)])
            for action in policy.act(window[None])[0]:
                observation, solved = sim.step(action)
                seen.append(observation)
                if solved or len(seen) > spec.max_episode_steps:
                    break
        out.append(np.stack(seen))
    return out


def at_fork(policy: Policy, seed: int = 0) -> tuple[Rate, list[np.ndarray], float]:
    """How a policy does at the fork: its success on 100 test episodes, the `paths` of the first 30, and which share of those that pass
    goes above the obstacle (a crash has no side; -1: none passes)."""
    spec = PROBES["fork"]
    policy.reset(seed)
    table = evaluate(spec, policy.act, reported_seeds(100), window=policy.window, chunk=policy.chunk)
    ways = paths(policy, reported_seeds(30), spec)
    above = [path[np.argmax(path[:, 0] > 0.9), 1] > 0 for path in ways if path[-1, 0] > 1.9]
    return wilson(int(table.success_once.sum()), len(table)), ways, float(np.mean(above)) if above else -1.0


def noised(policy: DiffusionPolicy, actions: np.ndarray, steps: list[int], seed: int = 0) -> np.ndarray:
    """A sequence of actions (T, act_dim) at each of the diffusion `steps`, all with the same noise: (len(steps), T, act_dim)."""
    clean = policy.noisable(torch.from_numpy(np.asarray(actions, np.float32)))
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))
    return np.stack([policy.executable(policy.noise.add_noise(clean[None], noise[None], torch.tensor([k])))[0].numpy() for k in steps])


@torch.no_grad()
def denoising(policy: DiffusionPolicy, window: np.ndarray, seed: int = 0) -> tuple[list[int], np.ndarray]:
    """How the policy's sampler goes from noise to actions for one window (window, obs_dim): the diffusion steps at which the network
    was asked, and the sequences (1 + steps, horizon, act_dim), from what it starts from to what is executed."""
    sequences, asked = [], []
    forward = policy.unet.forward

    def watched(actions, steps, condition):
        sequences.append(policy.executable(actions[0]).numpy().copy())
        asked.append(int(steps[0]))
        return forward(actions, steps, condition)

    policy.unet.forward = watched
    try:
        noise = torch.randn(1, policy.horizon, policy.config["act_dim"], generator=torch.Generator().manual_seed(seed))
        last = policy.denoise(torch.from_numpy(np.asarray(window, np.float32))[None], noise)
    finally:
        policy.unet.forward = forward
    return asked, np.stack([*sequences, last[0].numpy()])


def resampled(policy: DiffusionPolicy, **changes) -> DiffusionPolicy:
    """The same weights with another sampler, sampler_steps, spacing, temperature or chunk."""
    other = DiffusionPolicy(policy.config | changes)
    other.load_state_dict(policy.state_dict())
    return other.eval()


def compare_sampling(policy: DiffusionPolicy, spec: TaskSpec, variants: dict[str, dict], seeds: list[int], *, lanes: int = 25,
                     limit: int | None = None) -> pd.DataFrame:
    """One row a variant of `resampled`: its name, success_once over `seeds` as successes and episodes, action_change, and
    milliseconds a primitive step and environment that `act` takes with `lanes` environments.

    `difference`, `low` and `high` are its success less the first variant's, seed by seed (stats.paired): each seed is the same
    episode for all variants, though noise to start from is drawn as each needs it.
    """
    rows, first = [], None
    for name, changes in variants.items():
        other = resampled(policy, **changes)
        other.reset(0)
        table = evaluate(spec, other.act, seeds, window=other.window, chunk=other.chunk, num_envs=lanes, max_episode_steps=limit)
        first = table if first is None else first
        pair = paired(first, table)
        windows = np.zeros((lanes, other.window, spec.obs_dim), np.float32)
        started = time.perf_counter()
        for _ in range(3):
            other.act(windows)
        milliseconds = (time.perf_counter() - started) / 3 / lanes / other.chunk * 1e3
        rows.append(dict(variant=name, successes=int(table.success_once.sum()), episodes=len(table), success=table.success_once.mean(),
                         difference=pair.difference, low=pair.low, high=pair.high, action_change=table.action_change.mean(),
                         ms_per_step=milliseconds))
    return pd.DataFrame(rows)
