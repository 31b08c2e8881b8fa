"""StackCube on ManiSkill 3: a cube on another."""
from __future__ import annotations

import numpy as np

from .draws import Draws, noisy_joints
from .maniskill import FastSim, StockSim, place_body, renew_physics
from .spec import TaskSpec

CUBE = 0.04  # edge of a cube, metres


class StackCube(FastSim):
    """StackCube-v1, `pd_ee_delta_pos`, state observations: the fast step."""

    env_id, control = "StackCube-v1", "pd_ee_delta_pos"
    camera = ((0.45, 0.5, 0.4), (-0.05, 0.0, 0.1))

    def __init__(self, render: bool = False):
        super().__init__(render)
        self._red, self._green = self._env.cubeA._bodies[0], self._env.cubeB._bodies[0]

    def reset(self, seed: int) -> np.ndarray:
        joints, red, green = stack_cube_start(seed)
        self._physics = renew_physics(self._env)
        self._panda.place(joints)
        place_body(self._red, red)
        place_body(self._green, green)
        return self._observe()

    def _observe(self) -> np.ndarray:
        tool, red, green = self._panda.tool.entity_pose, self._red.entity_pose, self._green.entity_pose
        parts = (*self._robot_state(), red.p, red.q, green.p, green.q, red.p - tool.p, green.p - tool.p, green.p - red.p)
        return np.concatenate(parts, dtype=np.float32)

    def _success(self) -> bool:
        """ManiSkill's rule: red lies on green, is at rest, and the gripper has let go of it."""
        offset = self._red.entity_pose.p - self._green.entity_pose.p
        if np.hypot(offset[0], offset[1]) > CUBE / 2 * np.sqrt(2) + 0.005 or abs(offset[2] - CUBE) > 0.005:
            return False
        if np.linalg.norm(self._red.linear_velocity) > 0.01 or np.linalg.norm(self._red.angular_velocity) > 0.5:
            return False
        return not self._panda.holds(self._physics, self._red)


class StockStackCube(StockSim):
    """The same task through ManiSkill's own step."""

    fast = StackCube


def stack_cube_start(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where StackCube-v1 starts for `seed`: joint positions (9,), and poses (7,) of the red and the green cube.

    Draws the same random numbers in the same order as ManiSkill (`StackCubeEnv._initialize_episode` and
    `TableSceneBuilder.initialize`), in a tenth of the time.
    """
    draws = Draws(seed)

    def spot() -> np.ndarray:
        return draws.uniform([-0.1, -0.2], [0.1, 0.2])

    def cube(xy: np.ndarray) -> np.ndarray:
        return np.concatenate([xy, [CUBE / 2], draws.turn(0, 2 * np.pi)], dtype=np.float32)

    middle = draws.uniform([-0.1, -0.1], [0.1, 0.1])
    red = spot()
    apart = 2 * (np.float32(CUBE / 2 * np.sqrt(2)) + np.float32(0.001))  # so that the cubes never overlap
    for _ in range(100):
        green = spot()
        if np.linalg.norm(green - red) > apart:
            break
    else:
        green = np.zeros(2, np.float32)  # ManiSkill's own fallback
    return noisy_joints(np.random.RandomState(seed), -np.pi / 4), cube(middle + red), cube(middle + green)


STACK_CUBE = TaskSpec(
    name="StackCube",
    suite="maniskill",
    obs_dim=55,
    act_dim=4,
    max_episode_steps=200,
    control="pd_ee_delta_pos: displacement of the gripper in the robot's frame (1 = 10 cm) and its opening, 20 Hz",
    success_rule="the red cube lies on the green one (their middles at most 3.3 cm apart sideways, half a cube's diagonal and 5 mm, and in "
    "height within 5 mm of a cube's edge), is at rest, and the gripper has let go of it",
    absolute_actions=False,
    make=StackCube,
    summary="A Panda arm must put the red cube on the green one and let go.",
    joints=9,
    rate=20.0,
    held_actions=(3,),
)
