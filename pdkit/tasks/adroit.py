"""The four Adroit tasks (MuJoCo, gymnasium-robotics): a 24-joint ShadowHand, state observations, sparse success.

What the environments give is taken as it is (facts.md 5.1): success is judged at every step and can be lost again, they
never terminate, actions are absolute joint targets in [-1, 1]. The episode limits are the paper's (300/200/400/400), not
the registered 200. The paper's Pen has 46 observations; the environment gives 45 and nothing is padded.
"""
from __future__ import annotations

import contextlib
import io
import os
import sys
import warnings
from functools import partial

import numpy as np

from ..errors import PdkitError
from .spec import TaskSpec

RENDER_SIZE = (240, 320)  # height, width


class AdroitSim:
    """One Adroit world behind the Sim protocol.

    It talks to the unwrapped environment: no time limit, no checker, no reward. `reset` goes through
    `mj_resetData`, so the seed alone decides the episode (warm-start forces of the solver included).
    """

    def __init__(self, env_id: str, render: bool = False):
        self._env = _make(env_id, render)
        self._render_ready = render

    def reset(self, seed: int) -> np.ndarray:
        observation, _ = self._env.reset(seed=int(seed))
        return observation.astype(np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        observation, _, _, _, info = self._env.step(action)
        return observation.astype(np.float32), bool(info["success"])

    def render(self) -> np.ndarray:
        if not self._render_ready:
            raise PdkitError("This environment was made without rendering; make it with render=True.")
        return self._env.render()

    def close(self) -> None:
        self._env.close()


def _make(env_id: str, render: bool):
    if render and "MUJOCO_GL" not in os.environ and sys.platform.startswith("linux"):
        os.environ["MUJOCO_GL"] = "egl"  # must be set before mujoco is first imported for rendering
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import gymnasium

        try:
            with contextlib.redirect_stderr(io.StringIO()):  # a notice about dense rewards, which the kit does not use
                import gymnasium_robotics
        except Exception as error:  # whatever a graphics library that is missing makes of it; MuJoCo loads it with or without pictures
            chosen = os.environ.get("MUJOCO_GL")
            if not chosen or isinstance(error, ModuleNotFoundError) and error.name in ("gymnasium_robotics", "mujoco"):
                raise
            raise PdkitError(f"MuJoCo does not start with MUJOCO_GL={chosen} ({type(error).__name__}); `pdkit doctor` tells which "
                             "backends work here, and without pictures it can be unset.") from error
        gymnasium.register_envs(gymnasium_robotics)
        height, width = RENDER_SIZE
        keywords = {"render_mode": "rgb_array", "width": width, "height": height} if render else {}
        try:
            env = gymnasium.make(env_id, disable_env_checker=True, reward_type="sparse", **keywords).unwrapped
        except Exception as error:
            if render:
                raise PdkitError(
                    f"MuJoCo cannot render here ({error}); install EGL or OSMesa (Debian/Ubuntu: apt-get install "
                    "libegl1 libosmesa6) and set MUJOCO_GL=egl or osmesa, or go on without pictures."
                ) from error
            raise
    if render:
        # Ten times cheaper frames: no multisampling, no shadow maps.
        env.model.vis.quality.offsamples = 0
        env.model.vis.quality.shadowsize = 0
    return env


def _spec(name: str, obs_dim: int, joints: int, act_dim: int, limit: int, success_rule: str, summary: str) -> TaskSpec:
    return TaskSpec(
        name=name, suite="adroit", obs_dim=obs_dim, act_dim=act_dim, max_episode_steps=limit,
        control="absolute joint targets, scaled to [-1, 1]", success_rule=success_rule, absolute_actions=True,
        make=partial(AdroitSim, f"AdroitHand{name}-v1"), summary=summary, joints=joints, rate=100.0,
    )


ADROIT_TASKS = (
    _spec("Door", 39, 27, 28, 300, "door hinge >= 1.35 rad", "Undo the latch and swing the door open."),
    _spec("Pen", 45, 24, 24, 200, "pen within 0.075 m of the goal and axes aligned (cosine > 0.95)",
          "Turn a pen in the hand until it matches the goal pose."),
    _spec("Hammer", 46, 26, 26, 400, "nail head within 0.01 m of its goal", "Pick up a hammer and drive a nail home."),
    _spec("Relocate", 39, 30, 30, 400, "ball within 0.1 m of the target", "Carry a ball to a target in the air."),
)
