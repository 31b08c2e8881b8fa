"""What the scripted experts of `pd_ee_delta_pose` tasks share: from a step wanted in metres and radians to an action."""
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

OPEN, CLOSED = 1.0, -1.0
TOOL = slice(25, 32)  # pose of the tool centre point within an observation


def turn(quaternion: np.ndarray) -> Rotation:
    """A rotation from (w, x, y, z)."""
    return Rotation.from_quat(quaternion, scalar_first=True)


def pose_action(move: np.ndarray, turning: np.ndarray, gripper: float, noise: float, rng: np.random.Generator) -> np.ndarray:
    """The action (7,), float32, for a displacement in units of 10 cm, a rotation vector in units of 0.1 rad, both in the robot's
    frame, and the gripper.

    Too long a step is shortened, not bent. `noise` is the standard deviation of what is added to each of the six numbers.
    Rotations change their sign because ManiSkill 3.0.1 turns the other way.
    """
    move = move / max(1.0, np.abs(move).max())
    turning = -turning / max(1.0, np.linalg.norm(turning))
    if noise:
        move, turning = move + rng.normal(0, noise, 3), turning + rng.normal(0, noise, 3)
    return np.clip([*move, *turning, gripper], -1, 1).astype(np.float32)
