"""Proximal policy optimisation on residual actions (Schulman et al., 2017; GAE: Schulman et al., 2016; appendix D.3).

    delta_t      r_t + discount_t * V(s'_t) - V(s_t),   s' the true successor; discount 0 where the episode terminated
    advantage    A_t = delta_t + discount_t * lambda * A_t+1, and no A_t+1 once the episode is over, terminated or truncated
    policy       -mean open * min(ratio * A, clip(ratio, 1 - clip, 1 + clip) * A),   ratio = pi(u | s) / pi_acted(u | s)
    value        1/2 mean max((V - R)^2, (V_old + clip(V - V_old, -clip, clip) - R)^2),   R = A_t + V_old(s_t)

u is the action before the tanh: kept, because atanh of a float32 action at the edge of its range is infinite. log pi is that of the
squashed action, as in SAC. `open` is 1 where the gate let the residual through. What acts while the gate is half open is the mixture
(1 - p) * delta(0) + p * pi, and p does not depend on the weights. So a gated decision has no gradient through the policy, and the
ratio of an open one is that of pi, p cancelling: gated decisions are left out of policy loss, entropy and the advantages' mean
and spread, but not out of GAE and value loss: V is the value of the mixture, to which they belong. The loss is still divided by all
decisions, so that one open decision weighs the same in whichever minibatch it lands.
"""
from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import nn

from ..decorator import DecoratorConfig, actor_features
from ..methods.config import MethodConfig
from .networks import Actor, Critics
from .sac import SACConfig
from .state import pack, unpack

ROLLOUT_COLUMNS = ("log_prob", "open", "done")  # of a replay that holds a rollout; its column `residual` holds u


def log_prob(u: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """log pi (B,) of the action tanh(u), u normal with this mean and spread, as `Actor.sample` has it."""
    z = (u - mean) * torch.exp(-log_std)
    return (-0.5 * z.square() - log_std - 0.5 * math.log(2 * math.pi) - 2 * (math.log(2) - u - F.softplus(-2 * u))).sum(dim=-1)


def gae(reward: torch.Tensor, discount: torch.Tensor, done: torch.Tensor, values: torch.Tensor, next_values: torch.Tensor,
        decay: float) -> torch.Tensor:
    """Advantages (T, N) of a rollout of T decisions in N environments, `decay` being lambda; the last decision of the rollout
    sees one step ahead, as if decay were 0 there."""
    delta, advantages = reward + discount * next_values - values, torch.zeros_like(reward)
    ahead = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        ahead = delta[t] + discount[t] * decay * (1 - done[t]) * ahead
        advantages[t] = ahead
    return advantages


def clipped_surrogate(log_ratio: torch.Tensor, advantage: torch.Tensor, clip: float) -> torch.Tensor:
    """What the policy climbs, (B,): it gains nothing from moving the ratio further than `clip` from 1."""
    ratio = log_ratio.exp()
    return torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)


def clipped_value_loss(values: torch.Tensor, old: torch.Tensor, returns: torch.Tensor, clip: float) -> torch.Tensor:
    """The squared error (B,), and at least that of the value moved by no more than `clip`."""
    near = old + (values - old).clamp(-clip, clip)
    return 0.5 * torch.max((values - returns).square(), (near - returns).square())


def standardised(advantages: torch.Tensor, open_: torch.Tensor) -> torch.Tensor:
    """Advantages (B,) with zero mean and unit spread over the open decisions, and 0 at gated ones (all 0 if fewer than two are open)."""
    chosen = advantages[open_ > 0]
    if len(chosen) < 2:
        return torch.zeros_like(advantages)
    return (advantages - chosen.mean()) / (chosen.std() + 1e-8) * open_


