"""DPPO: PPO on the denoising steps of a Diffusion Policy (Ren et al., 2024; appendix C.2; facts.md 3.8). The learner: pdkit/rl/dppo.py.

The paper compares with it on DPPO's own tasks, because it came out three weeks before the deadline, and prints no numbers that we have.
Ours are those of its Square task (20 DDPM steps, 10 of them fine-tuned; clip 0.001 to 0.01, denoising discount 0.99, both least stds 0.1,
learning rates 1e-4 and 1e-3, gamma 0.999, lambda 0.95, 10 epochs, no clipping of gradients or values), gamma and epochs in the paper
profile alone: the lesson makes 5 epochs and has its task's gamma (a chunk's is 0.922 on StackCube, 0.941 on Door). Where DPPO samples a
U-Net by DDIM, as here, it fine-tunes all 5 of 5 steps: so do we, all 4. There it takes a clip of 0.001, a discount of 0.9, a std of 0.04,
and for the policy a learning rate of 1e-5, a tenth of ours (in the recorded runs half and more of the ratios lie outside the clip); V's
rate stays where it is, ours falls to a tenth. It collects in 50 environments, 10,000 transitions a minibatch; the paper profile here has 16
and divides its rollout of 400 decisions each into as many minibatches (1,280 rows), the lesson far fewer.

As in its code the fine-tuned steps have a copy of the network (`late` of pdkit/policies/diffusion.py, saved with the policy), and all its
weights train (`lora` 0; another rank trains adapters). Not as there, beside what ppo.py says of rewards and advantages: V does not
learn for two iterations before the policy does; the episode's success and the reward of a chunk are those of the loop.
"""
from __future__ import annotations

import numpy as np

from ..policies.lora import with_lora
from ..rl.dppo import DPPO as Learner
from ..rl.replay import Replay
from .diffusion import FineTuneDiffusion
from .ppo import OnPolicy


class DPPO(OnPolicy, FineTuneDiffusion):
    """A rollout holds the chains of its decisions."""

    reads = ("ppo_", "dppo_", "lora")
    unread = OnPolicy.unread | FineTuneDiffusion.unread | {"ppo_clip", "ppo_entropy_coef"}

    def _make_agent(self) -> Learner:
        c, m = self.config, self.config.method_config
        actor = self._start_policy.with_late(m.dppo_steps).requires_grad_(False)
        actor.late = with_lora(actor.late, m.lora)
        return Learner(self.spec.obs_dim, self.act_dim, m, c.sac, c.decorator, actor=actor, value_view=self._last_observation,
                       device=c.device)

    def _make_replay(self, capacity: int) -> Replay:
        c, m, size = self.config, self.config.method_config, self._start_policy.horizon * self.spec.act_dim
        return Replay(m.ppo_rollout * c.num_envs, self.stored_dim, self.act_dim, device=c.device, extra=("open", "done"),
                      wide={"log_prob": m.dppo_steps, "chain": (m.dppo_steps + 1) * size})

    def _explore(self, obs: np.ndarray, base: np.ndarray) -> np.ndarray:
        start = self._start_policy
        noise = self.rng.standard_normal((len(obs), 1 + start.sampling_steps, start.horizon, self.spec.act_dim))
        actions, log_probs, chain = (x.cpu().numpy() for x in self.agent.act(self._tensor(obs), self._tensor(noise)))
        self._acted = actions, log_probs, chain.reshape(len(obs), -1), np.ones((len(obs), 1), np.float32)
        return actions
