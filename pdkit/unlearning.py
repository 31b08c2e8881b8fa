"""What SAC's actor loss does to a policy that is good already: the measurements of notebooks 06 (appendix F.2) and 07 (F.5.2).

    drift          mean |a_k - a_0| on fixed observations, a_k the deterministic action after k updates of the actor
    heading        the cosine of a_k - a_0 with what would be better: whether it drifts to there
    pull           d/da min_i Q_i(s, a) at a = pi(s): where the critic sends the executed action
    entropy gap    target entropy - entropy of the actor; the temperature's gradient, so above 0 the temperature rises

A verdict is a function of measured numbers, so that another run may come to another one.
"""
from __future__ import annotations

import contextlib
import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from .claims import EXPLODES, RISES
from .decorated import Decorated
from .decorator import compose, gate
from .demos import Demos
from .errors import PdkitError
from .imitate import Windows
from .methods.registry import make_trainer, method_config
from .online import Trainer
from .policies import Policy
from .rl.networks import Actor
from .rl.replay import Replay
from .rl.sac import SAC
from .stats import Paired
from .tasks.lanes import IDLE
from .tasks.spec import TaskSpec
from .tasks.vector import VectorEnv

# ---- a learner and what it learns from -------------------------------------------------------------------------------

def starting_point(method: str, task: str, base: Policy, steps: int, seed: int = 0, spec: TaskSpec | None = None,
                   **changes: Any) -> Trainer:
    """The trainer of `method` before its first update, with `steps` transitions of its starting policy in `replay`.

    The method's own loop collects them with learning off, so that they are what its first batches are drawn from; the
    last actor is evaluated, not an average, and no penalty holds residuals back.
    """
    off = dict(total_steps=steps, warmup_steps=steps - 1, utd=0.0, eval_every=0, env_workers=0, eval_workers=0, log_every=0,
               checkpoint_every=0, demo_fraction=0.0, average=0.0, residual_penalty=0.0, actor_every=1)
    trainer = make_trainer(method_config(method, task, "lesson", seed, **(off | changes)), base, None, spec)
    trainer.train()
    return trainer


def fresh(trainer: Trainer, critic_seed: int = 0, **changes: Any) -> SAC:
    """A new learner for the data of `trainer`: the actor as it started, critics drawn with `critic_seed`, other settings of SAC by name.

    With another `log_std_range` the actor, too, is drawn anew.
    """
    other = copy.copy(trainer)
    try:
        other.config = replace(trainer.config, sac=replace(trainer.config.sac, **changes))
    except TypeError:
        raise PdkitError(f"Not all of these are settings of SAC: {', '.join(changes)}.") from None
    torch.manual_seed(critic_seed)
    agent = other._make_agent()
    if "log_std_range" not in changes:
        agent.actor.load_state_dict(trainer.agent.actor.state_dict())
    return agent


