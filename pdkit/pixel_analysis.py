"""What notebook 15 measures: frames a second, and what a buffer weighs that holds pictures or features."""
from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Sequence

import numpy as np
import pandas as pd

from .decorated import Decorated
from .demos.format import Demos
from .errors import PdkitError
from .evaluate import Actor
from .pixels.cameras import View, view_of
from .pixels.encoders import FEATURES, Encoder
from .pixels.pictures import Pictures
from .pixels.sim import Frame, PixelSim
from .policies import Policy
from .tasks import get_task
from .video import try_render


def why_not(task: str) -> str | None:
    """None if this task's cameras can be drawn here, else one sentence that says why not."""
    return try_render(dataclasses.replace(get_task(task), plan_view=False))  # PushChair's plans of the floor are no pictures


def backend(task: str) -> str:
    """What draws a task here, as far as it tells."""
    if get_task(task).suite == "adroit":
        return f"MuJoCo, {os.environ.get('MUJOCO_GL') or 'default'}"
    from .tasks.maniskill_headless import render_device

    return f"SAPIEN, Vulkan on {render_device()}"


def measure(task: str, frames: int, seed: int = 0) -> tuple[Frame, dict[str, float | str]]:
    """Draw a task for `frames` steps of random actions; the last frame, and a row of measurements.

    Columns: task, backend, pictures (cameras and their size), first (seconds to build the scene and draw once), seen (steps a second with
    pictures), blind (without), encode (milliseconds of the encoder for one frame).
    """
    spec, view = get_task(task), view_of(task)
    actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (frames, spec.act_dim)).astype(np.float32)
    started = time.perf_counter()
    sim = PixelSim(spec)
    try:
        frame = sim.reset(seed)
        first = time.perf_counter() - started
        seen = _rate(sim.step, actions)
        frame = sim.step(actions[-1])[0]
    finally:
        sim.close()
    plain = spec.make()
    try:
        plain.reset(seed)
        blind = _rate(plain.step, actions)
    finally:
        plain.close()
    encoder = Encoder(view).eval()
    encode = 1000 / _rate(lambda _: encoder.encode(frame.rgb[None], frame.depth[None]), actions[:20])
    size = f"{len(view.cameras)} x {view.height} x {view.width}{' RGBD' if view.depth else ' RGB'}"
    return frame, dict(task=task, backend=backend(task), pictures=size, first=first, seen=seen, blind=blind, encode=encode)


def _rate(function, arguments: Sequence) -> float:
    """Calls a second."""
    started = time.perf_counter()
    for argument in arguments:
        function(argument)
    return len(arguments) / (time.perf_counter() - started)


def buffer_bytes(view: View, steps: int, features: bool) -> int:
    """Bytes of what was seen in a buffer of `steps` transitions, each with its observation and the next one.

    As pictures in the form in which they are kept (bytes, and two for a distance), or as float32 features; the robot's state in both.
    """
    frame = 4 * FEATURES if features else view.bytes
    return 2 * steps * (frame + 4 * view.state_dim)


def memory(tasks: Sequence[str], steps: int) -> pd.DataFrame:
    """Gigabytes of a buffer of `steps` transitions, a row a task: pictures, features, and how many times more."""
    rows = []
    for task in tasks:
        pictures, features = (buffer_bytes(view_of(task), steps, kind) / 1e9 for kind in (False, True))
        rows.append(dict(task=task, pictures=pictures, features=features, times=pictures / features))
    return pd.DataFrame(rows)


def shifted(picture: np.ndarray, down: int, right: int) -> np.ndarray:
    """A picture (H, W, C) moved by whole pixels; what is bared repeats the edge. What the exercise asks for."""
    height, width = picture.shape[:2]
    rows, columns = np.clip(np.arange(height) - down, 0, height - 1), np.clip(np.arange(width) - right, 0, width - 1)
    return picture[rows][:, columns]


def errors(policy: Policy, encoder: Encoder, demos: Demos, pictures: Pictures) -> dict[str, float]:
    """Root mean square of what the policy does beside what the demonstrations did, in units of actions, when each frame is seen with its
    own picture, with the one that the next demonstration showed at the same step, with the features of the average frame, and with a
    black one. The robot's state is the right one each time, so the differences are what the picture is worth; a black one is like
    nothing that the policy ever saw.
    """
    starts = np.concatenate([[0], np.cumsum(demos.lengths + 1)])
    rows = np.concatenate([start + np.arange(length) for start, length in zip(starts, demos.lengths, strict=False)])
    other = np.concatenate([starts[(i + 1) % demos.num] + np.minimum(np.arange(length), demos.lengths[(i + 1) % demos.num] - 1)
                            for i, length in enumerate(demos.lengths)])
    features, state = encoder.encode(pictures.rgb, pictures.depth), encoder.view.robot(demos.observations)[rows]
    black = encoder.encode(np.zeros_like(pictures.rgb[:1]), np.zeros_like(pictures.depth[:1])).repeat(len(rows), axis=0)
    average = features.mean(axis=0, keepdims=True).repeat(len(rows), axis=0)
    results = {}
    for name, seen in (("its own", features[rows]), ("another episode's", features[other]), ("the average", average), ("black", black)):
        actions = policy.act(np.concatenate([state, seen], axis=1)[:, None].repeat(policy.window, axis=1))[:, 0]
        results[name] = float(np.sqrt(np.mean((actions - demos.actions) ** 2)))
    return results


def probe(encoder: Encoder, demos: Demos, pictures: Pictures, numbers: slice, train: int) -> float:
    """How much of some numbers of the state observation a frame's features tell linearly: R^2 of ridge regression from the features,
    fitted on the first `train` demonstrations and tested on the others, over all their frames.

    Raises PdkitError where no demonstration is left to test on.
    """
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    if not 0 < train < demos.num:
        raise PdkitError(f"A probe on {demos.num} demonstrations can be fitted on 1 to {demos.num - 1} of them, not on {train}.")
    split = int((demos.lengths[:train] + 1).sum())
    features, target = encoder.encode(pictures.rgb, pictures.depth), demos.observations[:, numbers]
    model = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-1, 4, 11))).fit(features[:split], target[:split])
    return float(model.score(features[split:], target[split:]))


def blindfolded(policy: Policy | Decorated, view: View) -> Actor:
    """A visual policy that is told the robot's state and, instead of features, always the average frame's: it acts on the observations of
    the *state* task (windows (N, window, obs_dim)), of which it is told the robot's part only. Nothing has to be drawn for it.
    """
    base = policy.base if isinstance(policy, Decorated) else policy
    average = base.normalizer.mean[view.state_dim:].numpy()

    def act(windows: np.ndarray) -> np.ndarray:
        features = np.broadcast_to(average, (*windows.shape[:2], len(average)))
        return policy.act(np.concatenate([view.robot(windows), features], axis=-1))

    return act
