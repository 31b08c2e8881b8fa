"""PPO as the backbone instead of SAC (appendix D.3, Fig. 18; facts.md 4.2): decorator, residual RL and fine-tuning on the same loop.

The paper says that all three were tried with PPO on Pen, and that the decorator did best; it gives no PPO numbers. Ours follow the
defaults of cleanrl's ppo_continuous_action.py (clip 0.2, lambda 0.95, 2,048 decisions, 10 epochs of 32 minibatches, learning rate
3e-4 falling, value 0.5, entropy 0, gradient norm 0.5, clipped value loss), except that

    networks      are those of the SAC methods (size, ReLU, a spread that depends on the state and is squashed to a range, 0.6 at
                  first and not 1; fine-tuning starts with the policy's own)
    observations  go through the base policy's normaliser, not a running one
    rewards       are multiplied by 1 - gamma, so that values stay in [-1, 0]: in place of a running normaliser
    advantages    are normalised over the open decisions of a rollout, not of a minibatch, which may hold hardly any
    gamma         is the task profile's, as in the other methods
    learning rate falls to a tenth, not to 0
    weights       start as PyTorch's layers do and the last ones near 0 (there: orthogonal, the value's with gain 1)
    time limits   keep the value of what would follow (there they count as an end)

On-policy there is no replay, no warm-up and no demonstration in a batch. The loop learns while the simulators run: the decision in
flight during an update is the first of the next rollout. Its ratio is to the policy that took it, whose log pi was kept; values
are computed when a rollout is full, all by the value function that stood while it was collected.
"""
from __future__ import annotations

import numpy as np
import torch

from ..decorator import gate
from ..errors import PdkitError
from ..online import Trainer
from ..online_config import decision_reward, lr_factor, stops
from ..rl.gpt_critic import GPTCritics, make_backbone
from ..rl.ppo import PPO, ROLLOUT_COLUMNS
from ..rl.replay import Replay
from ..rl.sac import SACConfig
from .finetune import FineTune


class OnPolicy(Trainer):
    """Collects `ppo_rollout` decisions of every environment, learns from them, and forgets them."""

    sees_features = False
    reads = ("ppo_",)
    unread = frozenset({*SACConfig.__dataclass_fields__, "utd", "batch", "n_step", "warmup", "critic_input", "residual_units"}
                       - {"hidden", "layers", "actor_layer_norm", "critic_layer_norm", "log_std_range"})

    def __init__(self, config, base, demos=None, spec=None):
        m, rows = config.method_config, config.method_config.ppo_rollout * config.num_envs
        if rows * base.chunk >= config.total_steps or m.ppo_minibatches > rows:
            raise PdkitError(f"PPO learns from rollouts of ppo_rollout * num_envs = {rows} decisions, {rows * base.chunk} steps: "
                             f"take fewer than total_steps ({config.total_steps}) and at least ppo_minibatches ({m.ppo_minibatches}).")
        if config.warmup_steps or config.demo_fraction:
            raise PdkitError("PPO learns from its own policy's decisions only: set warmup_steps=0 and demo_fraction=0.")
        self.reward_scale = 1 - config.gamma if config.gamma < 1 else 1.0
        super().__init__(config, base, demos, spec)

    def _make_replay(self, capacity: int) -> Replay:
        """One rollout; a checkpoint holds what there is of it, as of any replay."""
        rows = self.config.method_config.ppo_rollout * self.config.num_envs
        return Replay(rows, self.stored_dim, self.act_dim, device=self.config.device, extra=ROLLOUT_COLUMNS)

    def _make_agent(self) -> PPO:
        c = self.config
        return PPO(self.spec.obs_dim, self.act_dim, c.method_config, c.sac, c.decorator, device=c.device,
                   normalize=self.base.normalizer if c.normalize_obs else None)

    @property
    def _actor(self):
        return self.agent.actor

    def _explore(self, obs: np.ndarray, base: np.ndarray) -> np.ndarray:
        noise = torch.from_numpy(self.rng.standard_normal(base.shape).astype(np.float32))
        tensors = (torch.from_numpy(np.ascontiguousarray(x)).to(self.config.device) for x in (obs, base))
        residual, u, log_prob = (x.float().cpu().numpy() for x in self.agent.act(*tensors, noise.to(self.config.device)))
        on = gate(self.config.decorator, np.ones((len(base), 1), np.float32), self.step, self.rng)
        self._acted = u, log_prob[:, None], on  # of the policy that acts: the next update comes before they are stored
        return residual * on

    def _learn(self) -> None:
        if self.replay.size == self.replay.capacity:
            self.agent.scale_lr(lr_factor(self.config, self.step))
            self.log |= self.agent.update(self.replay.unpack(self.replay.rows), self.config.num_envs, self.generator)
            self.replay.size = self.replay.position = 0

    def _store(self, obs, residual, base, result, base_final) -> None:
        c, (u, *acted) = self.config, self._acted
        reward = decision_reward(c, result.reward) * self.reward_scale
        stop = [stops(c, bool(t), bool(limit)) for t, limit in zip(result.terminated, result.truncated, strict=True)]
        parts = [obs, u, base, reward[:, None], self._view(result.final_windows), base_final, np.where(stop, 0, c.gamma)[:, None],
                 *acted, result.done[:, None]]
        self.replay.add(list(np.concatenate(parts, axis=1).astype(np.float32)))


class PPOFineTune(OnPolicy, FineTune):
    """PPO on a `bet-sac` policy with adapters; the value function is an MLP on the last observation, or a head on a transformer
    (`critic_backbone`, appendix F.5.1)."""

    reads = OnPolicy.reads + FineTune.reads
    unread = OnPolicy.unread | FineTune.unread

    def _make_agent(self) -> PPO:
        c, m, start = self.config, self.config.method_config, self._start_policy
        if start.config["act_dropout"]:
            raise PdkitError("PPO compares probabilities of one decision before and after learning, which dropout would change: "
                             "take a base policy with act_dropout=False.")
        actor = start.with_lora(m.lora)
        if m.critic_backbone == "mlp":
            return PPO(self.spec.obs_dim, self.spec.act_dim, m, c.sac, c.decorator, device=c.device, actor=actor,
                       value_view=self._last_observation)
        value = GPTCritics(make_backbone(m.critic_backbone, actor, start, m.lora), 0, c.sac, 1)
        return PPO(self.stored_dim, self.spec.act_dim, m, c.sac, c.decorator, device=c.device, actor=actor, value=value)
