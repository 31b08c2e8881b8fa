"""`pdkit bench`: speed on this machine, as ratios measured in one run.

Machines are shared and noisy, so both sides of a ratio take turns (A B A B ...) and the median of the pairwise ratios is
reported beside the medians. Absolute numbers tell about this machine at this hour; ratios tell about the code.
"""
from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from .claims import TASKS
from .cli import Parser
from .decorator import DecoratorConfig, critic_features
from .demos import Demos
from .demos.sources import bundled
from .files import DATA, check_writable, write_json
from .gradient_steps import GradientSteps, gradient_step, make_optimizer
from .imitate import ImitateConfig, Windows, untrained
from .pixel_analysis import backend, why_not
from .pixels.sim import PixelSim
from .policies import POLICIES
from .profiles import online_config
from .rl.replay import Replay
from .rl.sac import SAC, SACConfig
from .runs import describe_machine
from .tasks import get_task
from .tasks.chair import StockPushChairSource
from .tasks.faucet import StockTurnFaucetSource
from .tasks.peg import StockPegInsertionSide
from .tasks.stack_cube import StockStackCube
from .tasks.vector import VectorEnv
from .torch_setup import has_bf16, pick_device, set_threads

PARTS = ("step", "updates", "base", "imitation", "pictures", "profiles")


def rate(work: Callable[[], int], seconds: float) -> float:
    """Units of work a second: `work` returns how many it did and is called until the time is up."""
    done, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        done += work()
    return done / (time.perf_counter() - started)


def paired(first: Callable[[], int], second: Callable[[], int], seconds: float, rounds: int = 5) -> dict[str, float]:
    """Median rates of both, taking turns, and the median, least and greatest of their pairwise ratios first / second."""
    first(), second()  # warm up
    pairs = [(rate(first, seconds), rate(second, seconds)) for _ in range(rounds)]
    ratios = [a / b for a, b in pairs]
    return {"first_per_s": float(np.median([a for a, _ in pairs])), "second_per_s": float(np.median([b for _, b in pairs])),
            "ratio": float(np.median(ratios)), "ratio_min": min(ratios), "ratio_max": max(ratios), "rounds": rounds}


