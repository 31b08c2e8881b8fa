"""How smooth a motion is, from what an evaluation sees anyway: the actions and the robot's joint positions.

Neither number says how well a task is done: standing still is perfectly smooth. They stand beside success.
"""
from __future__ import annotations

import numpy as np

from .tasks.spec import TaskSpec


def action_change(actions: np.ndarray) -> float:
    """Root mean square of a_t - a_(t-1) over an episode's steps and dimensions; actions (T, act_dim) in [-1, 1]. 0 for one step."""
    return float(np.sqrt(np.mean(np.square(np.diff(actions, axis=0))))) if len(actions) > 1 else 0.0


def jerk(joints: np.ndarray, rate: float) -> float:
    """Mean length of the joints' third derivative over an episode, in rad/s^3 (fingers that slide: m/s^3).

    NaN below four positions or without joints.
    `joints` (T + 1, n) are positions `rate` times a second; the derivative is the third difference, as in Flash and Hogan's
    minimum-jerk criterion (1985), which integrates its square.
    """
    if len(joints) < 4 or not joints.shape[1]:
        return float("nan")
    return float(np.linalg.norm(np.diff(joints.astype(np.float64), n=3, axis=0), axis=1).mean() * rate**3)


class Motions:
    """Collects what each of N lanes does until its episode ends.

    Joint positions are known where the windows reach back over a whole decision (`window` at least `chunk`); elsewhere jerk is NaN.
    """

    def __init__(self, spec: TaskSpec, windows: np.ndarray):
        self.spec = spec
        self.actions: list[list[np.ndarray]] = [[] for _ in windows]
        self.joints = [self._joints(window[-1:]) for window in windows]

    def _joints(self, window: np.ndarray) -> list[np.ndarray]:
        return list(window[:, : self.spec.joints].copy())

    def add(self, actions: np.ndarray, steps: np.ndarray, final_windows: np.ndarray) -> None:
        """One decision: `actions` (N, chunk, act_dim), of which lane i took the first steps[i] and then saw final_windows[i]."""
        for i in np.flatnonzero(steps):
            self.actions[i] += list(np.clip(actions[i, : steps[i]], -1, 1))
            self.joints[i] += self._joints(final_windows[i, -steps[i]:])

    def end(self, lane: int, window: np.ndarray) -> dict[str, float]:
        """action_change and jerk of the lane's episode, which is over; `window` is the next one's first."""
        actions, joints = np.stack(self.actions[lane]), np.stack(self.joints[lane])
        self.actions[lane], self.joints[lane] = [], self._joints(window[-1:])
        known = len(joints) == len(actions) + 1
        return {"action_change": action_change(actions), "jerk": jerk(joints, self.spec.rate) if known else float("nan")}
