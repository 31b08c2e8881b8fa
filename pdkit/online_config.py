"""The configuration of the online loop, and the one rule that it decides: where the value of s' is left out."""
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .decorator import DecoratorConfig
from .errors import PdkitError, unknown
from .methods.config import MethodConfig
from .rl.sac import SACConfig
from .tasks.vector import SIMULATORS

WARMUPS = ("base", "uniform", "policy")
SELECTIONS = ("last", "best")
ON_SUCCESS = ("terminate", "continue")
BOOTSTRAPS = ("truncated", "never", "always")


@dataclass(frozen=True)
class OnlineConfig:
    """The loop and everything in it; the profiles (profiles.py) give values for each task."""

    task: str = "Door"
    seed: int = 0
    total_steps: int = 65_000  # primitive environment steps
    num_envs: int = 8
    env_workers: int = 1  # processes that step environments while this one learns; results do not depend on it
    warmup_steps: int = 6_000  # steps stored before learning starts
    warmup: str = "base"  # actions until then: the base policy's, base plus a gated uniform residual (the paper's code), or the actor's
    utd: float = 0.25  # gradient updates per environment step after the warm-up
    batch: int = 256
    demo_fraction: float = 0.25  # of each batch, drawn from the demonstrations
    n_step: int = 5
    gamma: float = 0.97
    reward_shift: float = -1.0  # added to the sparse 0/1 reward of every decision (see decision_reward)
    train_limit: int = 0  # time limit of training episodes (0: the task's); shorter ones spend fewer steps on lost episodes
    on_success: str = "continue"  # training episodes go on when solved, or end ("terminate")
    start_fraction: float = 0.0  # episodes start this far along a way to success, time limits shrink alike (pdkit/tasks/horizon.py); 0: not
    success_tail: int = 20  # those that go on are cut, as by a time limit, this many steps after the first success; 0: not
    bootstrap: str = "truncated"  # value of s' at an episode's end: only at time limits, never, or always
    normalize_obs: bool = True  # networks see observations through the base policy's normaliser (the paper's code: raw)
    features: bool = False  # networks see the task's features beside the observation (pdkit/tasks/features.py; ours, not the paper's)
    lr_decay_from: float = 0.4  # fraction of the run after which the learning rates of actor and critics fall linearly to a tenth
    eval_every: int = 7_500
    eval_episodes: int = 50  # on selection seeds
    eval_workers: int = 1  # 1: evaluations run in a process of their own while this one learns; results do not depend on it
    select: str = "best"  # the result: the last policy, or the best evaluated since the gate was fully open (see Trainer._collect)
    log_every: int = 2_500
    checkpoint_every: int = 15_000
    device: str = "cpu"  # where updates are made
    simulator: str = "cpu"  # or physx_cuda, which simulates the lanes of training together on a GPU (pdkit/tasks/batched.py)
    method: str = "policy_decorator"  # see pdkit/methods
    method_config: MethodConfig = field(default_factory=MethodConfig)
    decorator: DecoratorConfig = field(default_factory=DecoratorConfig)
    sac: SACConfig = field(default_factory=SACConfig)

    def __post_init__(self):
        for name, known in (("warmup", WARMUPS), ("select", SELECTIONS), ("on_success", ON_SUCCESS), ("bootstrap", BOOTSTRAPS),
                            ("simulator", SIMULATORS)):
            if getattr(self, name) not in known:
                raise unknown(name, getattr(self, name), known)
        if not 0 <= self.demo_fraction < 1 or not 0 < self.gamma <= 1 or self.n_step < 1 or self.utd < 0 or self.batch < 2:
            raise PdkitError("The loop needs demo_fraction in [0, 1), gamma in (0, 1], n_step >= 1, utd >= 0 and batch >= 2.")
        if not 0 <= self.start_fraction < 1:
            raise PdkitError(f"start_fraction must be at least 0 and below 1, not {self.start_fraction}.")
        if min(self.train_limit, self.success_tail, self.warmup_steps, self.eval_every, self.eval_episodes) < 0 or self.num_envs < 1:
            raise PdkitError("The loop needs train_limit, success_tail, warmup_steps, eval_every and eval_episodes of 0 or more, and "
                             "num_envs of 1 or more.")
        if self.seed < 0:
            raise PdkitError(f"The seed must be 0 or more, not {self.seed}.")
        if self.demo_fraction and 0 in self.decorator.alpha_scale:
            raise PdkitError("Where alpha_scale is 0 no residual makes a demonstrated action; use a small factor, or demo_fraction=0.")
        if self.total_steps <= self.warmup_steps:
            raise PdkitError(f"total_steps ({self.total_steps}) must exceed warmup_steps ({self.warmup_steps}), or nothing is learned.")
        if self.utd and self.batch > self.total_steps:
            raise PdkitError(f"No update would be made: a batch ({self.batch}) is larger than all steps together ({self.total_steps}).")


def stops(config: OnlineConfig, terminated: bool, truncated: bool) -> bool:
    """Whether the value of s' is left out of the target at this transition."""
    return {"truncated": terminated, "never": terminated or truncated, "always": False}[config.bootstrap]


def decision_reward(config: OnlineConfig, solved: np.ndarray) -> np.ndarray:
    """Rewards (N,) of decisions during which the task was solved at `solved` (N,) primitive steps: 1 or 0, plus the shift.

    A chunk of actions is one decision: it is rewarded once, and the discount counts it once. That is what the paper's code does
    where success ends the episode (facts.md 1.2); where episodes go on it would add the primitive steps up.
    """
    return np.minimum(solved, 1) + config.reward_shift


def lr_factor(config: OnlineConfig, step: int) -> float:
    """What the learning rates are multiplied by at environment step `step`: 1, then falling linearly to a tenth at the end."""
    if config.lr_decay_from >= 1:
        return 1.0
    done = (step / config.total_steps - config.lr_decay_from) / (1 - config.lr_decay_from)
    return 1 - 0.9 * min(max(done, 0.0), 1.0)
