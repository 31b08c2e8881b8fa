"""What lesson 12 measures: how DIPO and DPPO change a Diffusion Policy, and what each change costs (appendix B.4.2, C.2, H).

    inner steps   DPPO's second decision process: noise, clip and discount of every step of sampling
    ascent        DIPO's actions on their way up the critics, and the policy that follows, where both can be drawn
    adapters      how many numbers LoRA trains
    costs         milliseconds of an update and passes through the U-Net that it takes, timed side by side
    outcomes      recorded runs against the policy that they start from
"""
from __future__ import annotations

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch

from .decorator import critic_features
from .demos import Demos
from .imitate import ImitateConfig, imitate
from .methods import METHODS
from .methods.registry import make_trainer
from .online import Trainer
from .online_config import OnlineConfig
from .policies import DiffusionPolicy
from .policies.lora import with_lora
from .policies.unet import UNet
from .probes import PROBES, ReachSim
from .profiles import build
from .rl.dipo import DIPO
from .rl.dppo import DPPO
from .stats import newcombe, wilson
from .tasks.spec import TaskSpec

AIM = np.array([0.55, -0.1])  # where the demonstrator of the drawn problem aims; solved within 0.5 of (0.5, 0.5)

# Appendix H.2 groups methods by what becomes of the reinforcement learning; DPPO stands beside its groups, the decorator outside. What each
# needs follows from its loss.
_FAMILIES = (
    ("supervised learning on better actions", "DIPO, IDQL", "DIPO: yes; IDQL: no", "no", "no", "no",
     "DIPO was the paper's choice; IDQL samples 32 to 128 actions a decision"),
    ("the score matched to the critic", "QSM", "yes", "no", "no", "no", "said to be poor in manipulation"),
    ("backpropagation through sampling", "Diffusion QL, Consistency AC", "yes", "yes", "no", "no",
     "long gradient paths; said to be poor online"),
    ("policy gradient over denoising steps", "DPPO", "no, a value of states", "no", "of each step", "yes",
     "out three weeks before the deadline; compared on its own tasks"),
    ("a residual on a frozen policy", "Policy Decorator", "yes, of the residual", "no", "of the residual", "no",
     "the Diffusion Policy is only asked, never differentiated"),
)


def taxonomy() -> pd.DataFrame:
    """The families of appendix H.2 and what each asks for, a row a family."""
    columns = ("family", "methods", "a critic's gradient in actions", "gradient through sampling", "likelihood", "on-policy data", "remark")
    return pd.DataFrame(_FAMILIES, columns=columns)


# ---- DPPO's inner process --------------------------------------------------------------------------------------------

def inner_steps(agent: DPPO) -> pd.DataFrame:
    """A row for each step of sampling, the noisiest first: `step` (of the diffusion), `sigma` (of DDPM or DDIM with eta 1), `noise` (added
    while it learns), `tuned`, and for fine-tuned steps `clip` of the ratio and `discount` of the advantage (else NaN)."""
    steps, config, late = agent.steps, agent.config, agent.late
    early = len(steps.times) - late
    pad = [np.nan] * early
    return pd.DataFrame({
        "step": steps.times.tolist(), "sigma": steps.sigma.tolist(), "noise": steps.sigma.clamp(min=config.dppo_sample_std).tolist(),
        "tuned": [False] * early + [True] * late, "clip": pad + agent.clips.tolist(),
        "discount": pad + [config.dppo_gamma ** (late - 1 - i) for i in range(late)]})


# ---- DIPO where it can be drawn --------------------------------------------------------------------------------------

class OneReach(ReachSim):
    """The reach probe from one start to one goal: every episode is the same decision. `push` is the standard deviation of what the world
    adds to each number of an action: with it success is likelier the nearer an action is, without it there is only yes and no."""

    def __init__(self, push: float = 0.0):
        self.push = push

    def reset(self, seed: int) -> np.ndarray:
        self.position, self.goal = np.zeros(2), np.array([0.1, 0.1])
        self.pushed = self.push * np.random.default_rng(seed).standard_normal(2)
        return self._observation()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        return super().step(np.clip(action, -1, 1) + self.pushed)


def one_reach(push: float = 0.0) -> TaskSpec:
    """`OneReach` as a task of a single step."""
    return dataclasses.replace(PROBES["reach"], make=functools.partial(OneReach, push), max_episode_steps=1)


