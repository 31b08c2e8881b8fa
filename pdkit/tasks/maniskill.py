"""The ManiSkill tasks of the paper on ManiSkill 3 (SAPIEN), stepped by a thin numpy layer over the stock scene.

Nearly all the time of a stock `env.step` on a CPU goes into batched torch wrappers around a batch of one. The classes
here let ManiSkill build its scene and then drive that same scene directly: the same controller (inverse kinematics,
drive targets), the same number of physics steps and the same success rule, without torch and in the same order of
roundings: on x86 a trajectory is the stock environment's to the last bit. `tests/test_maniskill.py` holds it to that;
the stock environment is here as well (`StockStackCube`).

Observations are ManiSkill 3's with the robot's base pose put back (7 values after the joint positions and velocities),
as in the ManiSkill 2 observations that the paper used.
"""
from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import PdkitError
from .maniskill_headless import make_env
from .spec import TaskSpec

BASE_POSE = slice(18, 25)  # where the base pose is put back: after 9 joint positions and 9 joint velocities
CUBE = 0.04  # edge of a cube, metres
CAMERA = ((0.45, 0.5, 0.4), (-0.05, 0.0, 0.1))  # where the camera is and what it looks at, metres


def _picture(env: Any, can_render: bool) -> np.ndarray:
    if not can_render:
        raise PdkitError("This simulation was made without pictures; make it with render=True to draw it.")
    return env.render_rgb_array()[0].cpu().numpy()


def _clipped(action: np.ndarray) -> np.ndarray:
    return np.minimum(np.maximum(np.asarray(action, np.float32), -1), 1)  # np.clip takes four times as long


