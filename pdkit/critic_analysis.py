"""What a critic's architecture does to the policy that it is to improve: the measurements of notebook 08 (appendix F.5.1).

    drift        mean |a_k - a_0| on fixed observations after k updates, by the critics alone or by critics and actor
    error        root of mean (Q(s, a) - G)^2 over states and actions of episodes that no critic learned from, G their returns
    pulls        norms of the gradients by which PPO's two losses pull at the actor's transformer

A policy that stands still has values that do not move, and G are samples of them if the target holds rewards alone. So critics are held
against returns with the actor at rest and without the entropy term; on a shared transformer the actor does not stay at rest.
"""
from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import torch

from .ablations import differences
from .decorator import critic_features
from .demos.sources import rollouts
from .methods.config import CRITIC_BACKBONES
from .methods.finetune import FineTune
from .methods.registry import make_trainer, method_config
from .online_rows import demo_rows
from .policies.bet_sac import BeTForSAC
from .rl.calql import WithReturns
from .rl.ppo import clipped_surrogate, clipped_value_loss, log_prob
from .rl.replay import Replay
from .rl.sac import SAC
from .seeds import rollout_seeds
from .torch_setup import autocast
from .unlearning import drift, seconds, updates

KINDS = {"mlp": "MLP", "shared": "shared transformer", "separate": "separate transformer"}
TUNED = ("sac_finetune", "ppo_finetune")  # what the lesson compares them for
NEVER = 10**9  # updates to wait
assert tuple(KINDS) == CRITIC_BACKBONES


def recipe(method: str, kind: str) -> str:
    """What data/sweeps/q_architectures.toml calls a run."""
    return f"{method},critic_backbone={kind}"


# ---- learners on the same transitions --------------------------------------------------------------------------------

def learner(trainer: FineTune, kind: str, seed: int = 0, **changes: Any) -> SAC:
    """A new learner of SAC fine-tuning with critics of this `kind`, for the data of `trainer`; other settings of SAC by name.

    One seed gives the three kinds the same actor, adapters included. Raises PdkitError for an unknown kind.
    """
    other, c = copy.copy(trainer), trainer.config
    other.config = replace(c, sac=replace(c.sac, **changes), method_config=replace(c.method_config, critic_backbone=kind))
    torch.manual_seed(seed)
    return other._make_agent()


def critics_alone(trainer: FineTune, kind: str, seed: int = 0, **changes: Any) -> SAC:
    """A learner whose actor takes no step of its own, and whose targets hold rewards alone; other settings of SAC by name.

    The kit refuses such a setting for a shared transformer, because it would move the actor; here that is what is to be seen.
    """
    agent = learner(trainer, kind, seed, autotune=False, entropy_backup=False, **changes)
    agent.config = replace(agent.config, critic_warmup=NEVER)
    return agent


def trail(agent: SAC, replay: Replay, count: int, windows: np.ndarray, test: dict[str, torch.Tensor], *, every: int, batch: int = 64,
          seed: int = 0) -> Iterator[dict[str, float]]:
    """Update `agent` `count` times, measuring at first, every so many updates and at the end: update, drift, error.

    Args:
        windows: (N, window, obs_dim), where the policy's drift is measured.
        test: rows of `returns`.
    """
    reference = agent.actor.act(windows)[:, 0]

    def row() -> dict[str, float]:
        return {"update": agent.updates, "drift": drift(agent.actor.act(windows)[:, 0], reference), "error": error(agent, test)}

    yield row()
    for log in updates(agent, replay, count, batch=batch, seed=seed):
        if log["update"] % every == 0 or log["update"] == count:
            yield row()


