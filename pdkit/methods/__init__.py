"""Every method as what it changes in the shared loop (pdkit/online.py): read two of them on one screen.

A method is a set of configuration values over a task's profile, the policy that it starts from, and, where the loop itself
differs, a subclass of Trainer of a few dozen lines.
"""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Method:
    """One row of the comparison."""

    title: str
    source: str  # where its equations and numbers come from
    changes: dict[str, Any] = field(default_factory=dict)  # over the profile of the decorator, in every profile
    lesson: dict[str, Any] = field(default_factory=dict)  # further ones in the lesson profile
    paper: dict[str, Any] = field(default_factory=dict)  # ... and in the paper profile
    base: str = "base"  # shipped checkpoint that it starts from (data/checkpoints/TASK/NAME)
    trainer: str = "pdkit.online:Trainer"  # imported when used


# No base action is added and nothing is gated; acting is the actor's own business from the first step.
_OWN_POLICY = dict(alpha=1.0, alpha_scale=(), H=0, residual_penalty=0.0)

METHODS: dict[str, Method] = {
    "policy_decorator": Method("Policy Decorator", "facts.md 1"),
    "residual_rl": Method(
        "Residual RL", "Johannink et al. 2019; appendix B.5, G.1; facts.md 3.5: the decorator without bound and schedule",
        changes=dict(alpha=1.0, alpha_scale=(), H=0, warmup="uniform", residual_penalty=0.0)),
    "sac_from_scratch": Method(
        "SAC from scratch", "Haarnoja et al. 2018; appendix C.1; facts.md 4.2: no base policy and no demonstrations",
        changes=_OWN_POLICY | dict(warmup="uniform", demo_fraction=0.0), trainer="pdkit.methods.scratch:Scratch"),
    "sac_finetune": Method(
        "SAC fine-tuning", "appendix B.4.1; facts.md 2.3", changes=_OWN_POLICY | dict(warmup="policy", demo_fraction=0.0), base="bet-sac",
        trainer="pdkit.methods.finetune:FineTune"),
    "rlpd_paper": Method(
        "RLPD as in the paper", "appendix B.5; facts.md 3.2: LayerNorm critics and half of each batch from demonstrations, on fine-tuning; "
        "ensemble and high UTD left out",
        changes=_OWN_POLICY | dict(warmup="policy", demo_fraction=0.5, critic_layer_norm=True),
        base="bet-sac", trainer="pdkit.methods.finetune:FineTune"),
    "rlpd": Method(
        "RLPD, the original", "Ball et al. 2023, Adroit command; facts.md 3.2: 10 critics, least of 2, no entropy in the target, UTD 20, "
        "from scratch with demonstrations",
        changes=_OWN_POLICY | dict(warmup="uniform", demo_fraction=0.5, critic_layer_norm=True, num_critics=10, target_subset=2,
                                   actor_value="mean", entropy_backup=False, target_entropy_scale=0.5, n_step=1),
        # An update of ten critics costs four times one of two, so UTD 20 at full batch would take hours: 1 is ten times too low.
        lesson=dict(utd=1.0),
        paper=dict(utd=20.0, batch=256, gamma=0.99, actor_lr=3e-4, critic_lr=3e-4, tau=0.005, warmup_steps=5_000, total_steps=1_000_000,
                   actor_every=20),
        trainer="pdkit.methods.scratch:Scratch"),
}
