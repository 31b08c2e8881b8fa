"""Cal-QL: critics from data alone that online learning can start from (Nakamoto et al. 2023; facts.md 3.3).

    critic i   mean (Q_i(s, a) - y)^2 + (w / c^2) * mean ( log sum exp L_i - c Q_i(s, a) ),   over K samples each,
               L_i = [ c Q_i(s, a_rand) - log 0.5^d,                          a_rand uniform in [-1, 1]^d
                       max(c Q_i(s, a_pi), c V) - log pi(a_pi | s),           a_pi from pi(. | s)
                       max(c Q_i(s, a_next), c V) - log pi(a_next | s') ]     a_next from pi(. | s'), but valued at s
    target     y = reward + discount * max_k min_i Qbar_i(s', a'_k),          no entropy

The term pushes down what actions outside the data promise; V, the Monte-Carlo return of the data at s, stops that for the policy's
actions (without the max it is CQL, whose values fall far below any real return and are unlearned online). Q of random actions has no
such floor, and none of them lies where a BeT for SAC may go beyond [-1, 1] (dimensions it scales). With n-step rows s' is the state n
steps on, in both places. c stands for the scale of the rewards: with c = 10 this is, up to a factor that Adam ignores, the loss for
rewards of -10 and 0 in place of the loop's -1 and 0. The original has -5 and, once, 5: as far apart, but a step's delay costs half as
much.
"""
from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
import torch

from ..decorator import actor_features, critic_features
from ..torch_setup import autocast
from .replay import NStep
from .sac import SAC


class WithReturns(NStep):
    """Rows with one more column, the Monte-Carlo return of their state and action; so they are complete when the episode is.

    Where an episode is cut rather than solved, its last reward is taken to go on for ever: a failed sparse one has
    r_neg / (1 - gamma) everywhere, as in the original.
    """

    def push(self, lane: int, obs, residual, base, reward: float, next_obs, next_base, stop: bool, done: bool) -> list[np.ndarray]:
        queue = self.waiting[lane]
        queue.append((obs, residual, base, reward))
        if not done:
            return []
        items = list(queue)
        queue.clear()
        steps, rows = NStep(1, self.n, self.gamma), []
        successors = [(o, b) for o, _, b, _ in items[1:]] + [(next_obs, next_base)]
        for t, (item, successor) in enumerate(zip(items, successors, strict=True), 1):
            last = t == len(items)
            rows += steps.push(0, *item, *successor, stop and last, last)
        value, returns = 0.0 if stop else reward / (1 - self.gamma), []
        for *_, r in reversed(items):
            value = r + self.gamma * value
            returns.append(value)
        return [np.append(row, mc).astype(np.float32) for row, mc in zip(rows, reversed(returns), strict=True)]


@dataclass(frozen=True)
class Conservative:
    """The numbers of the conservative term."""

    actions: int = 10  # K
    weight: float = 1.0  # w
    scale: float = 10.0  # c
    max_target: bool = True  # the best of K sampled actions in the target; otherwise one


