"""Offline training of base policies from demonstrations, with checkpoint selection (appendix B.1.3: the checkpoint with the
best success over 50-episode evaluations)."""
from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from .demos.format import Demos
from .errors import PdkitError, unknown
from .evaluate import selection_scores
from .gradient_steps import GradientSteps, make_optimizer
from .policies import POLICIES, Policy
from .profiles import checked
from .rl.state import pack, unpack
from .runs import Run
from .tasks import get_task
from .tasks.spec import TaskSpec

SCHEDULES = ("constant", "cosine")
EARLY = 10  # gradient steps after which it is known how long they take


@dataclass(frozen=True)
class ImitateConfig:
    """How a base policy is trained; a policy may train with other values of its own (`Policy.recipe`)."""

    iterations: int = 1500  # gradient steps
    batch: int = 256  # windows per step
    lr: float = 1e-3  # AdamW
    schedule: str = "constant"  # of the learning rate; "cosine" falls to 0 at the end
    lr_warmup: int = 0  # gradient steps over which the learning rate rises from 0
    beta1: float = 0.9  # AdamW's memory of gradients
    weight_decay: float = 2e-4  # on the weights that the policy names (BeT: the GPT's linear ones)
    ema_power: float = 0.0  # above 0 the averaged weights are evaluated and kept; the average remembers ever longer, 1 - (1 + step)^-power
    hold_end: bool = False  # also imitate keeping still (TaskSpec.resting) at a demonstration's last observation; else it is left out
    pad_start: bool = True  # windows before step 0 repeat the first observation, as acting does; the paper's code skips them
    eval_every: int = 500  # gradient steps between checkpoints
    eval_episodes: int = 50  # per checkpoint, on selection seeds; 0 keeps the last
    seed: int = 0
    bf16: bool = True  # autocast to bfloat16 where the CPU or GPU has it

    def __post_init__(self):
        if self.iterations < 1 or self.batch < 1 or self.eval_every < 1 or self.eval_episodes < 0 or self.lr <= 0 or self.seed < 0:
            raise PdkitError("Imitation needs iterations, batch and eval_every >= 1, eval_episodes and seed >= 0 and lr > 0.")
        if self.schedule not in SCHEDULES:
            raise unknown("schedule", self.schedule, SCHEDULES)
        if self.lr_warmup < 0 or not 0 <= self.beta1 < 1 or self.ema_power < 0:
            raise PdkitError("Imitation needs lr_warmup and ema_power of 0 or more, and beta1 in [0, 1).")

    def lr_factor(self, iteration: int) -> float:
        """What `lr` is multiplied by at gradient step `iteration`, from 0."""
        if iteration < self.lr_warmup:
            return iteration / self.lr_warmup
        if self.schedule == "constant":
            return 1.0
        return 0.5 * (1 + math.cos(math.pi * (iteration - self.lr_warmup) / max(1, self.iterations - self.lr_warmup)))


def configured(kind: str, settings: dict[str, Any]) -> tuple[ImitateConfig, dict[str, Any]]:
    """How a policy of `kind` is trained, and what it is made of, from flat names over its own recipe and defaults.

    Raises PdkitError for an unknown kind or name, or a value that training cannot have; what the policy is made of `untrained` checks.
    """
    if kind not in POLICIES:
        raise unknown("policy", kind, POLICIES)
    fields = {f.name for f in dataclasses.fields(ImitateConfig)}
    given = set(POLICIES[kind].defaults) - set(POLICIES[kind].made)
    for name in settings:
        if name not in fields | given:
            raise unknown("field", name, fields | given)
    config = checked(ImitateConfig, POLICIES[kind].recipe | {name: value for name, value in settings.items() if name in fields})
    return config, {name: value for name, value in settings.items() if name in given}


