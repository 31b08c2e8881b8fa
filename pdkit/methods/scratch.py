"""Learning without a base policy: the loop over a policy that does nothing."""
from __future__ import annotations

from ..online import Trainer
from ..policies.zero import Zero


class Scratch(Trainer):
    """SAC from scratch, and RLPD. The base policy lends its normaliser, so that all methods see observations alike."""

    chunks = False  # it takes one action at a time, whatever the base policy does

    def __init__(self, config, base, demos=None, spec=None):
        super().__init__(config, Zero.instead_of(base), demos, spec)
