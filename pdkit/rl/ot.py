"""Optimal transport as a reward: how much a whole episode resembles a demonstration (Haldar et al., 2022, ROT; facts.md 3.1).

    C_ij = 1 - cos(phi(o_i), phi(o^e_j)),   mu = Sinkhorn(1/T, 1/T', C; epsilon, iterations),   r_i = -scale * sum_j mu_ij C_ij

Against each demonstration; the one with the largest sum counts. The first episode is judged with scale 1, after which scale is set once
so that its rewards sum to -10 (the original's automatic factor). o_i are the observations that the actions led to.

Traps (facts.md 3.1). The reward is imitation alone: success is not in it. One episode sets the scale for good: after a first one near
a demonstration, all others cost much. An episode's mass is 1 however long it is, so a step of a long one weighs less.
phi must not move under the reward: it is a frozen copy. Rewards exist only when an episode is over, so its transitions are held
back. With epsilon 0.01 a hundred iterations may not converge: each o_i still moves its whole mass 1/T (Sinkhorn updates the rows
last), but some o^e_j get more or less than 1/T', and a cost that is due can be missing altogether; `error` says how much.
"""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from ..errors import PdkitError
from .replay import NStep

SMALLEST_EPSILON = 0.003  # costs reach 2, and exp(-2 / epsilon) must not vanish in float64


def cosine_cost(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """1 - cos between all rows of a (T, F) and b (T', F), (T, T') float64."""
    a, b = (x.astype(np.float64) / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12) for x in (a, b))
    return 1 - a @ b.T


def sinkhorn(cost: np.ndarray, epsilon: float, iterations: int) -> np.ndarray:
    """The entropic transport plan (T, T') between uniform marginals."""
    import ot  # takes a second to import

    rows, columns = (np.full(n, 1 / n) for n in cost.shape)
    return ot.sinkhorn(rows, columns, cost, epsilon, numItermax=iterations, warn=False)


class OTReward:
    """Rewards of whole episodes.

    Args:
        phi: features (T, F) of the observations (T, width) of an episode, in order: as they are stored, or as demonstrations have them.
        demos: observations of each demonstration, the first one included.
        total: what the first episode's rewards shall sum to, without the sign.
        frozen: the network in phi, if it is renewed while training goes on: a part of checkpoints then.
    """

    def __init__(self, phi: Callable[[np.ndarray], np.ndarray], demos: list[np.ndarray], *, epsilon: float, iterations: int, total: float,
                 frozen: nn.Module | None = None):
        if epsilon < SMALLEST_EPSILON:
            raise PdkitError(f"ot_epsilon must be at least {SMALLEST_EPSILON}, not {epsilon}: below, Sinkhorn's kernel vanishes.")
        self.phi, self.demos, self.epsilon, self.iterations, self.total = phi, demos, epsilon, iterations, total
        self.frozen = frozen or nn.Identity()
        self.scale = 0.0  # 0: no episode seen yet
        self.error = 0.0  # of the last episode: the largest relative error of a demonstrated observation's mass
        self.chosen = -1  # of the last episode: which demonstration
        self.refresh()

    def renew(self, network: nn.Module) -> None:
        """Copy the network in phi from this one."""
        self.frozen.load_state_dict(network.state_dict())
        self.refresh()

    def refresh(self) -> None:
        """Compute the demonstrations' features anew: phi has changed."""
        self.targets = [self.phi(observations)[1:] for observations in self.demos]

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Rewards (T,) of an episode's T actions, from its observations (T + 1, width)."""
        features, best = self.phi(observations)[1:], None
        for i, target in enumerate(self.targets):
            cost = cosine_cost(features, target)
            plan = sinkhorn(cost, self.epsilon, self.iterations)
            rewards = -(plan * cost).sum(axis=1)
            if best is None or rewards.sum() > best.sum():
                best, self.chosen = rewards, i
                self.error = float(np.abs(plan.sum(axis=0) * len(target) - 1).max())
        if not self.scale:
            self.scale = self.total / max(abs(float(best.sum())), 1e-6)
        return self.scale * best


class OTReturns(NStep):
    """n-step rows whose rewards are made when an episode is over: each lane's unfinished one is held back, and is part of a
    checkpoint. A sparse reward that is pushed is ignored."""

    def __init__(self, num_envs: int, n: int, gamma: float, reward: OTReward):
        super().__init__(num_envs, n, gamma)
        self.reward, self.total = reward, 0.0  # of the last episode
        self.unfinished: list[list[tuple[np.ndarray, ...]]] = [[] for _ in range(num_envs)]

    def push(self, lane: int, obs, residual, base, reward: float, next_obs, next_base, stop: bool, done: bool) -> list[np.ndarray]:
        """Add one transition; all rows of the episode when it is over, none before."""
        episode = self.unfinished[lane]
        episode.append((obs, residual, base, next_obs, next_base))
        if not done:
            return []
        self.unfinished[lane], rows = [], []
        rewards = self.reward(np.stack([episode[0][0], *(t[3] for t in episode)]))
        self.total = float(rewards.sum())
        for t, (transition, value) in enumerate(zip(episode, rewards, strict=True)):
            last = t == len(episode) - 1
            rows += super().push(lane, *transition[:3], float(value), *transition[3:], stop and last, last)
        return rows

    def state(self) -> dict[str, np.ndarray]:
        items = [np.concatenate(transition) for episode in self.unfinished for transition in episode]
        frozen = {f"phi.{name}": tensor.cpu().numpy() for name, tensor in self.reward.frozen.state_dict().items()}
        return frozen | {
            "counts": np.array([len(episode) for episode in self.unfinished], np.int64), "scale": np.array([self.reward.scale]),
            "items": np.stack(items).astype(np.float32) if items else np.zeros((0, 0), np.float32)}

    def load(self, state: dict[str, np.ndarray], obs_dim: int, act_dim: int) -> None:
        cuts, items = np.cumsum([obs_dim, act_dim, act_dim, obs_dim]), iter(state["items"])
        self.unfinished = [[tuple(np.split(next(items), cuts)) for _ in range(int(count))] for count in state["counts"]]
        self.reward.scale = float(state["scale"][0])
        frozen = {name.removeprefix("phi."): torch.from_numpy(array) for name, array in state.items() if name.startswith("phi.")}
        self.reward.frozen.load_state_dict(frozen)
        self.reward.refresh()
