"""Soft actor-critic on residual actions (Haarnoja et al., 2018; facts.md 1.1 to 1.3).

    target   y = reward + discount * (min_i Qbar_i(s', a') - temperature * log pi(a_res' | s')),  a' = compose(base', a_res')
    critic   sum_i mean (Q_i(s, a) - y)^2
    actor    mean (temperature * log pi(a_res | s) - min_i Q_i(s, compose(base, a_res))) + penalty * mean a_res^2
    temperature   -log_temperature * mean (log pi + target_entropy)

With num_critics > 2 and target_subset = M this is the learner of RLPD (Ball et al., 2023; facts.md 3.2): the target takes the least of
M critics drawn anew for each update, and with actor_value = "mean" the actor climbs the mean of all. Its high update-to-data ratio and
symmetric sampling are the loop's (utd, demo_fraction; pdkit/methods).

log pi is that of the unscaled residual: alpha does not enter the entropy. Plain SAC is the case base = 0, alpha = 1.
"""
from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import nn

from ..decorator import DecoratorConfig, actor_features, critic_features
from ..errors import PdkitError, unknown
from ..torch_setup import autocast
from .networks import Actor, Critics, xavier_uniform
from .state import pack, unpack

ACTOR_VALUES = ("min", "mean")


def _same(x: torch.Tensor) -> torch.Tensor:
    return x


@dataclass(frozen=True)
class SACConfig:
    """Optimisation and networks; the defaults are the lesson profile's, the paper's are in profiles.py."""

    actor_lr: float = 6e-4
    critic_lr: float = 1e-3  # the temperature uses it too
    tau: float = 0.01  # step of the target critics towards the critics
    hidden: int = 256
    layers: int = 2
    num_critics: int = 2
    critic_layer_norm: bool = True  # DAWN, RLPD: keeps values bounded off the data
    actor_layer_norm: bool = False
    xavier_init: bool = False  # every layer starts Xavier-uniform, the last ones included (the official code on PushChair)
    log_std_range: tuple[float, float] = (-5.0, 2.0)  # the paper's code: (-20, 2)
    init_temperature: float = 0.01  # the paper's: 1.0
    autotune: bool = True  # learn the temperature
    target_entropy_scale: float = 1.0  # target entropy = -scale * act_dim
    entropy_backup: bool = True  # the entropy term inside the target
    target_subset: int = 0  # the target takes the least of so many critics, drawn anew each update (RLPD: 2 of 10); 0: of all
    actor_value: str = "min"  # what the actor climbs: the least critic, or their mean (RLPD)
    critic_warmup: int = 0  # updates before the actor moves (appendix F.5.2); the temperature is learned meanwhile
    grad_clip: float = 50.0  # global norm, separately for each critic and the actor
    residual_penalty: float = 1.0  # weight of mean a_res^2 in the actor's loss: no drift where the critic has no preference
    actor_every: int = 2  # critic updates per actor update
    average: float = 0.9995  # decay, a step of the actor, of the averaged one that evaluation uses; 0 evaluates the last weights
    bf16: bool = True  # autocast to bfloat16 where the hardware has it
    compile: bool = False  # torch.compile of the networks: on a CPU minutes of compiling for 4 %; for CUDA see `pdkit bench`

    def __post_init__(self):
        if self.num_critics < 1 or self.actor_lr <= 0 or self.critic_lr <= 0 or not 0 < self.tau <= 1 or not 0 <= self.average < 1:
            raise PdkitError("SAC needs num_critics >= 1, positive learning rates, tau in (0, 1] and average in [0, 1).")
        if self.hidden < 1 or self.layers < 1 or self.actor_every < 1 or self.init_temperature <= 0 or self.grad_clip <= 0:
            raise PdkitError("SAC needs hidden, layers and actor_every of 1 or more, and init_temperature and grad_clip above 0.")
        if not self.log_std_range[0] < self.log_std_range[1] or self.residual_penalty < 0:
            raise PdkitError("SAC needs a log_std_range whose first number is the smaller one, and residual_penalty of 0 or more.")
        if not 0 <= self.target_subset <= self.num_critics or self.critic_warmup < 0:
            raise PdkitError("SAC needs target_subset from 0 to num_critics, and critic_warmup of 0 or more.")
        if self.actor_value not in ACTOR_VALUES:
            raise unknown("actor_value", self.actor_value, ACTOR_VALUES)


