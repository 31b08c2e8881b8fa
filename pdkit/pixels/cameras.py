"""What the cameras of a task see, and which part of its state observation stays beside the pictures (appendix A; facts.md 1.6).

The paper: one 64 x 64 RGBD picture from a base camera and one from a hand camera (StackCube, PegInsertionSide, TurnFaucet), three of
50 x 125 from the robot's own mast (PushChair), one 128 x 128 RGB picture from a third-person view (Adroit). Where the Adroit camera
stood is not known; ours are those of the kit's videos. The state is the robot's own, as its sensors would tell it, never an object's:
for Adroit the joint positions; for the Panda also velocities, base and tool pose, and for TurnFaucet which handle is to be turned how
far, which no picture shows (so does ManiSkill 2, whose observation beside pictures is the tool's pose and that).
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import PdkitError
from ..tasks import TASKS

# Adroit's cameras: hand and object are seen throughout; the environments' own cut off the door, or stand far away.
CAMERAS = {
    "Door": {"distance": 1.25, "azimuth": 55.0, "elevation": -35.0, "lookat": np.array([0.08, -0.12, 0.27])},
    "Pen": {"distance": 0.7, "azimuth": 45.0, "elevation": -40.0, "lookat": np.array([0.0, -0.15, 0.25])},
    "Hammer": {"distance": 0.9, "azimuth": 45.0, "elevation": -30.0, "lookat": np.array([0.0, -0.1, 0.2])},
    "Relocate": {"distance": 1.1, "azimuth": 60.0, "elevation": -30.0, "lookat": np.array([0.0, -0.1, 0.25])},
}


@dataclass(frozen=True)
class View:
    """What a policy of one task sees."""

    task: str
    cameras: tuple[str, ...]  # their names, in the order of the channels
    height: int  # pixels
    width: int
    depth: bool  # a distance for each pixel beside its colour
    state: tuple[tuple[int, int], ...]  # ranges [start, stop) of the state observation that stay beside the pictures
    shift: int  # pixels by which pictures are shifted at random in imitation; 0: not (facts.md 2.2)

    @property
    def channels(self) -> int:
        """Of all cameras together: three colours each, then a distance each."""
        return len(self.cameras) * (4 if self.depth else 3)

    @property
    def state_dim(self) -> int:
        return sum(stop - start for start, stop in self.state)

    @property
    def bytes(self) -> int:
        """Of one frame as it is kept: a byte a colour, two a distance."""
        return self.height * self.width * len(self.cameras) * (5 if self.depth else 3)

    def robot(self, observations: np.ndarray) -> np.ndarray:
        """The robot's part (..., state_dim) of state observations (..., obs_dim), float32."""
        return np.concatenate([observations[..., start:stop] for start, stop in self.state], axis=-1, dtype=np.float32)


_PANDA = (0, 32)  # joint positions and velocities, base pose, tool pose (pdkit/tasks/maniskill.py)


def _arm(task: str, state: tuple[int, int] = _PANDA, shift: int = 0) -> View:
    return View(task, ("base", "hand"), 64, 64, True, (state,), shift)


def _mast(task: str) -> View:
    return View(task, ("mast 1", "mast 2", "mast 3"), 50, 125, True, ((0, 44), (107, 131)), 0)  # not the chair, 44 to 106


def _hand(task: str) -> View:
    return View(task, ("third person",), 128, 128, False, ((0, TASKS[task].joints),), 4)  # the shift is ours, as large for its size


VIEWS: dict[str, View] = {view.task: view for view in (
    _arm("StackCube"), _arm("PegInsertionSide"), _arm("TurnFaucet", (0, 39), 2), _arm("TurnFaucetSource", (0, 39), 2),
    _mast("PushChair"), _mast("PushChairSource"), *map(_hand, CAMERAS))}


def view_of(task: str) -> View:
    """What a policy of this task sees. Raises PdkitError where no cameras are set up."""
    if task not in VIEWS:
        raise PdkitError(f"No cameras are set up for {task!r}; choose one of: {', '.join(VIEWS)}.")
    return VIEWS[task]
