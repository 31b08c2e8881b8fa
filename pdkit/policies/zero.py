"""The policy that does nothing: learning from scratch is decorating it with alpha = 1."""
from __future__ import annotations

from typing import Any

import numpy as np
import torch

from .base import Policy


class Zero(Policy):
    """Config: obs_dim, act_dim, window, chunk. It carries a normaliser, so that networks beside it see observations as usual."""

    kind = "zero"
    learns = False
    defaults: dict[str, Any] = dict(window=1, chunk=1)

    def __init__(self, config: dict[str, Any]):
        super().__init__(config)
        self.window, self.chunk = self.config["window"], self.config["chunk"]

    @classmethod
    def instead_of(cls, policy: Policy, window: int = 1, chunk: int = 1) -> Zero:
        """One with the dimensions and the normaliser of another policy."""
        zero = cls({"obs_dim": policy.config["obs_dim"], "act_dim": policy.config["act_dim"], "window": window, "chunk": chunk})
        zero.normalizer.load_state_dict(policy.normalizer.state_dict())
        return zero.eval()

    def fit_statistics(self, observations: np.ndarray, actions: np.ndarray, seed: int = 0) -> None:
        """Normaliser from observations (N, obs_dim)."""
        self.normalizer.fit(observations)

    def remember(self, windows: torch.Tensor, actions: torch.Tensor) -> None:
        """Nothing."""

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(windows), self.chunk, self.config["act_dim"], device=windows.device)

    @torch.inference_mode()
    def act(self, windows: np.ndarray) -> np.ndarray:
        """Zeros; nothing to look a device up from."""
        return np.zeros((len(windows), self.chunk, self.config["act_dim"]), np.float32)
