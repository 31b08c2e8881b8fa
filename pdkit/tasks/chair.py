"""PushChair: a robot with two arms on a rolling base pushes a swivel chair to the origin and leaves it standing there.

ManiSkill 3 does not have this task of the paper; here it is after ManiSkill 2. ManiSkill 3 builds the scenes (`chair_env.py`) and
this drives them without torch, as `maniskill.py` does for StackCube.

An observation (131,): the robot's joint positions and velocities (19 each: height, then right arm 7 + 2 fingers, left arm 7 + 2),
the base's x, y and heading and their velocities (6); of the chair's root link the place, quaternion, velocity and angular velocity
(13), then its joint positions and velocities (25 each, zeros after as many as the chair has); finger tips and fingers' velocities
(12 each). Metres, radians, seconds, in the world's frame.
"""
from __future__ import annotations

from functools import cache
from typing import Any, ClassVar

import numpy as np

from ..errors import PdkitError
from .chair_assets import Chair, chairs
from .chair_body import HZ, ChairBody, chair_start, solved
from .chair_plan import plan
from .maniskill import renew_physics
from .maniskill_headless import Camera, close_env, make_env, quiet
from .mobile_panda import CONTROL, MobilePanda
from .spec import TaskSpec

CAMERA: Camera = ((2.0, -2.0, 2.2), (0.0, 0.0, 0.5))  # ManiSkill's own; visual policies bring theirs


def make_chair_env(selection: list[Chair], cameras: bool = False, **options: Any) -> Any:
    """The stock ManiSkill environment in which every episode has one of the chairs; with `cameras` in a scene that can be drawn.
    `options` are ManiSkill's."""
    with quiet():
        from . import chair_env  # registers it
    return make_env(chair_env.NAME, CONTROL, CAMERA if cameras else None, chairs=selection, **options)


@cache
def standing(chair: Chair) -> ChairBody:
    """A chair's body, to ask where it is put (`ChairBody.start`): its scene is gone."""
    env = make_chair_env([chair])
    body = env.body
    close_env(env)
    return body


class PushChair:
    """The fast step, with the novel chairs; see `Sim` for the methods. A chair's scene is built when first needed.

    With `cameras` the scenes can be drawn by pdkit/pixels (`render` draws plans of the floor, without a scene).
    """

    kind: ClassVar[str] = "novel"
    slow_to_build = True  # a scene takes as long as some tens of steps: lanes keep it when they are closed

    def __init__(self, render: bool = False, cameras: bool = False):
        self._can_render, self._cameras = render, cameras
        self._chairs = chairs(self.kind)
        self._scenes: dict[int, tuple[Any, MobilePanda]] = {}

    @classmethod
    def build(cls, render: bool, **options: Any) -> Any:
        """The stock environment behind this task; `options` are ManiSkill's."""
        return make_chair_env(chairs(cls.kind), render, **options)

    def reset(self, seed: int) -> np.ndarray:
        start = chair_start(seed, len(self._chairs))
        if start.chair not in self._scenes:
            env = make_chair_env([self._chairs[start.chair]], self._cameras)
            self._scenes[start.chair] = env, MobilePanda(env)
        self._env, self._panda = self._scenes[start.chair]
        self._chair = self._env.body
        self._physics = renew_physics(self._env)
        self._panda.place(start.base)
        self._chair.place(start)
        return self._observe()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        before = self._chair.root
        self._panda.drive(action)
        for _ in range(self._env._sim_steps_per_control):
            self._physics.step()
        return self._observe(), solved(before, self._chair.root)

    def _observe(self) -> np.ndarray:
        parts = [*self._panda.proprioception(), self._chair.state(), *self._panda.fingers()]
        self._last = np.concatenate(parts, dtype=np.float32)
        return self._last.copy()

    def render(self) -> np.ndarray:
        if not self._can_render:
            raise PdkitError("This simulation was made without pictures; make it with render=True to draw it.")
        return plan(self._last)

    def close(self) -> None:
        for env, _ in self._scenes.values():
            close_env(env)


class PushChairSource(PushChair):
    """The same task with the source chairs."""

    kind = "source"


class StockPushChairSource:
    """PushChairSource through ManiSkill's own step, to test and time the fast step against. A chair is built anew in each episode."""

    def __init__(self):
        self._env = PushChairSource.build(render=False)

    def reset(self, seed: int) -> np.ndarray:
        return self._env.reset(seed=seed)[0][0].numpy()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        observation, _, _, _, info = self._env.step(np.clip(action, -1, 1))
        return observation[0].numpy(), bool(info["success"][0])

    def close(self) -> None:
        close_env(self._env)


_COMMON = dict(
    suite="maniskill",
    own_objects=True,
    obs_dim=131,
    act_dim=20,
    max_episode_steps=200,
    control=f"{CONTROL}: velocities of the base (forwards, left, turning: 0.5 m/s and 3.14 rad/s; rising: 0.5 m/s), then for the left "
    "and the right arm seven joint velocities (3.14 rad/s) and the opening of the fingers (-1 closed, 1 open), 20 Hz",
    success_rule="the chair is less than 0.15 m from the origin, less than 9 degrees off upright, and moved at most 0.1 m/s and turned at "
    "most 36 degrees a second within the step",
    absolute_actions=False,
    joints=19,
    rate=float(HZ),
    plan_view=True,
    held_actions=(11, 19),
)
CHAIR_TASKS = (
    TaskSpec(name="PushChair", make=PushChair, demo_task="PushChairSource", **_COMMON,
             summary="A robot with two arms must push a swivel chair that its demonstrations never showed to the middle of the room."),
    TaskSpec(name="PushChairSource", make=PushChairSource, **_COMMON,
             summary="PushChair with the chairs of the demonstrations."),
)