def untrained(kind: str, spec: TaskSpec, architecture: dict[str, Any] | None = None) -> Policy:
    """A new policy of `kind` for a task. Raises PdkitError for settings that it cannot have."""
    return POLICIES[kind]({"obs_dim": spec.obs_dim, "act_dim": spec.act_dim, **POLICIES[kind].for_task(spec), **(architecture or {})})


class Windows:
    """All training windows of a demonstration set: (window, obs_dim) observations, and `horizon` actions from the first of them on.

    Without `horizon` these are the actions taken at each position. Where a horizon reaches beyond a demonstration, `rest` says from
    the last action what follows; with `hold_end` that is also what is done at the last observation, which else is left out.
    """

    def __init__(self, demos: Demos, window: int, pad_start: bool, horizon: int = 0, rest: Callable[[np.ndarray], np.ndarray] = np.copy,
                 hold_end: bool = False):
        observations, actions, index, offset = [], [], [], 0
        beyond = max(0, horizon - window)
        for episode in demos.episodes():
            o, a = episode["observations"], np.concatenate([episode["actions"], rest(episode["actions"][-1])[None]])
            o, a = (x if hold_end else x[:-1] for x in (o, a))
            pad = window - 1 if pad_start else 0
            # Before the first step the first observation repeats; the action there is the first one's.
            o, a = (np.concatenate([np.repeat(x[:1], pad, axis=0), x]) for x in (o, a))
            index.extend(offset + np.arange(max(0, len(a) - window + 1)))
            offset += len(a) + beyond
            observations += [o, np.repeat(o[-1:], beyond, axis=0)]
            actions += [a, np.repeat(rest(a[-1])[None], beyond, axis=0)]
        if not index:
            raise PdkitError(f"Every demonstration is shorter than the window of {window}; use a smaller window or pad_start=True.")
        self.observations = torch.from_numpy(np.concatenate(observations))
        self.actions = torch.from_numpy(np.concatenate(actions))
        self.index = torch.tensor(np.array(index))
        self.span, self.ahead = torch.arange(window), torch.arange(horizon or window)

    def to(self, device: str) -> Windows:
        """Keep them on `device`; where batches are drawn stays the business of the generator given to `sample`, on the CPU."""
        for name in ("observations", "actions", "index", "span", "ahead"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def all(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Every window (N, window, obs_dim), and the action (N, act_dim) taken at its last observation."""
        rows = self.index[:, None] + self.span
        return self.observations[rows], self.actions[rows[:, -1]]

    def sample(self, batch: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, window, obs_dim) and (B, horizon, act_dim)."""
        drawn = torch.randint(len(self.index), (batch,), generator=generator)
        start = self.index[drawn.to(self.index.device)][:, None]
        return self.observations[start + self.span], self.actions[start + self.ahead]


class Diverged(PdkitError):
    """The loss is no number any more: going on from a checkpoint would repeat it."""


class Average:
    """The exponentially averaged weights of what is in training (diffusers' EMAModel, whose decay rises with the steps); with a power of 0
    there is no average, and the weights are always those of training."""

    def __init__(self, parameters: Iterable[nn.Parameter], power: float):
        self._parameters, self._ema = list(parameters), None
        if power:
            from diffusers.training_utils import EMAModel  # takes seconds to load

            # The official code gives the power without the warm-up, and diffusers then does not look at it: its average remembers less
            # below 6,600 steps (112 instead of 178 at 1,000) and more up to about 215,000. This is the original Diffusion Policy's.
            # On a GPU all weights at once, or the average would take longer than the step; on a CPU that would only round differently.
            self._ema = EMAModel(self._parameters, use_ema_warmup=True, power=power, foreach=self._parameters[0].is_cuda)

    def step(self) -> None:
        """Take in the weights as they are after a gradient step."""
        if self._ema:
            self._ema.step(self._parameters)

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        """Within this block they have the averaged weights."""
        if not self._ema:
            yield
            return
        self._ema.store(self._parameters)
        self._ema.copy_to(self._parameters)
        try:
            yield
        finally:
            self._ema.restore(self._parameters)

    def pack(self) -> dict[str, torch.Tensor]:
        """What a checkpoint needs of it, by name."""
        if not self._ema:
            return {}
        return {f"average.{i}": value for i, value in enumerate(self._ema.shadow_params)} | {
            "average.steps": torch.tensor(self._ema.optimization_step)}

    def unpack(self, tensors: dict[str, torch.Tensor]) -> None:
        """Restore what `pack` gave."""
        if self._ema:
            for i, value in enumerate(self._ema.shadow_params):
                value.copy_(tensors[f"average.{i}"])
            self._ema.optimization_step = int(tensors["average.steps"])


def _checkpoint_row(iteration: int, terms: dict[str, torch.Tensor], lr: float) -> dict[str, float]:
    """iteration and the loss terms. Raises Diverged for a loss that is no number."""
    row = {"iteration": iteration, **{k: float(v.detach()) for k, v in terms.items()}}
    if not np.isfinite(row["loss"]):
        raise Diverged(f"The imitation loss became {row['loss']} at iteration {iteration}; lower lr (now {lr}).")
    return row


def imitate(kind: str, demos: Demos, config: ImitateConfig | None = None, policy_config: dict | None = None, *, device: str = "cpu",
            progress: Callable[[dict], None] | None = None, spec: TaskSpec | None = None, run: Run | None = None
            ) -> tuple[Policy, list[dict]]:
    """Train a policy of `kind` on `demos`; `spec` is for worlds outside the registry, such as the probes. With a `run` the training is
    saved there at each checkpoint and goes on from there, to the same numbers.

    Returns the selected policy in evaluation mode, on `device`, and one row per checkpoint: iteration, loss terms, seconds and, when
    evaluated, success_once and success_at_end on the selection seeds. A policy without gradient steps, such as VINN, is only
    given the demonstrations: it has a single row, of iteration 0, and of `config` only the evaluation and the windows matter.
    """
    config = config or ImitateConfig(**POLICIES[kind].recipe)
    spec = spec or get_task(demos.task)
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    policy = untrained(kind, spec, policy_config)
    policy.fit_statistics(demos.observations, demos.actions, config.seed)
    policy.to(device).train()
    windows = Windows(demos, policy.window, config.pad_start, policy.horizon, spec.resting, config.hold_end)
    if not policy.learns:
        started = time.monotonic()
        policy.remember(*windows.all())
        row = {"iteration": 0, "seconds": time.monotonic() - started} | selection_scores(spec, policy, config.eval_episodes, config.seed)
        if progress:
            progress(row)
        return policy.eval(), [row]
    optimizer = make_optimizer(policy, config, device=device)
    step = GradientSteps(policy.loss, optimizer, device, config.bf16)
    windows.to(device)
    average = Average(policy.parameters(), config.ema_power)

    def batch() -> tuple[torch.Tensor, ...]:
        observations, actions = windows.sample(config.batch, generator)
        return observations, actions, *(x.to(device) for x in policy.draw(actions.shape))

    def candidate() -> tuple[dict[str, torch.Tensor], dict[str, float]]:
        scores = selection_scores(spec, policy.eval(), config.eval_episodes, config.seed)
        policy.train()
        return {k: v.clone() for k, v in policy.state_dict().items()}, scores

    saved = run and Saved(run, {"policy": policy}, optimizer, average, generator)
    best, history = best_checkpoint(config, lambda: step(*batch()), optimizer, average, candidate, progress, saved)
    policy.load_state_dict(best)
    return policy.eval(), history


class Saved:
    """A training of imitation in a run's folder: everything that the rest of it depends on.

    Args:
        networks: what is trained, by name; its optimizer and average.
        batches: the generator that draws the batches. All else is drawn by torch's own.
    """

    def __init__(self, run: Run, networks: dict[str, nn.Module], optimizer: torch.optim.Optimizer, average: Average,
                 batches: torch.Generator):
        self._run, self._parts, self._average, self._batches = run, (networks, {"optimizer": optimizer}), average, batches

    def save(self, history: list[dict], best: float, chosen: dict[str, torch.Tensor]) -> None:
        """Write it; `chosen` is the best candidate so far, and `best` its score."""
        tensors = pack(*self._parts) | self._average.pack() | {f"chosen.{name}": value for name, value in chosen.items()}
        tensors |= {"batches": self._batches.get_state(), "torch": torch.get_rng_state()}
        if torch.cuda.is_available():
            tensors["cuda"] = torch.cuda.get_rng_state()
        arrays = {name: value.detach().cpu().numpy() for name, value in tensors.items()}
        self._run.save_checkpoint(arrays, {"step": history[-1]["iteration"], "history": history, "best": best})

    def load(self) -> tuple[list[dict], float, dict[str, torch.Tensor]]:
        """What `save` was given, once the training stands where it did; nothing where nothing was saved."""
        if not self._run.has_checkpoint:
            return [], -1.0, {}
        arrays, values = self._run.load_checkpoint()
        tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
        unpack(tensors, *self._parts)
        self._average.unpack(tensors)
        self._batches.set_state(tensors["batches"])
        torch.set_rng_state(tensors["torch"])
        if "cuda" in tensors and torch.cuda.is_available():
            torch.cuda.set_rng_state(tensors["cuda"])
        chosen = {name.removeprefix("chosen."): value for name, value in tensors.items() if name.startswith("chosen.")}
        return values["history"], values["best"], chosen


def best_checkpoint(config: ImitateConfig, step: Callable[[], dict[str, torch.Tensor]], optimizer: torch.optim.Optimizer, average: Average,
                    candidate: Callable[[], tuple[dict[str, torch.Tensor], dict[str, float]]], progress: Callable[[dict], None] | None,
                    saved: Saved | None = None) -> tuple[dict[str, torch.Tensor], list[dict]]:
    """Make `config.iterations` gradient steps; the best candidate by its success_once (without evaluations the latest), and one row
    a checkpoint. `step` makes a gradient step and gives its loss terms; `candidate` gives what may be chosen, and its scores, and is
    called while the weights are the averaged ones. What was `saved` is not done again. `progress` is given each row and, where the next
    is further than EARLY steps away, after these a dict of iteration and seconds_a_step. Raises Diverged for a loss that is no number.
    """
    history, best, chosen = saved.load() if saved else ([], -1.0, {})
    done, started = (history[-1]["iteration"], time.monotonic() - history[-1]["seconds"]) if history else (0, time.monotonic())
    for group in optimizer.param_groups if done else ():
        lr = group["lr"]  # a tensor that the scheduler fills where steps are recorded
        group["initial_lr"] = lr.clone() if isinstance(lr, torch.Tensor) else lr
    rates = torch.optim.lr_scheduler.LambdaLR(optimizer, config.lr_factor, last_epoch=done - 1)
    for iteration in range(done + 1, config.iterations + 1):
        terms = step()
        rates.step()
        average.step()
        if iteration == done + 1:
            began = time.monotonic()  # the first step takes longer
        if iteration % config.eval_every and iteration < config.iterations:
            if progress and iteration == done + EARLY:
                float(terms["loss"])  # a GPU may not be there yet
                progress({"iteration": iteration, "seconds_a_step": (time.monotonic() - began) / (EARLY - 1)})
            continue
        row = _checkpoint_row(iteration, terms, config.lr)
        with average.in_place():
            it, scores = candidate()
        row |= {"seconds": time.monotonic() - started} | scores
        score = scores.get("success_once", float(iteration))
        if score > best:
            best, chosen = score, it
        history.append(row)
        if saved:
            saved.save(history, best, chosen)
        if progress:
            progress(row)
    return chosen, history