def sim_stepper(sim, act_dim: int, seed: int = 0, steps: int = 20) -> Callable[[], int]:
    """Random actions (act_dim,) in `sim`, an episode of 100 steps at a time: a call takes `steps` of them."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (100, act_dim)).astype(np.float32)
    state = {"t": 0}

    def work() -> int:
        for _ in range(steps):
            if state["t"] % 100 == 0:
                sim.reset(state["t"] // 100)
            sim.step(actions[state["t"] % 100])
            state["t"] += 1
        return steps

    return work


def _against_stock(fast, stock, act_dim: int, seconds: float) -> dict[str, float]:
    return paired(sim_stepper(fast, act_dim), sim_stepper(stock, act_dim), seconds)


def bench_step(seconds: float) -> dict[str, Any]:
    """The fast StackCube step against stock ManiSkill's, one process; and two workers against stock, one process.

    For the tasks with other objects in every episode the resets count too: stock ManiSkill builds its scene anew in each.
    """
    spec = get_task("StackCube")
    fast, stock = spec.make(), StockStackCube()
    out = {"fast step / stock ManiSkill, one process (steps/s)": _against_stock(fast, stock, 4, seconds)}
    for other, its_stock in (("PegInsertionSide", StockPegInsertionSide), ("TurnFaucetSource", StockTurnFaucetSource),
                             ("PushChairSource", StockPushChairSource)):
        out[f"{other}: fast step / stock ManiSkill, one process, resets included (steps/s)"] = _against_stock(
            get_task(other).make(), its_stock(), get_task(other).act_dim, seconds)
    counts = [0] * 8

    def next_seed(lane: int) -> int:
        counts[lane] += 1
        return 1000 * lane + counts[lane]

    with VectorEnv(spec, 8, next_seed, workers=2, max_episode_steps=100) as envs:
        envs.reset()
        rng = np.random.default_rng(0)

        def work() -> int:
            for _ in range(10):
                envs.step(rng.uniform(-1, 1, (8, 1, 4)))
            return 80

        out["fast step, two workers / stock, one process (steps/s)"] = paired(work, sim_stepper(stock, 4), seconds)
    fast.close()
    stock.close()
    return out


def bench_pictures(seconds: float) -> dict[str, Any]:
    """Each task with a frame of all its cameras at every step, by the backend that draws it here, against the simulation alone.

    Tasks that cannot be drawn here are said so and left out.
    """
    out = {}
    for task in (name for suite in TASKS.values() for name in suite):
        if reason := why_not(task):
            print(f"{task} is not measured. {reason}", flush=True)
            continue
        spec = get_task(task)
        with closing(PixelSim(spec)) as seen, closing(spec.make()) as alone:
            out[f"{task}: simulated and drawn ({backend(task)}) / simulated, one process (steps/s)"] = paired(
                sim_stepper(seen, spec.act_dim), sim_stepper(alone, spec.act_dim), seconds)
    return out


class EagerSAC(SAC):
    """The reference: the same update as a plain script writes it, float32, unfused Adam, critics' gradients in the actor step."""

    def __init__(self, *args, **keywords):
        super().__init__(*args, **keywords)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=self.config.actor_lr, foreach=False)
        self.critic_optimizers = [torch.optim.Adam(m.parameters(), lr=self.config.critic_lr, foreach=False) for m in self.critics.members]

    def update(self, batch, generator):
        noise = torch.randn((2, *batch["base"].shape), generator=generator).to(self.device)
        temperature = self.log_temperature.detach().exp()
        target = self.td_target(batch, batch["next_obs"], noise[0], temperature)
        features = critic_features(self.decorator, batch["obs"], batch["base"], batch["residual"])
        for member, optimizer in zip(self.critics.members, self.critic_optimizers, strict=True):
            loss = ((member(features)[:, 0] - target) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(member.parameters(), self.config.grad_clip)
            optimizer.step()
        residual, log_pi = self.actor.sample(batch["obs"], noise[1])
        value = self.critics(critic_features(self.decorator, batch["obs"], batch["base"], residual)).min(dim=0).values
        loss = (temperature * log_pi - value).mean()
        self.actor_optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.actor.parameters(), self.config.grad_clip)
        self.actor_optimizer.step()
        self.temperature_optimizer.zero_grad()
        (-self.log_temperature * (log_pi.detach() + self.target_entropy).mean()).backward()
        self.temperature_optimizer.step()
        for source, mean in ((self.critics, self.targets), (self.actor, self.average)):
            for p, q in zip(source.parameters(), mean.parameters(), strict=True):
                q.data.copy_(0.01 * p.data + 0.99 * q.data)
        self.updates += 1
        return {}


def updater(agent: SAC, batch: int, device: str) -> Callable[[], int]:
    """One call makes five updates on random data of Door's shapes."""
    replay = Replay(20_000, 39, 28, device)
    replay.rows.normal_()
    replay.rows[:, -1] = 0.9
    replay.size = 20_000
    generator = torch.Generator().manual_seed(0)

    def work() -> int:
        for _ in range(5):
            agent.update(replay.unpack(replay.draw(batch, generator)), generator)
        if device == "cuda":
            torch.cuda.synchronize()
        return 5

    return work


