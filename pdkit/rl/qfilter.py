"""SAC with imitation kept in the actor's loss as far as the critic agrees: ROT's adaptive Q-filter (facts.md 3.1).

    w = mean 1[ Q(s, a_BC) > Q(s, a) ],   loss = (1 - w) * (SAC's loss) + w * bc_weight * (imitation loss),   bc_weight = 0.03

a is the actor's sample, a_BC what imitation alone would do; Q is the least critic. The original regularises a deterministic actor,
whose loss is -Q alone; here (1 - w) takes the entropy term along.
"""
from __future__ import annotations

import torch

from ..decorator import critic_features
from .sac import SAC


class QFilteredSAC(SAC):
    """Subclasses say what imitation would do, and how far the actor is from it on demonstrations."""

    bc_weight = 0.0

    def reference(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        """a_BC as a residual (B, act_dim)."""
        raise NotImplementedError

    def imitation_loss(self, generator: torch.Generator) -> torch.Tensor:
        """A scalar, on demonstrations drawn with `generator`."""
        raise NotImplementedError

    def update(self, batch: dict[str, torch.Tensor], generator: torch.Generator, critics: bool = True) -> dict[str, torch.Tensor]:
        self._generator = generator
        return super().update(batch, generator, critics)

    def filter_weight(self, batch: dict[str, torch.Tensor], obs: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        """w for normalised observations and the values (B,) of the actor's own actions."""
        with torch.no_grad():
            features = critic_features(self.decorator, self.critic_view(obs), batch["base"], self.reference(batch))
            return (self.critics(features).min(dim=0).values > value).float().mean()

    def _actor_loss(self, loss, batch, obs, value) -> torch.Tensor:
        self._weight = self.filter_weight(batch, obs, value)
        return (1 - self._weight) * loss + self._weight * self.bc_weight * self.imitation_loss(self._generator)

    def _update_actor(self, batch, obs, noise, temperature) -> dict[str, torch.Tensor]:
        return super()._update_actor(batch, obs, noise, temperature) | {"bc_share": self._weight}
