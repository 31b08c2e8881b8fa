"""ManiSkill 3's random numbers for a seed, drawn without its batched tensors: the same generators, order and roundings."""
from __future__ import annotations

import numpy as np

from .quaternions import about_z


class Draws:
    """What ManiSkill draws with torch while it initialises an episode, from a generator of its own."""

    def __init__(self, seed: int):
        import torch

        self._torch, self._generator = torch, torch.Generator().manual_seed(int(seed))

    def _random(self, count: int) -> np.ndarray:
        return self._torch.rand(count, generator=self._generator).numpy()

    def uniform(self, low: list[float], high: list[float]) -> np.ndarray:
        """Numbers between `low` and `high`, float32 (len(low),), as `randomization.uniform` draws them."""
        low, high = np.float32(low), np.float32(high)
        return self._random(len(low)) * (high - low) + low

    def turn(self, low: float, high: float) -> np.ndarray:
        """A quaternion (4,) about the z axis, as `randomization.random_quaternions` draws it: three angles, two dropped."""
        return about_z(self._random(3)[2] * np.float32(high - low) + np.float32(low))


def noisy_joints(rng: np.random.RandomState, wrist: float) -> np.ndarray:
    """Joint positions (9,) about the arm's rest pose, the gripper open, as `TableSceneBuilder.initialize` draws them.

    `wrist` is the last joint's rest angle, radians; it depends on how the hand is mounted.
    """
    rest = np.array([0, np.pi / 8, 0, -np.pi * 5 / 8, 0, np.pi * 3 / 4, wrist, 0.04, 0.04])
    joints = rng.normal(0, 0.02, (1, 9))[0] + rest
    joints[-2:] = 0.04
    return joints.astype(np.float32)
