"""The scripted expert of PushChair (ours): roll round the chair to its far side, push it home with the torso, let it come to rest."""
from __future__ import annotations

import numpy as np


class PushChairExpert:
    """Pushes with the base alone; arms and height stay as they are.

    `noise` is the standard deviation of what is added to the base's three velocities (1 is 0.5 m/s and 3.14 rad/s), for
    demonstrations that also show how to recover.
    """

    BASE, HEADING = slice(38, 40), 40  # place on the floor and angle within the observation
    CHAIR, MOTION = slice(44, 46), slice(51, 53)  # the chair's place on the floor and its velocity
    SPEED, TURNING = 0.5, 3.14  # metres and radians a second that an action of 1 means
    RADIUS = 0.64  # metres from the chair's middle at which the robot goes round it
    HOME = 0.14  # metres from the target at which pushing ends: the chair hardly rolls on
    BESIDE = 0.35  # radians off the way home at which the chair is not pushed any further

    def __init__(self, noise: float = 0.0):
        self.noise = noise

    def reset(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._stage = "round"

    def act(self, observation: np.ndarray) -> np.ndarray:
        base, chair, motion = (observation[part].astype(np.float64) for part in (self.BASE, self.CHAIR, self.MOTION))
        away = base - chair  # from the chair to the robot
        distance, far = np.linalg.norm(away), np.linalg.norm(chair)  # of the robot from the chair, of the chair from home
        around = _wrapped(_angle(chair) - _angle(away))  # still to go round the chair, to be behind it on its way home
        self._advance(around, distance, far, motion)
        velocity = self._velocity(away, distance, -chair / max(far, 1e-6), far, around)
        heading = float(observation[self.HEADING])
        cosine, sine = np.cos(heading), np.sin(heading)
        action = np.zeros(20)
        action[0] = (cosine * velocity[0] + sine * velocity[1]) / self.SPEED
        action[1] = (cosine * velocity[1] - sine * velocity[0]) / self.SPEED
        action[2] = 3 * _wrapped(_angle(-away) - heading) / self.TURNING  # always look at the chair
        if self.noise:
            action[:3] += self._rng.normal(0, self.noise, 3)
        return np.clip(action, -1, 1).astype(np.float32)

    def _advance(self, around: float, distance: float, far: float, motion: np.ndarray) -> None:
        """Go on to the next stage, or go round again where the chair was pushed past or has slipped away sideways."""
        if self._stage == "round" and abs(around) < 0.12 and distance < 0.85:
            self._stage = "push"
        if self._stage == "push":
            if far < self.HOME:
                self._stage = "rest"
            elif abs(around) > 0.6 and far > 0.15:
                self._stage = "round"
        if self._stage == "rest" and far > 0.15 and np.linalg.norm(motion) < 0.05:
            self._stage = "round"

    def _velocity(self, away: np.ndarray, distance: float, home: np.ndarray, far: float, around: float) -> np.ndarray:
        """How the base should move on the floor (2,), metres a second; `home` points from the chair to the target."""
        if self._stage == "round":
            outward = away / distance
            sideways = np.array([-outward[1], outward[0]])
            return self.SPEED * np.clip(3 * around, -1, 1) * sideways - 2 * (distance - self.RADIUS) * outward
        if self._stage == "push":
            speed = 0.5 if far > 0.5 else 0.3 if far > 0.3 else 0.17
            return speed * max(0.0, 1 - abs(around) / self.BESIDE) * home - 2.5 * (away - (away @ home) * home)
        return -0.25 * home if distance < 0.6 else np.zeros(2)


def _angle(direction: np.ndarray) -> float:
    return float(np.arctan2(direction[1], direction[0]))


def _wrapped(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi
