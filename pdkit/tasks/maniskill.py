"""What the ManiSkill tasks of the paper share: ManiSkill 3 (SAPIEN), stepped by a thin numpy layer over the stock scene.

Nearly all the time of a stock `env.step` on a CPU goes into batched torch wrappers around a batch of one. The classes
here let ManiSkill build its scene and then drive that same scene directly: the same controller (inverse kinematics,
drive targets), the same number of physics steps and the same success rule, without torch and in the same order of
roundings: on x86 a trajectory is the stock environment's to the last bit. The tests hold each task to that; the stock
environments are here as well (`StockSim`).

Observations are ManiSkill 3's with the robot's base pose put back (7 values after the joint positions and velocities),
as in the ManiSkill 2 observations that the paper used.
"""
from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import numpy as np

from ..errors import PdkitError
from .maniskill_headless import Camera, close_env, make_env, without_materials
from .panda import Panda

BASE_POSE = slice(18, 25)  # where the base pose is put back: after 9 joint positions and 9 joint velocities
POSE_CONTROL = (  # what an action of `pd_ee_delta_pose` means
    "pd_ee_delta_pose: displacement (3) of the gripper in the robot's frame (1 = 10 cm), rotation (3) about that frame's axes "
    "(1 = 0.1 rad, at most that altogether) and opening of the gripper, 20 Hz; ManiSkill 3.0.1 scales rotations by the lower bound of "
    "their range, so a positive number turns in the negative sense"
)


class FastSim:
    """The fast step of one task. See `Sim` for the methods; a task adds `reset`, `_observe` and `_success`."""

    env_id: ClassVar[str]
    control: ClassVar[str]  # ManiSkill's name of the control mode
    camera: ClassVar[Camera]  # where the camera is and what it looks at, metres
    slow_to_build: ClassVar[bool] = True  # as long as some tens of steps take: lanes keep it when they are closed

    def __init__(self, render: bool = False):
        self._env = self.build(render)
        self._can_render = render
        self._substeps = self._env._sim_steps_per_control
        self._panda = Panda(self._env)

    @classmethod
    def build(cls, render: bool, **options: Any) -> Any:
        """The stock environment behind this task; `options` are ManiSkill's."""
        return make_env(cls.env_id, cls.control, cls.camera if render else None, **options)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        self._panda.drive(_clipped(action))
        for _ in range(self._substeps):
            self._physics.step()
        return self._observe(), self._success()

    def _robot_state(self) -> tuple[np.ndarray, ...]:
        """The observation's first 32 numbers: joint positions and velocities, base pose, pose of the tool centre point."""
        robot, tool = self._panda.robot, self._panda.tool.entity_pose
        return robot.qpos, robot.qvel, self._panda.base_pose, tool.p, tool.q

    def render(self) -> np.ndarray:
        return _picture(self._env, self._can_render)

    def close(self) -> None:
        close_env(self._env)


class StockSim:
    """A task through ManiSkill's own `env.reset` and `env.step`, to test and time the fast step against.

    Unlike the fast step it may break the promise of `Sim`: from the first contact on its last digits can depend on
    earlier episodes, so compare with a new one.
    """

    fast: ClassVar[type[FastSim]]

    def __init__(self, render: bool = False):
        self._env = self.fast.build(render)
        self._can_render = render

    def reset(self, seed: int) -> np.ndarray:
        with building(self._can_render):  # some tasks load their scene anew
            return with_base_pose(self._env, self._env.reset(seed=seed)[0])[0]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        observations, _, _, _, info = self._env.step(_clipped(action))
        return with_base_pose(self._env, observations)[0], bool(info["success"][0])

    def render(self) -> np.ndarray:
        return _picture(self._env, self._can_render)

    def close(self) -> None:
        close_env(self._env)


def with_base_pose(env: Any, observations: Any) -> np.ndarray:
    """A stock environment's observations, torch (N, D), with the robot's base pose put back: numpy (N, D + 7)."""
    values, base = observations.cpu().numpy(), env.agent.robot.pose.raw_pose.cpu().numpy()
    at = BASE_POSE.start
    return np.concatenate([values[:, :at], base, values[:, at:]], axis=1, dtype=np.float32)


def building(can_render: bool) -> AbstractContextManager:
    """Within this block bodies can be built, for pictures or without a Vulkan driver."""
    return nullcontext() if can_render else without_materials()


def _picture(env: Any, can_render: bool) -> np.ndarray:
    if not can_render:
        raise PdkitError("This simulation was made without pictures; make it with render=True to draw it.")
    return env.render_rgb_array()[0].cpu().numpy()


def _clipped(action: np.ndarray) -> np.ndarray:
    return np.minimum(np.maximum(np.asarray(action, np.float32), -1), 1)  # np.clip takes four times as long


def renew_physics(env: Any) -> Any:
    """Move all bodies of a ManiSkill scene, in their order, into a new physics system; return that system.

    Placing bodies anew is not enough to repeat an episode bit for bit: from the first contact on PhysX's results depend
    on the contacts that were made before in the same system. A new one costs a tenth of a millisecond.
    ManiSkill's scene is left pointing at the new system, so that its own methods keep working.
    """
    import sapien

    scene, old = env.scene.sub_scenes[0], env.scene.px
    entities = list(scene.entities)
    for entity in entities:
        scene.remove_entity(entity)
    sapien.physx.set_scene_config(old.config)  # it is global, and another task may have set its own
    new = sapien.physx.PhysxCpuSystem()
    new.timestep = old.timestep
    env.scene.sub_scenes[0] = sapien.Scene([new, *([scene.render_system] if env.scene.can_render() else [])])
    env.scene.px = new
    for entity in entities:
        env.scene.sub_scenes[0].add_entity(entity)
    return new


def place_body(body: Any, pose: np.ndarray) -> None:
    """Put a rigid body at a pose (7,), at rest and awake.

    Sleeping and waking restarts PhysX's count of how long it has been still, which decides when it falls asleep.
    """
    import sapien

    body.entity_pose = sapien.Pose(pose[:3], pose[3:])
    body.linear_velocity = body.angular_velocity = np.zeros(3, np.float32)
    body.put_to_sleep()
    body.wake_up()
