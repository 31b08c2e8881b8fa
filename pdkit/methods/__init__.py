"""Every method as what it changes in the shared loop (pdkit/online.py): read two of them on one screen.

A method is a set of configuration values over a task's profile, the policy that it starts from, and, where the loop itself
differs, a subclass of Trainer of a few dozen lines, in a module that has its equations. Two have none of their own:

    policy_decorator   a = clip(a_base + alpha * a_res) where a gate that opens over H steps lets it (pdkit/decorator.py); SAC
                       (pdkit/rl/sac.py)
    residual_rl        a = clip(a_base + a_res) from the first step: alpha = 1 for each dimension, H = 0 (Johannink et al., 2019; appendix
                       G.1), uniform residuals until learning begins, and nothing that keeps them small. SAC, all other numbers and, in
                       the lesson, demonstrations in each batch are the decorator's of the same profile
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

# A transformer as the actor: an update costs several times a residual's, and a lesson would take an hour. Smaller batches, and half as
# many updates a step, bring it near a decorator's run (data/results/leaderboard.csv: updates, train_minutes).
_TRANSFORMER = dict(batch=64, utd=0.125)

# In the lesson: under a reward by likeness an end at success would itself be a reward, and a cut soon after it a price
# (pdkit/methods/transport.py), on whatever task.
_LIKENESS = dict(on_success="continue", success_tail=0)

# A U-Net with adapters, which also denoises in four steps for every target, so an update is slow: there are fewer, each with half of the
# original's steps in actions. Not tuned; recorded in data/results/diffusion_finetuning.csv (notebook 12).
_DIFFUSION = dict(batch=64, utd=0.03, dipo_steps=10)

# PPO learns from its own policy alone, with the learning rate falling from the start (as in cleanrl) and a spread that starts at 0.6
# (cleanrl: 1; the lesson's 0.2 is enough for SAC, whose entropy term raises it)
_ON_POLICY = dict(warmup="policy", warmup_steps=0, demo_fraction=0.0, lr_decay_from=0.0, log_std_range=(-3.0, 2.0))
# ... and at the paper's scale, where the SAC code sees raw observations.
_ON_POLICY_PAPER = dict(ppo_rollout=128, normalize_obs=True)

# Cal-QL: the actor acts from the first step, success ends an episode. The paper gives no number for it: the original's.
_CALQL = _OWN_POLICY | dict(warmup="policy", on_success="terminate")
_CALQL_PAPER: dict[str, Any] = dict(calql_offline_updates=20_000, calql_actions=10)
_CALQL_ORIGINAL = _CALQL_PAPER | dict(utd=1.0, batch=256, gamma=0.99, actor_lr=1e-4, critic_lr=3e-4, tau=0.005, hidden=512,
                                      log_std_range=(-4.0, 2.0),  # a spread of 0.37 at first
                                      init_temperature=0.1)  # there 1, with rewards that are ten times as large

METHODS: dict[str, Method] = {
    "policy_decorator": Method(
        "Policy Decorator", "the paper; facts.md 1: a residual over the frozen base policy, bounded by alpha, switched on over H steps",
    ),
    "residual_rl": Method(
        "Residual RL", "Johannink et al. 2019; appendix B.5, G.1; facts.md 3.5: the decorator without bound and schedule",
        changes=dict(alpha=1.0, alpha_scale=(), H=0, warmup="uniform", residual_penalty=0.0)),
    "sac_from_scratch": Method(
        "SAC from scratch", "Haarnoja et al. 2018; appendix C.1; facts.md 4.2: no base policy and no demonstrations",
        changes=_OWN_POLICY | dict(warmup="uniform", demo_fraction=0.0), trainer="pdkit.methods.scratch:Scratch"),
    "sac_finetune": Method(
        "SAC fine-tuning", "appendix B.4.1; facts.md 2.3", changes=_OWN_POLICY | dict(warmup="policy", demo_fraction=0.0),
        lesson=_TRANSFORMER, base="bet-sac", trainer="pdkit.methods.finetune:FineTune"),
    "rlpd_paper": Method(
        "RLPD as in the paper", "appendix B.5; facts.md 3.2: LayerNorm critics and half of each batch from demonstrations, on fine-tuning; "
        "ensemble and high UTD left out",
        changes=_OWN_POLICY | dict(warmup="policy", demo_fraction=0.5, critic_layer_norm=True), lesson=_TRANSFORMER, base="bet-sac",
        trainer="pdkit.methods.finetune:FineTune"),
    "rlpd": Method(
        "RLPD, the original", "Ball et al. 2023, Adroit command; facts.md 3.2: 10 critics, least of 2, no entropy in the target, UTD 20, "
        "from scratch with demonstrations",
        changes=_OWN_POLICY | dict(warmup="uniform", demo_fraction=0.5, critic_layer_norm=True, num_critics=10, target_subset=2,
                                   actor_value="mean", entropy_backup=False, target_entropy_scale=0.5, n_step=1),
        # An update of ten critics costs several times one of two, so UTD 20 at full batch would take hours: 1 is a twentieth.
        lesson=dict(utd=1.0),
        paper=dict(utd=20.0, batch=256, gamma=0.99, actor_lr=3e-4, critic_lr=3e-4, tau=0.005, warmup_steps=5_000, total_steps=1_000_000,
                   actor_every=20, on_success="continue", log_std_range=(-3.0, 2.0), xavier_init=True),  # a spread of 0.6 at first, there 1
        trainer="pdkit.methods.scratch:Scratch"),
    "ppo_decorator": Method(
        "Policy Decorator (PPO)", "appendix D.3; facts.md 4.2: PPO instead of SAC; no numbers given, ours follow cleanrl",
        changes=_ON_POLICY, paper=_ON_POLICY_PAPER, trainer="pdkit.methods.ppo:OnPolicy"),
    "ppo_residual_rl": Method(
        "Residual RL (PPO)", "appendix D.3; facts.md 3.5, 4.2: PPO without bound and schedule",
        changes=_ON_POLICY | _OWN_POLICY, paper=_ON_POLICY_PAPER, trainer="pdkit.methods.ppo:OnPolicy"),
    "ppo_finetune": Method(
        "PPO fine-tuning", "appendix D.3, F.5.1; facts.md 4.2: PPO on the base policy itself, MLP value function",
        changes=_ON_POLICY | _OWN_POLICY, paper=_ON_POLICY_PAPER, base="bet-sac", trainer="pdkit.methods.ppo:PPOFineTune"),
    "rot": Method(
        "ROT", "Haldar et al. 2022; appendix B.5; facts.md 3.1: SAC fine-tuning, reward by optimal transport, Q-filtered imitation",
        changes=_OWN_POLICY | dict(warmup="policy", demo_fraction=0.0, reward_shift=0.0), lesson=_TRANSFORMER | _LIKENESS, base="bet-sac",
        trainer="pdkit.methods.rot:ROT"),
    "fish": Method(
        "FISH", "Haldar et al. 2023; appendix B.5, G.2; facts.md 3.6: residual over VINN on a reward by optimal transport",
        changes=dict(alpha=0.2, alpha_scale=(), H=0, critic_input="concat", residual_units="action", actor_input="obs+base",
                     warmup="uniform", demo_fraction=0.0, reward_shift=0.0, residual_penalty=0.0),
        lesson=_LIKENESS, base="vinn", trainer="pdkit.methods.fish:FISH"),
    "calql": Method(
        "Cal-QL", "Nakamoto et al. 2023; appendix B.5, F.3 (E); facts.md 3.3: imitated transformer, demonstrations, online SAC",
        changes=_CALQL | dict(demo_fraction=0.0), lesson=_TRANSFORMER, paper=_CALQL_PAPER, base="bet-sac",
        trainer="pdkit.methods.calql:TransformerCalQL"),
    "calql_a": Method(
        "Cal-QL, the original", "appendix F.3 (A); facts.md 3.3: small MLP, demonstrations and rollouts, online Cal-QL",
        changes=_CALQL | dict(demo_fraction=0.5, calql_data="mixed", calql_online="calql"), paper=_CALQL_ORIGINAL,
        trainer="pdkit.methods.calql:SmallCalQL"),
    "calql_b": Method(
        "Cal-QL without rollouts", "appendix F.3 (B): small MLP, demonstrations, online Cal-QL",
        changes=_CALQL | dict(demo_fraction=0.5, calql_online="calql"), paper=_CALQL_ORIGINAL, trainer="pdkit.methods.calql:SmallCalQL"),
    "calql_c": Method(
        "Cal-QL, then SAC", "appendix F.3 (C): small MLP, demonstrations, online SAC",
        changes=_CALQL | dict(demo_fraction=0.0), paper=_CALQL_ORIGINAL, trainer="pdkit.methods.calql:SmallCalQL"),
    "calql_d": Method(
        "Cal-QL on a random GPT", "appendix F.3 (D): GPT from random weights, demonstrations, online SAC",
        changes=_CALQL | dict(demo_fraction=0.0, calql_pretrained=False), lesson=_TRANSFORMER, paper=_CALQL_PAPER, base="bet-sac",
        trainer="pdkit.methods.calql:TransformerCalQL"),
    "dipo": Method(
        "DIPO", "Yang et al. 2023; appendix B.4.2, H.2; facts.md 3.7: critics improve stored actions, a Diffusion Policy imitates them",
        changes=_OWN_POLICY | dict(warmup="policy", demo_fraction=0.0), lesson=_DIFFUSION, base="diffusion",
        trainer="pdkit.methods.dipo:DIPO"),
    "dppo": Method(
        "DPPO", "Ren et al. 2024; appendix C.2, H.2; facts.md 3.8: PPO on the denoising steps of a Diffusion Policy",
        changes=_ON_POLICY | _OWN_POLICY | dict(lora=0, ppo_lr=1e-4, ppo_grad_clip=1e6),  # in effect none
        # Chunks are fewer decisions, each with four steps to learn from: smaller rollouts, fewer passes. Not tuned either.
        lesson=dict(ppo_rollout=32, ppo_minibatches=4, ppo_epochs=5),
        paper=_ON_POLICY_PAPER | dict(ppo_rollout=400, ppo_minibatches=20, gamma=0.999),
        base="diffusion", trainer="pdkit.methods.dppo:DPPO"),
    "jsrl": Method(
        "JSRL", "Uchendu et al. 2023; appendix B.5; facts.md 3.4: the base policy begins each episode, a learner from scratch ends it",
        changes=_OWN_POLICY | dict(warmup="uniform", demo_fraction=0.0, select="last"),
        lesson=dict(eval_every=2_500, eval_episodes=20),  # the curriculum moves once an evaluation
        trainer="pdkit.methods.jsrl:JSRL"),
}
