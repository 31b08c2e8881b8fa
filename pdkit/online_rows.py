"""Demonstrations in the form in which the online loop stores what happens."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .decorated import flat_actions
from .decorator import scaled
from .demos.format import Demos
from .online_config import OnlineConfig, decision_reward, stops
from .policies import Policy
from .rl.replay import NStep


def last_observation(windows: np.ndarray) -> np.ndarray:
    """What most methods store of windows (N, window, obs_dim): the latest observations (N, obs_dim)."""
    return windows[:, -1]


def demo_rows(demos: Demos, base: Policy, config: OnlineConfig,
              view: Callable[[np.ndarray], np.ndarray] = last_observation, steps: NStep | None = None,
              rest: Callable[[np.ndarray], np.ndarray] = np.copy) -> list[np.ndarray]:
    """Demonstrations as replay rows: the residual stored is the one that makes the executed action the demonstrated one.

    With on_success="terminate" an episode ends at its first success, as training episodes do; else at its own end, as at a time limit (the
    value of its last state counts): neither `success_tail` nor `train_limit` cuts it, so that these rows show more of the time after
    success. `steps` makes the rows (one lane); `rest` says from an episode's last action what fills its last chunk up
    (TaskSpec.resting).
    """
    steps, rows, chunk = steps or NStep(1, config.n_step, config.gamma), [], base.chunk
    for episode in demos.episodes():
        observations, actions, success = episode["observations"], episode["actions"], episode["success"]
        length = len(actions)
        if config.on_success == "terminate" and success.any():
            length = int(np.argmax(success)) + 1
        padded = np.concatenate([np.repeat(observations[:1], base.window - 1, axis=0), observations])
        windows = np.lib.stride_tricks.sliding_window_view(padded, base.window, axis=0).transpose(0, 2, 1)[: length + 1]
        bases, seen = flat_actions(base, windows), view(windows)
        followed = np.concatenate([actions[:length], np.repeat(rest(actions[length - 1])[None], chunk - 1, axis=0)])
        taken = np.lib.stride_tricks.sliding_window_view(followed, chunk, axis=0).transpose(0, 2, 1).reshape(length, -1)
        residuals = (taken - bases[:length]) / np.maximum(scaled(config.decorator, np.ones_like(taken)), 1e-6)
        for first in range(min(chunk, length)):  # a chunk may begin at any step: one way through the episode for each
            for t in range(first, length, chunk):
                after = min(t + chunk, length)
                last = after == length
                terminated = last and config.on_success == "terminate" and bool(success[length - 1])
                reward = decision_reward(config, success[t:after].sum())
                rows += steps.push(0, seen[t], residuals[t], bases[t], float(reward), seen[after], bases[after],
                                   stops(config, terminated, last and not terminated), last)
    return rows
