"""What fine-tuning a Diffusion Policy adds to fine-tuning a transformer (finetune.py): it decides on chunks of actions, and is saved plain.

As there, base actions are zero and windows are stored; critics and value functions are MLPs on the last observation.
"""
from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..errors import PdkitError
from ..policies import DiffusionPolicy, Policy
from ..policies.lora import merged
from .finetune import FineTune


class FineTuneDiffusion(FineTune):
    """Subclasses make the agent, and say how it acts."""

    starts_from = DiffusionPolicy

    def __init__(self, config, base, demos=None, spec=None):
        d = config.decorator
        if d.alpha != 1 or d.alpha_scale or d.H or config.warmup != "policy":
            raise PdkitError(f"{config.method} executes the policy's own actions from the first step: set alpha=1, alpha_scale=(), H=0 and "
                             "warmup='policy'.")
        super().__init__(config, base, demos, spec)
        if base.config["late_steps"]:
            raise PdkitError(f"{config.method} starts from a Diffusion Policy with one network, and this one was fine-tuned by DPPO: take "
                             "one that was only imitated.")

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.require(array, np.float32, ["C", "W"])).to(self.config.device)

    def save_policy(self, policy: Policy, folder: Path) -> None:
        super().save_policy(merged(policy), folder)
