"""The actor and the critics: ReLU networks as in the paper's code (facts.md 1.3: 3x256; the lesson: 2x256), with LayerNorm as an option."""
from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import nn


def mlp(sizes: list[int], layer_norm: bool) -> nn.Sequential:
    """Linear, (LayerNorm,) ReLU for each consecutive pair of sizes."""
    layers: list[nn.Module] = []
    for a, b in zip(sizes[:-1], sizes[1:], strict=True):
        layers += [nn.Linear(a, b), *([nn.LayerNorm(b)] if layer_norm else []), nn.ReLU()]
    return nn.Sequential(*layers)


def xavier_uniform(module: nn.Module) -> None:
    """Start a linear layer anew, without bias, as the official code does on PushChair (facts.md 1.3); for `Module.apply`."""
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(module.weight)
        nn.init.zeros_(module.bias)


class Actor(nn.Module):
    """A tanh-squashed Gaussian over actions in [-1, 1]^act_dim.

    The heads start near zero (orthogonal, gain 0.01), so the first residuals are small. log_std is squashed to
    `log_std_range`: with the paper's (-20, 2) the untrained log_std is -9, a spread of 1e-4, which makes |log pi| huge at
    the start (facts.md 1.5, trap 6); with (-5, 2) it is -1.5.
    """

    def __init__(self, in_dim: int, act_dim: int, hidden: int, layers: int, layer_norm: bool, log_std_range: tuple[float, float]):
        super().__init__()
        self.config = dict(in_dim=in_dim, act_dim=act_dim, hidden=hidden, layers=layers, layer_norm=layer_norm,
                           log_std_range=list(log_std_range))
        self.net = mlp([in_dim, *[hidden] * layers], layer_norm)
        self.head = nn.Linear(hidden, 2 * act_dim)  # mean, then log_std
        for half in self.head.weight.data.chunk(2):
            nn.init.orthogonal_(half, 0.01)
        nn.init.zeros_(self.head.bias)
        self.low, self.high = log_std_range

    def heads(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log_std (B, act_dim) before tanh, float32."""
        mean, log_std = self.head(self.net(x)).float().chunk(2, dim=-1)
        return mean, self.low + 0.5 * (self.high - self.low) * (torch.tanh(log_std) + 1)

    def sample(self, x: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Reparameterised action (B, act_dim) for standard normal noise (B, act_dim), and its log probability (B,)."""
        mean, log_std = self.heads(x)
        u = mean + log_std.exp() * noise
        log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        # log(1 - tanh(u)^2), in the form that does not overflow
        log_prob = log_prob - 2 * (math.log(2) - u - F.softplus(-2 * u))
        return torch.tanh(u), log_prob.sum(dim=-1)

    def mean_action(self, x: torch.Tensor) -> torch.Tensor:
        """The deterministic action tanh(mean), (B, act_dim): what evaluation executes."""
        return self.squash(self.heads(x)[0])

    @staticmethod
    def squash(u: torch.Tensor) -> torch.Tensor:
        """From before the tanh to the action."""
        return torch.tanh(u)


class Critics(nn.Module):
    """An ensemble of independent Q-functions: (B, in_dim) -> (num, B), or only those of some members."""

    def __init__(self, in_dim: int, hidden: int, layers: int, num: int, layer_norm: bool):
        super().__init__()
        self.members = nn.ModuleList()
        for _ in range(num):
            last = nn.Linear(hidden, 1)
            nn.init.orthogonal_(last.weight, 0.01)
            nn.init.zeros_(last.bias)
            self.members.append(nn.Sequential(mlp([in_dim, *[hidden] * layers], layer_norm), last))

    def seen(self, x: torch.Tensor) -> torch.Tensor:
        """What the members see of a row: all of it."""
        return x

    def forward(self, x: torch.Tensor, members: Sequence[int] | None = None) -> torch.Tensor:
        x = self.seen(x)
        asked = list(self.members) if members is None else [self.members[i] for i in members]
        features = [hidden(x).to(last.weight.dtype) for hidden, last in asked]
        # The last layers compute in their own precision always: bfloat16 has steps of 0.0625 between 8 and 16, so that values a residual
        # apart would come out equal, and whoever compares them (ROT's Q-filter) or learns their difference (a target) would see nothing.
        with torch.autocast(x.device.type, enabled=False):
            return torch.stack([last(f)[:, 0] for f, (_, last) in zip(features, asked, strict=True)])
