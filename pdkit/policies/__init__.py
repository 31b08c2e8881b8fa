"""Base policies: one protocol, one way to disk."""
from __future__ import annotations

from .base import Normalizer, Policy, load_policy, save_policy
from .bet import BeT
from .mlp import MLP

POLICIES: dict[str, type[Policy]] = {cls.kind: cls for cls in (BeT, MLP)}

__all__ = ["POLICIES", "BeT", "MLP", "Normalizer", "Policy", "load_policy", "save_policy"]
