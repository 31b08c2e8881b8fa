"""DIPO: reinforcement learning turned into imitation of improved actions (Yang et al., 2023; appendix B.4.2, H.2; facts.md 3.7).

    target   y = reward + discount * min_i Qbar_i(s', a'),   a' by the target policy from noise
    critic   sum_i mean (Q_i(s, a) - y)^2
    actions  K times  a <- clamp(a + Adam step of size lr up the gradient of min_i Q_i(s, a), -1, 1),  written back to where they came from
    actor    the diffusion loss, on the improved actions

Two replays: the critics learn from what was executed and what came of it, the actor from a memory of its own, in which actions are
moved further each time they are drawn and so drift from the executed ones. The gradient of a batch is clipped, as a whole, to a norm
of 0.1 for each number of an action. There is no entropy term. The target policy follows the actor as the target critics follow the critics.

Moved actions are put back, as DPPO's port does it (with 10 steps of 1e-4, so by next to nothing) and the original's code says: there
numpy copies them into a temporary array, so that every draw starts from the executed action again and moves it by 0.6 at most.

Diffusion Policy predicts a sequence of `horizon` actions, of which the chunk that begins at the latest observation is executed and
valued: that part alone is moved (appendix B.4.2: moving the rest would make it disagree with the dynamics), and the actor imitates
the whole sequence with that part replaced.
"""
from __future__ import annotations

import copy
import dataclasses

import numpy as np
import torch

from ..decorator import DecoratorConfig, critic_features
from ..policies import DiffusionPolicy
from ..torch_setup import autocast
from .sac import SAC, SACConfig


@dataclasses.dataclass(frozen=True)
class ActionGradient:
    """The numbers of the ascent in actions."""

    steps: int = 20  # K
    lr: float = 0.03
    norm: float = 0.1  # of a batch's gradient, times the numbers in one action