class Panda:
    """The Panda arm of a ManiSkill scene under `pd_ee_delta_pos`.

    An action (4,) is a displacement of the tool centre point in the frame of the base (1 means 10 cm) and an opening of
    the gripper (-1 closed, 1 open).
    """

    def __init__(self, env: Any):
        import sapien

        self._pose_type = sapien.Pose
        agent = env.agent
        arm, gripper = agent.controller.controllers["arm"], agent.controller.controllers["gripper"]
        kinematics = arm.kinematics
        self.robot = agent.robot._objs[0]
        self.tool = agent.tcp._bodies[0]
        self.fingers = (agent.finger1_link._bodies[0], agent.finger2_link._bodies[0])
        joints = self.robot.get_active_joints()
        self._arm, self._gripper = joints[:7], joints[7:9]
        self._model, self._tool_index = kinematics.pmodel, kinematics.end_link_idx
        self._mask = kinematics.qmask.numpy().astype(np.int32)
        self._reach, self._opening = _middle_and_half(arm), _middle_and_half(gripper)
        base = self.robot.root_pose
        self.base_pose = np.concatenate([base.p, base.q])

    def place(self, joints: np.ndarray) -> None:
        """Put the arm at joint positions (9,), at rest."""
        zeros = np.zeros(9, np.float32)
        self.robot.set_qpos(joints)
        self.robot.set_qvel(zeros)
        self.robot.set_qf(zeros)

    def _tool_in_base(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and rotation of the tool centre point in the base's frame, with ManiSkill's very roundings.

        The base is not turned, but physics normalises its quaternion to (1.0000001, 0, 0, 0).
        """
        tool, scale = self.tool.entity_pose, self.base_pose[3]
        return scale * -self.base_pose[:3] * scale + scale * tool.p * scale, scale * tool.q

    def drive(self, action: np.ndarray) -> None:
        """Set the joints' targets for an action in [-1, 1].

        Where no joint positions reach the displaced pose, the arm's targets are where it is now, as in ManiSkill.
        """
        position, turn = self._tool_in_base()
        there = self._pose_type(position + (self._reach[0] + self._reach[1] * action[:3]), turn)
        joints = self.robot.qpos
        solution, reached, _ = self._model.compute_inverse_kinematics(
            self._tool_index, there, initial_qpos=joints, active_qmask=self._mask, max_iterations=100
        )
        for joint, target in zip(self._arm, (solution if reached else joints)[:7], strict=True):
            joint.set_drive_target(target)
        opening = (self._opening[0] + self._opening[1] * action[3])[0]
        for joint in self._gripper:
            joint.set_drive_target(opening)

    def holds(self, physics: Any, body: Any) -> bool:
        """Whether both fingers press on `body` with at least 0.5 N, at most 85 degrees off their closing direction."""
        contacts = physics.get_contacts()
        for finger, sign in zip(self.fingers, (1, -1), strict=True):
            force = _contact_impulse(contacts, finger.entity, body.entity) / physics.timestep
            strength = np.linalg.norm(force)
            if strength < 0.5:
                return False
            closing = sign * finger.entity_pose.to_transformation_matrix()[:3, 1]
            if np.degrees(np.arccos(np.clip(force @ closing / strength, -1, 1))) > 85:
                return False
        return True


def _middle_and_half(controller: Any) -> tuple[np.ndarray, np.ndarray]:
    """How a controller scales actions from [-1, 1]: the middle and half the width of its range."""
    low, high = controller.action_space_low.numpy(), controller.action_space_high.numpy()
    half = np.float32(0.5)
    return half * (high + low), half * (high - low)


def _contact_impulse(contacts: list, first: Any, second: Any) -> np.ndarray:
    """The impulse (3,) that entity `second` gives to entity `first` over the last physics step."""
    total = np.zeros(3)
    for contact in contacts:
        entities = [body.entity for body in contact.bodies]
        if entities == [first, second]:
            total += sum(point.impulse for point in contact.points)
        elif entities == [second, first]:
            total -= sum(point.impulse for point in contact.points)
    return total


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


class StackCube:
    """StackCube-v1, `pd_ee_delta_pos`, state observations: the fast step. See `Sim` for the methods."""

    def __init__(self, render: bool = False):
        self._env = make_env("StackCube-v1", "pd_ee_delta_pos", CAMERA if render else None)
        self._can_render = render
        self._substeps = self._env._sim_steps_per_control
        self._panda = Panda(self._env)
        self._red, self._green = self._env.cubeA._bodies[0], self._env.cubeB._bodies[0]

    def reset(self, seed: int) -> np.ndarray:
        joints, red, green = stack_cube_start(seed)
        self._physics = renew_physics(self._env)
        self._panda.place(joints)
        place_body(self._red, red)
        place_body(self._green, green)
        return self._observe()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        self._panda.drive(_clipped(action))
        for _ in range(self._substeps):
            self._physics.step()
        return self._observe(), self._success()

    def _observe(self) -> np.ndarray:
        robot, tool = self._panda.robot, self._panda.tool.entity_pose
        red, green = self._red.entity_pose, self._green.entity_pose
        parts = (robot.qpos, robot.qvel, self._panda.base_pose, tool.p, tool.q, red.p, red.q, green.p, green.q,
                 red.p - tool.p, green.p - tool.p, green.p - red.p)
        return np.concatenate(parts, dtype=np.float32)

    def _success(self) -> bool:
        """ManiSkill's rule: red lies on green, is at rest, and the gripper has let go of it."""
        offset = self._red.entity_pose.p - self._green.entity_pose.p
        if np.hypot(offset[0], offset[1]) > CUBE / 2 * np.sqrt(2) + 0.005 or abs(offset[2] - CUBE) > 0.005:
            return False
        if np.linalg.norm(self._red.linear_velocity) > 0.01 or np.linalg.norm(self._red.angular_velocity) > 0.5:
            return False
        return not self._panda.holds(self._physics, self._red)

    def render(self) -> np.ndarray:
        return _picture(self._env, self._can_render)

    def close(self) -> None:
        self._env.close()


class StockStackCube:
    """The same task through ManiSkill's own `env.reset` and `env.step`, to test and time the fast step against.

    Unlike the fast step it breaks the promise of `Sim`: from the first contact on its last digits depend on earlier
    episodes, so compare with a new one.
    """

    def __init__(self, render: bool = False):
        self._env = make_env("StackCube-v1", "pd_ee_delta_pos", CAMERA if render else None)
        self._can_render = render

    def _with_base_pose(self, observation: Any) -> np.ndarray:
        values = observation[0].numpy()
        base = self._env.agent.robot.pose.raw_pose[0].numpy()
        at = BASE_POSE.start
        return np.concatenate([values[:at], base, values[at:]], dtype=np.float32)

    def reset(self, seed: int) -> np.ndarray:
        return self._with_base_pose(self._env.reset(seed=seed)[0])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        observation, _, _, _, info = self._env.step(_clipped(action))
        return self._with_base_pose(observation), bool(info["success"][0])

    def render(self) -> np.ndarray:
        return _picture(self._env, self._can_render)

    def close(self) -> None:
        self._env.close()


def stack_cube_start(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where StackCube-v1 starts for `seed`: joint positions (9,), and poses (7,) of the red and the green cube.

    Draws the same random numbers in the same order as ManiSkill (`StackCubeEnv._initialize_episode` and
    `TableSceneBuilder.initialize`), in a tenth of the time.
    """
    import torch

    rest = np.array([0, np.pi / 8, 0, -np.pi * 5 / 8, 0, np.pi * 3 / 4, -np.pi / 4, 0.04, 0.04])
    joints = np.random.RandomState(seed).normal(0, 0.02, (1, 9))[0] + rest
    joints[-2:] = 0.04
    generator = torch.Generator().manual_seed(int(seed))

    def uniform(count: int) -> np.ndarray:
        return torch.rand(count, generator=generator).numpy()

    def spot() -> np.ndarray:
        return uniform(2) * np.float32([0.2, 0.4]) + np.float32([-0.1, -0.2])

    def cube(xy: np.ndarray) -> np.ndarray:
        angle = torch.rand(3, generator=generator)[2] * (2 * np.pi)
        cosine, sine = angle.cos(), angle.sin()
        # Half angles as ManiSkill's matrix_to_quaternion takes them, from the larger one: the roundings agree.
        if cosine >= 0:
            root = (1 + cosine + cosine + 1).sqrt()
            turn = (root**2 / (2 * root), 0, 0, (sine + sine) / (2 * root))
        else:
            root = (1 - cosine - cosine + 1).sqrt()
            turn = ((sine + sine).abs() / (2 * root), 0, 0, sine.sign() * root**2 / (2 * root))
        return np.concatenate([xy, [CUBE / 2], turn], dtype=np.float32)

    middle = uniform(2) * np.float32(0.2) - np.float32(0.1)
    red = spot()
    apart = 2 * (np.float32(CUBE / 2 * np.sqrt(2)) + np.float32(0.001))  # so that the cubes never overlap
    for _ in range(100):
        green = spot()
        if np.linalg.norm(green - red) > apart:
            break
    else:
        green = np.zeros(2, np.float32)  # ManiSkill's own fallback
    return joints.astype(np.float32), cube(middle + red), cube(middle + green)


MANISKILL_TASKS = (
    TaskSpec(
        name="StackCube",
        suite="maniskill",
        obs_dim=55,
        act_dim=4,
        max_episode_steps=200,
        control="pd_ee_delta_pos: displacement of the gripper in the robot's frame (1 = 10 cm) and its opening, 20 Hz",
        success_rule="the red cube lies on the green one (2 cubes apart at most half a cube sideways, 5 mm in height), "
        "is at rest, and the gripper has let go of it",
        absolute_actions=False,
        make=StackCube,
        summary="A Panda arm must put the red cube on the green one and let go.",
        joints=9,
        rate=20.0,
        held_actions=(3,),
    ),
)
