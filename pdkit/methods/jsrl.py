"""Jump-start RL: the base policy begins each episode, a small policy learned from scratch ends it (facts.md 3.4; appendix B.5).

    a_t = a_base(o_t) for t < h,   a_learner(o_t) afterwards
    h starts as the mean length of the base policy's successful episodes (100 of them tried)
    after each evaluation of the two together: h falls by 10 when the mean of the last evaluations lies within
    [best - tolerance, best + tolerance] of the best such mean

Window and tolerance are not given by the paper; ours are 3 evaluations and 0.1. So how often one evaluates sets the pace: every 2,500
steps on 20 episodes in the lesson (1,000 and 10 in the recorded comparisons, or h could not reach 0 within them), every 50,000 on 50 in
the paper profile. The learner is SAC from scratch, with the numbers of pdkit/profiles.py: batches of 256, targets of 5 steps of reward,
rates of 6e-4 and 1e-3 on Door and 3e-4 on StackCube; paper 1,024, 1 step and 1e-4. The best mean includes the present one, so that an
improvement never blocks, and while it is 0 nothing falls: doing equally badly is no progress. Rows hold the executed action, whoever
chose it, and base = 0: the critics value actions, not corrections. The result is the combination at its final h, which the rows
call `guide_steps`: if h never reached 0, the base policy is still part of it. Training waits for each evaluation, because the
next episode depends on it. The guide acts in single steps: over a Diffusion Policy it needs one with chunk=1.
"""
from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import torch

from ..decorated import Decorated, load_decorated, save_decorated
from ..demos.sources import rollouts
from ..errors import PdkitError
from ..evaluate import timed
from ..files import atomic_folder, read_json, write_json
from ..online import Trainer
from ..policies import Policy, load_policy, save_policy
from ..policies.zero import Zero
from ..seeds import selection_seeds

FORMAT = "pdkit-jump-start-1"
CARD = "jump_start.json"  # beside guide and learner, in the folder of what was trained


def may_advance(scores: list[float], window: int, tolerance: float) -> bool:
    """Whether the guide may give up steps after evaluations with these success rates, in order."""
    if len(scores) < window:
        return False
    means = np.convolve(scores, np.full(window, 1 / window), "valid")
    best = means.max()
    return bool(best > 0 and abs(means[-1] - best) <= tolerance + 1e-9)


class JumpStart:
    """The guide for the first steps of an episode, then the learner."""

    def __init__(self, guide: Policy, learner: Decorated):
        self.guide, self.learner = guide, learner
        self.window, self.chunk = guide.window, guide.chunk

    @property
    def guide_steps(self) -> int:
        return int(self.learner.actor.guide_steps)

    def reset(self, seed: int) -> None:
        """Restart the guide's random numbers."""
        self.guide.reset(seed)

    @timed
    def act(self, windows: np.ndarray, elapsed: np.ndarray | None = None) -> np.ndarray:
        """Action chunks (N, 1, act_dim) for windows (N, window, obs_dim) and the steps since each episode's start (N,)."""
        if elapsed is None:
            raise PdkitError("A jump-start policy must be told the steps since each episode's start: call act(windows, elapsed).")
        actions, guided = self.learner.act(windows), np.flatnonzero(elapsed < self.guide_steps)
        if len(guided):
            actions[guided] = self.guide.act(windows[guided])
        return actions