def updates(agent: SAC, replay: Replay, count: int, *, batch: int = 64, seed: int = 0, critics: bool = True) -> Iterator[dict[str, float]]:
    """Update `agent` `count` times on batches of `replay`, yielding its log after each; without `critics` they stay as they are."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        rows = replay.draw(batch, generator)
        log = agent.update(replay.unpack(rows), generator, critics=critics)
        yield {"update": agent.updates, "gap": agent.target_entropy - float(log["entropy"]), **{k: float(v) for k, v in log.items()}}


def seconds(agent: SAC, replay: Replay, count: int, batch: int) -> float:
    """Median seconds of an update on batches of `replay`."""
    taken, generator = [], torch.Generator().manual_seed(0)
    for _ in range(count + 2):  # the first two make the optimisers' memories
        rows = replay.unpack(replay.draw(batch, generator))
        started = time.perf_counter()
        agent.update(rows, generator)
        taken.append(time.perf_counter() - started)
    return float(np.median(taken[2:]))


# ---- measurements ----------------------------------------------------------------------------------------------------

def held_out(demos: Demos, window: int, count: int, *, skip: int, seed: int = 0) -> np.ndarray:
    """`count` windows (count, window, obs_dim) drawn without replacement from the demonstrations after the first `skip`."""
    windows, _ = Windows(demos, window, True).all()
    windows = windows[int(demos.lengths[:skip].sum()):]
    if count > len(windows):
        raise PdkitError(f"{count} windows were asked for; the demonstrations after the first {skip} hold {len(windows)}.")
    return windows[np.random.default_rng(seed).permutation(len(windows))[:count]].numpy()


def lifted(observations: np.ndarray) -> np.ndarray:
    """StackCube: whether the red cube is off the table, (M,) bool: its centre lies 2 cm above where it rests (half a cube, 2 cm)."""
    return observations[:, 34] > 0.04


def drift(actions: np.ndarray, reference: np.ndarray) -> float:
    """mean |a - a_0| per action dimension: actions (N, act_dim), `reference` those of the policy where it started."""
    return float(np.abs(np.clip(actions, -1, 1) - np.clip(reference, -1, 1)).mean())


def heading(actions: np.ndarray, reference: np.ndarray, improvement: np.ndarray) -> float:
    """Where a policy has drifted: the mean cosine of a_k - a_0 and the improving direction, all (N, act_dim); 0 before it has moved."""
    return float(cosines(np.clip(actions, -1, 1) - np.clip(reference, -1, 1), improvement).mean())


def pull(agent: SAC, seen: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """d/da min_i Q_i(s, a), (N, act_dim), at executed `actions` (N, act_dim) for observations as critics are given them (N, stored)."""
    a = torch.from_numpy(np.ascontiguousarray(actions, np.float32)).requires_grad_(True)
    obs = agent.critic_view(agent.normalize(torch.from_numpy(np.ascontiguousarray(seen, np.float32))))
    if agent.decorator.critic_input != "sum":
        raise PdkitError("The pull on the executed action needs critics that see the sum (critic_input='sum').")
    values = agent.critics(torch.cat([obs, a], dim=-1)).min(dim=0).values
    return torch.autograd.grad(values.sum(), a)[0].numpy()


def entropy_pull(temperature: float, actions: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """d/da of -temperature * log pi at the middle of the Gaussian, (N, act_dim): tanh makes it point to the middle of the range.

    With a = tanh(u) / scale, log pi holds -log(1 - tanh(u)^2) = -log(1 - (scale a)^2), and nothing else that depends on a.
    """
    return -temperature * 2 * actions * scale**2 / np.maximum(1 - (scale * actions) ** 2, 1e-6)


def cosines(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The cosine of the angle between rows, (N,); 0 where one of them is zero."""
    norms = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return np.where(norms > 0, (first * second).sum(axis=1) / np.maximum(norms, 1e-12), 0.0)


def reached(spec: TaskSpec, policy: Policy | Decorated, seeds: Sequence[int], stage: Callable[[np.ndarray], np.ndarray], *,
            limit: int | None = None) -> np.ndarray:
    """Whether each seed's episode ever came to a stage, (N,) bool: `stage` maps observations (M, obs_dim) to (M,) bool."""
    policy.reset(0)
    queue = [*seeds][::-1]
    with VectorEnv(spec, len(seeds), lambda lane: queue.pop() if queue else IDLE, window=policy.window, max_episode_steps=limit) as envs:
        windows, found, running = envs.reset(), np.zeros(len(seeds), bool), np.ones(len(seeds), bool)
        while running.any():
            result = envs.step(policy.act(windows))
            found |= running & stage(result.final_windows[:, -1])
            running &= ~result.done
            windows = result.windows
    return found


