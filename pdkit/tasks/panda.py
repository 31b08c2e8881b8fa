"""The Panda arm of a ManiSkill scene, driven without torch: both end-effector control modes, and what its fingers hold."""
from __future__ import annotations

from typing import Any

import numpy as np

from . import quaternions


class Panda:
    """The Panda arm of a ManiSkill scene under `pd_ee_delta_pos` or `pd_ee_delta_pose`.

    An action is a displacement (3,) of the tool centre point in the frame of the base (1 means 10 cm), under
    `pd_ee_delta_pose` a rotation (3,) about the axes of that frame (1 means 0.1 rad, no more than that altogether), and
    an opening of the gripper (-1 closed, 1 open). ManiSkill 3.0.1 scales rotations by the *lower* bound of their range,
    -0.1: a positive number turns the hand clockwise, seen against the axis. That is kept.
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
        self._turn_scale = getattr(arm.config, "rot_lower", None)  # None: the hand keeps its orientation
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
        if self._turn_scale is not None:
            delta = quaternions.limited(action[3:6]) * np.float32(self._turn_scale)
            turn = quaternions.multiply(quaternions.from_small_angles(delta), turn)
        there = self._pose_type(position + (self._reach[0] + self._reach[1] * action[:3]), turn)
        joints = self.robot.qpos
        solution, reached, _ = self._model.compute_inverse_kinematics(
            self._tool_index, there, initial_qpos=joints, active_qmask=self._mask, max_iterations=100
        )
        for joint, target in zip(self._arm, (solution if reached else joints)[:7], strict=True):
            joint.set_drive_target(target)
        opening = (self._opening[0] + self._opening[1] * action[-1])[0]
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
    """How a controller scales actions from [-1, 1]: the middle and half the width of its range (of positions)."""
    low, high = controller.action_space_low.numpy()[:3], controller.action_space_high.numpy()[:3]
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
