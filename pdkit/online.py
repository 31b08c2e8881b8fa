"""The one loop of every online method: act, learn while the simulators run, store, evaluate, checkpoint.

Steps are primitive environment steps. The loop is deterministic on a CPU: the learner works on what was stored before the
step now in flight, so neither the number of workers nor a restart from a checkpoint changes the curve.
"""
from __future__ import annotations

import contextlib
import copy
import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import nn

from .decorated import Decorated, flat_actions, save_decorated
from .decorator import check_scale, compose, gate, gate_probability, scaled
from .demos.format import Demos
from .errors import PdkitError
from .machine import load_average
from .online_config import OnlineConfig, decision_reward, lr_factor, stops
from .online_eval import Evaluations
from .online_rows import demo_rows, last_observation
from .policies import Policy
from .rl.replay import NStep, Replay
from .rl.sac import SAC
from .runs import Run
from .seeds import training_seed
from .tasks import get_task
from .tasks.batched import require_batched
from .tasks.features import Sight
from .tasks.horizon import horizon_spec, shortened
from .tasks.spec import TaskSpec
from .tasks.vector import Episode, VectorEnv
from .torch_setup import has_bf16, pick_device


class Trainer:
    """State of one online run. `train()` runs it to the end; `save` and `load` are its checkpoint."""

    def __init__(self, config: OnlineConfig, base: Policy, demos: Demos | None = None, spec: TaskSpec | None = None):
        pick_device(config.device)  # an error where it is not there
        # A spec of its own is for worlds outside the registry, such as the probes; with start_fraction both become a shorter task.
        self.spec = horizon_spec(spec or get_task(config.task), config.start_fraction)
        if base.config["obs_dim"] != self.spec.obs_dim or base.config["act_dim"] != self.spec.act_dim:
            raise PdkitError(f"This base policy is for {base.config['obs_dim']} observations and {base.config['act_dim']} actions; "
                             f"{self.spec.name} has {self.spec.obs_dim} and {self.spec.act_dim}: start from one of this task.")
        check_scale(config.decorator, base.config["act_dim"])
        # The factors of alpha hold for each action of a chunk.
        decorator = dataclasses.replace(config.decorator, alpha_scale=config.decorator.alpha_scale * base.chunk)
        self.config, self.base = dataclasses.replace(config, decorator=decorator), base.eval().to(config.device)
        if config.simulator == "physx_cuda":
            require_batched(self.spec)
        if base.chunk != 1 and not self.chunks:
            raise PdkitError(f"{config.method} takes one action at a time, and this {base.kind} policy decides on {base.chunk} at once: "
                             "start from another one, or from the same with chunk=1.")
        if config.features and not self.sees_features:
            raise PdkitError(f"The networks of {config.method} see the observation alone; set features=False.")
        self.sight = Sight(self.base.normalizer, config.normalize_obs, self.spec.name if config.features else "")
        torch.manual_seed(config.seed)
        self.rng = np.random.default_rng([config.seed, 1])
        self.generator = torch.Generator().manual_seed(config.seed)
        self.agent = self._make_agent()
        self.replay = self._make_replay(self.decisions)
        self.demos = None
        if demos is not None and (config.demo_fraction or self.needs_demos):
            rows = self._demo_rows(demos)
            self.demos = self._make_replay(len(rows))
            self.demos.add(rows)
        elif config.demo_fraction:
            raise PdkitError("demo_fraction is above 0 but no demonstrations were given; pass demos or set demo_fraction=0.")
        self.nstep = self._make_nstep(config.num_envs)
        self.step, self.train_seconds, self.rows, self.recent = 0, 0.0, [], []
        self.sizes = np.zeros(3)  # since the last row: sums over decisions of |residual|, of |base action|, and their number
        self.first_reward = 0  # the step by which the first reward came; 0: none yet
        self.loads = np.zeros(2)  # the machine's load average at each row: their sum, and their number
        self.episode_counts = [0] * config.num_envs
        self.log: dict[str, torch.Tensor] = {}
        self.best_score, self.best_actor = -1.0, {}  # of the evaluations so far
        self._unscored: dict[int, dict[str, torch.Tensor]] = {}  # of a checkpoint: actors whose evaluation had not come back

    # ---- what a method may do otherwise: see pdkit/methods ----

    _view = staticmethod(last_observation)  # what is stored of a window, and what the agent sees

    @property
    def stored_dim(self) -> int:
        """Width of what `_view` gives."""
        return self.spec.obs_dim

    @property
    def in_bf16(self) -> bool:
        """Whether its gradient steps are computed in bfloat16 here."""
        return "bf16" not in self.unread and self.config.sac.bf16 and has_bf16(self.config.device)

    @property
    def act_dim(self) -> int:
        """Numbers in one decision: the actions of a chunk, one after the other. Residuals and critics take it as one action."""
        return self.spec.act_dim * self.base.chunk

    @property
    def decisions(self) -> int:
        """Room for all decisions of a run. Each takes a chunk's steps but an episode's last, so that twice their quotient is enough
        while episodes last half a chunk or longer."""
        return min(self.config.total_steps, 2 * -(-self.config.total_steps // self.base.chunk))

    reads: tuple[str, ...] = ()  # what its names begin with that it takes from MethodConfig
    unread: frozenset[str] = frozenset()  # settings of the loop and of SAC that mean nothing to it
    sees_features = True  # whether the agent's networks see what `sight` shows
    chunks = True  # whether base policies may decide on several actions at once

    def _make_agent(self) -> SAC:
        c = self.config
        return SAC(self.spec.obs_dim + self.sight.more, self.act_dim, c.sac, c.decorator, device=c.device, normalize=self.sight)

    def _make_replay(self, capacity: int) -> Replay:
        return Replay(capacity, self.stored_dim, self.act_dim, device=self.config.device)

    def _make_nstep(self, lanes: int) -> NStep:
        return NStep(lanes, self.config.n_step, self.config.gamma)

    def _demo_rows(self, demos: Demos) -> list[np.ndarray]:
        return demo_rows(demos, self.base, self.config, self._view, rest=self.spec.resting)

    needs_demos = False  # even when none are mixed into batches
    offline_updates = 0  # made by `_offline`; those of the loop come on top

    def _offline(self, evaluations: Evaluations) -> Iterator[None]:
        """Learning from data before the first step, or what remains of it; each yield is a row, and a moment to checkpoint."""
        yield from ()

    def _as_policy(self, actor: nn.Module, base: Policy) -> Decorated | Policy:
        """What is evaluated and reported: this actor as a policy."""
        return Decorated(base, actor, self.config.decorator, self.config.normalize_obs, self.sight.features)

    def save_policy(self, policy: Decorated | Policy, folder: Path) -> None:
        """Write a policy that `_as_policy` made."""
        save_decorated(policy, folder, {"task": self.config.task, "seed": self.config.seed})

    # ---- the loop ----

    def _next_seed(self, lane: int) -> int:
        self.episode_counts[lane] += 1
        return training_seed(self.config.seed, lane, self.episode_counts[lane])

    @property
    def policy(self) -> Decorated | Policy:
        """The policy as it stands (the averaged actor)."""
        return self._as_policy(self._actor, self.base)

    @property
    def _actor(self) -> nn.Module:
        return self.agent.average if self.config.sac.average else self.agent.actor

    def result(self) -> Decorated | Policy:
        """The policy that the run ends with: the last, or the one selected on the selection seeds."""
        chosen = copy.deepcopy(self._actor)
        if self.best_actor:
            chosen.load_state_dict(self.best_actor)
        return self._as_policy(chosen, self.base)

    def train(self, run: Run | None = None, progress: Callable[[Trainer], None] | None = None) -> Decorated | Policy:
        """Run to `total_steps`, from a checkpoint in `run` if there is one; `progress(self)` is called for each new row of
        `rows`, and again when the evaluation that belongs to a row comes back.

        Raises PdkitError when a loss or weight stops being finite; the last checkpoint is then still good.
        """
        c = self.config
        envs = VectorEnv(self.spec, c.num_envs, self._next_seed, window=self.base.window, chunk=self.base.chunk,
                         workers=c.env_workers, simulator=c.simulator,
                         terminate_on_success=c.on_success == "terminate", success_tail=c.success_tail,
                         max_episode_steps=shortened(c.train_limit, c.start_fraction) or None)
        with envs, contextlib.closing(self._evaluations()) as evaluations:
            windows, base = self._start(envs, run)
            for step, weights in sorted(self._unscored.items()):
                evaluations.submit(step, weights)
            started = time.monotonic()
            for _ in self._offline(evaluations):
                self.train_seconds += time.monotonic() - started
                self.rows.append(self._row())
                if progress:
                    progress(self)
                if run is not None:
                    self.save(run, envs.snapshot() | {"base": base}, evaluations.pending)
                started = time.monotonic()
            while self.step < c.total_steps:
                started = time.monotonic()
                before = self.step
                residual = self._explore(self._view(windows), base)
                envs.send(compose(c.decorator, base, residual).reshape(len(base), self.base.chunk, -1))
                self.sizes += np.abs(scaled(c.decorator, residual)).mean(1).sum(), np.abs(base).mean(1).sum(), len(base)
                self._learn()
                result = envs.receive()
                base_next, base_final = self._base_actions(result)
                self._store(self._view(windows), residual, base, result, base_final)
                windows, base = result.windows, base_next
                self.step += int(result.steps.sum())
                self.recent += result.episodes
                self.first_reward = self.first_reward or self.step * bool(result.reward.any())
                if self._row_is_due(before):
                    self._add_row(before, evaluations)
                    if progress:
                        progress(self)
                self._collect(evaluations, progress)
                self.train_seconds += time.monotonic() - started
                if run is not None and self._crossed(before, c.checkpoint_every):
                    self.save(run, envs.snapshot() | {"base": base}, evaluations.pending)
            started = time.monotonic()
            self._collect(evaluations, progress, wait=True)
            self.train_seconds += time.monotonic() - started
        if c.utd and not self.agent.updates:
            raise PdkitError(f"Not one update was made in {self.step:,} steps (warmup_steps {c.warmup_steps:,}, utd {c.utd:g}, batch "
                             f"{c.batch}): take more steps, a shorter warm-up or smaller batches.")
        return self.result()

    def _evaluations(self) -> Evaluations:
        c, actor = self.config, copy.deepcopy(self._actor).cpu()
        policy = self._as_policy(actor, copy.deepcopy(self.base).cpu())
        return Evaluations(self.spec, policy, actor, episodes=c.eval_episodes, seed=c.seed,
                           workers=c.eval_workers if c.eval_every and c.eval_episodes else 0)

    def _start(self, envs: VectorEnv, run: Run | None):
        if run is not None and run.has_checkpoint:
            snapshot = self.load(run)
            windows = envs.restore(snapshot)
            return windows, snapshot["base"].astype(np.float32)
        self.base.reset(self.config.seed)
        windows = envs.reset()
        return windows, flat_actions(self.base, windows)

    def _explore(self, obs: np.ndarray, base: np.ndarray) -> np.ndarray:
        """Gated residuals (N, act_dim) to execute and store."""
        c, shape = self.config, base.shape
        if self.step < c.warmup_steps and c.warmup != "policy":
            residual = np.zeros(shape, np.float32) if c.warmup == "base" else self.rng.uniform(-1, 1, shape).astype(np.float32)
        else:
            noise = torch.from_numpy(self.rng.standard_normal(shape).astype(np.float32)).to(c.device)
            obs, base = (torch.from_numpy(np.ascontiguousarray(x)).to(c.device) for x in (obs, base))
            residual = self.agent.act(obs, base, noise).float().cpu().numpy()
        return gate(c.decorator, residual, self.step, self.rng)

    def _learn(self) -> None:
        c = self.config
        due = int((self.step - c.warmup_steps) * c.utd) + self.offline_updates - self.agent.updates
        if due > 0 and self.replay.size >= c.batch and c.lr_decay_from < 1:
            self.agent.scale_lr(lr_factor(c, self.step))
        for _ in range(max(0, due) if self.replay.size >= c.batch else 0):
            demos = round(c.batch * c.demo_fraction) if self.demos else 0
            rows = self.replay.draw(c.batch - demos, self.generator)
            if demos:
                rows = torch.cat([rows, self.demos.draw(demos, self.generator)])
            self.log |= self.agent.update(self.replay.unpack(rows), self.generator)

    def _base_actions(self, result) -> tuple[np.ndarray, np.ndarray]:
        """Base actions (N, self.act_dim) to act on next, and those at the true successors: the base policy runs once for each
        distinct window, so only episodes that just ended cost a second one."""
        ended = np.flatnonzero(result.done)
        actions = flat_actions(self.base, np.concatenate([result.windows, result.final_windows[ended]]))
        upcoming, final = actions[: len(result.windows)], actions[: len(result.windows)].copy()
        final[ended] = actions[len(result.windows):]
        return upcoming, final

    def _store(self, obs, residual, base, result, base_final) -> None:
        c, final, reward = self.config, self._view(result.final_windows), decision_reward(self.config, result.reward)
        for i in range(c.num_envs):
            stop = stops(c, bool(result.terminated[i]), bool(result.truncated[i]))
            self.replay.add(self.nstep.push(i, obs[i], residual[i], base[i], float(reward[i]), final[i], base_final[i], stop,
                                            bool(result.done[i])))

    def _crossed(self, before: int, every: int) -> bool:
        """Whether a multiple of `every` steps (or the end) lies between `before` and now."""
        return bool(every) and (self.step // every > before // every or self.step >= self.config.total_steps)

    def _row_is_due(self, before: int) -> bool:
        return self._crossed(before, self.config.log_every) or self._crossed(before, self.config.eval_every)

    def _add_row(self, before: int, evaluations: Evaluations) -> None:
        self.rows.append(self._row())
        self.loads += load_average(), 1
        if self._crossed(before, self.config.eval_every) and self.config.eval_episodes:
            evaluations.submit(self.step, self._actor.state_dict())

    def _collect(self, evaluations: Evaluations, progress, wait: bool = False) -> None:
        """Enter what has been evaluated into its row, and keep the best actor since the gate was open and the actor learned."""
        for step, weights, scores in evaluations.collect(wait):
            row = next(row for row in reversed(self.rows) if row["step"] == step)
            row.update(scores)
            score = scores["success_once"]
            if self.config.on_success == "continue":  # then staying solved is learned too
                score = (score + scores["success_at_end"]) / 2
            # Else it is what the run, or its online stage, started from; the actor learns every so many updates.
            learned = row["updates"] >= max(self.offline_updates, self.config.sac.critic_warmup) + self.config.sac.actor_every
            if self.config.select == "best" and learned and step >= max(self.config.decorator.H, 1) and score >= self.best_score:
                self.best_score, self.best_actor = score, weights
            if progress:
                progress(self)

    def _row(self) -> dict:
        values = {name: float(value) for name, value in self.log.items()}
        self._must_be_finite(values)
        episodes, self.recent = self.recent, []
        if episodes:
            values |= {"train_success": float(np.mean([e.success_once for e in episodes])), "train_episodes": len(episodes),
                       "train_length": float(np.mean([e.length for e in episodes]))}
        if self.sizes[2]:  # as executed: bounded by alpha, 0 where the gate was shut
            values |= {"residual_size": self.sizes[0] / self.sizes[2], "base_size": self.sizes[1] / self.sizes[2]}
        self.sizes = np.zeros(3)
        return {"step": self.step, "updates": self.agent.updates, "seconds": self.train_seconds,
                "gate": gate_probability(self.config.decorator, self.step), **values}

    def _must_be_finite(self, values: dict[str, float]) -> None:
        bad = [name for name, value in values.items() if not np.isfinite(value)]
        if bad:
            raise PdkitError(f"Training stopped at step {self.step}: {bad[0]} is no longer a number; the last checkpoint is good: "
                             "lower the learning rates or set bf16=False in a new run.")

    def save(self, run: Run, snapshot: dict[str, np.ndarray], unscored: dict[int, dict[str, torch.Tensor]]) -> None:
        """Write a checkpoint: everything the rest of the run depends on, environments included (as seeds and actions)."""
        arrays = {f"envs.{k}": v for k, v in snapshot.items()} | {f"nstep.{k}": v for k, v in self.nstep.state().items()}
        arrays |= {"replay": self.replay.rows[: self.replay.size].cpu().numpy(), "episode_counts": np.array(self.episode_counts),
                   "generator": self.generator.get_state().numpy(), "torch_rng": torch.get_rng_state().numpy()}
        if self.config.device == "cuda":  # which has a generator of its own: dropout and sampling draw from it
            arrays["cuda_rng"] = torch.cuda.get_rng_state().numpy()
        agent = self.agent.state()
        self._must_be_finite({name: float(tensor.float().sum()) for name, tensor in agent.items()})
        arrays |= {f"agent.{k}": v.numpy() for k, v in agent.items()}
        arrays |= {f"best.{k}": v.numpy() for k, v in self.best_actor.items()}
        arrays |= {f"unscored.{step}/{k}": v.numpy() for step, weights in unscored.items() for k, v in weights.items()}
        values = {"step": self.step, "train_seconds": self.train_seconds, "position": self.replay.position, "rows": self.rows,
                  "best_score": self.best_score, "rng": self.rng.bit_generator.state, "recent": [vars(e) for e in self.recent],
                  "sizes": self.sizes.tolist(), "first_reward": self.first_reward, "loads": self.loads.tolist(),
                  "log": {k: float(v) for k, v in self.log.items()}}
        run.save_checkpoint(arrays, values)

    def load(self, run: Run) -> dict[str, np.ndarray]:
        """Restore a checkpoint; what the environments need."""
        arrays, values = run.load_checkpoint()

        def group(name: str) -> dict[str, np.ndarray]:
            return {k.removeprefix(f"{name}."): v for k, v in arrays.items() if k.startswith(f"{name}.")}

        self.agent.load({k: torch.from_numpy(v) for k, v in group("agent").items()})
        replay = torch.from_numpy(arrays["replay"])
        self.replay.rows[: len(replay)] = replay
        self.replay.size, self.replay.position = len(replay), values["position"]
        self.nstep.load(group("nstep"), self.stored_dim, self.act_dim)
        self.generator.set_state(torch.from_numpy(arrays["generator"]))
        torch.set_rng_state(torch.from_numpy(arrays["torch_rng"]))
        if "cuda_rng" in arrays:
            torch.cuda.set_rng_state(torch.from_numpy(arrays["cuda_rng"]))
        self.rng.bit_generator.state = values["rng"]
        self.episode_counts = arrays["episode_counts"].tolist()
        self.step, self.train_seconds, self.rows = values["step"], values["train_seconds"], values["rows"]
        self.recent = [Episode(**e) for e in values["recent"]]
        self.sizes, self.first_reward = np.array(values["sizes"]), values["first_reward"]
        self.loads = np.array(values.get("loads", (0.0, 0.0)))  # a checkpoint of before has none
        self.log = {k: torch.tensor(v) for k, v in values["log"].items()}
        self.best_score, self.best_actor = values["best_score"], {k: torch.from_numpy(v) for k, v in group("best").items()}
        for key, tensor in group("unscored").items():
            step, name = key.split("/")
            self._unscored.setdefault(int(step), {})[name] = torch.from_numpy(tensor)
        return group("envs")
