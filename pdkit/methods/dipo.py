"""DIPO: "basic RL" for Diffusion Policy in the paper (Yang et al., 2023; appendix B.4.2, H.2; facts.md 3.7). The learner: pdkit/rl/dipo.py.

The paper modifies the original in two ways, both here: of a predicted sequence only the executed chunk is moved by the action
gradient, and the policy learns through LoRA on all layers (peft has none for transposed convolutions: pdkit/policies/lora.py). It gives
neither the rank nor the numbers of the action gradient: these are the original's (20 Adam steps of 0.03, in the lesson 10 of them; in
DPPO's port 10 of 1e-4).
The rest is the SAC methods' (appendix B.5: shared settings).

Not as in the original: it explores by 10,000 random steps first, here the imitated policy acts from the start and its own noise
explores; it treats an episode's time limit as its end (no value of s'), here the loop's `bootstrap` decides, which by default keeps the
value of s' there. Gradients are clipped as in this kit's SAC, at a norm of 50; the original's limit is 2.
"""
from __future__ import annotations

import numpy as np

from ..errors import PdkitError
from ..policies.lora import with_lora
from ..rl.dipo import DIPO as Learner
from ..rl.dipo import ActionGradient, Sequences
from .diffusion import FineTuneDiffusion


class DIPO(FineTuneDiffusion):
    """Every decision goes to two replays: what was executed to the critics', the whole sequence to the actor's."""

    reads = ("dipo_", "lora")
    unread = FineTuneDiffusion.unread | {"target_subset", "actor_value", "entropy_backup", "residual_penalty", "autotune",
                                         "init_temperature", "target_entropy_scale"}

    def __init__(self, config, base, demos=None, spec=None):
        super().__init__(config, base, demos, spec)
        if not base.config["temperature"]:
            raise PdkitError("DIPO explores by the noise that its policy samples from, and this one has temperature 0: take one with more.")

    def _make_agent(self) -> Learner:
        c, m, start = self.config, self.config.method_config, self._start_policy
        memory = Sequences(self.decisions, self.stored_dim, start.horizon, self.spec.act_dim, c.device)
        return Learner(self.spec.obs_dim, self.act_dim, c.sac, c.decorator, actor=with_lora(start, m.lora), memory=memory,
                       rule=ActionGradient(m.dipo_steps, m.dipo_lr, m.dipo_norm), critic_view=self._last_observation, device=c.device)

    def _explore(self, obs: np.ndarray, base: np.ndarray) -> np.ndarray:
        noise = self.rng.standard_normal((len(obs), self._start_policy.horizon, self.spec.act_dim))
        self._sequences = self.agent.act(self._tensor(obs), self._tensor(noise))
        return self._sequences[:, self.agent.executed].flatten(1).cpu().numpy()

    def _store(self, obs, residual, base, result, base_final) -> None:
        super()._store(obs, residual, base, result, base_final)
        self.agent.memory.add(obs, self._sequences)