class Gated:
    """A decorated policy as the loop runs it at environment step `step`: the residual is on only now and then."""

    def __init__(self, policy: Decorated, step: int, seed: int = 0):
        self.policy, self.step, self.window, self.chunk = policy, step, policy.window, 1
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Restart the gate's random numbers and the base policy's."""
        self.rng = np.random.default_rng([seed, 2])
        self.policy.reset(seed)

    def act(self, windows: np.ndarray) -> np.ndarray:
        base, residual = self.policy.parts(windows)
        return compose(self.policy.config, base, gate(self.policy.config, residual, self.step, self.rng))[:, None]


# ---- the two things that the entropy explanation is about ------------------------------------------------------------

def set_spread(actor: nn.Module, log_std: float) -> None:
    """Make an actor's first log_std this number wherever it looks: the bias of its head, through the range it is squashed to."""
    if isinstance(actor, Actor):
        low, high, bias, weight = actor.low, actor.high, actor.head.bias, actor.head.weight
        bias, weight = bias[len(bias) // 2:], weight[len(weight) // 2:]
    else:
        from .policies.bet_sac import LOG_STD

        (low, high), bias, weight = LOG_STD, actor.spread.bias, actor.spread.weight
    if not low < log_std < high:
        raise PdkitError(f"This actor's log_std lies between {low:g} and {high:g}; {log_std:g} is not inside.")
    with torch.no_grad():
        bias.fill_(math.atanh(2 * (log_std - low) / (high - low) - 1))
        weight.zero_()


def threshold(act_dim: int, target_entropy: float) -> float:
    """The log_std at which a Gaussian that tanh hardly bends has the target entropy: below it the temperature rises."""
    return target_entropy / act_dim - 0.5 * math.log(2 * math.pi * math.e)


@contextlib.contextmanager
def clamped_log_pi(actor: nn.Module, limit: float) -> Iterator[None]:
    """While it lasts `actor.sample` reports log pi inside [-limit, limit]: an intervention on its size alone."""
    plain = actor.sample

    def sample(*arguments):
        action, log_pi = plain(*arguments)
        return action, log_pi.clamp(-limit, limit)

    actor.sample = sample
    try:
        yield
    finally:
        del actor.sample


# ---- verdicts --------------------------------------------------------------------------------------------------------

def unlearning_verdict(few: Paired, many: Paired, guarded: Paired) -> tuple[str, list[str]]:
    """F.2 from three comparisons with the policy before any update: after few and many updates by a random critic, and the same
    number of updates of a bounded residual. A fall or its absence is judged by the 95 % interval of the paired difference; "untested" for
    a policy that solves nothing, and has nothing to lose."""
    falls, falls_early, keeps = many.high < 0, few.high < 0, guarded.low <= 0 <= guarded.high
    reasons = [
        _said("after few updates", few, "it falls" if falls_early else "no fall that this many episodes can show"),
        _said("after many updates", many, "it falls" if falls else "no fall that this many episodes can show"),
        _said("decorated, many updates", guarded, "no change that this many episodes can show" if keeps else
              "it falls too" if guarded.high < 0 else "it rises"),
    ]
    if falls and many.difference <= few.difference:
        return ("reproduced" if falls_early else "partly"), reasons
    return ("not" if many.base.value > 0 else "untested"), reasons


def _said(what: str, result: Paired, words: str) -> str:
    return (f"{what}: {100 * result.difference:+.0f} points ({100 * result.low:+.0f} to {100 * result.high:+.0f}): {words}")


def warm_start_verdict(runs: dict[str, dict[str, float]], bound: float) -> tuple[str, list[str]]:
    """F.5.2 from three runs, "warm", "vanilla" and "fixed": by what factor their `temperature` grew, the critics' mean `loss` over the
    second half of the warm start (of all at the same updates), and the largest mean |Q|, `q`, which is told beside `bound`, the largest
    that rewards alone can make.

    Both halves of the claim: with a warm start the temperature increases massively (here: more than doubles, and more than twice
    as much as without), and the critic's loss explodes (here: to ten times what it is without one).
    """
    warm, vanilla, fixed = (runs[name] for name in ("warm", "vanilla", "fixed"))
    rises = warm["temperature"] > RISES * max(1.0, vanilla["temperature"])
    explodes = warm["loss"] > EXPLODES * vanilla["loss"]
    return ("reproduced" if rises and explodes else "partly" if rises or explodes else "not"), [
        f"temperature: times {warm['temperature']:.2f} with a warm start, times {vanilla['temperature']:.2f} without: "
        f"{'the warm start lets it rise' if rises else 'no rise that only the warm start explains'}",
        f"loss of the critic, in the second half of the wait: {warm['loss']:,.2f} with a warm start, {vanilla['loss']:,.2f} without, "
        f"{fixed['loss']:,.2f} with warm start and fixed temperature: "
        f"{'it explodes' if explodes else 'no explosion that only the warm start explains'}",
        f"largest mean |Q|: {warm['q']:,.0f}, {vanilla['q']:,.0f} and {fixed['q']:,.0f}; rewards alone reach {bound:,.0f}"]


def explanation_verdict(arms: Sequence[dict[str, float]]) -> tuple[str, list[str]]:
    """What decides whether the temperature of a frozen actor rises, from arms with their first `gap` (target entropy - entropy), first
    `size` (mean |log pi|) and the `growth` of the temperature: "size", "side" (entropy below the target), "both" or "neither".

    Size decides if every arm that rises is larger than every arm that falls; side, if the arms that rise are those with a gap above 0.
    """
    rising = [arm for arm in arms if arm["growth"] > 1]
    falling = [arm for arm in arms if arm["growth"] <= 1]
    if not rising or not falling:
        return "neither", ["all temperatures went the same way: these arms cannot tell"]
    side = all((arm["gap"] > 0) == (arm["growth"] > 1) for arm in arms)
    least, most = min(arm["size"] for arm in rising), max(arm["size"] for arm in falling)
    size = least > most
    return {(True, True): "both", (True, False): "side", (False, True): "size", (False, False): "neither"}[side, size], [
        f"the side of the target {'tells' if side else 'does not tell'} which temperatures rise: {len(rising)} of {len(arms)} do",
        f"the least |log pi| that rises is {least:.0f}, the largest that falls {most:.0f}: size alone "
        f"{'would tell as well' if size else 'does not tell'}"]
