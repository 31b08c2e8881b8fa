"""A simulation that shows pictures instead of the object's state."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..tasks.spec import TaskSpec
from .cameras import View, view_of
from .mujoco_eyes import MujocoEyes
from .sapien_eyes import SapienEyes

EYES = {"adroit": MujocoEyes, "maniskill": SapienEyes}  # by the task's suite


@dataclass(frozen=True)
class Frame:
    """What a policy is shown at one step; k cameras."""

    rgb: np.ndarray  # (3 k, height, width) uint8, one camera after the other
    depth: np.ndarray  # (k, height, width) uint16, 1/1024 metre, 0 where there is nothing; (0, height, width) without depth
    state: np.ndarray  # (state_dim,) float32, the robot's own


class PixelSim:
    """A task's simulation with its cameras: drawing changes nothing about the trajectory.

    Raises PdkitError where the simulator cannot draw.
    """

    def __init__(self, spec: TaskSpec, view: View | None = None):
        self.view = view or view_of(spec.name)
        # A ManiSkill scene is built with or without what can be drawn; a MuJoCo one can be drawn by whoever reads its data.
        drawing = {"cameras" if spec.plan_view else "render": True} if spec.suite == "maniskill" else {}
        self._sim = spec.make(**drawing)
        self._eyes = EYES[spec.suite](self.view, self._sim)

    def reset(self, seed: int) -> Frame:
        """Start the episode that `seed` names."""
        return self._frame(self._sim.reset(seed))

    def step(self, action: np.ndarray) -> tuple[Frame, bool]:
        """One primitive step with an action (act_dim,); what is seen then, and whether the task is solved at this step."""
        observation, solved = self._sim.step(action)
        return self._frame(observation), solved

    def _frame(self, observation: np.ndarray) -> Frame:
        return Frame(*self._eyes.look(), self.view.robot(observation))

    def close(self) -> None:
        self._sim.close()


def panels(rgb: np.ndarray) -> np.ndarray:
    """The colours (3 k, height, width) of k cameras side by side, as a picture (height, k width, 3)."""
    return np.concatenate([rgb[i: i + 3].transpose(1, 2, 0) for i in range(0, len(rgb), 3)], axis=1)
