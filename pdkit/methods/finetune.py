"""Fine-tuning the base policy itself: what the decorator is compared with (appendix B.4.1; facts.md 2.3).

    a = a_pi(o),  pi the whole Behavior Transformer, by SAC's actor loss through its adapters

No base action is added and nothing is gated: alpha = 1, H = 0 over a policy that does nothing. Critics are small MLPs that see the
last observation; the actor sees the whole window, so whole windows are stored.
"""
from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import PdkitError
from ..online import Trainer
from ..policies import Policy, save_policy
from ..policies.bet_sac import BeTForSAC
from ..policies.zero import Zero
from ..rl.sac import SAC


class FineTune(Trainer):
    """SAC on a `bet-sac` policy. RLPD (the paper's cut-down) is the same with half of each batch from demonstrations."""

    def __init__(self, config, base, demos=None, spec=None):
        if not isinstance(base, BeTForSAC):
            raise PdkitError(f"Fine-tuning by SAC needs a base policy of kind bet-sac, not {base.kind}: train one with "
                             "`pdkit train base TASK --policy bet-sac`.")
        self._start_policy = base
        super().__init__(config, Zero.instead_of(base, base.window), demos, spec)

    @staticmethod
    def _view(windows: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(windows.reshape(len(windows), -1))

    @property
    def stored_dim(self) -> int:
        return self.spec.obs_dim * self._start_policy.window

    def _make_agent(self) -> SAC:
        c, dim, normalizer = self.config, self.spec.obs_dim, self.base.normalizer
        return SAC(dim, self.spec.act_dim, c.sac, c.decorator, device=c.device, actor=self._start_policy.with_lora(c.method_config.lora),
                   critic_view=lambda stored: normalizer(stored[:, -dim:]))

    def _as_policy(self, actor: BeTForSAC, base: Policy) -> BeTForSAC:
        return actor

    def save_policy(self, policy: BeTForSAC, folder: Path) -> None:
        save_policy(policy, folder, {"task": self.config.task, "seed": self.config.seed, "method": self.config.method})