class Sampling:
    """A policy as the loop lets it explore: actions drawn from its Gaussian, (N, 1, act_dim) for windows (N, window, obs_dim)."""

    def __init__(self, policy: BeTForSAC):
        self.policy, self.window, self.chunk = policy, policy.window, 1
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Restart the noise."""
        self.rng = np.random.default_rng([seed, 4])

    @torch.inference_mode()
    def act(self, windows: np.ndarray) -> np.ndarray:
        noise = self.rng.standard_normal((len(windows), self.policy.config["act_dim"])).astype(np.float32)
        stored = torch.from_numpy(np.ascontiguousarray(windows.reshape(len(windows), -1), np.float32))
        return self.policy.sample(stored, torch.from_numpy(noise))[0].numpy()[:, None]


def returns(trainer: FineTune, episodes: int) -> dict[str, torch.Tensor]:
    """Steps of episodes that the starting policy plays with its noise, on seeds of their own: the columns of a replay, and `mc`, the
    discounted return G (B,). Beyond the training episodes' time limit the last reward is taken to go on for ever. Actions are those that
    were executed, cut to [-1, 1], where training rows keep what was drawn."""
    c, dim = trainer.config, trainer.spec.act_dim
    played = rollouts(Sampling(trainer._start_policy), trainer.spec, rollout_seeds(episodes), c.train_limit or None)
    rows = demo_rows(played, trainer.base, c, trainer._view, WithReturns(1, c.n_step, c.gamma))
    kept = Replay(len(rows), trainer.stored_dim, dim, extra=("mc",))
    kept.add(rows)
    return kept.unpack(kept.rows)


@torch.no_grad()
def values(agent: SAC, test: dict[str, torch.Tensor]) -> torch.Tensor:
    """Mean over the critics of Q(s, a), (B,)."""
    with autocast(agent.device, agent.config.bf16):
        seen = agent.critic_view(agent.normalize(test["obs"]))
        return agent.critics(critic_features(agent.decorator, seen, test["base"], test["residual"])).mean(dim=0).float()


def error(agent: SAC, test: dict[str, torch.Tensor]) -> float:
    """Root of the mean squared difference of Q and return, in units of reward."""
    return float((values(agent, test) - test["mc"]).square().mean().sqrt())


# ---- what it costs ---------------------------------------------------------------------------------------------------

def costs(agent: SAC, replay: Replay, count: int = 10, batch: int = 64) -> dict[str, float]:
    """parameters of the critics (a shared transformer's included), trained ones of them, `own` that the actor does not have, and
    seconds: the median time of an update with a step of the actor in it."""
    mine = list(agent.critics.parameters())
    actors = {id(p) for p in agent.actor.parameters()}
    return {"parameters": sum(p.numel() for p in mine), "trained": sum(p.numel() for p in mine if p.requires_grad),
            "own": sum(p.numel() for p in mine if id(p) not in actors), "seconds": seconds(agent, replay, count, batch)}


# ---- PPO -------------------------------------------------------------------------------------------------------------

def ppo_pulls(start: BeTForSAC, kind: str, test: dict[str, torch.Tensor], head_steps: int = 0, task: str = "Door", seed: int = 0
              ) -> dict[str, float]:
    """Norms of the gradients on the actor's transformer: `policy` (of the clipped surrogate) and `value` (of the value loss, with its
    coefficient), on steps with known returns in place of a rollout. Before, the value's head alone takes `head_steps` steps on them."""
    config = method_config("ppo_finetune", task, "lesson", seed, critic_backbone=kind)
    trainer = make_trainer(config, start)
    agent, m = trainer.agent, config.method_config
    goal = test["mc"] * trainer.reward_scale
    optimizer = torch.optim.Adam(agent.value.members.parameters(), lr=m.ppo_lr)
    for _ in range(head_steps):
        optimizer.zero_grad()
        (agent.values(test["obs"], test["base"]) - goal).square().mean().backward()
        optimizer.step()
    value = agent.values(test["obs"], test["base"])
    advantage = (goal - value).detach()
    mean, log_std = agent.actor.heads(test["obs"])
    log_pi = log_prob(agent.actor.squashed(test["residual"]), mean, log_std)
    losses = {"policy": -clipped_surrogate(log_pi - log_pi.detach(), (advantage - advantage.mean()) / advantage.std(), m.ppo_clip).mean(),
              "value": m.ppo_value_coef * clipped_value_loss(value, value.detach(), goal, m.ppo_clip).mean()}
    shared = [p for p in agent.actor.gpt.parameters() if p.requires_grad]
    found = {}
    for name, loss in losses.items():
        gradients = torch.autograd.grad(loss, shared, retain_graph=True, allow_unused=True)
        found[name] = float(torch.stack([g.square().sum() for g in gradients if g is not None] or [torch.zeros(())]).sum().sqrt())
    return found


# ---- verdict ---------------------------------------------------------------------------------------------------------

def moved_by_critics(drifts: Mapping[str, float]) -> tuple[str, list[str]]:
    """Whether critic updates alone move the policy through a shared transformer only: `drifts` is kind -> drift after them.

    "reproduced": exactly 0 for mlp and separate, above 0 for shared; "not" else. It is our statement; the paper does not make it.
    """
    still = all(drifts[kind] == 0 for kind in ("mlp", "separate"))
    return ("reproduced" if still and drifts["shared"] > 0 else "not"), [
        f"{KINDS[kind]}: critic updates alone move an action by {value:.4f} per dimension" for kind, value in drifts.items()]


# ---- recorded runs ---------------------------------------------------------------------------------------------------

def gains(table: pd.DataFrame, methods: Sequence[str] = ("sac_finetune", "ppo_finetune")) -> pd.DataFrame:
    """`ablations.differences` of each recorded architecture from the policy that it started from, with columns method and kind, in the
    order of KINDS."""
    cells = {recipe(method, kind): (method, kind) for method in methods for kind in KINDS}
    rows = differences(table, {name: f"{method.split('_')[0].upper()}, {KINDS[kind]}" for name, (method, kind) in cells.items()})
    return rows.assign(method=[cells[name][0] for name in rows.recipe], kind=[cells[name][1] for name in rows.recipe])
