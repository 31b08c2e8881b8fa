"""BC-RNN: an LSTM reads a window of observations and acts at each of them (Mandlekar et al., 2021; appendix D.1 names the policy and gives
no numbers: ours follow robomimic's two layers, with a squared error instead of its mixture of Gaussians)."""
from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from .base import Policy


class BCRNN(Policy):
    """Config: obs_dim, act_dim, window, hidden, layers, std_floor (of the normaliser). Every window starts from a state of zeros, in
    training and in acting alike."""

    kind = "rnn"
    defaults: dict[str, Any] = dict(window=10, hidden=256, layers=2, std_floor=0.0)

    def __init__(self, config: dict[str, Any]):
        super().__init__(config)
        c = self.config
        self.window = c["window"]
        self.lstm = nn.LSTM(c["obs_dim"], c["hidden"], c["layers"], batch_first=True)
        self.head = nn.Linear(c["hidden"], c["act_dim"])

    def fit_statistics(self, observations: np.ndarray, actions: np.ndarray, seed: int = 0) -> None:
        """Normaliser from observations (N, obs_dim)."""
        self.normalizer.fit(observations, self.config["std_floor"])

    def _actions(self, windows: torch.Tensor) -> torch.Tensor:
        """An action at every position, (N, window, act_dim)."""
        return self.head(self.lstm(self.normalizer(windows))[0])

    def loss(self, windows: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"loss": F.mse_loss(self._actions(windows).float(), actions)}

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        return self._actions(windows)[:, -1:]

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        return [{"params": list(self.parameters()), "weight_decay": weight_decay}]
