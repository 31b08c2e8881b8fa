"""The derived task for online RL: a simulation that draws, encodes with a frozen encoder and shows the robot's state and features.

    observation   the robot's own state, then 256 features of the frame: a flat vector like any other
    so            replay, critic, residual, decorator, evaluation and recording work as they are; no picture is ever stored

That is what the paper's code does (facts.md 1.3): residual and critic see the frozen base encoder's features and the latest state.
"""
from __future__ import annotations

import copy
import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PdkitError
from ..files import atomic_folder
from ..policies import Policy, save_policy
from ..tasks.spec import TaskSpec
from ..torch_setup import one_thread
from .cameras import VIEWS
from .encoders import FEATURES, Encoder, load_encoder, save_encoder
from .sim import Frame, PixelSim, panels

ENCODER = "encoder"  # folder inside a visual policy's


class FeatureSim:
    """A simulation whose observations are robot state and features; see `Sim`."""

    def __init__(self, spec: TaskSpec, encoder: Encoder, render: bool = False):
        self._sim, self._encoder = PixelSim(spec, encoder.view), encoder

    def reset(self, seed: int) -> np.ndarray:
        return self._observe(self._sim.reset(seed))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        frame, solved = self._sim.step(action)
        return self._observe(frame), solved

    def _observe(self, frame: Frame) -> np.ndarray:
        self._frame = frame
        with one_thread():  # a picture is little work
            features = self._encoder.encode(frame.rgb[None], frame.depth[None])[0]
        return np.concatenate([frame.state, features])

    def render(self) -> np.ndarray:
        """What the policy sees: its cameras side by side, enlarged."""
        return panels(self._frame.rgb).repeat(2, axis=0).repeat(2, axis=1)

    def close(self) -> None:
        self._sim.close()


def pixel_spec(spec: TaskSpec, encoder: Encoder) -> TaskSpec:
    """`spec` seen through `encoder`. Raises PdkitError for an encoder of another view than the task's (worlds outside VIEWS have any)."""
    if spec.name in VIEWS and replace(encoder.view, task=spec.name) != VIEWS[spec.name]:
        raise PdkitError(f"This encoder was trained for the cameras and the robot of {encoder.view.task}, not of {spec.name}; give a "
                         "policy that was trained on the same task.")
    return replace(spec, name=f"{spec.name}-pixels", obs_dim=encoder.view.state_dim + FEATURES,
                   make=functools.partial(FeatureSim, spec, encoder))


def encoder_of(folder: str | Path) -> Encoder | None:
    """The encoder that a policy in `folder` (for a decorated one: its base policy) sees through; None for one that is told the state."""
    found = [path for path in (Path(folder) / ENCODER, Path(folder) / "base" / ENCODER) if path.is_dir()]
    return load_encoder(found[0]) if found else None


def save_visual(policy: Policy, encoder: Encoder, folder: str | Path, info: dict[str, Any]) -> None:
    """Write a policy that `imitate_pixels` trained, its encoder in a folder inside. Weights are stored as bfloat16, which they fit."""
    halved = copy.deepcopy(policy)
    for parameter in halved.parameters():
        parameter.data = parameter.data.bfloat16()
    with atomic_folder(folder) as temporary:  # without its encoder it would pass for a policy that is told the state
        save_policy(halved, temporary, info)
        save_encoder(encoder, temporary / ENCODER)