def bench_updates(seconds: float, device: str) -> dict[str, Any]:
    """SAC updates: the shipped path against float32 eager, same networks and batch; and the lesson's own configuration."""
    lesson = online_config("Door", "lesson")
    out = {}
    for label, batch, config in (("batch 256, 3x256", 256, SACConfig(layers=3)), ("batch 1024, 3x256", 1024, SACConfig(layers=3))):
        shipped = SAC(39, 28, config, DecoratorConfig(), device=device)
        eager = EagerSAC(39, 28, SACConfig(layers=3, bf16=False), DecoratorConfig(), device=device)
        out[f"SAC update, shipped / float32 eager, {label} (updates/s)"] = paired(updater(shipped, batch, device),
                                                                                 updater(eager, batch, device), seconds)
    mine = SAC(39, 28, lesson.sac, lesson.decorator, device=device)
    eager = EagerSAC(39, 28, SACConfig(layers=3, bf16=False), DecoratorConfig(), device=device)
    out[f"SAC update, lesson profile (batch {lesson.batch}, {lesson.sac.layers}x{lesson.sac.hidden}, actor every "
        f"{lesson.sac.actor_every}) / float32 eager 3x256 (updates/s)"] = paired(updater(mine, lesson.batch, device),
                                                                                updater(eager, lesson.batch, device), seconds)
    if device == "cuda":  # on a CPU compiling takes minutes and gains nothing
        compiled = SAC(39, 28, replace(lesson.sac, compile=True), lesson.decorator, device=device)
        out["SAC update, lesson profile, torch.compile / without (updates/s)"] = paired(
            updater(compiled, lesson.batch, device), updater(mine, lesson.batch, device), seconds)
    return out


def bench_base(seconds: float) -> dict[str, Any]:
    """Base-policy inference: a batch of 8 windows, BeT against MLP."""
    windows = {name: np.random.default_rng(0).normal(size=(8, w, 39)).astype(np.float32) for name, w in (("bet", 10), ("mlp", 1))}
    policies = {name: POLICIES[name](dict(obs_dim=39, act_dim=28)).eval() for name in windows}
    return {"base policy, BeT / MLP, 8 environments (decisions/s)": paired(
        *(lambda n=name: len(policies[n].act(windows[n])) for name in ("bet", "mlp")), seconds)}


def imitator(kind: str, demos: Demos, batch: int, device: str, shipped: bool) -> Callable[[], int]:
    """One call makes a gradient step of imitation: the shipped path, or a plain float32 loop with AdamW one tensor at a time."""
    spec, config = get_task(demos.task), ImitateConfig(batch=batch)
    policy = untrained(kind, spec)
    policy.fit_statistics(demos.observations, demos.actions)
    policy.to(device).train()
    windows, generator = Windows(demos, policy.window, True, policy.horizon, spec.resting), torch.Generator().manual_seed(0)
    if shipped:
        step = GradientSteps(policy.loss, make_optimizer(policy, config, device=device), device, bf16=True)
        windows.to(device)
    else:
        plain = torch.optim.AdamW(policy.parameter_groups(config.weight_decay), lr=config.lr, foreach=False)
        step = partial(gradient_step, policy.loss, plain, device, False)

    def work() -> int:
        observations, actions = windows.sample(batch, generator)
        step(*(x.to(device) for x in (observations, actions, *policy.draw(actions.shape))))
        if device == "cuda":
            torch.cuda.synchronize()
        return 1

    return work


def multiplier(device: str, dtype: torch.dtype) -> Callable[[], int]:
    """One call makes ten of the largest matrix products of a BeT's gradient step on batches of 256."""
    left, right = (torch.randn(shape, device=device, dtype=dtype) for shape in ((2560, 256), (256, 1024)))

    def work() -> int:
        for _ in range(10):
            left @ right
        if device == "cuda":
            torch.cuda.synchronize()
        return 10

    return work


def bench_imitation(seconds: float, device: str) -> dict[str, Any]:
    """Gradient steps of every base policy that learns by them, at its default size on StackCube, against float32 eager; and what bfloat16
    makes of a matrix product alone, which is as much as it can make of a step."""
    demos, out = bundled("StackCube"), {}
    out["matrix product, 2560 x 256 by 256 x 1024, bfloat16 / float32 (products/s)"] = paired(
        *(multiplier(device, dtype) for dtype in (torch.bfloat16, torch.float32)), seconds)
    for kind in (kind for kind, policy in POLICIES.items() if policy.learns):
        sides = (imitator(kind, demos, 256, device, shipped) for shipped in (True, False))
        out[f"imitation of {kind}, shipped / float32 eager, batch 256 (gradient steps/s)"] = paired(*sides, seconds)
    return out


