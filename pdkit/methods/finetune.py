"""Fine-tuning the base policy itself: what the decorator is compared with (appendix B.4.1; facts.md 2.3).

    a = a_pi(o),  pi the whole Behavior Transformer, by SAC's actor loss through its adapters

No base action is added and nothing is gated: alpha = 1, H = 0 over a policy that does nothing. Critics are small MLPs that see the
last observation; the actor sees the whole window, so whole windows are stored. With another `critic_backbone` critics, too, see the
window, through a transformer (pdkit/rl/gpt_critic.py; appendix F.5.1). Adapters have rank 8, on attention and regression head (the
paper gives none). Other numbers (the paper's code: facts.md 1.3; pdkit/profiles.py holds all):

                            lesson, Door    StackCube    paper
    steps between updates              8            8        4
    batch                             64           64    1,024
    rate of actor, critics    6e-4, 1e-3   3e-4, 3e-4     1e-4
    gamma, tau                0.97, 0.01   0.98, 0.01   0.97, 0.01
    steps of reward                    5            5        1
    first temperature               0.01         0.01        1
    target entropy              -act_dim   -3 act_dim   -act_dim

RLPD's cut-down (appendix B.5) has half of each batch from demonstrations and LayerNorm in its critics, in each profile (fine-tuning has
that in the lesson alone), and all else the same.
"""
from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..errors import PdkitError
from ..online import Trainer
from ..policies import Policy, save_policy
from ..policies.bet_sac import BeTForSAC
from ..policies.zero import Zero
from ..rl.gpt_critic import GPTSAC, GPTCritics, make_backbone
from ..rl.sac import SAC


class FineTune(Trainer):
    """SAC on a `bet-sac` policy. RLPD (the paper's cut-down) is the same with half of each batch from demonstrations."""

    starts_from: type[Policy] = BeTForSAC  # the only kind of base policy that it can tune
    sees_features = False
    reads = ("lora", "critic_backbone")
    unread = frozenset({"log_std_range", "actor_layer_norm"})  # the actor is the base policy, with its own

    def __init__(self, config, base, demos=None, spec=None):
        kind = self.starts_from.kind
        if not isinstance(base, self.starts_from):
            raise PdkitError(f"{config.method} fine-tunes a base policy of kind {kind}, not {base.kind}: train one with "
                             f"`pdkit train base TASK --policy {kind}`.")
        self._start_policy = base
        super().__init__(config, Zero.instead_of(base, base.window, base.chunk), demos, spec)

    @staticmethod
    def _view(windows: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(windows.reshape(len(windows), -1))

    @property
    def stored_dim(self) -> int:
        return self.spec.obs_dim * self._start_policy.window

    def _last_observation(self, stored: torch.Tensor) -> torch.Tensor:
        """What small critics see of stored windows (B, stored): the last observation (B, obs_dim), normalised where the configuration
        says so. (The policy always sees its own normalised ones.)"""
        last = stored[:, -self.spec.obs_dim:]
        return self.base.normalizer(last) if self.config.normalize_obs else last

    def _make_agent(self) -> SAC:
        c, m, start = self.config, self.config.method_config, self._start_policy
        actor = start.with_lora(m.lora)
        if m.critic_backbone == "mlp":
            return SAC(self.spec.obs_dim, self.spec.act_dim, c.sac, c.decorator, device=c.device, actor=actor,
                       critic_view=self._last_observation)
        backbone = make_backbone(m.critic_backbone, actor, start, m.lora, c.sac.critic_warmup)
        critics = GPTCritics(backbone, c.decorator.critic_dim(0, self.spec.act_dim), c.sac, c.sac.num_critics)
        return GPTSAC(self.stored_dim, self.spec.act_dim, c.sac, c.decorator, device=c.device, actor=actor, critics=critics)

    def _as_policy(self, actor: Policy, base: Policy) -> Policy:
        return actor

    def save_policy(self, policy: Policy, folder: Path) -> None:
        save_policy(policy, folder, {"task": self.config.task, "seed": self.config.seed, "method": self.config.method})
