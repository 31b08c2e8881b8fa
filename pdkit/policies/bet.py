"""Behavior Transformer (Shafiullah et al., 2022) as Policy Decorator trains it (facts.md 2.1).

Actions are split into a k-means bin and an offset from its centre. A GPT reads a window of observations and, at every
position, predicts which bin (focal loss) and the offset for each bin (squared error at the true bin, weighted 1000).
Acting takes the most likely bin's centre plus its offset, at the last position. The kit's numbers are smaller, so that a CPU trains it in
minutes: a window of 10, 1,500 gradient steps at a rate of 1e-3 on batches of 256, no dropout while it acts; the official code has 20,
200,000, 1e-4, 2,048, and dropout on (StackCube 1e-3 and 4,096, PegInsertionSide an embedding of 256, PushChair 16 bins), and the best of
evaluations every 5,000 steps on 100 episodes: `pdkit train base TASK --profile paper`.
"""
from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..errors import PdkitError
from .base import Policy


class Block(nn.Module):
    """A pre-norm transformer block with causal self-attention: (B, T, C) -> (B, T, C), or with `last` -> (B, 1, C), the last position's.
    """

    def __init__(self, embed: int, heads: int, dropout: float):
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.norm1, self.norm2 = nn.LayerNorm(embed), nn.LayerNorm(embed)
        self.qkv, self.proj = nn.Linear(embed, 3 * embed), nn.Linear(embed, embed)
        self.fc1, self.fc2 = nn.Linear(embed, 4 * embed), nn.Linear(4 * embed, embed)

    def forward(self, x: torch.Tensor, last: bool = False) -> torch.Tensor:
        batch, length, embed = x.shape
        q, k, v = self.qkv(self.norm1(x)).view(batch, length, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        if last:
            q, x, length = q[:, :, -1:], x[:, -1:], 1
        dropout = self.dropout if self.training else 0.0
        y = F.scaled_dot_product_attention(q, k, v, is_causal=not last, dropout_p=dropout)  # the last position may see all others
        x = x + F.dropout(self.proj(y.transpose(1, 2).reshape(batch, length, embed)), self.dropout, self.training)
        y = self.fc2(F.gelu(self.fc1(self.norm2(x))))
        return x + F.dropout(y, self.dropout, self.training)


class GPT(nn.Module):
    """Observations (B, T, obs_dim) -> features (B, T, out_dim); position t sees positions <= t only.

    With `last` only those of the last position, (B, 1, out_dim): a quarter less work, for learners that read nothing else.
    All weights start with a spread of 0.02; in the official code (minGPT's) those of the layers that end on the residual stream start
    sqrt(2 * layers) times smaller, and the features have no bias.
    """

    def __init__(self, obs_dim: int, out_dim: int, window: int, layers: int, heads: int, embed: int, dropout: float):
        super().__init__()
        self.inp = nn.Linear(obs_dim, embed)
        self.position = nn.Parameter(torch.zeros(window, embed))
        self.dropout = dropout
        self.blocks = nn.ModuleList(Block(embed, heads, dropout) for _ in range(layers))
        self.norm = nn.LayerNorm(embed)
        self.out = nn.Linear(embed, out_dim)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)
        nn.init.normal_(self.position, std=0.02)

    def forward(self, x: torch.Tensor, last: bool = False) -> torch.Tensor:
        x = F.dropout(self.inp(x) + self.position[: x.shape[1]], self.dropout, self.training)
        for number, block in enumerate(self.blocks, 1):
            x = block(x, last and number == len(self.blocks))
        return self.out(self.norm(x))


def focal_loss(logits: torch.Tensor, target: torch.Tensor, gamma: float) -> torch.Tensor:
    """Mean of -(1 - p)^gamma log p, p being the probability given to the true class; logits (B, K), target (B,)."""
    log_p = F.log_softmax(logits, dim=-1).gather(1, target[:, None])[:, 0]
    return (-((1 - log_p.exp()) ** gamma) * log_p).mean()