def aims_beside(iterations: int, seed: int = 0, num: int = 200) -> DiffusionPolicy:
    """A small Diffusion Policy that imitates a demonstrator of `one_reach` who aims beside what would solve it, with a spread of 0.2: it
    sees one observation, predicts four actions, of which the last three are rest, and executes one."""
    rng, observation = np.random.default_rng([seed, 12]), OneReach().reset(0)
    actions = np.clip(AIM + rng.normal(0, 0.2, (num, 2)), -1, 1).astype(np.float32)
    observations, alone = np.repeat(observation[None], 2 * num, axis=0), np.ones(num, np.int64)
    demos = Demos("reach", "scripted", "aims beside the goal", "pdkit.diffusion_finetuning.aims_beside", observations, actions,
                  solves(actions), alone, np.arange(num))
    network = dict(window=1, horizon=4, chunk=1, dims=[16], groups=4, embed=16, prediction="v_prediction", sampler_steps=2,
                   spacing="trailing")
    config = ImitateConfig(iterations=iterations, batch=64, lr=3e-3, eval_every=iterations, eval_episodes=0, seed=seed, bf16=False)
    return imitate("diffusion", demos, config, network, spec=one_reach())[0]


def probe_trainer(base: DiffusionPolicy, total_steps: int, push: float, seed: int = 0, **changes: Any) -> Trainer:
    """DIPO on `one_reach`, in seconds; `changes` by flat name. A third of the steps are the policy's own, before it learns."""
    values = dict(
        task="reach", seed=seed, method="dipo", total_steps=total_steps, warmup_steps=total_steps // 3, num_envs=16, env_workers=0,
        eval_workers=0, eval_every=0, checkpoint_every=0, log_every=max(total_steps // 6, 1), utd=0.2, batch=128, n_step=1,
        on_success="terminate", success_tail=0, bootstrap="never", hidden=64, actor_lr=3e-3, critic_lr=5e-3, tau=0.1, actor_every=2,
        average=0.0, critic_warmup=total_steps // 30, bf16=False, lora=4, dipo_steps=10)
    return make_trainer(build(OnlineConfig, values | METHODS["dipo"].changes | changes), base, None, one_reach(push))


def draws(policy: DiffusionPolicy, window: np.ndarray, count: int, seed: int = 0) -> torch.Tensor:
    """Sequences (count, horizon, act_dim) that the policy samples for one window (window, obs_dim)."""
    noise = torch.randn(count, policy.horizon, policy.config["act_dim"], generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        return policy.denoise(_repeated(window, count), noise).clamp(-1, 1)


def ascent(agent: DIPO, window: np.ndarray, sequences: torch.Tensor) -> np.ndarray:
    """Sequences (B, horizon, act_dim) after 0, 1, ... of the rule's gradient steps at one window: (1 + steps, B, horizon, act_dim)."""
    rule, obs, path = agent.rule, _repeated(window, len(sequences)).flatten(1), [sequences]
    try:
        for steps in range(1, rule.steps + 1):  # each time from the start, because Adam remembers
            agent.rule = dataclasses.replace(rule, steps=steps)
            path.append(agent.improved(obs, sequences))
    finally:
        agent.rule = rule
    return torch.stack(path).numpy()


def values(agent: DIPO, window: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """The least critic's value (N,) of executed actions (N, chunk * act_dim) at one window."""
    actions = torch.as_tensor(np.asarray(actions, np.float32))
    seen = agent.critic_view(_repeated(window, len(actions)).flatten(1))
    with torch.no_grad():
        return agent.critics(critic_features(agent.decorator, seen, torch.zeros_like(actions), actions)).min(dim=0).values.numpy()


def solves(actions: np.ndarray) -> np.ndarray:
    """Whether each action (N, 2) solves `one_reach` without a push, (N,)."""
    found, sim = [], OneReach()
    for action in actions:
        sim.reset(0)
        found.append(sim.step(action)[1])
    return np.array(found, bool)


def _repeated(window: np.ndarray, count: int) -> torch.Tensor:
    return torch.from_numpy(np.asarray(window, np.float32))[None].repeat(count, 1, 1)


# ---- costs -----------------------------------------------------------------------------------------------------------

def adapters(policy: DiffusionPolicy, ranks: Sequence[int]) -> pd.DataFrame:
    """How many numbers of the U-Net train with adapters of each rank (0: all weights): rank, trained, share (of all weights)."""
    rows = []
    for rank in ranks:
        trained = sum(p.numel() for p in with_lora(policy.unet, rank).parameters() if p.requires_grad)
        rows.append({"rank": rank, "trained": trained, "share": trained / sum(p.numel() for p in policy.unet.parameters())})
    return pd.DataFrame(rows)


def update_costs(trainers: dict[str, Trainer], repeats: int, clock: Callable[[], float] = time.perf_counter) -> pd.DataFrame:
    """What an update of each trainer's learner takes, on random transitions of the right shape; a row a trainer.

    ms (the middle one of `repeats` measurements, each of as many updates as share a rollout, or of two, because actors may move every
    second time), rows (transitions in a batch), passes (of a transition through a U-Net, an update, forwards), and `per_step`
    (updates that an environment step pays for). The learners are changed: give trainers that nothing else needs.
    """
    rows = []
    for name, trainer in trainers.items():
        generator, asked = torch.Generator().manual_seed(0), []
        trainer.agent.update(*_fake(trainer, generator))  # the first one is slower
        hooks = [module.register_forward_hook(functools.partial(_count, asked)) for module in _networks(trainer)]
        seconds, before = [], trainer.agent.updates
        for _ in range(repeats):
            arguments, updates, started = _fake(trainer, generator), trainer.agent.updates, clock()
            trainer.agent.update(*arguments)
            if trainer.agent.updates == updates + 1:
                trainer.agent.update(*arguments)
            seconds.append((clock() - started) / (trainer.agent.updates - updates))
        for hook in hooks:
            hook.remove()
        batch = _batch(trainer)
        rows.append({"method": name, "ms": 1e3 * float(np.median(seconds)), "rows": batch,
                     "passes": sum(asked) / batch / (trainer.agent.updates - before), "per_step": _per_step(trainer)})
    return pd.DataFrame(rows)


def _count(asked: list[int], module: UNet, given: tuple, out: torch.Tensor) -> None:
    asked.append(len(out))


def _networks(trainer: Trainer) -> list[UNet]:
    parts = itertools.chain.from_iterable(part.modules() for part in (trainer.agent.actor, getattr(trainer.agent, "target_actor", None))
                                          if part is not None)
    return [module for module in parts if isinstance(module, UNet)]


def _fake(trainer: Trainer, generator: torch.Generator) -> tuple:
    """The arguments of one call of the learner's `update`."""
    on_policy, c = isinstance(trainer.agent, DPPO), trainer.config
    count = trainer.replay.capacity if on_policy else c.batch
    table = 0.5 * torch.rand(count, trainer.replay.rows.shape[1], generator=generator)
    memory = getattr(trainer.agent, "memory", None)
    if memory is not None and not memory.size:
        shape = (c.batch, *memory.actions.shape[1:])
        memory.add(table[:, : memory.obs.shape[1]].numpy(), torch.rand(shape, generator=generator))
    batch = trainer.replay.unpack(table)
    return (batch, c.num_envs, generator) if on_policy else (batch, generator)


def _batch(trainer: Trainer) -> int:
    """Rows that one update learns from: for DPPO a fine-tuned step of a decision is one."""
    m = trainer.config.method_config
    if isinstance(trainer.agent, DPPO):
        return trainer.replay.capacity * trainer.agent.late // m.ppo_minibatches
    return trainer.config.batch


def _per_step(trainer: Trainer) -> float:
    m = trainer.config.method_config
    if isinstance(trainer.agent, DPPO):
        return m.ppo_epochs * m.ppo_minibatches / (trainer.replay.capacity * trainer.base.chunk)
    return trainer.config.utd


# ---- recorded outcomes -----------------------------------------------------------------------------------------------

def outcomes(table: pd.DataFrame, ends: str = "success") -> pd.DataFrame:
    """Recorded runs against the policy that each starts from, on the same test episodes; a row a run.

    recipe, seed, before, after (stats.Rate), difference (Interval, Newcombe's for independent rates: wider than needed, because the
    episodes are shared but not recorded singly) and `verdict`: above or below where that interval leaves out 0, else "not told apart".

    Args:
        ends: success, or success_at_end.
    """
    rows = []
    for row in table.itertuples():
        before, after = (wilson(round(getattr(row, f"{who}_{ends}") * row.episodes), row.episodes) for who in ("base", "decorated"))
        change = newcombe(before, after)
        verdict = "above" if change.low > 0 else "below" if change.high < 0 else "not told apart"
        rows.append({"recipe": row.recipe, "seed": row.seed, "before": before, "after": after, "difference": change, "verdict": verdict})
    return pd.DataFrame(rows, columns=["recipe", "seed", "before", "after", "difference", "verdict"])
