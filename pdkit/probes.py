"""Tiny worlds in which exactly one component can be wrong; each is solved in seconds, through the same loop as real tasks.

    wait      nothing helps: values must equal the geometric sum that the bootstrap rule implies
    lever     one decision: the action's sign decides; a wrong sign in the actor's or critic's loss fails
    corridor  success only after several steps: discounting and n-step returns order the values along the way
    reach     a biased base policy misses by less than alpha allows: only the decorator's sum closes the gap
    fork      demonstrations pass an obstacle on either side: a policy that averages them runs into it
"""
from __future__ import annotations

from functools import partial

import numpy as np
import torch

from .policies.base import Policy
from .tasks.spec import TaskSpec


class WaitSim:
    """Observation 1; never solved."""

    def reset(self, seed: int) -> np.ndarray:
        return np.ones(1, np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        return np.ones(1, np.float32), False

    def close(self) -> None: ...


class LeverSim:
    """Observation s in {-1, 1}; solved at once when the action has the sign of s and more than half its size."""

    def reset(self, seed: int) -> np.ndarray:
        self.side = 1.0 if seed % 2 else -1.0
        return np.array([self.side], np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        return np.array([self.side], np.float32), bool(action[0] * self.side > 0.5)

    def close(self) -> None: ...


class CorridorSim:
    """Position on a line from 0; each step moves by 0.25 times the action; solved beyond 0.9, in four steps at nearly full speed."""

    def reset(self, seed: int) -> np.ndarray:
        self.x = 0.0
        return np.zeros(1, np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        self.x = float(np.clip(self.x + 0.25 * np.clip(action[0], -1, 1), -1, 1.25))
        return np.array([self.x], np.float32), self.x > 0.9

    def close(self) -> None: ...


class ReachSim:
    """A point in the plane must come within 0.1 of a random goal; observation (position, goal), action a velocity."""

    def reset(self, seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        self.position, self.goal = rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2)
        return self._observation()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        self.position = np.clip(self.position + 0.2 * np.clip(action, -1, 1), -1.5, 1.5)
        return self._observation(), bool(np.linalg.norm(self.position - self.goal) < 0.1)

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.position, self.goal]).astype(np.float32)

    def close(self) -> None: ...


class ForkSim:
    """A point starts near the origin and must pass x = 1.9 without touching a disc of radius 0.4 around (1, 0); action: a velocity."""

    CENTRE, RADIUS = np.array([1.0, 0.0]), 0.4

    def reset(self, seed: int) -> np.ndarray:
        self.position, self.crashed = np.array([0.0, np.random.default_rng(seed).uniform(-0.05, 0.05)]), False
        return self.position.astype(np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        if not self.crashed:
            self.position = self.position + 0.25 * np.clip(action, -1, 1)
            self.crashed = bool(np.linalg.norm(self.position - self.CENTRE) < self.RADIUS)
        return self.position.astype(np.float32), bool(not self.crashed and self.position[0] > 1.9)

    def close(self) -> None: ...


class ProbeBase(Policy):
    """A base policy known exactly. Config: obs_dim, act_dim, kind ("zero", or "reach": towards the goal, missed by `bias`)."""

    kind = "probe"

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        now = windows[:, -1]
        if self.config["kind"] == "zero":
            return torch.zeros(len(now), 1, self.config["act_dim"])
        target = now[:, 2:] + torch.tensor(self.config["bias"])
        return ((target - now[:, :2]) * 2.5).clamp(-1, 1)[:, None]

    def act(self, windows: np.ndarray) -> np.ndarray:
        """The same in numpy; there are no parameters to look a device up from."""
        return self(torch.tensor(windows, dtype=torch.float32)).numpy()


def _probe(name: str, sim, obs_dim: int, act_dim: int, limit: int) -> TaskSpec:
    return TaskSpec(name=name, suite="probe", obs_dim=obs_dim, act_dim=act_dim, max_episode_steps=limit, control="probe",
                    success_rule=sim.__doc__, absolute_actions=False, make=partial(sim))


PROBES = {spec.name: spec for spec in (_probe("wait", WaitSim, 1, 1, 5), _probe("lever", LeverSim, 1, 1, 1),
                                      _probe("corridor", CorridorSim, 1, 1, 20), _probe("reach", ReachSim, 4, 2, 25),
                                      _probe("fork", ForkSim, 2, 2, 16))}


def zero_base(spec: TaskSpec) -> ProbeBase:
    """A base that does nothing: what remains of the decorator is plain SAC."""
    return ProbeBase(dict(obs_dim=spec.obs_dim, act_dim=spec.act_dim, kind="zero"))


def biased_base(bias: tuple[float, float] = (0.2, -0.2)) -> ProbeBase:
    """The reach base: it settles `bias` away from the goal, so it nearly always fails."""
    return ProbeBase(dict(obs_dim=4, act_dim=2, kind="reach", bias=list(bias)))