class JSRL(Trainer):
    """The loop in which `base` is the guide's action where the guide acts and 0 elsewhere; it is stored as 0 everywhere.

    The number of guided steps is a buffer of the actor: it goes wherever its weights go, to evaluations, checkpoints and disk.
    """

    chunks = False
    reads = ("jsrl_",)

    def __init__(self, config, base, demos=None, spec=None):
        if config.decorator.alpha != 1 or config.decorator.alpha_scale or config.decorator.H or config.demo_fraction:
            raise PdkitError("JSRL's learner acts by itself and without demonstrations: set alpha=1, alpha_scale=(), H=0, demo_fraction=0.")
        if not config.eval_every or not config.eval_episodes:
            raise PdkitError("JSRL's curriculum follows evaluations: set eval_every and eval_episodes above 0.")
        super().__init__(config, base, demos, spec)
        self.elapsed = np.zeros(config.num_envs, np.int64)  # steps since each lane's episode started
        self.guided = np.ones(config.num_envs, bool)  # where the guide chooses the action now due

    def _make_agent(self):
        agent = super()._make_agent()
        for actor in (agent.actor, agent.average):
            actor.register_buffer("guide_steps", torch.zeros((), dtype=torch.int64, device=self.config.device))
        return agent

    @property
    def guide_steps(self) -> int:
        return int(self.agent.actor.guide_steps)

    def _set_guide_steps(self, steps: int) -> None:
        for actor in (self.agent.actor, self.agent.average):
            actor.guide_steps.fill_(steps)

    def _first_guide_steps(self) -> int:
        episodes = self.config.method_config.jsrl_episodes
        played = rollouts(self.base, self.spec, selection_seeds(episodes)).episodes()
        lengths = [int(np.argmax(e["success"])) + 1 for e in played if e["success"].any()]
        if not lengths:
            raise PdkitError(f"The base policy solved none of {episodes} episodes, so JSRL has no first horizon; use a better one.")
        return round(np.mean(lengths))

    def _start(self, envs, run):
        if run is None or not run.has_checkpoint:
            self._set_guide_steps(self._first_guide_steps())
        return super()._start(envs, run)

    def _explore(self, obs, base):
        return np.where(self.guided[:, None], 0, super()._explore(obs, np.zeros_like(base))).astype(np.float32)

    def _base_actions(self, result):
        self.elapsed = np.where(result.done, 0, self.elapsed + result.steps)
        self.guided = self.elapsed < self.guide_steps
        actions = np.zeros((len(self.guided), self.spec.act_dim), np.float32)
        if self.guided.any():
            actions[self.guided] = self.base.act(result.windows[self.guided])[:, 0]
        return actions, np.zeros_like(actions)

    def _store(self, obs, residual, base, result, base_final):
        super()._store(obs, base + residual, np.zeros_like(base), result, base_final)

    def _add_row(self, before, evaluations):
        super()._add_row(before, evaluations)
        if evaluations.pending:
            self._collect(evaluations, None, wait=True)
            own, scores = self.config.method_config, [row["success_once"] for row in self.rows if "success_once" in row]
            over = self.step >= self.config.total_steps  # nobody evaluates a horizon that falls now
            if not over and may_advance(scores, own.jsrl_window, own.jsrl_tolerance):
                self._set_guide_steps(max(self.guide_steps - own.jsrl_step, 0))

    def _row(self):
        return super()._row() | {"guide_steps": self.guide_steps}

    def _as_policy(self, actor, base):
        zero = Zero.instead_of(base, base.window).to(next(actor.parameters()).device)
        return JumpStart(base, Decorated(zero, actor, self.config.decorator, self.config.normalize_obs, self.sight.features))

    def save_policy(self, policy, folder):
        save_jump_start(policy, folder, {"task": self.config.task, "seed": self.config.seed})

    def save(self, run, snapshot, unscored):
        super().save(run, snapshot | {"guided": self.guided}, unscored)

    def load(self, run):
        snapshot = super().load(run)
        self.elapsed, self.guided = snapshot["lengths"].copy(), snapshot["guided"]
        return snapshot


def save_jump_start(policy: JumpStart, folder: str | Path, info: dict | None = None) -> None:
    """Write guide, learner and the number of guided steps to `folder`."""
    learner = copy.copy(policy.learner)
    learner.actor = copy.deepcopy(policy.learner.actor)
    del learner.actor.guide_steps  # in the card, where it can be read
    with atomic_folder(folder) as temporary:
        save_policy(policy.guide, temporary / "guide")
        save_decorated(learner, temporary / "learner")
        write_json(temporary / CARD, {"format": FORMAT, "guide_steps": policy.guide_steps, "info": info or {}})


def load_jump_start(folder: str | Path) -> JumpStart:
    """The policy saved in `folder`. Raises PdkitError when a part is missing, altered or does not fit."""
    folder = Path(folder)
    card = read_json(folder / CARD)
    if not isinstance(card, dict) or card.get("format") != FORMAT or "guide_steps" not in card:
        raise PdkitError(f"{folder}/{CARD} is not a {FORMAT} file.")
    learner = load_decorated(folder / "learner")
    learner.actor.register_buffer("guide_steps", torch.tensor(int(card["guide_steps"])))
    return JumpStart(load_policy(folder / "guide"), learner)