class CalQL(SAC):
    """SAC whose critics are conservative for `offline_updates`, and then, with `stays`, go on like that.

    Args:
        log_volume: what the actor's log pi leaves out of the log density of its actions (weights are ratios of densities).
        restart: after the offline stage the actor starts over as it was given, and only the parameters train that were
            open then; offline all do. Critics go on (appendix B.5).
        others: as SAC has them.
    """

    def __init__(self, *args, rule: Conservative, offline_updates: int, stays: bool, log_volume: float = 0.0, restart: bool = False,
                 **others):
        self.rule, self.offline_updates, self.stays, self.log_volume, self._start = rule, offline_updates, stays, log_volume, None
        if restart:
            actor = others["actor"]
            self._start = copy.deepcopy(actor.state_dict()), {name for name, p in actor.named_parameters() if p.requires_grad}
            actor.requires_grad_(True)
        super().__init__(*args, **others)
        if not offline_updates:
            self._go_online()

    @property
    def conservative(self) -> bool:
        return self.stays or self.updates < self.offline_updates

    def update(self, batch, generator):
        if self.conservative:
            batch = batch | self._sampled(batch, generator)
        log = super().update(batch, generator)
        if self.updates == self.offline_updates:
            self._go_online()
        return log

    def load(self, tensors) -> None:
        if int(tensors["updates"]) >= self.offline_updates:
            self._go_online()
        super().load(tensors)

    def _go_online(self) -> None:
        if self._start is None:
            return
        weights, trained = self._start
        for actor in (self.actor, self.average):
            actor.load_state_dict(weights)
        self.actor_steps = 0
        for name, parameter in self.actor.named_parameters():
            parameter.requires_grad_(name in trained)
        c = self.config
        self.actor_optimizer = torch.optim.Adam([p for p in self.actor.parameters() if p.requires_grad], lr=c.actor_lr, fused=True)
        with torch.no_grad():  # the temperature belongs to the actor
            self.log_temperature.fill_(math.log(c.init_temperature))
        if c.autotune:
            self.temperature_optimizer = torch.optim.Adam([self.log_temperature], lr=c.critic_lr, fused=True)

    @torch.no_grad()
    def _sampled(self, batch, generator) -> dict[str, torch.Tensor]:
        """K actions (K, B, act_dim) of each kind, and the policy's log densities (K, B): one pass of the actor a state."""
        shape = (self.rule.actions, *batch["base"].shape)
        random = 2 * torch.rand(shape, generator=generator) - 1
        noise = torch.randn((2, *shape), generator=generator).to(self.device)
        sampled = {"random": random.to(self.device)}
        with autocast(self.device, self.config.bf16):
            for i, (name, at) in enumerate((("here", ""), ("ahead", "next_"))):
                features = actor_features(self.decorator, self.normalize(batch[f"{at}obs"]), batch[f"{at}base"])
                sampled[name], log_pi = self.actor.sample(features, noise[i])
                sampled[f"log_{name}"] = log_pi + self.log_volume
        return sampled

    def _values(self, critics, obs, base, actions: torch.Tensor) -> torch.Tensor:
        """Q (num_critics, K, B) of actions (K, B, act_dim) at normalised observations (B, stored)."""
        k, b = actions.shape[:2]
        features = critic_features(self.decorator, self.critic_view(obs).repeat(k, 1), base.repeat(k, 1), actions.flatten(0, 1))
        return critics(features).unflatten(1, (k, b))

    def td_target(self, batch, next_obs, noise, temperature, members=None) -> torch.Tensor:
        if not self.conservative:
            return super().td_target(batch, next_obs, noise, temperature, members)
        actions = batch["ahead"] if self.rule.max_target else batch["ahead"][:1]
        with torch.no_grad(), autocast(self.device, self.config.bf16):
            values = self._values(self.targets, next_obs, batch["next_base"], actions)
        values = values if members is None else values[members]
        return batch["reward"] + batch["discount"] * values.min(dim=0).values.max(dim=0).values

    def _critic_penalty(self, batch, obs, values):
        if not self.conservative:
            return 0.0
        c, base, bound = self.rule.scale, batch["base"], batch["mc"]
        actions = torch.cat([batch["random"], batch["here"], batch["ahead"]])
        random, here, ahead = self._values(self.critics, obs, base, actions).chunk(3, dim=1)
        parts = [c * random + base.shape[-1] * math.log(2), c * here.maximum(bound) - batch["log_here"],
                 c * ahead.maximum(bound) - batch["log_ahead"]]
        gap = torch.cat(parts, dim=1).logsumexp(dim=1) - c * values
        self._seen = {"conservative": gap.detach().mean(), "q_random": random.detach().mean(), "q_policy": here.detach().mean(),
                      "calibrated": (here < bound).float().mean()}
        return self.rule.weight / c**2 * gap.mean(dim=1).sum()

    def _update_critics(self, batch, *others):
        log = super()._update_critics(batch, *others)
        return log | self._seen if self.conservative else log
