"""FISH: a residual over nearest neighbours, on a reward by optimal transport (Haldar et al., 2023; appendix B.5, G.2; facts.md 3.6).

    a = clamp(a_vinn + 0.2 * a_res, -1, 1)     the environment clamps
    actor sees (o, a_vinn), critics see (o, a_vinn, 0.2 * a_res)
    reward   optimal transport in the features by which VINN looks up (pdkit/rl/ot.py); they are frozen, so nothing is renewed
    actor    Q-filtered towards a residual of 0 on demonstrations (pdkit/rl/qfilter.py), as -log of a Gaussian of width 0.1

The original repeats a_vinn and the residual 50 to 100 times so that they weigh as much as image features; low-dimensional observations
need no such thing. Its Q-filter compares a_res with itself at the same observation, which without images is always a tie (weight 0);
here it compares a_res with 0, as its words say. Actor and critics see the last observation, not the features of the lookup. The original's
critics learn from 0.2 a_res and are asked about a_res; ours see 0.2 a_res each time. At an expert's observation its base action is
the expert's own, ours VINN's. And it explores with small noise from the first episode on, where the loop here begins, as for the
decorator, with uniform residuals (the lesson: 6,000 steps), of which VINN's successes suffer.

The paper looks up by features of BeT's GPT (appendix B.5) and gives no k; FISH's code takes one neighbour, with an exclusion buffer. The
VINN that comes with the kit, on Door alone, looks up five neighbours by raw observations, where it does no worse (data/results/vinn.csv),
and both profiles start from it unless --base names another (`pdkit train base Door --policy vinn --set
representation=data/checkpoints/Door/base`). Recorded are runs from both on Door and by GPT features on StackCube. Other numbers:

                              lesson, Door    StackCube       paper    FISH's code
    steps of reward                      5            5           1              3
    batch                              256          256       1,024            256
    steps between updates                4          2.9           4              2
    rate of actor, critics      6e-4, 1e-3         3e-4        1e-4           1e-4
    weight of imitation               0.03         0.03        0.03           0.03
"""
from __future__ import annotations

import numpy as np
import torch

from ..decorator import actor_features
from ..errors import PdkitError
from ..policies.vinn import VINN
from ..rl.qfilter import QFilteredSAC
from .transport import OTRewarded, as_numpy

WIDTH = 0.1  # of the Gaussian in the imitation loss


class FISHAgent(QFilteredSAC):
    """Imitation here means: no residual."""

    def reference(self, batch):
        return torch.zeros_like(batch["base"])

    def imitation_loss(self, generator):
        rows = self.expert.unpack(self.expert.draw(self.expert_batch, generator))
        mean = self.actor.mean_action(actor_features(self.decorator, self.normalize(rows["obs"]), rows["base"]))
        return mean.square().sum(dim=1).mean() / (2 * WIDTH**2)


class FISH(OTRewarded):
    """The decorator's loop over VINN, rewarded by optimal transport."""

    unread = OTRewarded.unread | {"ot_trunk", "ot_renew_every"}

    def __init__(self, config, base, demos=None, spec=None):
        if not isinstance(base, VINN):
            raise PdkitError(f"FISH needs a base policy of kind vinn, not {base.kind}: make one with "
                             "`pdkit train base TASK --policy vinn`.")
        super().__init__(config, base, demos, spec)
        self.agent.expert = self.demos  # for observations and base actions; their sparse rewards are never learned from

    def _make_agent(self) -> FISHAgent:
        c = self.config
        agent = FISHAgent(self.spec.obs_dim, self.spec.act_dim, c.sac, c.decorator, device=c.device,
                          normalize=self.base.normalizer if c.normalize_obs else None)
        agent.bc_weight, agent.expert_batch = c.method_config.bc_weight, c.batch // 2
        return agent

    def _features(self, observations: np.ndarray) -> np.ndarray:
        """What VINN looks up at each observation of an episode, in order."""
        padded = np.concatenate([np.repeat(observations[:1], self.base.looks - 1, axis=0), observations])
        windows = np.lib.stride_tricks.sliding_window_view(padded, self.base.looks, axis=0).transpose(0, 2, 1)
        return as_numpy(self.base.features, self.config.device, windows)
