"""What ROT and FISH share: the reward by optimal transport (pdkit/rl/ot.py) in the place of success.

Success is no reward. But where it ends training episodes (on_success="terminate", the paper profile), it is worth reaching all the
same, because every further step costs: on the reach probe a constant negative reward then teaches as much as transport does. Where it
cuts them, as by a time limit (a success_tail), it costs: an episode's mass is 1, so each step of a short one weighs more. With
on_success="continue" and success_tail=0 (the lesson profile of both, on every task; the originals' episodes are all of one length, too)
every episode lasts to the limit and transport alone teaches. Rows reach the replay when their episode is over.
"""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from ..demos.format import Demos
from ..errors import PdkitError
from ..online import Trainer
from ..online_config import OnlineConfig
from ..rl.ot import OTReturns, OTReward


class OTRewarded(Trainer):
    """Subclasses say in which features episodes and demonstrations are compared."""

    needs_demos = True
    sees_features = False
    reads = ("ot_", "bc_weight")
    unread = frozenset({"reward_shift"})  # the reward is another one
    _phi: nn.Module | None = None  # the network in these features, if it is renewed

    def __init__(self, config, base, demos=None, spec=None):
        if demos is None or config.demo_fraction:
            raise PdkitError("A reward by optimal transport needs demonstrations to compare with, and none in the batches, where their "
                             "reward would be another one; pass demos and set demo_fraction=0.")
        self._expert = demos
        super().__init__(config, base, demos, spec)
        m = config.method_config
        self.reward = OTReward(self._features, as_trained(demos.first(min(m.ot_demos, demos.num)), config), epsilon=m.ot_epsilon,
                               iterations=m.ot_iterations, total=m.ot_total, frozen=self._phi)
        self.nstep = OTReturns(config.num_envs, config.n_step, config.gamma, self.reward)

    def _features(self, observations: np.ndarray) -> np.ndarray:
        """phi (T, F) of an episode's observations (T, width), as they are stored or as demonstrations have them."""
        raise NotImplementedError

    def _store(self, obs, residual, base, result, base_final) -> None:
        super()._store(obs, residual, base, result, base_final)
        if result.done.any():
            self.log |= {"ot_return": torch.tensor(self.nstep.total), "ot_error": torch.tensor(self.reward.error)}


def as_trained(demos: Demos, config: OnlineConfig) -> list[np.ndarray]:
    """Observations (T + 1, obs_dim) of each demonstration, ended where a training episode would end."""
    trajectories = []
    for episode in demos.episodes():
        success, length = episode["success"], len(episode["actions"])
        if success.any() and (config.on_success == "terminate" or config.success_tail):
            length = min(length, int(np.argmax(success)) + 1 + (config.success_tail if config.on_success == "continue" else 0))
        trajectories.append(episode["observations"][: min(length, config.train_limit or length) + 1])
    return trajectories


def as_numpy(module: Callable[[torch.Tensor], torch.Tensor], device: str, rows: np.ndarray) -> np.ndarray:
    """A torch function of float32 rows, without gradients, from numpy to numpy."""
    with torch.no_grad():
        return module(torch.from_numpy(np.require(rows, np.float32, ["C", "W"])).to(device)).float().cpu().numpy()
