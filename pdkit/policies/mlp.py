"""The plain behaviour-cloning MLP: one observation to one action, mean squared error (appendix D.1 names an MLP and gives no
sizes: ours)."""
from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..errors import PdkitError
from .base import Policy


class MLP(Policy):
    """Config: obs_dim, act_dim, window (1), hidden, layers (hidden ones; 0: a linear policy), std_floor (of the normaliser)."""

    kind = "mlp"
    defaults: dict[str, Any] = dict(window=1, hidden=256, layers=3, std_floor=0.0)
    least = dict(layers=0)

    def __init__(self, config: dict[str, Any]):
        super().__init__(config)
        c = self.config
        if c["window"] != 1:
            raise PdkitError(f"The MLP looks at one observation: leave window at 1 (now {c['window']}), or choose rnn or cnn.")
        sizes = [c["obs_dim"], *[c["hidden"]] * c["layers"]]
        layers = [m for a, b in zip(sizes[:-1], sizes[1:], strict=True) for m in (nn.Linear(a, b), nn.ReLU())]
        self.net = nn.Sequential(*layers, nn.Linear(sizes[-1], c["act_dim"]))

    def fit_statistics(self, observations: np.ndarray, actions: np.ndarray, seed: int = 0) -> None:
        """Normaliser from observations (N, obs_dim)."""
        self.normalizer.fit(observations, self.config["std_floor"])

    def loss(self, windows: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"loss": F.mse_loss(self.net(self.normalizer(windows)), actions)}

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        return self.net(self.normalizer(windows[:, -1:]))

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        return [{"params": list(self.net.parameters()), "weight_decay": weight_decay}]
