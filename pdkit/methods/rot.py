"""ROT: fine-tuning that may not forget, on a reward by optimal transport (Haldar et al., 2022; appendix B.5; facts.md 3.1).

    reward   optimal transport to the best demonstration (pdkit/rl/ot.py) instead of success
    phi      the trunk of the critics, tanh(LayerNorm(W o)) of width 50: a copy, renewed every 10,000 steps
    actor    Q-filtered imitation (pdkit/rl/qfilter.py), a_BC the policy that fine-tuning starts from

The rest is SAC fine-tuning (finetune.py), as in the paper. The original keeps -log pi(a_e | s_e) of a fixed-width Gaussian; the paper
applies imitation to BeT's whole window and does not say by which loss: here it is the one that BeT was trained by. Width, interval and
weight are the original's; the paper gives none. So are transport's epsilon of 0.01, 100 iterations, and rewards scaled so that the first
episode's sum to -10; that the first 10 demonstrations alone are compared with is ours (`ot_...` in config.py). Rates, batches and updates
are those in finetune.py. Unlike the original, the trunk is the critics' (the paper's words), so it starts untrained. Each critic's gradient
is clipped as in SAC; the trunk's, which they share, is not (the original clips none). Where the original looks three steps of reward
ahead, the lesson looks five and the paper profile one, as fine-tuning does; and in the lesson training episodes go on after success.
"""
from __future__ import annotations

import copy

import numpy as np
import torch
from torch import nn

from ..imitate import Windows
from ..rl.networks import Critics
from ..rl.qfilter import QFilteredSAC
from .finetune import FineTune
from .transport import OTRewarded, as_numpy


class TrunkCritics(Critics):
    """Critics behind one layer that they share and that only observations pass."""

    def __init__(self, obs_dim: int, act_dim: int, trunk: int, hidden: int, layers: int, num: int, layer_norm: bool):
        super().__init__(trunk + act_dim, hidden, layers, num, layer_norm)
        self.trunk, self.obs_dim = nn.Sequential(nn.Linear(obs_dim, trunk), nn.LayerNorm(trunk), nn.Tanh()), obs_dim

    def seen(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat([self.trunk(x[..., : self.obs_dim]), x[..., self.obs_dim:]], dim=-1)


class ROTAgent(QFilteredSAC):
    """Stays near `start`, the policy before fine-tuning, by the imitation loss of BeT on whole windows."""

    def reference(self, batch):
        return self.start.mean_action(batch["obs"])

    def imitation_loss(self, generator):
        observations, actions = (x.to(self.device) for x in self.windows.sample(self.expert_batch, generator))
        return self.actor.loss(observations, actions)["loss"]


class ROT(OTRewarded, FineTune):
    """Fine-tuning with both changes."""

    reads = (*OTRewarded.reads, "lora")
    unread = FineTune.unread | OTRewarded.unread | {"xavier_init"}  # its networks are all given

    def _make_agent(self) -> ROTAgent:
        c, m, dim = self.config, self.config.method_config, self.spec.obs_dim
        critics = TrunkCritics(dim, self.spec.act_dim, m.ot_trunk, c.sac.hidden, c.sac.layers, c.sac.num_critics, c.sac.critic_layer_norm)
        agent = ROTAgent(dim, self.spec.act_dim, c.sac, c.decorator, device=c.device, actor=self._start_policy.with_lora(m.lora),
                         critics=critics, critic_view=self._last_observation)
        agent.start, agent.bc_weight, agent.expert_batch = self._start_policy.to(c.device), m.bc_weight, c.batch // 2
        agent.windows = Windows(self._expert, self._start_policy.window, pad_start=True)
        self._phi = copy.deepcopy(critics.trunk).requires_grad_(False)
        return agent

    def _features(self, observations: np.ndarray) -> np.ndarray:
        """phi of stored windows or of a demonstration's observations: of the last observation in each row."""
        return as_numpy(lambda rows: self._phi(self.agent.critic_view(rows)), self.config.device, observations)

    def _store(self, obs, residual, base, result, base_final) -> None:
        super()._store(obs, residual, base, result, base_final)
        every, after = self.config.method_config.ot_renew_every, self.step + int(result.steps.sum())
        if after // every > self.step // every:
            self.reward.renew(self.agent.critics.trunk)
