"""The scripted expert for PegInsertionSide (ours): grasp the peg near its tail, line it up before the hole, push it in."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .pose_control import CLOSED, OPEN, TOOL, pose_action, turn

X = np.array([1.0, 0.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class _Scene:
    """An observation taken apart; positions in metres."""

    tool: np.ndarray
    tool_turn: Rotation
    peg: np.ndarray
    peg_turn: Rotation
    half_length: float
    hole: np.ndarray
    hole_turn: Rotation

    @classmethod
    def of(cls, observation: np.ndarray) -> _Scene:
        o = observation.astype(np.float64)
        tool, peg, hole = o[TOOL], o[32:39], o[42:49]
        return cls(tool[:3], turn(tool[3:]), peg[:3], turn(peg[3:]), o[39], hole[:3], turn(hole[3:]))

    @property
    def head(self) -> np.ndarray:
        return self.peg + self.peg_turn.apply(X) * self.half_length

    @property
    def grip(self) -> np.ndarray:
        """Where to take the peg: far enough towards the tail that the fingers stay clear of the box."""
        return self.peg - self.peg_turn.apply(X) * max(0.05, self.half_length / 2 + 0.01)

    @property
    def head_in_hole(self) -> np.ndarray:
        """The head seen from the hole, whose x axis leads inwards."""
        return self.hole_turn.inv().apply(self.head - self.hole)

    @property
    def misalignment(self) -> np.ndarray:
        """The rotation vector that would turn the peg into the hole's direction."""
        return (self.hole_turn * self.peg_turn.inv()).as_rotvec()


