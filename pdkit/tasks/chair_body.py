"""A chair within a SAPIEN scene: how an episode begins, where the chair is put, what is seen of it, and when it counts as pushed home."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import PdkitError
from .chair_assets import Chair

ROOM = 25  # joints that an observation has room for (ManiSkill 2)
CLOSE = 0.15  # metres from the origin
UPRIGHT = 0.05 * np.pi  # radians off the vertical
STILL = (0.1, 0.2 * np.pi)  # metres and radians a second (ManiSkill 2 divides its angles by pi)
HZ = 20  # steps a second


@dataclass(frozen=True)
class Start:
    """How an episode begins."""

    chair: int  # which of the chairs
    place: np.ndarray  # (2,) of the chair, metres
    facing: float  # the way that the chair faces, radians
    base: np.ndarray  # (4,) x, y, heading and height of the robot
    frictions: np.ndarray  # (ROOM, 2) friction and damping of a castor, in SAPIEN's units, as many as are needed
    swivel: np.ndarray  # (2,) friction and damping of the joint below the seat


def chair_start(seed: int, count: int) -> Start:
    """What `seed` decides, with `count` chairs: ManiSkill 2's distributions, drawn from a generator of our own.

    The chair stands 0.8 to 1.2 m from the origin and faces it within 72 degrees; the robot stands 0.8 to 1.2 m behind the chair,
    within 36 degrees, and looks at it within 9.
    """
    rng = np.random.default_rng(seed)
    chair = int(rng.integers(count))
    far, around, turned = rng.uniform((0.8, -np.pi, -0.4 * np.pi), (1.2, np.pi, 0.4 * np.pi))
    apart, aside, askew = rng.uniform((0.8, -0.2 * np.pi, -0.05 * np.pi), (1.2, 0.2 * np.pi, 0.05 * np.pi))
    place = far * _towards(around)
    facing = around + np.pi + turned
    behind = facing + np.pi + aside
    base = np.append(place + apart * _towards(behind), (behind + np.pi + askew, 0.9))
    base[2] = (base[2] + np.pi) % (2 * np.pi) - np.pi
    return Start(chair, place, facing, base, rng.uniform(0, (0.1, 0.5), (ROOM, 2)), rng.uniform((0.05, 5), (0.15, 15)))


def _towards(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


class ChairBody:
    """The chair of a scene, as SAPIEN's articulation."""

    def __init__(self, articulation: Any, chair: Chair, seat: Any):
        """`seat` is the link that carries the seat; the chair is put at rest to see which way it faces then.

        Raises PdkitError for a chair that has not the joints it should have.
        """
        import sapien

        self._articulation, self._pose = articulation, sapien.Pose
        self._joints = list(articulation.active_joints)
        if len(self._joints) > ROOM or len(chair.joints) not in (0, len(self._joints)):
            raise PdkitError(f"Chair {chair.model.name} has {len(self._joints)} joints where {len(chair.joints) or f'at most {ROOM}'} are "
                             "expected; put PartNet-Mobility's own description in its place.")
        self._rest = np.array(chair.joints or np.zeros(len(self._joints)), np.float32)
        self._height, self._rest_turn = chair.position[2], sapien.Pose(q=chair.rotation)
        articulation.set_root_pose(sapien.Pose(chair.position, chair.rotation))
        articulation.set_qpos(self._rest)
        # PartNet's seats look along their -y once the Euler angles about x and y are taken off (ManiSkill 2).
        forward = seat.entity_pose.to_transformation_matrix()
        self._facing = np.arctan2(forward[1, 0], forward[0, 0]) - np.pi / 2

    def start(self, start: Start) -> tuple[Any, np.ndarray]:
        """Where an episode begins: the root link's pose, SAPIEN's, and the joints' positions (n,), radians."""
        half = (start.facing - self._facing) / 2
        turned = self._pose([*start.place, self._height], [np.cos(half), 0, 0, np.sin(half)])
        return turned * self._rest_turn, self._rest

    def place(self, start: Start) -> None:
        """Put the chair, at rest, where an episode begins, with that episode's frictions."""
        body, none = self._articulation, np.zeros(3, np.float32)
        pose, joints = self.start(start)
        body.set_root_pose(pose)
        body.set_qpos(joints)
        body.set_root_linear_velocity(none)
        body.set_root_angular_velocity(none)
        still = np.zeros(len(self._rest), np.float32)
        body.set_qvel(still)
        body.set_qf(still)
        body.root.put_to_sleep()  # as maniskill.place_body does, and for the same reason
        body.root.wake_up()
        set_frictions(self._joints, start)

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """Place (3,) and quaternion (4,) of the root link."""
        pose = self._articulation.root_pose
        return pose.p, pose.q

    def state(self) -> np.ndarray:
        """What an observation holds of the chair: (63,)."""
        body, root, count = self._articulation, self._articulation.root, len(self._rest)
        state = np.zeros(13 + 2 * ROOM, np.float32)
        state[:3], state[3:7] = self.root
        state[7:10], state[10:13] = root.linear_velocity, root.angular_velocity
        state[13 : 13 + count], state[13 + ROOM : 13 + ROOM + count] = body.qpos, body.qvel
        return state


def set_frictions(joints: Sequence[Any], start: Start) -> None:
    """Give a chair's active joints, SAPIEN's, the friction and damping of an episode."""
    for joint, castor in zip(joints, start.frictions, strict=False):
        friction, damping = start.swivel if "helper" in joint.parent_link.name else castor
        joint.set_friction(friction)
        joint.set_drive_properties(0, damping)


def solved(before: tuple[np.ndarray, np.ndarray], now: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether the chair counts as pushed home, from place (3,) and quaternion (4,) of its root link a step ago and now.

    Close to the origin, standing and static; static is judged by how far it moved and turned within the step, as in the paper's
    PushChair-v2.
    """
    (old_place, old_turn), (place, turn) = before, now
    if np.hypot(place[0], place[1]) >= CLOSE:
        return False
    if np.arccos(np.clip(1 - 2 * (turn[1] ** 2 + turn[2] ** 2), -1, 1)) >= UPRIGHT:
        return False
    moved, turned = np.linalg.norm(place - old_place), 2 * np.arccos(min(abs(old_turn @ turn), 1))
    return bool(moved <= STILL[0] / HZ and turned <= STILL[1] / HZ)
