"""The dual-arm mobile Panda without torch: drive targets from an action, and what the robot contributes to an observation.

The robot and its controllers are built by ManiSkill (`chair_env.py`); this does what they do to the same SAPIEN joints.
"""
from __future__ import annotations

from typing import Any

import numpy as np

CONTROL = "base_pd_joint_vel_arm_pd_joint_vel"
BASE_JOINTS = ("root_x_axis_joint", "root_y_axis_joint", "root_z_rotation_joint", "linear_actuator_height")
SIDES = ("right", "left")  # in the order of observations
ACTING = ("left", "right")  # in the order of actions (ManiSkill 2)
ARM_REST = (0, 0, 0, -1.5, 0, 3, 0.78, 0.02, 0.02)  # seven joints and two fingers of an arm when an episode starts
# The finger tips: metres along y of these joints' frames.
TIP_JOINTS = [(f"{side}_panda_{name}", along) for side in SIDES for name, along in (("finger_joint2", 0.035), ("finger_joint1", -0.035))]


def arm_joints(side: str) -> list[str]:
    return [f"{side}_panda_joint{index}" for index in range(1, 8)]


def finger_joints(side: str) -> list[str]:
    return [f"{side}_panda_finger_joint{index}" for index in (1, 2)]


JOINTS = [*BASE_JOINTS, *(name for side in SIDES for name in (*arm_joints(side), *finger_joints(side)))]
FINGERS = [f"{side}_panda_{finger}finger" for side in SIDES for finger in ("left", "right")]  # links; joint 1 moves the left one


def joint_order(robot: Any) -> list[int]:
    """Where each of JOINTS is among the robot's joints: PhysX goes through both arms at once."""
    names = [joint.name for joint in robot.active_joints]
    return [names.index(name) for name in JOINTS]


def first_joints(base: np.ndarray, order: list[int]) -> np.ndarray:
    """Joint positions (22,) where an episode begins, in PhysX's order: the base at (x, y, heading, height), the arms at rest."""
    positions = np.empty(len(JOINTS), np.float32)
    positions[order] = [*base, *ARM_REST, *ARM_REST]
    return positions


class MobilePanda:
    """The robot of a PushChair scene.

    An action (20,) sets velocities and openings, 1 meaning: 0.5 m/s forwards and to the left, 3.14 rad/s of turning and 0.5 m/s of
    rising for the base; then for the left arm 3.14 rad/s for each of its seven joints and 4 cm for its fingers (-1: closed, with
    force); then the same for the right arm.
    """

    def __init__(self, env: Any):
        import sapien
        import torch

        robot = env.agent.robot
        self.robot = robot._objs[0]
        joints = {name: joint._objs[0] for name, joint in robot.active_joints_map.items()}
        self._order = joint_order(robot)
        self._base = [joints[name] for name in BASE_JOINTS]
        self._arms = [[joints[name] for name in arm_joints(side)] for side in ACTING]
        self._grippers = [[joints[name] for name in finger_joints(side)] for side in ACTING]
        self._tips = [(joints[name], sapien.Pose([0, along, 0])) for name, along in TIP_JOINTS]
        self._fingers = [robot.links_map[name]._objs[0] for name in FINGERS]
        parts = env.agent.controller.controllers.values()
        low, high = (np.concatenate([getattr(part, f"action_space_{end}").numpy() for part in parts]) for end in ("low", "high"))
        self._heading = torch.zeros(1)  # numpy's sine and ManiSkill's, which is torch's, differ in the last bit
        half = np.float32(0.5)
        self._middle, self._half = half * (high + low), half * (high - low)

    def place(self, base: np.ndarray) -> None:
        """Put the base at (x, y, heading, height), the arms at rest, everything still."""
        still = np.zeros(len(JOINTS), np.float32)
        self.robot.set_qpos(first_joints(base, self._order))
        self.robot.set_qvel(still)
        self.robot.set_qf(still)

    def drive(self, action: np.ndarray) -> None:
        """Set the joints' targets for an action (20,), clipped to [-1, 1]."""
        targets = self._middle + self._half * np.minimum(np.maximum(np.asarray(action, np.float32), -1), 1)
        self._heading[0] = float(self.robot.qpos[self._order[2]])
        cosine, sine = self._heading.cos().numpy()[0], self._heading.sin().numpy()[0]
        forward, left = targets[:2]
        targets[:2] = cosine * forward - sine * left, sine * forward + cosine * left
        for joint, target in zip(self._base, targets[:4], strict=True):
            joint.set_drive_velocity_target(target)
        for arm, gripper, at in zip(self._arms, self._grippers, (4, 12), strict=True):
            for joint, target in zip(arm, targets[at : at + 7], strict=True):
                joint.set_drive_velocity_target(target)
            for joint in gripper:
                joint.set_drive_target(targets[at + 7])

    def proprioception(self) -> list[np.ndarray]:
        """Joint positions (19,) and velocities (19,) without the floor's three, then where the base is (x, y), its heading, and
        the velocities of both."""
        positions, velocities = self.robot.qpos[self._order], self.robot.qvel[self._order]
        return [positions[3:], velocities[3:], positions[:3], velocities[:3]]

    def fingers(self) -> list[np.ndarray]:
        """Places of the four finger tips and velocities of the four fingers, three numbers each, right hand first.

        Within a hand the tips come second finger first, the velocities first finger first, as in ManiSkill 2.
        """
        places = [(joint.global_pose * along).p for joint, along in self._tips]
        return [*places, *(link.linear_velocity for link in self._fingers)]