class PPO:
    """The learner.

    Args:
        obs_dim, act_dim: what the value function sees of an observation, and the action.
        config: its `ppo_` fields.
        sizes: its hidden, layers, actor_layer_norm, critic_layer_norm and log_std_range.
        normalize: maps stored observations before any network sees them (identity by default).
        actor: another actor than the small Gaussian one: a module with `heads`, `squash` and `mean_action` as `Actor` has them.
        value: another value function than the plain one: a `Critics` of one member; it may share modules with the actor.
        value_view: what the value function sees of a normalised observation, (B, stored) -> (B, obs_dim); all of it by default.
        value_lr: the learning rate of what belongs to the value function alone; the policy's by default.
    """

    def __init__(self, obs_dim: int, act_dim: int, config: MethodConfig, sizes: SACConfig, decorator: DecoratorConfig, *,
                 normalize=None, actor: nn.Module | None = None, value: Critics | None = None, value_view=None,
                 value_lr: float | None = None, device: str = "cpu"):
        self.config, self.decorator, self.device = config, decorator, device
        self.normalize, self.value_view = normalize or (lambda x: x), value_view or (lambda x: x)
        dim, s = decorator.actor_dim(obs_dim, act_dim), sizes
        self.actor = (actor or Actor(dim, act_dim, s.hidden, s.layers, s.actor_layer_norm, s.log_std_range)).to(device)
        self.value = (value or Critics(dim, s.hidden, s.layers, 1, s.critic_layer_norm)).to(device)
        policy = dict.fromkeys(p for p in self.actor.parameters() if p.requires_grad)
        alone = [p for p in self.value.parameters() if p.requires_grad and p not in policy]  # they may share some
        self.parameters, self.rates = [*policy, *alone], (config.ppo_lr, value_lr or config.ppo_lr)
        groups = [{"params": group, "lr": lr} for group, lr in zip((list(policy), alone), self.rates, strict=True)]
        self.optimizer = torch.optim.Adam(groups, eps=1e-5, fused=True)
        self.updates = 0

    @torch.no_grad()
    def act(self, obs: torch.Tensor, base: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Residuals (B, act_dim) in [-1, 1] for standard normal noise, the same before the tanh, and log pi (B,)."""
        mean, log_std = self.actor.heads(actor_features(self.decorator, self.normalize(obs), base))
        u = mean + log_std.exp() * noise
        return self.actor.squash(u), u, log_prob(u, mean, log_std)

    def values(self, obs: torch.Tensor, base: torch.Tensor) -> torch.Tensor:
        """V (B,)."""
        return self.value(actor_features(self.decorator, self.value_view(self.normalize(obs)), base))[0]

    def update(self, rollout: dict[str, torch.Tensor], num_envs: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Epochs of minibatches over a rollout: columns of a replay, decision by decision, each of all environments."""
        c, data = self.config, self._prepared(rollout, num_envs)
        log: dict[str, torch.Tensor] = {}
        for _ in range(c.ppo_epochs):
            for rows in torch.randperm(len(data["advantage"]), generator=generator).chunk(c.ppo_minibatches):
                noise = torch.randn((len(rows), rollout["base"].shape[1]), generator=generator).to(self.device)
                log = self._step({k: v[rows.to(self.device)] for k, v in data.items()}, noise)
            if c.ppo_target_kl and float(log["kl"]) > c.ppo_target_kl:
                break
        return log | {"target_mean": data["returns"].mean(), "open": rollout["open"].mean()}

    @torch.no_grad()
    def _prepared(self, rollout: dict[str, torch.Tensor], num_envs: int) -> dict[str, torch.Tensor]:
        """The rows that minibatches are drawn from: what was decided, and what came of it."""
        old, ahead = self.values(rollout["obs"], rollout["base"]), self.values(rollout["next_obs"], rollout["next_base"])
        columns = (rollout["reward"], rollout["discount"], rollout["done"], old, ahead)
        advantages = gae(*(x.view(-1, num_envs) for x in columns), self.config.ppo_gae_lambda).flatten()
        data = {k: rollout[k] for k in ("obs", "base", "residual", "log_prob", "open")}
        return data | {"old": old, "returns": advantages + old, "advantage": standardised(advantages, rollout["open"])}

    def _step(self, batch: dict[str, torch.Tensor], noise: torch.Tensor) -> dict[str, torch.Tensor]:
        c, open_ = self.config, batch["open"]
        mean, log_std = self.actor.heads(actor_features(self.decorator, self.normalize(batch["obs"]), batch["base"]))
        log_ratio = log_prob(batch["residual"], mean, log_std) - batch["log_prob"]
        surrogate = (open_ * clipped_surrogate(log_ratio, batch["advantage"], c.ppo_clip)).mean()
        entropy = -(open_ * log_prob(mean + log_std.exp() * noise, mean, log_std)).mean()
        value_loss = clipped_value_loss(self.values(batch["obs"], batch["base"]), batch["old"], batch["returns"], c.ppo_clip).mean()
        self._descend(c.ppo_value_coef * value_loss - surrogate - c.ppo_entropy_coef * entropy)
        with torch.no_grad():
            share, ratio = open_.sum().clamp(min=1), log_ratio.exp()
            return {"policy_loss": -surrogate.detach(), "value_loss": value_loss.detach(), "entropy": entropy * len(open_) / share,
                    "kl": (open_ * (ratio - 1 - log_ratio)).sum() / share,
                    "clipped": (open_ * ((ratio - 1).abs() > c.ppo_clip)).sum() / share,
                    "residual_abs": self.actor.squash(mean).abs().mean()}

    def _descend(self, loss: torch.Tensor) -> None:
        """One gradient step."""
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.config.ppo_grad_clip)
        self.optimizer.step()
        self.updates += 1

    def scale_lr(self, factor: float) -> None:
        """Scale the learning rate (smaller late steps)."""
        for group, lr in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = lr * factor

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that training goes on from, as named tensors."""
        tensors = {"updates": torch.tensor(self.updates)} | pack(*self._parts())
        return {k: v.detach().cpu().clone().contiguous() for k, v in tensors.items()}

    def load(self, tensors: dict[str, torch.Tensor]) -> None:
        """Restore what `state` gave."""
        self.updates = int(tensors["updates"])
        unpack(tensors, *self._parts())

    def _parts(self):
        return {"actor": self.actor, "value": self.value}, {"adam": self.optimizer}
