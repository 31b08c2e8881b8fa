"""The one vectorised environment. Everything that corrupts results silently when it is wrong lives here and nowhere else:
autoreset, time limits, truncation against termination, true final observations, frame stacks, action chunks, sparse reward.

One call steps N lanes (one simulator each) by one decision, a chunk of Ta primitive actions; steps are counted in primitive
environment steps everywhere. A lane whose episode ends is reset in the same call: `StepResult.final_windows` holds what the
episode really ended with, `StepResult.windows` what the policy must act on next.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from ..errors import PdkitError, unknown
from .batched import gpu_lanes
from .lanes import IDLE, InProcess, Lanes, Workers, must_be_importable
from .spec import TaskSpec

SIMULATORS: dict[str, Callable[..., Any]] = {"cpu": Lanes, "physx_cuda": gpu_lanes}


@dataclass(frozen=True)
class Episode:
    """One finished episode."""

    lane: int
    seed: int
    length: int  # primitive steps
    success_once: bool  # at any step
    success_at_end: bool  # at its last step


@dataclass(frozen=True)
class StepResult:
    """What one decision led to, per lane (N lanes)."""

    windows: np.ndarray  # (N, window, obs_dim) to act on next, after any reset
    final_windows: np.ndarray  # (N, window, obs_dim) the true successor, before any reset
    solved: np.ndarray  # (N, chunk) whether the task was solved at each primitive step; false where none was taken
    terminated: np.ndarray  # (N,) the episode ended because the task was solved (only with terminate_on_success)
    truncated: np.ndarray  # (N,) the episode ended at the time limit
    steps: np.ndarray  # (N,) primitive steps taken; 0 for an idle lane
    episodes: list[Episode] = field(default_factory=list)

    @property
    def reward(self) -> np.ndarray:
        """(N,) sparse: number of primitive steps of the decision at which the task was solved."""
        return self.solved.sum(axis=1).astype(np.float32)

    @property
    def done(self) -> np.ndarray:
        return self.terminated | self.truncated


class VectorEnv:
    """N lanes of one task.

    Args:
        spec: the task.
        num_envs: N.
        next_seed: called with a lane's index when that lane needs an episode; returns its seed, or IDLE.
        window: observations stacked for the policy; an episode starts with its first observation repeated.
        chunk: primitive actions per decision.
        workers: 0 steps in this process; k splits the lanes over k processes, so that the caller can compute
            between `send` and `receive`. Results do not depend on it.
        terminate_on_success: end an episode when solved (training); otherwise it runs to the time limit.
        success_tail: without termination, end an episode (as a time limit) this many steps after its first success; 0: never.
        max_episode_steps: another limit than the task's.
        simulator: "cpu", or "physx_cuda": all lanes in one scene on a GPU, always with one worker (see batched.py for what differs).
    """

    def __init__(self, spec: TaskSpec, num_envs: int, next_seed: Callable[[int], int], *, window: int = 1, chunk: int = 1,
                 workers: int = 0, terminate_on_success: bool = False, success_tail: int = 0, max_episode_steps: int | None = None,
                 simulator: str = "cpu"):
        if simulator not in SIMULATORS:
            raise unknown("simulator", simulator, SIMULATORS)
        if num_envs < 1 or workers < 0 or window < 1 or chunk < 1:
            raise PdkitError("A vectorised environment needs num_envs, window and chunk >= 1 and workers >= 0.")
        self.spec, self.num_envs, self.window, self.chunk = spec, num_envs, window, chunk
        self.limit = max_episode_steps or spec.max_episode_steps
        self._next_seed = next_seed
        self._histories: list[tuple[int, list[np.ndarray]]] = [(IDLE, []) for _ in range(num_envs)]
        shapes = {
            "actions": ((num_envs, chunk, spec.act_dim), np.float32), "seeds": ((num_envs,), np.int64),
            "observations": ((num_envs, chunk, spec.obs_dim), np.float32), "first": ((num_envs, spec.obs_dim), np.float32),
            "solved": ((num_envs, chunk), np.bool_), "steps": ((num_envs,), np.int64), "ended": ((num_envs, 2), np.bool_),
            "episode": ((num_envs, 4), np.int64),
        }
        make = partial(SIMULATORS[simulator], spec, rules=(self.limit, terminate_on_success, success_tail))
        if simulator == "physx_cuda":  # changes how its process simulates on the CPU, and must be there before anything else of PhysX
            workers = 1
        if workers:
            must_be_importable(spec.make)
        self._backend = Workers(shapes, num_envs, min(workers, num_envs), make) if workers else InProcess(shapes, num_envs, make)
        self._built: np.ndarray | None = None  # the seeds of the lanes' first episodes, where lanes keep the bodies of those
        self._keeps_bodies = simulator != "cpu"
        self._arrays = self._backend.arrays
        self._windows = np.zeros((num_envs, window, spec.obs_dim), np.float32)
        self._upcoming = np.full(num_envs, IDLE, np.int64)

    def reset(self) -> np.ndarray:
        """Start an episode in every lane; windows (N, window, obs_dim)."""
        for i in range(self.num_envs):
            self._arrays["seeds"][i] = self._next_seed(i)
        seeds = self._arrays["seeds"].copy()
        if self._keeps_bodies and self._built is None:
            self._built = seeds
        self._backend.call("reset")
        self._histories = [(int(seed), []) for seed in seeds]
        self._windows[:] = self._arrays["first"][:, None]
        self._upcoming[:] = [self._next_seed(i) for i in range(self.num_envs)]
        return self._windows.copy()

    def send(self, actions: np.ndarray) -> None:
        """Begin one decision with actions (N, chunk, act_dim); with workers it runs while the caller goes on."""
        actions = np.asarray(actions, np.float32)
        if actions.shape != self._arrays["actions"].shape:
            raise PdkitError(f"{self.spec.name} expects actions of shape {self._arrays['actions'].shape}, not {actions.shape}.")
        np.clip(actions, -1, 1, out=self._arrays["actions"])
        self._arrays["seeds"][:] = self._upcoming
        self._backend.send("step")

    def receive(self) -> StepResult:
        """The result of the decision that `send` began."""
        self._backend.receive()
        arrays = self._arrays
        steps = arrays["steps"].copy()
        solved = arrays["solved"] & (np.arange(self.chunk) < steps[:, None])
        ended = arrays["ended"] & (steps > 0)[:, None]
        final = self._windows.copy()
        for i, taken in enumerate(steps):
            for observation in arrays["observations"][i, :taken]:
                final[i, :-1] = final[i, 1:]
                final[i, -1] = observation
            self._histories[i][1].extend(arrays["actions"][i, :taken].copy())
        self._windows = final.copy()
        episodes = []
        for i in np.flatnonzero(ended.any(axis=1)):
            seed, length, once, at_end = (int(x) for x in arrays["episode"][i])
            episodes.append(Episode(int(i), seed, length, bool(once), bool(at_end)))
            self._histories[i] = (int(self._upcoming[i]), [])
            self._windows[i] = arrays["first"][i]
            self._upcoming[i] = self._next_seed(int(i))
        return StepResult(self._windows.copy(), final, solved, ended[:, 0].copy(), ended[:, 1].copy(), steps, episodes)

    def step(self, actions: np.ndarray) -> StepResult:
        self.send(actions)
        return self.receive()

    def snapshot(self) -> dict[str, np.ndarray]:
        """Where every lane stands, as arrays: its seed, the actions since, and the seed that comes next.

        Replaying is exact because a simulator is decided by seed and actions; it costs at most one episode a lane.
        """
        lengths = np.array([len(actions) for _, actions in self._histories], np.int64)
        flat = [action for _, actions in self._histories for action in actions]
        built = {} if self._built is None else {"built": self._built}
        return built | {
            "seeds": np.array([seed for seed, _ in self._histories], np.int64), "upcoming": self._upcoming.copy(), "lengths": lengths,
            "actions": np.stack(flat) if flat else np.zeros((0, self.spec.act_dim), np.float32),
        }

    def restore(self, snapshot: dict[str, np.ndarray]) -> np.ndarray:
        """Go back to a snapshot; windows (N, window, obs_dim)."""
        if "built" in snapshot:
            self._built = self._arrays["seeds"][:] = snapshot["built"]
            self._backend.call("reset")
        parts = np.split(snapshot["actions"], np.cumsum(snapshot["lengths"])[:-1])
        self._histories = [(int(seed), list(part)) for seed, part in zip(snapshot["seeds"], parts, strict=True)]
        observations = self._backend.replay([(int(s), p) for s, p in zip(snapshot["seeds"], parts, strict=True)])
        for i, history in enumerate(observations):
            if len(history):
                padded = np.concatenate([np.repeat(history[:1], self.window, axis=0), history[1:]])
                self._windows[i] = padded[-self.window:]
        self._upcoming[:] = snapshot["upcoming"]
        return self._windows.copy()

    def close(self) -> None:
        self._backend.close(keep=True)

    def __enter__(self) -> VectorEnv:
        return self

    def __exit__(self, failed: type[BaseException] | None, *_) -> None:
        self._backend.close(keep=failed is None)