class Sequences:
    """The actor's memory, a ring: stored windows (obs_dim) beside predicted sequences (horizon, act_dim), which can be replaced."""

    def __init__(self, capacity: int, obs_dim: int, horizon: int, act_dim: int, device: str = "cpu"):
        self.obs = torch.zeros(capacity, obs_dim, device=device)
        self.actions = torch.zeros(capacity, horizon, act_dim, device=device)
        self.size, self.position = 0, 0

    def add(self, obs: np.ndarray, actions: torch.Tensor) -> None:
        """Append windows (N, obs_dim) and sequences (N, horizon, act_dim), overwriting the oldest when full."""
        where = (self.position + torch.arange(len(obs))) % len(self.obs)
        self.obs[where], self.actions[where] = torch.from_numpy(obs).to(self.obs), actions
        self.position = (self.position + len(obs)) % len(self.obs)
        self.size = min(self.size + len(obs), len(self.obs))

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Which rows were drawn, uniformly with replacement (count,), and their windows and sequences."""
        rows = torch.randint(self.size, (count,), generator=generator).to(self.obs.device)
        return rows, self.obs[rows], self.actions[rows]

    def replace(self, rows: torch.Tensor, actions: torch.Tensor) -> None:
        """Put sequences (B, horizon, act_dim) where `rows` (B,) were drawn."""
        self.actions[rows] = actions


class DIPO(SAC):
    """The learner: SAC's critics without entropy, an actor that imitates.

    Args:
        obs_dim, act_dim: what critics see of an observation, and the numbers in one decision.
        actor: the policy; it sees stored windows through its own normaliser.
        memory: where its sequences are kept.
        rule: how they are improved.
        critic_view: what critics see of a stored window, (B, stored) -> (B, obs_dim).
    """

    def __init__(self, obs_dim: int, act_dim: int, config: SACConfig, decorator: DecoratorConfig, *, actor: DiffusionPolicy,
                 memory: Sequences, rule: ActionGradient, critic_view, device: str = "cpu"):
        config = dataclasses.replace(config, autotune=False)  # no entropy, no temperature
        super().__init__(obs_dim, act_dim, config, decorator, actor=actor, critic_view=critic_view, device=device)
        self.memory, self.rule = memory, rule
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.executed = slice(actor.window - 1, actor.window - 1 + actor.chunk)  # of a sequence

    @torch.no_grad()
    def act(self, obs: torch.Tensor, noise: torch.Tensor, actor: DiffusionPolicy | None = None) -> torch.Tensor:
        """Sequences (B, horizon, act_dim) in [-1, 1] for stored windows (B, stored) and standard normal noise of the sequences' shape."""
        actor = actor or self.actor
        with autocast(self.device, self.config.bf16):
            return actor.denoise(self._windows(obs), noise).float().clamp(-1, 1)

    def _windows(self, obs: torch.Tensor) -> torch.Tensor:
        return obs.unflatten(-1, (self.actor.window, -1))

    def update(self, batch, generator):
        shape = (len(batch["reward"]), *self.memory.actions.shape[1:])
        noise = torch.randn(shape, generator=generator).to(self.device)
        log = self._update_critics(batch, batch["obs"], batch["next_obs"], noise, None, None)
        if self.updates >= self.config.critic_warmup and self.updates % self.config.actor_every == 0:
            log |= self._imitate(len(noise), generator)
        with torch.no_grad():
            for target, source in ((self.targets, self.critics), (self.target_actor, self.actor)):
                torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), self.config.tau)
        self.updates += 1
        return log

    def td_target(self, batch, next_obs, noise, temperature=None, members=None) -> torch.Tensor:
        actions = self.act(next_obs, noise, self.target_actor)[:, self.executed].flatten(1)
        with torch.no_grad(), autocast(self.device, self.config.bf16):
            values = self.targets(critic_features(self.decorator, self.critic_view(next_obs), batch["next_base"], actions))
        return batch["reward"] + batch["discount"] * values.min(dim=0).values

    def improved(self, obs: torch.Tensor, sequences: torch.Tensor) -> torch.Tensor:
        """Sequences (B, horizon, act_dim) at stored windows (B, stored) with their executed part moved to where the critics, as they
        stand, see more value."""
        seen, actions = self.critic_view(obs), sequences[:, self.executed].flatten(1).clone().requires_grad_()
        base, optimizer = torch.zeros_like(actions), torch.optim.Adam([actions], lr=self.rule.lr, eps=1e-5)
        self._hold_critics(True)
        for _ in range(self.rule.steps):
            with autocast(self.device, self.config.bf16):
                value = self.critics(critic_features(self.decorator, seen, base, actions)).min(dim=0).values.sum()
            optimizer.zero_grad()
            (-value).backward()
            torch.nn.utils.clip_grad_norm_([actions], self.rule.norm * actions.shape[1])
            optimizer.step()
            with torch.no_grad():
                actions.clamp_(-1, 1)
        self._hold_critics(False)
        better = sequences.clone()
        better[:, self.executed] = actions.detach().view_as(better[:, self.executed])
        return better

    def _imitate(self, count: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Improve `count` sequences of the memory there, and take a step of the diffusion loss on them."""
        rows, obs, sequences = self.memory.draw(count, generator)
        better = self.improved(obs, sequences)
        self.memory.replace(rows, better)
        with autocast(self.device, self.config.bf16):
            loss = self.actor.loss(self._windows(obs), better)["loss"]
        self.actor_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.actor.parameters(), self.config.grad_clip)
        self.actor_optimizer.step()
        self._average_actor()
        return {"actor_loss": loss.detach(), "action_moved": (better - sequences)[:, self.executed].abs().mean()}

    def state(self):
        memory = {"memory_obs": self.memory.obs, "memory_actions": self.memory.actions}
        kept = {name: rows[: self.memory.size].cpu().clone() for name, rows in memory.items()}
        return super().state() | kept | {"memory_position": torch.tensor(self.memory.position)}

    def load(self, tensors) -> None:
        super().load(tensors)
        self.memory.size, self.memory.position = len(tensors["memory_obs"]), int(tensors["memory_position"])
        self.memory.obs[: self.memory.size] = tensors["memory_obs"]
        self.memory.actions[: self.memory.size] = tensors["memory_actions"]

    def _modules(self):
        return super()._modules() | {"target_actor": self.target_actor}
