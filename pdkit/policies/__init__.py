"""Base policies: one protocol, one way to disk."""
from __future__ import annotations

from .base import Normalizer, Policy, load_policy, save_policy
from .bet import BeT
from .bet_sac import BeTForSAC
from .cnn import CNN
from .diffusion import DiffusionPolicy
from .mlp import MLP
from .rnn import BCRNN
from .vinn import VINN
from .zero import Zero

POLICIES: dict[str, type[Policy]] = {cls.kind: cls for cls in (BeT, BeTForSAC, DiffusionPolicy, MLP, BCRNN, CNN, VINN, Zero)}

__all__ = ["BCRNN", "CNN", "POLICIES", "BeT", "BeTForSAC", "DiffusionPolicy", "MLP", "VINN", "Normalizer", "Policy", "Zero", "load_policy",
           "save_policy"]