class SAC:
    """The learner.

    Args:
        obs_dim, act_dim: what critics see of an observation, and the action.
        normalize: maps stored observations before any network sees them (identity by default).
        actor: another actor than the small Gaussian one: a module with `sample` and `mean_action` as `Actor` has them.
        critics: other critics than the plain ones: a `Critics`.
        critic_view: what critics see of a normalised observation, (B, stored) -> (B, obs_dim); all of it by default.
    """

    def __init__(self, obs_dim: int, act_dim: int, config: SACConfig, decorator: DecoratorConfig, *, normalize=None,
                 actor: nn.Module | None = None, critics: Critics | None = None, critic_view=None, device: str = "cpu"):
        self.config, self.decorator, self.device = config, decorator, device
        self.normalize, self.critic_view = normalize or _same, critic_view or _same
        c = config
        self.actor = (actor or Actor(decorator.actor_dim(obs_dim, act_dim), act_dim, c.hidden, c.layers, c.actor_layer_norm,
                                     c.log_std_range)).to(device)
        self.critics = (critics or Critics(decorator.critic_dim(obs_dim, act_dim), c.hidden, c.layers, c.num_critics,
                                           c.critic_layer_norm)).to(device)
        for own in [part for part, given in ((self.actor, actor), (self.critics, critics)) if given is None and c.xavier_init]:
            own.apply(xavier_uniform)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.average = copy.deepcopy(self.actor).requires_grad_(False)
        if c.compile:
            self.critics.compile()
            self.targets.compile()
            for part in self.actor.children():  # in place: a compiled method would stay this actor's own in every copy
                part.compile()
        self.log_temperature = torch.full((), math.log(c.init_temperature), device=device, requires_grad=c.autotune)
        self.target_entropy = -c.target_entropy_scale * act_dim
        self.actor_optimizer = torch.optim.Adam([p for p in self.actor.parameters() if p.requires_grad], lr=c.actor_lr, fused=True)
        self.critic_optimizer = torch.optim.Adam([p for p in self.critics.parameters() if p.requires_grad], lr=c.critic_lr, fused=True)
        self.temperature_optimizer = torch.optim.Adam([self.log_temperature], lr=c.critic_lr, fused=True) if c.autotune else None
        self.updates = self.actor_steps = 0  # of everything; of the actor, since it was last as it was given

    @torch.no_grad()
    def act(self, obs: torch.Tensor, base: torch.Tensor, noise: torch.Tensor | None = None) -> torch.Tensor:
        """Residuals (B, act_dim) in [-1, 1]: sampled with the given normal noise, or, without, the deterministic ones of the
        averaged actor (of the last one when average is 0)."""
        with autocast(self.device, self.config.bf16):
            x = actor_features(self.decorator, self.normalize(obs), base)
            if noise is not None:
                return self.actor.sample(x, noise)[0]
            return (self.average if self.config.average else self.actor).mean_action(x)

    def update(self, batch: dict[str, torch.Tensor], generator: torch.Generator, critics: bool = True) -> dict[str, torch.Tensor]:
        """One gradient step on each part, the critics only if asked; scalar tensors for the log (no synchronisation with the device)."""
        obs, next_obs = self.normalize(batch["obs"]), self.normalize(batch["next_obs"])
        noise = torch.randn((2, *batch["base"].shape), generator=generator).to(self.device)
        temperature = self.log_temperature.detach().exp()
        c = self.config
        members = torch.randperm(c.num_critics, generator=generator)[: c.target_subset].tolist() if c.target_subset else None
        log = self._update_critics(batch, obs, next_obs, noise[0], temperature, members) if critics else {}
        if self.updates % self.config.actor_every == 0:
            log |= self._update_actor(batch, obs, noise[1], temperature)
        with torch.no_grad():
            torch._foreach_lerp_(list(self.targets.parameters()), list(self.critics.parameters()), self.config.tau)
        self.updates += 1
        return log

    def td_target(self, batch, next_obs, noise, temperature, members: list[int] | None = None) -> torch.Tensor:
        """y, (B,); the least of the target critics `members`, or of all."""
        with torch.no_grad(), autocast(self.device, self.config.bf16):
            residual, log_pi = self.actor.sample(actor_features(self.decorator, next_obs, batch["next_base"]), noise)
            features = critic_features(self.decorator, self.critic_view(next_obs), batch["next_base"], residual)
            if self.config.compile and members:  # all are computed: each choice of members would be compiled for itself
                value = self.targets(features)[members].min(dim=0).values
            else:
                value = self.targets(features, members).min(dim=0).values
            if self.config.entropy_backup:
                value = value - temperature * log_pi
            return batch["reward"] + batch["discount"] * value

    def _update_critics(self, batch, obs, next_obs, noise, temperature, members) -> dict[str, torch.Tensor]:
        target = self.td_target(batch, next_obs, noise, temperature, members)
        with autocast(self.device, self.config.bf16):
            values = self.critics(critic_features(self.decorator, self.critic_view(obs), batch["base"], batch["residual"]))
            loss = F.mse_loss(values, target.expand_as(values), reduction="none").mean(dim=1).sum()
            loss = loss + self._critic_penalty(batch, obs, values)
        self.critic_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for part in self._clipped():
            torch.nn.utils.clip_grad_norm_(part.parameters(), self.config.grad_clip)
        self.critic_optimizer.step()
        return {"critic_loss": loss.detach() / self.config.num_critics, "q_mean": values.detach().mean(), "target_mean": target.mean()}

    def _critic_penalty(self, batch, obs, values) -> torch.Tensor | float:
        """What a subclass adds to the critics' loss, summed over them; `values` (num_critics, B) are those of the batch's actions."""
        return 0.0

    def _update_actor(self, batch, obs, noise, temperature) -> dict[str, torch.Tensor]:
        self._hold_critics(True)
        with autocast(self.device, self.config.bf16):
            residual, log_pi = self.actor.sample(actor_features(self.decorator, obs, batch["base"]), noise)
            values = self.critics(critic_features(self.decorator, self.critic_view(obs), batch["base"], residual))
            value = values.mean(dim=0) if self.config.actor_value == "mean" else values.min(dim=0).values
            loss = (temperature * log_pi - value).mean() + self.config.residual_penalty * residual.square().mean()
            loss = self._actor_loss(loss, batch, obs, value)
        if self.updates >= self.config.critic_warmup:
            self.actor_optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.actor.parameters(), self.config.grad_clip)
            self.actor_optimizer.step()
        self._hold_critics(False)
        if self._actor_moves():
            self._average_actor()
        entropy = -log_pi.detach().mean()
        if self.temperature_optimizer:
            self.temperature_optimizer.zero_grad(set_to_none=True)
            (self.log_temperature * (entropy - self.target_entropy)).backward()
            self.temperature_optimizer.step()
        return {"actor_loss": loss.detach(), "entropy": entropy, "temperature": temperature, "residual_abs": residual.detach().abs().mean()}

    def _actor_moves(self) -> bool:
        """Whether this update moves the actor, or it stands still while the critics warm up."""
        return self.updates >= self.config.critic_warmup

    @torch.no_grad()
    def _average_actor(self) -> None:
        """Take the actor, which has just moved, into the average."""
        self.actor_steps += 1
        if self.config.average:
            # A plain mean of where its steps led at first (decay 1 - 1/k), so that the start is forgotten quickly.
            decay = min(self.config.average, 1 - 1 / self.actor_steps)
            torch._foreach_lerp_(list(self.average.parameters()), list(self.actor.parameters()), 1 - decay)

    def _hold_critics(self, hold: bool) -> None:
        """Leave the critics out of the gradients while the actor moves: theirs would be thrown away."""
        self.critics.requires_grad_(not hold)

    def _clipped(self) -> Sequence[nn.Module]:
        """Parts of the critics whose gradients are clipped each by its own norm."""
        return self.critics.members

    def _actor_loss(self, loss: torch.Tensor, batch, obs: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        """What the actor descends, of SAC's own loss and the values (B,) of its actions: some methods add to it."""
        return loss

    def scale_lr(self, factor: float) -> None:
        """Scale the learning rates of actor and critics (smaller late steps)."""
        for optimizer, lr in ((self.actor_optimizer, self.config.actor_lr), (self.critic_optimizer, self.config.critic_lr)):
            for group in optimizer.param_groups:
                group["lr"] = lr * factor

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that training goes on from, as named tensors."""
        tensors = {"log_temperature": self.log_temperature.detach(), "updates": torch.tensor(self.updates),
                   "actor_steps": torch.tensor(self.actor_steps)}
        tensors |= pack(self._modules(), self._optimizers())
        return {k: v.detach().cpu().clone().contiguous() for k, v in tensors.items()}

    def load(self, tensors: dict[str, torch.Tensor]) -> None:
        """Restore what `state` gave."""
        with torch.no_grad():
            self.log_temperature.copy_(tensors["log_temperature"])
        self.updates, self.actor_steps = (int(tensors[name]) for name in ("updates", "actor_steps"))
        unpack(tensors, self._modules(), self._optimizers())

    def _modules(self):
        return {"actor": self.actor, "critics": self.critics, "targets": self.targets, "average": self.average}

    def _optimizers(self):
        optimizers = {"adam_actor": self.actor_optimizer, "adam_critic": self.critic_optimizer,
                      "adam_temperature": self.temperature_optimizer}
        return {name: optimizer for name, optimizer in optimizers.items() if optimizer is not None}
