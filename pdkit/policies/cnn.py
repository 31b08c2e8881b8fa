"""A convolutional policy: filters run over the time of a window of observations, then one layer acts (appendix D.1 names a CNN and gives
no numbers: ours)."""
from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..errors import PdkitError
from .base import Policy


class CNN(Policy):
    """Config: obs_dim, act_dim, window, hidden (channels), layers, kernel (odd, in steps), std_floor (of the normaliser)."""

    kind = "cnn"
    defaults: dict[str, Any] = dict(window=8, hidden=128, layers=3, kernel=3, std_floor=0.0)

    def __init__(self, config: dict[str, Any]):
        super().__init__(config)
        c = self.config
        if c["kernel"] % 2 != 1:
            raise PdkitError(f"The CNN's kernel must be odd, so that the window keeps its length, not {c['kernel']}.")
        self.window = c["window"]
        sizes = [c["obs_dim"], *[c["hidden"]] * c["layers"]]
        layers = [m for a, b in zip(sizes[:-1], sizes[1:], strict=True) for m in (nn.Conv1d(a, b, c["kernel"], padding="same"), nn.ReLU())]
        self.net = nn.Sequential(*layers, nn.Flatten(), nn.Linear(sizes[-1] * self.window, c["act_dim"]))

    def fit_statistics(self, observations: np.ndarray, actions: np.ndarray, seed: int = 0) -> None:
        """Normaliser from observations (N, obs_dim)."""
        self.normalizer.fit(observations, self.config["std_floor"])

    def loss(self, windows: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """Of the action at the last position alone: the filters see the whole window."""
        return {"loss": F.mse_loss(self(windows)[:, 0].float(), actions[:, -1])}

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        return self.net(self.normalizer(windows).transpose(1, 2))[:, None]

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        return [{"params": list(self.parameters()), "weight_decay": weight_decay}]
