"""What a task is: one frozen description, and the small simulator interface behind it."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np


class Sim(Protocol):
    """One simulated world, unbatched numpy, without time limit, reward or autoreset (vector.py adds these).

    `reset(seed)` alone decides everything that follows: the same seed and actions give the same trajectory,
    whatever was simulated before. Training resume relies on it.
    """

    def reset(self, seed: int) -> np.ndarray:
        """Start the episode that `seed` names; the observation, float32 (obs_dim,)."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        """One primitive step with an action (act_dim,), clipped here to [-1, 1]; (observation, success at this step)."""

    def render(self) -> np.ndarray:
        """The current picture, uint8 (height, width, 3). Raises PdkitError where no render backend works."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class TaskSpec:
    """A task as it runs here: of the paper (appendix A, Tables 2 and 3), or of your own."""

    name: str
    suite: str  # "adroit" (MuJoCo, gymnasium-robotics) or "maniskill" (SAPIEN), or a word of your own
    obs_dim: int  # state observation
    act_dim: int
    max_episode_steps: int  # the paper's limit, in primitive steps
    control: str  # what an action means
    success_rule: str  # in words; judged at every step
    absolute_actions: bool  # actions are targets, not displacements or velocities
    make: Callable[..., Sim]  # make(render=False) -> Sim
    summary: str = ""  # one sentence for people
    joints: int = 0  # the first so many numbers of an observation are the robot's joint positions
    rate: float = 1.0  # primitive steps a second
    demo_task: str = ""  # the task whose demonstrations are imitated, where it is another (other objects, same numbers)
    plan_view: bool = False  # pictures are plans of the floor that the task draws itself, without a graphics driver
    own_objects: bool = False  # its objects are the user's own where PDKIT_PARTNET is set (partnet.py), and generated ones else
    held_actions: tuple[int, ...] = ()  # where actions are not targets: the dimensions that are all the same, such as a gripper's

    def resting(self, action: np.ndarray) -> np.ndarray:
        """What to do after `action` (act_dim,) so that nothing moves on: the same targets, and no displacement.

        It fills action sequences up behind the end of a demonstration (facts.md 2.2: zeros are wrong for absolute targets).
        """
        if self.absolute_actions:
            return action.copy()
        rest = np.zeros_like(action)
        rest[list(self.held_actions)] = action[list(self.held_actions)]
        return rest


def behind(make: Any) -> tuple[list[Callable], list[str]]:
    """The classes and functions that make a simulator, those among a partial's arguments, too; and the words and numbers among these."""
    if isinstance(make, TaskSpec):
        return behind(make.make)
    if isinstance(make, partial):
        parts = [behind(part) for part in (make.func, *make.args, *make.keywords.values())]
        return [one for code, _ in parts for one in code], [text for _, texts in parts for text in texts]
    if callable(make) and hasattr(make, "__qualname__"):
        return [make], []
    return ([], [repr(make)]) if type(make).__module__ == "builtins" else ([type(make)], [])
