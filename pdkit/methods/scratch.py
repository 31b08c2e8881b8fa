"""Learning without a base policy: the loop over a policy that does nothing.

    a_t = a_res,  a_res ~ pi_theta(o_t)          the decorator with base = 0, alpha = 1, H = 0

**SAC from scratch** (Haarnoja et al., 2018; appendix C.1): loss and numbers of the task's profile (pdkit/rl/sac.py), no demonstrations.

**RLPD, the original** (Ball et al., 2023; the Adroit command of its code; facts.md 3.2): twenty updates a step, half of each batch from
demonstrations, ten critics with LayerNorm and no entropy in their target,

    y = r + gamma * min_{i in Z} Qbar_i(s', a'),  a' ~ pi(s'),  Z two of the ten, drawn for each update
    critics   sum_i mean (Q_i(s, a) - y)^2
    actor     mean (temperature * log pi(a | s) - mean_i Q_i(s, a)), once a step;  target entropy -act_dim / 2

with batches of 256, rates of 3e-4, tau 0.005, gamma 0.99 and 5,000 random steps first (paper profile). The lesson makes one update a
step, because ten critics cost four times two, and its rates, batches and first temperature are the profile's. Not as in the original:
its offline data hold rollouts of a cloned policy as well, and a tenth of each is kept aside; gradients are clipped at a norm of 50 as in
this kit's SAC, where the original names no limit.
"""
from __future__ import annotations

from ..online import Trainer
from ..policies.zero import Zero


class Scratch(Trainer):
    """SAC from scratch, and RLPD. The base policy lends its normaliser, so that all methods see observations alike."""

    chunks = False  # it takes one action at a time, whatever the base policy does

    def __init__(self, config, base, demos=None, spec=None):
        super().__init__(config, Zero.instead_of(base), demos, spec)
