"""The scripted expert for PegInsertionSide: grasp the peg near its tail, line it up before the hole, push it in."""
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
    opening: float  # how far each finger is from the middle
    peg: np.ndarray
    peg_turn: Rotation
    half_length: float
    radius: float
    hole: np.ndarray
    hole_turn: Rotation

    @classmethod
    def of(cls, observation: np.ndarray) -> _Scene:
        o = observation.astype(np.float64)
        tool, peg, hole = o[TOOL], o[32:39], o[42:49]
        return cls(tool[:3], turn(tool[3:]), o[7:9].mean(), peg[:3], turn(peg[3:]), o[39], o[40], hole[:3], turn(hole[3:]))

    @property
    def head(self) -> np.ndarray:
        return self.peg + self.peg_turn.apply(X) * self.half_length

    @property
    def grip(self) -> np.ndarray:
        """Where to take the peg: far enough towards the tail that the fingers stay clear of the box."""
        return self.peg - self.peg_turn.apply(X) * max(0.05, self.half_length / 2 + 0.01)

    @property
    def held(self) -> bool:
        """Whether the peg is between the fingers."""
        return bool(np.linalg.norm(self.tool - self.grip) < 0.025 and self.opening < self.radius + 0.0025)

    @property
    def head_in_hole(self) -> np.ndarray:
        """The head seen from the hole, whose x axis leads inwards."""
        return self.hole_turn.inv().apply(self.head - self.hole)

    @property
    def misalignment(self) -> np.ndarray:
        """The rotation vector that would turn the peg into the hole's direction."""
        return (self.hole_turn * self.peg_turn.inv()).as_rotvec()


class PegInsertionSideExpert:
    """A proportional controller whose action is a function of the observation alone.

    It remembers no stage and sums up no error, because a policy that sees one observation could imitate neither: it would stop
    between two stages. What would need the sum is known beforehand: the controller's targets start from where the arm *is*, so
    the arm comes to rest a few millimetres below what proportional control asks for, and the hole is only 3 mm wider than the peg.
    `noise` is the standard deviation of what is added to displacement and rotation (1 is 10 cm and 0.1 rad a step); a tenth of
    it where the peg is lined up and pushed in, since 0.1 would already be 1 cm.
    """

    CALM = 0.1  # how much of the noise is left at the hole
    BEFORE = 0.03  # how far before the hole the peg's head is lined up, metres
    ABOVE = 0.08  # how far over the peg the hand is until it is in place, metres
    GAIN, TURN_GAIN = 6, 6  # of the peg; actions per metre or radian still to go
    HANG = np.array([0.015, 0.0, 0.025])  # what keeps the arm from hanging, in actions; measured
    TURN_HANG = np.array([0.0, -0.054, 0.0])

    def __init__(self, noise: float = 0.0):
        self.noise = noise

    def reset(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def act(self, observation: np.ndarray) -> np.ndarray:
        scene = _Scene.of(observation)
        return self._carry(scene) if scene.held else self._fetch(scene)

    def _fetch(self, scene: _Scene) -> np.ndarray:
        """Over the peg's tail, turning the fingers to its sides; then down; then close them."""
        away = scene.tool - scene.grip
        turning = (_across(scene) * scene.tool_turn.inv()).as_rotvec()
        if np.linalg.norm(away) < 0.012:
            return pose_action(np.zeros(3), 6 * turning, CLOSED, self.noise, self._rng)
        in_place = min(_fades(np.linalg.norm(away[:2]), 0.006, 0.02), _fades(np.linalg.norm(turning), 0.05, 0.2))
        return pose_action(8 * (UP * self.ABOVE * (1 - in_place) - away), 6 * turning, OPEN, self.noise, self._rng)

    def _carry(self, scene: _Scene) -> np.ndarray:
        """Up to the hole's height; before the hole, turning into its direction; in, as far as the peg is straight."""
        inwards, beside = scene.head_in_hole[0], np.linalg.norm(scene.head_in_hole[1:])
        waiting = -(scene.half_length + self.BEFORE)
        outside = inwards < -scene.half_length - 0.005 or beside > 0.006  # so far beside the axis it is jammed on the face
        straight = min(_fades(beside, 0.002, 0.005), _fades(np.linalg.norm(scene.misalignment), 0.02, 0.06))
        raised = _fades(abs(scene.hole[2] - scene.peg[2]), 0.01, 0.04) if outside else 1.0
        goal = inwards + 0.03
        if outside:
            goal = waiting + (goal - waiting) * straight * (inwards > waiting - 0.02)
        misalignment = scene.misalignment * raised
        head = scene.hole + scene.hole_turn.apply(X) * goal
        move = head + Rotation.from_rotvec(misalignment).apply(scene.tool - scene.head) - scene.tool  # the peg turns about its head
        move = raised * move + (1 - raised) * UP * (scene.hole[2] - scene.peg[2])
        noise = self.noise * (self.CALM if abs(inwards - waiting) < 0.05 or not outside else 1)
        return pose_action(self.GAIN * move + self.HANG, self.TURN_GAIN * misalignment + self.TURN_HANG, CLOSED, noise, self._rng)


def _fades(x: float, full: float, none: float) -> float:
    """1 up to `full`, 0 from `none` on, falling linearly between them."""
    return float(np.clip((none - x) / (none - full), 0, 1))


def _across(scene: _Scene) -> Rotation:
    """The hand pointing down, its fingers on the peg's two sides, on the nearer way round."""
    side = scene.peg_turn.apply([0.0, 1.0, 0.0]) * [1, 1, 0]
    side /= np.linalg.norm(side)
    if side @ scene.tool_turn.apply([0.0, 1.0, 0.0]) < 0:
        side = -side
    return Rotation.from_matrix(np.stack([np.cross(side, -UP), side, -UP], axis=1))