class BeT(Policy):
    """The policy. Config: obs_dim, act_dim, window, bins, layers, heads, embed, features, dropout, focal_gamma,
    offset_weight, act_dropout (leave dropout on when acting, as the paper's code does: facts.md 1.5, trap 3), std_floor (of the
    normaliser)."""

    kind = "bet"
    defaults: dict[str, Any] = dict(window=10, bins=8, layers=4, heads=4, embed=128, features=256, dropout=0.1, focal_gamma=2.0,
                                    offset_weight=1000.0, act_dropout=False, std_floor=0.0)

    def __init__(self, config: dict[str, Any]):
        super().__init__(config)
        c = self.config
        if c["dropout"] >= 1:
            raise PdkitError(f"BeT's dropout is the share of features that is dropped; it must be below 1, not {c['dropout']}.")
        if c["embed"] % c["heads"]:
            raise PdkitError(f"BeT's embed ({c['embed']}) must be a multiple of its heads ({c['heads']}).")
        self.window = c["window"]
        self.gpt = GPT(c["obs_dim"], c["features"], c["window"], c["layers"], c["heads"], c["embed"], c["dropout"])
        self.head = nn.Linear(c["features"], c["bins"] * (1 + c["act_dim"]))  # K logits, then K offsets
        nn.init.normal_(self.head.weight, std=0.02)
        nn.init.zeros_(self.head.bias)
        self.register_buffer("centres", torch.zeros(c["bins"], c["act_dim"]))

    @property
    def samples(self) -> bool:
        return self.config["act_dropout"] and self.config["dropout"] > 0

    def train(self, mode: bool = True) -> BeT:
        """Switch dropout; with `act_dropout` it stays on."""
        return super().train(mode or self.config["act_dropout"])

    def fit_statistics(self, observations: np.ndarray, actions: np.ndarray, seed: int = 0) -> None:
        """Normaliser from observations (N, obs_dim), bin centres by k-means over actions (N, act_dim)."""
        from sklearn.cluster import KMeans

        self.normalizer.fit(observations, self.config["std_floor"])
        bins = self.config["bins"]
        if len(actions) < bins:
            raise PdkitError(f"k-means with {bins} bins needs at least {bins} actions, not {len(actions)}; use more demonstrations.")
        means = KMeans(bins, max_iter=50, n_init=1, random_state=seed).fit(actions)
        self.centres.copy_(torch.from_numpy(means.cluster_centers_))

    def _heads(self, windows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits (B, T, K) and offsets (B, T, K, act_dim)."""
        out = self.head(self.gpt(self.normalizer(windows)))
        bins = self.config["bins"]
        return out[..., :bins], out[..., bins:].unflatten(-1, (bins, -1))

    def loss(self, windows: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        logits, offsets = self._heads(windows)
        logits, offsets, actions = logits.flatten(0, 1).float(), offsets.flatten(0, 1).float(), actions.flatten(0, 1)
        target = torch.cdist(actions, self.centres).argmin(dim=1)
        focal = focal_loss(logits, target, self.config["focal_gamma"])
        chosen = offsets[torch.arange(len(target), device=target.device), target]
        offset = F.mse_loss(chosen, actions - self.centres[target])
        return {"loss": focal + self.config["offset_weight"] * offset, "focal": focal, "offset_mse": offset,
                "bin_accuracy": (logits.argmax(-1) == target).float().mean()}

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        logits, offsets = self._heads(windows)
        logits, offsets = logits[:, -1], offsets[:, -1]
        choice = logits.argmax(dim=-1)
        action = self.centres[choice] + offsets[torch.arange(len(choice), device=choice.device), choice]
        return action[:, None]

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        """AdamW groups as in the paper's code: decay on the GPT's linear weights, none on biases, norms and positions,
        AdamW's own 0.01 on the prediction head."""
        decay = [m.weight for m in self.gpt.modules() if isinstance(m, nn.Linear)]
        chosen = {id(p) for p in decay}
        rest = [p for p in self.gpt.parameters() if id(p) not in chosen]
        return [{"params": decay, "weight_decay": weight_decay}, {"params": rest, "weight_decay": 0.0},
                {"params": list(self.head.parameters()), "weight_decay": 0.01}]
