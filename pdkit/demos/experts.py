"""Scripted experts: closed-loop controllers that act in a task's own control mode on its own observation.

They replace the motion-planned demonstrations of ManiSkill: nothing has to be converted between control modes, and any
number of demonstrations comes from seeds alone.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..errors import PdkitError, unknown
from ..tasks import get_task
from .chair_expert import PushChairExpert
from .faucet_expert import TurnFaucetExpert
from .peg_expert import PegInsertionSideExpert

GIVE_UP = 50  # failures in a row after which a scripted expert is not worth waiting for


class Expert(Protocol):
    """A scripted controller for one task. It sees nothing but observations (but see `Watching`); it may remember what it is doing."""

    def reset(self, rng: np.random.Generator) -> None:
        """Start an episode, with the random numbers for whatever is varied in it."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """The action (act_dim,) in [-1, 1], float32, for an observation (obs_dim,)."""


@runtime_checkable
class Watching(Protocol):
    """A scripted controller that looks at the simulation too, because the observation does not show what it needs."""

    def watch(self, sim: Any) -> None:
        """Called once, before the first episode, with the simulation it will act in."""


class StackCubeExpert:
    """Grasp the red cube, carry it above the green one, lower it, let go.

    A proportional controller on the way to one waypoint after another; `noise` is the standard deviation of what is
    added to the displacement (1 is 10 cm a step), for demonstrations that also show how to recover.
    """

    TOOL, RED, GREEN = slice(25, 28), slice(32, 35), slice(39, 42)  # positions within the observation
    CUBE = 0.04  # edge, metres
    OPEN, CLOSED = 1.0, -1.0
    SQUEEZE = 4  # steps for the fingers to close

    def __init__(self, noise: float = 0.0):
        self.noise = noise

    def reset(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._stage, self._waited = "reach", 0

    def act(self, observation: np.ndarray) -> np.ndarray:
        tool, red, green = (observation[part].astype(np.float64) for part in (self.TOOL, self.RED, self.GREEN))
        self._advance(tool, red, green)
        target, gain, gripper = self._waypoint(tool, red, green)
        move = np.clip(gain * (target - tool), -1, 1)
        if self.noise:
            move = np.clip(move + self._rng.normal(0, self.noise, 3), -1, 1)
        return np.append(move, gripper).astype(np.float32)

    def _advance(self, tool: np.ndarray, red: np.ndarray, green: np.ndarray) -> None:
        """Go on to the next stage, or past it where its condition is met already; start again with a dropped cube."""
        sideways = np.linalg.norm((red - green)[:2])
        dropped = np.linalg.norm(tool - red) > 0.05 and abs(red[2] - green[2] - self.CUBE) > 0.01
        if dropped and self._stage not in ("reach", "descend"):
            self._stage = "reach"
        if self._stage == "reach" and np.linalg.norm((tool - red)[:2]) < 0.01 and tool[2] - red[2] < 0.11:
            self._stage = "descend"
        if self._stage == "descend" and np.linalg.norm(tool - red) < 0.012:
            self._stage, self._waited = "grasp", 0
        if self._stage == "grasp":
            self._waited += 1
            if self._waited >= self.SQUEEZE:
                self._stage = "lift"
        if self._stage == "lift" and red[2] > green[2] + 0.07:
            self._stage = "carry"
        if self._stage == "carry" and sideways < 0.008:
            self._stage = "lower"
        if self._stage == "lower" and abs(red[2] - green[2] - self.CUBE) < 0.004 and sideways < 0.015:
            self._stage = "release"

    def _waypoint(self, tool: np.ndarray, red: np.ndarray, green: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Where the tool should be, metres; how hard to go there, 1/metre; and the gripper."""
        in_hand = tool - red  # the cube is carried with whatever offset it was grasped
        if self._stage == "reach":
            return red + [0, 0, 0.08], 8, self.OPEN
        if self._stage == "descend":
            return red, 8, self.OPEN
        if self._stage == "grasp":
            return red, 4, self.CLOSED
        if self._stage == "lift":
            return np.array([tool[0], tool[1], green[2] + 0.12]), 8, self.CLOSED
        if self._stage == "carry":
            return green + in_hand + [0, 0, 0.08], 8, self.CLOSED
        if self._stage == "lower":
            return green + in_hand + [0, 0, self.CUBE], 6, self.CLOSED
        return tool, 0, self.OPEN


EXPERTS: dict[str, Callable[..., Expert]] = {
    "StackCube": StackCubeExpert,
    "PegInsertionSide": PegInsertionSideExpert,
    "TurnFaucet": TurnFaucetExpert,
    "TurnFaucetSource": TurnFaucetExpert,
    "PushChair": PushChairExpert,
    "PushChairSource": PushChairExpert,
}


def scripted_episodes(
    task_name: str,
    num: int,
    first_seed: int = 0,
    noise: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[dict[str, Any]]:
    """`num` successful episodes of the task's scripted expert, from the seeds `first_seed`, `first_seed` + 1, ...

    Each is a dict of observations (T + 1, obs_dim) float32, actions (T, act_dim) float32 as they were executed (noise
    included), success (T,) bool and seed. An episode ends at its first success, as in ManiSkill 2; one that does not
    get there within the task's limit is skipped. `progress(kept, tried)` is called after every episode.

    Raises PdkitError for a task without an expert, for `num` < 1, for negative noise, and after 50 failures in a row.
    """
    if task_name not in EXPERTS:
        raise unknown("task for scripted demonstrations", task_name, EXPERTS)
    if num < 1:
        raise PdkitError(f"The number of demonstrations must be at least 1, not {num}.")
    if not noise >= 0:
        raise PdkitError(f"The action noise must be 0 or more, not {noise}.")
    return _successful_episodes(task_name, num, first_seed, noise, progress)


def _successful_episodes(
    task_name: str, num: int, first_seed: int, noise: float, progress: Callable[[int, int], None] | None
) -> Iterator[dict[str, Any]]:
    task, expert = get_task(task_name), EXPERTS[task_name](noise)
    sim = task.make()
    if isinstance(expert, Watching):
        expert.watch(sim)
    try:
        kept, seed, failures = 0, first_seed, 0
        while kept < num:
            episode = _episode(sim, expert, seed, task.max_episode_steps)
            seed += 1
            succeeded = bool(episode["success"][-1])
            kept, failures = kept + succeeded, 0 if succeeded else failures + 1
            if progress is not None:
                progress(kept, seed - first_seed)
            if succeeded:
                yield episode
            elif failures == GIVE_UP:
                raise PdkitError(
                    f"The {task_name} expert failed {GIVE_UP} times in a row at action noise {noise}; lower the noise."
                )
    finally:
        sim.close()


def _episode(sim: Any, expert: Expert, seed: int, limit: int) -> dict[str, Any]:
    """Let the expert act from `seed` until its first success, at most `limit` steps."""
    observations, actions, successes = [sim.reset(seed)], [], []
    expert.reset(np.random.default_rng(seed))
    while len(actions) < limit and not any(successes[-1:]):
        action = expert.act(observations[-1])
        observation, success = sim.step(action)
        actions.append(action)
        observations.append(observation)
        successes.append(success)
    return {
        "observations": np.stack(observations).astype(np.float32),
        "actions": np.stack(actions).astype(np.float32),
        "success": np.array(successes, bool),
        "seed": seed,
    }
