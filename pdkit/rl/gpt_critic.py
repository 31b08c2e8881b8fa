"""Critics on a transformer: the two other architectures of appendix F.5.1, for fine-tuning by SAC and by PPO.

    mlp        Q(o, a)      a small network on the last observation (pdkit/rl/networks.py): the default
    shared     Q(f(w), a)   the same head on features of the window w; f is the ACTOR'S transformer, its very weights
    separate   Q(g(w), a)   g a transformer of its own, which starts as the actor's does

Features are those that the actor's heads read: the transformer's output at the last position. PPO's value function has no action.
The page that lists the three is missing in our copy: of the other two it leaves "a separate GPT backbone" to read, and that the second
shares the actor's is our reading. What follows is ours, too:

    both Q      are heads on one transformer: their difference is the heads' alone, and a second transformer would double the cost
    adapters    the critic's transformer trains what the actor's does: the adapters on attention, or all weights with lora = 0
    critic loss goes through the features, so with `shared` it moves the actor, also between the actor's own steps
    actor loss  goes through the action only. Q's features are held, or else the actor could raise Q(f(w), a) by changing what the
                critic looks at instead of what the policy does. Through the actor's own heads it trains f as ever: with `shared`
                both losses move f, SAC by two optimisers, each with its own moments and its own clipping, PPO by the sum of the losses
    target      a slow copy of heads AND transformer: with the present f in it the target would jump with every step of the actor
    averaging   of the actor as a whole, its transformer included, whoever moved it
"""
from __future__ import annotations

import torch
from torch import nn

from ..errors import PdkitError
from ..policies.bet_sac import BeTForSAC
from .networks import Critics
from .sac import SAC, SACConfig


class Backbone(nn.Module):
    """A policy's transformer up to the features that its heads read: stored windows (B, window * obs_dim) -> (B, features).

    It holds the policy's own modules, not copies.
    """

    def __init__(self, policy: BeTForSAC):
        super().__init__()
        self.normalizer, self.gpt, self.window = policy.normalizer, policy.gpt, policy.window
        self.in_dim, self.out_dim = policy.window * policy.config["obs_dim"], policy.config["features"]

    def forward(self, stored: torch.Tensor) -> torch.Tensor:
        return self.gpt(self.normalizer(stored.unflatten(-1, (self.window, -1))), last=True)[:, 0]


class GPTCritics(Critics):
    """Critics that read a transformer's features where plain ones read an observation: (B, window * obs_dim + further) -> (num, B).

    Args:
        backbone: what makes the features.
        further: width of what follows the window in a row (the action; 0 for a value function).
        sizes: hidden, layers and critic_layer_norm of the heads.
        num: how many heads.
    """

    def __init__(self, backbone: Backbone, further: int, sizes: SACConfig, num: int):
        super().__init__(backbone.out_dim + further, sizes.hidden, sizes.layers, num, sizes.critic_layer_norm)
        self.backbone, self.held = backbone, False

    def hold(self, hold: bool) -> None:
        """While held, values have gradients with respect to the action only: neither heads nor features."""
        self.held = hold
        self.members.requires_grad_(not hold)

    def seen(self, x: torch.Tensor) -> torch.Tensor:
        window, further = x[..., : self.backbone.in_dim], x[..., self.backbone.in_dim:]
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.held):
            features = self.backbone(window)
        return torch.cat([features, further], dim=-1)


class GPTSAC(SAC):
    """SAC whose critics are `GPTCritics`."""

    def _hold_critics(self, hold: bool) -> None:
        self.critics.hold(hold)

    def _actor_moves(self) -> bool:
        return super()._actor_moves() or self.critics.backbone.gpt is self.actor.gpt  # a shared one moves with the critics' every step

    def _clipped(self) -> list[nn.Module]:
        return [*self.critics.members, self.critics.backbone]


def make_backbone(kind: str, actor: BeTForSAC, start: BeTForSAC, lora: int, critic_warmup: int = 0) -> Backbone:
    """The critic's transformer: that of `actor` ("shared"), or another of `start`, the policy before fine-tuning ("separate").

    Raises PdkitError for a shared one in a warm-up of the critic: it would move the actor, which is to stand still.
    """
    if kind == "separate":
        return Backbone(start.with_lora(lora))
    if critic_warmup:
        raise PdkitError("A critic on the actor's transformer moves the actor with every step, so it cannot be warmed up alone: set "
                         "critic_warmup=0, or critic_backbone to mlp or separate.")
    return Backbone(actor)