def profile_costs(steps: dict[str, dict[str, Any]], task: str) -> dict[str, Any]:
    """What a profile costs: milliseconds an environment step and hours for its whole budget, measured from a short run each."""
    from .online import Trainer
    from .policies import load_policy

    out = {}
    for profile, short in steps.items():
        whole = online_config(task, profile)
        config = online_config(task, profile, **short)
        trainer = Trainer(config, load_policy(DATA / "checkpoints" / task / "base"),
                          bundled(task) if config.demo_fraction else None)
        trainer.train()
        # Only the steps during which the learner works count: the warm-up costs next to nothing.
        learned = trainer.step - config.warmup_steps
        warm = next(row["seconds"] for row in trainer.rows if row["step"] >= config.warmup_steps)
        cost = (trainer.train_seconds - warm) / learned
        out[f"{task}, {profile} profile"] = {"ms_per_env_step": cost * 1e3, "env_steps": whole.total_steps,
                                             "hours": cost * whole.total_steps / 3600, "measured_steps": learned}
    return out


def main(argv: list[str]) -> int:
    parser = Parser(prog="pdkit bench", description="Measure speed on this machine, as ratios in one run.")
    parser.add_argument("--json", metavar="FILE", help="also write the results to FILE")
    parser.add_argument("--seconds", type=float, default=1.5, help="seconds per side and round (default 1.5; five rounds)")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda: where the updates run")
    parser.add_argument("--only", nargs="+", metavar="PART", choices=PARTS, default=PARTS, help=f"some of: {', '.join(PARTS)}")
    parser.add_argument("--quick", action="store_true", help="one short round of each, to see that all of it runs")
    args = parser.parse_args(argv)
    if args.json:
        check_writable(args.json)
    set_threads(args.threads)
    device = pick_device(args.device)
    seconds = 0.2 if args.quick else args.seconds
    expected = "1 minute" if args.quick else "5 minutes (7 where ManiSkill can be drawn)"
    print(f"About {expected} for all parts; {args.threads} thread(s), bfloat16 in hardware: {has_bf16(device)}, updates on {device}.",
          flush=True)
    results: dict[str, Any] = {}
    ratios = {"step": lambda: bench_step(seconds), "updates": lambda: bench_updates(seconds, device), "base": lambda: bench_base(seconds),
              "imitation": lambda: bench_imitation(seconds, device), "pictures": lambda: bench_pictures(seconds)}
    for part in (part for name, part in ratios.items() if name in args.only):
        for name, values in part().items():
            results[name] = values
            print(f"{name}\n    {values['first_per_s']:.0f} / {values['second_per_s']:.0f} = {values['ratio']:.2f} "
                  f"({values['ratio_min']:.2f} to {values['ratio_max']:.2f} over {values['rounds']} pairs)", flush=True)
    short = {"paper": dict(total_steps=2_300 if args.quick else 4_000, warmup_steps=2_000, env_workers=1, eval_every=0, log_every=500,
                           checkpoint_every=0),
             "lesson": dict(total_steps=2_300 if args.quick else 5_000, warmup_steps=2_000, eval_every=0, log_every=500,
                            checkpoint_every=0)}
    for name, values in (profile_costs(short, "Door") if "profiles" in args.only else {}).items():
        results[name] = values
        print(f"{name}: {values['ms_per_env_step']:.2f} ms an environment step, so {values['env_steps']:,} steps take "
              f"{values['hours']:.2f} h", flush=True)
    if device == "cpu":
        print("No CUDA device was used: nothing is said about a GPU.")
    if args.json:
        write_json(args.json, {"results": results, "machine": describe_machine(), "device": device})
        print(f"wrote {args.json}")
    return 0
