"""The scripted expert for TurnFaucet (ours): push a lever, fin or bar of the handle round with closed fingers."""
from __future__ import annotations

from typing import Any

import numpy as np

from .pose_control import CLOSED, TOOL, pose_action, turn

UP = np.array([0.0, 0.0, 1.0])
ANGLE_LEFT = 39  # where an observation tells how far the handle still has to go, radians


class TurnFaucetExpert:
    """Go over the handle, down behind it, and push along its circle; come from above again where the handle stops turning.

    It knows more than the observation shows, which names neither where the handle's axis is nor its shape: it looks at the handle in
    the simulation. `noise` is the standard deviation of what is added to displacement and rotation (1 is 10 cm and 0.1 rad a step).
    """

    ABOVE = 0.09  # metres over the place behind the handle
    BEHIND = 0.022  # metres from the middle of a bar to that of the closed fingers that touch it
    AHEAD = 0.09  # how far beyond the place of contact the hand aims while it pushes, metres
    TRIES = ((0.78, 0.045), (0.65, 0.06), (0.90, 0.04), (0.55, 0.07), (0.80, 0.05))  # where on the bar, and how far behind it to go down
    STUCK_DOWN, STUCK_PUSH = 40, 25  # steps after which it goes on, or comes again

    def __init__(self, noise: float = 0.0):
        self.noise = noise

    def watch(self, sim: Any) -> None:
        self._sim = sim

    def reset(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._stage, self._waited, self._try, self._least = "over", 0, 0, np.inf
        self._bar = self._held = None  # which corners are the end of the bar that is pushed; how the hand was held at first

    def act(self, observation: np.ndarray) -> np.ndarray:
        tool, hand = observation[TOOL][:3].astype(np.float64), turn(observation[TOOL][3:])
        if self._held is None:
            self._held = hand
        contact, onwards = self._contact()
        behind = contact - onwards * self.TRIES[self._try][1]
        target = self._target(tool, contact, behind, onwards, float(observation[ANGLE_LEFT]))
        return pose_action(8 * (target - tool), 5 * (self._held * hand.inv()).as_rotvec(), CLOSED, self.noise, self._rng)

    def _target(self, tool: np.ndarray, contact: np.ndarray, behind: np.ndarray, onwards: np.ndarray, left: float) -> np.ndarray:
        """Where the hand should go now, metres; goes on to the next stage where its condition is met."""
        over = behind + UP * self.ABOVE
        if self._stage == "over" and np.linalg.norm(tool - over) < 0.03:
            self._stage, self._waited = "down", 0
        if self._stage == "down":
            self._waited += 1
            there = np.linalg.norm((tool - behind)[:2]) < 0.02 and abs(tool[2] - behind[2]) < 0.01
            if there or self._waited > self.STUCK_DOWN:
                self._stage, self._waited, self._least = "push", 0, left
        if self._stage == "push":
            self._waited += 1
            if left < self._least - 0.03:
                self._least, self._waited = left, 0
            if self._waited > self.STUCK_PUSH:
                self._stage, self._try = "over", (self._try + 1) % len(self.TRIES)
        return {"over": over, "down": behind, "push": contact + onwards * self.AHEAD}[self._stage]

    def _contact(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the closed fingers touch the bar from behind, metres, and the direction (3,) in which it moves there."""
        handle = self._sim.handle()
        from_axis = handle.corners - handle.origin
        along = from_axis @ handle.axis
        outwards = from_axis - along[:, None] * handle.axis
        if self._bar is None:
            self._bar = _best_bar(outwards, handle.axis)
        arm = outwards[self._bar].mean(axis=0)
        onwards = np.cross(handle.axis, arm / np.linalg.norm(arm))
        middle = handle.origin + along[self._bar].mean() * handle.axis
        return middle + self.TRIES[self._try][0] * arm - self.BEHIND * onwards, onwards


def _best_bar(outwards: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The corners, bool (N,), at the end of the bar that is best pushed: away from the robot, and not from behind the faucet.

    `outwards` (N, 3) are the corners seen from the axis; those far out belong to ends of bars, those within 30 degrees to one end.
    """
    radius = np.linalg.norm(outwards, axis=1)
    far = radius > 0.85 * radius.max()
    directions = outwards / np.maximum(radius, 1e-9)[:, None]
    scores = np.cross(axis, directions)[:, 0] - 0.3 * directions[:, 0]
    best = directions[far][np.argmax(scores[far])]
    return far & (directions @ best > np.cos(np.pi / 6))