class PegInsertionSideExpert:
    """A proportional controller from stage to stage, with an integral part while the peg is lined up.

    The controller's targets start from where the arm *is*, so the arm hangs below what proportional control asks for; the hole
    is only 3 mm wider than the peg, which is why the remaining error has to be summed up and pushed against.
    `noise` is the standard deviation of what is added to displacement and rotation (1 is 10 cm and 0.1 rad a step); a tenth of
    it from where the peg is lined up, since 0.1 would already be 1 cm.
    """

    CALM = 0.1  # how much of the noise is left at the hole
    SQUEEZE = 5  # steps for the fingers to close
    STEADY = 3  # steps that the peg must stay lined up
    BEFORE = 0.03  # how far before the hole the peg's head waits, metres
    JAMMED, BACK = 9, 6  # steps without progress; steps of going back then

    def __init__(self, noise: float = 0.0):
        self.noise = noise

    def reset(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._stage, self._waited = "reach", 0
        self._hand = None  # how the hand is held while it grasps, Rotation
        self._forget_errors()

    def act(self, observation: np.ndarray) -> np.ndarray:
        scene = _Scene.of(observation)
        self._advance(scene)
        if self._stage in ("align", "insert"):
            move, turning = self._steer_peg(scene)
        else:
            move, turning = self._steer_hand(scene)
        gripper = OPEN if self._stage in ("reach", "descend") else CLOSED
        noise = self.noise * (self.CALM if self._stage in ("align", "insert") else 1)
        return pose_action(move, turning, gripper, noise, self._rng)

    def _forget_errors(self) -> None:
        self._sum, self._turn_sum = UP * 0.005, np.zeros(3)  # metres, radians; the arm hangs 5 mm low with a peg in its hand
        self._furthest, self._stuck = -np.inf, 0

    def _advance(self, scene: _Scene) -> None:
        """Go on to the next stage where its condition is met; start again with a dropped peg."""
        if self._stage not in ("reach", "descend", "grasp") and np.linalg.norm(scene.tool - scene.grip) > 0.08:
            self._stage, self._hand = "reach", None
        if self._hand is None:
            self._hand = _across(scene)
        if self._stage == "reach":
            above = np.linalg.norm((scene.tool - scene.grip)[:2]) < 0.008
            if above and np.linalg.norm((self._hand * scene.tool_turn.inv()).as_rotvec()) < 0.06:
                self._stage = "descend"
        if self._stage == "descend" and np.linalg.norm(scene.tool - scene.grip) < 0.01:
            self._stage, self._waited = "grasp", 0
        if self._stage == "grasp":
            self._waited += 1
            if self._waited >= self.SQUEEZE:
                self._stage, self._height = "lift", max(scene.peg[2] + 0.06, scene.hole[2])
        if self._stage == "lift" and abs(self._height - scene.peg[2]) < 0.01:
            self._stage, self._waited = "align", 0
            self._forget_errors()
        inwards, sideways, askew = self._errors(scene)
        if self._stage == "align":
            ready = abs(inwards + scene.half_length + self.BEFORE) < 0.02 and sideways < 0.0025 and askew < 0.025
            self._waited = self._waited + 1 if ready else 0
            if self._waited >= self.STEADY:
                self._stage = "insert"
        if self._stage == "insert" and inwards < -scene.half_length - 0.003 and (sideways > 0.006 or askew > 0.06):
            self._stage, self._waited = "align", 0
            self._forget_errors()

    @staticmethod
    def _errors(scene: _Scene) -> tuple[float, float, float]:
        """How far the head is in the hole (negative: before its middle), beside its axis, metres, and how much askew, radians."""
        head = scene.head_in_hole
        return head[0], float(np.linalg.norm(head[1:])), float(np.linalg.norm(scene.misalignment))

    def _steer_hand(self, scene: _Scene) -> tuple[np.ndarray, np.ndarray]:
        """Before the peg is in the air: the hand's own displacement and rotation, in units of the action."""
        turning = 6 * (self._hand * scene.tool_turn.inv()).as_rotvec()
        if self._stage == "grasp":
            return np.zeros(3), turning
        if self._stage == "lift":
            return 8 * UP * (self._height - scene.peg[2]), np.zeros(3)
        return 8 * (scene.grip + UP * (0.08 if self._stage == "reach" else 0) - scene.tool), turning

    def _steer_peg(self, scene: _Scene) -> tuple[np.ndarray, np.ndarray]:
        """Move the hand so that the peg's head goes where it should and the peg turns about its head into the hole's direction."""
        inwards, sideways, askew = self._errors(scene)
        waiting = -(scene.half_length + self.BEFORE)
        goal = waiting if self._stage == "align" else self._push(inwards)
        misalignment = scene.misalignment
        near = self._stage == "insert" or abs(inwards - waiting) < 0.05
        if near and sideways < 0.012 and askew < 0.1:
            beside = scene.head_in_hole * [0, -1, -1]
            self._sum = np.clip(self._sum + 0.15 * scene.hole_turn.apply(beside), -0.03, 0.03)
            self._turn_sum = np.clip(self._turn_sum + 0.06 * misalignment, -0.15, 0.15)
        head = scene.hole + scene.hole_turn.apply(X) * goal
        tool = head + self._sum + Rotation.from_rotvec(misalignment).apply(scene.tool - scene.head)
        gain = 6 if self._stage == "insert" else 5 if abs(inwards - waiting) < 0.03 else 8
        return gain * (tool - scene.tool), 6 * (misalignment + self._turn_sum)

    def _push(self, inwards: float) -> float:
        """Where along the hole the head should go next, metres: on, or back for some steps where the peg has jammed."""
        if inwards > self._furthest + 0.001:
            self._furthest, self._stuck = inwards, 0
        else:
            self._stuck += 1
        if self._stuck >= self.JAMMED:
            self._stuck = -self.BACK
        if self._stuck < 0:
            self._furthest = inwards
            return inwards - 0.03
        return inwards + 0.03  # faster, it would not be straightened in time


def _across(scene: _Scene) -> Rotation:
    """The hand pointing down, its fingers on the peg's two sides, on the nearer way round."""
    side = scene.peg_turn.apply([0.0, 1.0, 0.0]) * [1, 1, 0]
    side /= np.linalg.norm(side)
    if side @ scene.tool_turn.apply([0.0, 1.0, 0.0]) < 0:
        side = -side
    return Rotation.from_matrix(np.stack([np.cross(side, -UP), side, -UP], axis=1))
