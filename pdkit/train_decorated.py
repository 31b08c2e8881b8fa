"""`pdkit train decorated`: one run a seed by any of the methods, and the row of evidence that each leaves."""
from __future__ import annotations

import hashlib
import json
import shlex
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import pandas as pd

from .cli import parse_settings
from .decorated import Decorated
from .demos import Demos, sources
from .demos.cli import Progress
from .errors import PdkitError
from .evaluate import outcome, reported
from .files import DATA, atomic_file, atomic_folder, code_checksum, read_json, runs_root
from .machine import load_average
from .methods.registry import base_folder as shipped_base
from .methods.registry import make_trainer, method_config, trainer_of
from .online import Trainer
from .online_config import OnlineConfig
from .pixels.encoders import Encoder, save_encoder
from .pixels.pictures import encoded, pictures_of
from .pixels.task import ENCODER, encoder_of, pixel_spec
from .policies import Policy, load_policy
from .policies.base import read_card
from .profiles import differences, flat
from .recorded import SETTINGS, mark, record, told_of
from .runs import Run, commits, describe_machine, kept_so_far, origin
from .sweep_spec import check_names
from .tasks import get_task
from .tasks.partnet import object_set
from .tasks.spec import TaskSpec, behind
from .tensorboard import Board


def train_decorated(args) -> int:
    settings = parse_settings(args.set)
    get_task(args.task)
    visual = DATA / "checkpoints" / args.task / "pixels" / "base"
    base_folder = Path(args.base) if args.base else visual if args.pixels else shipped_base(args.method, args.task)
    encoder = encoder_of(base_folder)
    if encoder:
        pixel_spec(get_task(args.task), encoder)  # refuses another task's before any picture is drawn
    if args.pixels and not encoder:
        raise PdkitError(f"There is no visual policy in {base_folder}; train one with `pdkit train base {args.task} --policy mlp --pixels` "
                         "and name its folder with --base.")
    if not args.recipe:  # names the run's folder, too: runs of two profiles are two runs
        plain = args.profile if args.method == "policy_decorator" else args.method
        args.recipe = plain if args.profile == "lesson" or plain == args.profile else f"{plain},profile={args.profile}"
    if args.episodes < 1 or min(args.seeds) < 0:
        raise PdkitError("--episodes must be at least 1 and every seed 0 or more.")
    check_names(args.record, args.recipe)
    for seed in args.seeds:
        base = load_policy(base_folder)
        config = method_config(args.method, args.task, args.profile, seed, policy=base, **settings)
        print(f"{args.task}, seed {seed}: " + str(differences(config, args.profile) or "the profile unchanged"), flush=True)
        out = Path(args.out or runs_root() / "train") / f"{args.task}-{args.recipe}-seed{seed}"
        card, demos = read_card(base_folder), None
        if config.demo_fraction or trainer_of(args.method).needs_demos:
            demos = sources.learned_from(sources.given(args.task, args.demos), card, args.num_demos)
            args.num_demos = demos.num
        started_from = origin(card, demos, encoder, object_set(get_task(args.task)))
        if encoder and demos:
            demos = encoded(demos, pictures_of(demos, Progress(demos.num, "drawn")), encoder)
        try:
            row = decorate(config, base, demos, out, args.episodes, started_from, args.tensorboard, encoder)
        except KeyboardInterrupt:
            print(f"\nInterrupted. {kept_so_far(out)} the same command.", file=sys.stderr)
            return 130
        row |= {"recipe": args.recipe, "command": command_of(args, seed), "commit": commits(manifest := read_json(out / "manifest.json"))}
        print(", ".join(f"{k} {v}" for k, v in row.items()), flush=True)
        if args.record:
            curves = pd.read_csv(out / "metrics.csv").assign(task=args.task, seed=seed, recipe=args.recipe)
            told = told_of(manifest["parameters"])
            record(args.record, pd.DataFrame([row | {SETTINGS: mark(told)}]), curves, {mark(told): told})
    return 0


def command_of(args, seed: int) -> str:
    """The command that makes one row again."""
    method = ["--method", args.method] if args.method != "policy_decorator" else []
    parts = ["pdkit", "train", "decorated", args.task, *method, "--profile", args.profile, "--seeds", str(seed), "--recipe", args.recipe,
             "--episodes", str(args.episodes), "--threads", str(args.threads)]
    parts += ["--base", args.base] if args.base else []
    parts += ["--pixels"] if args.pixels else []
    parts += ["--demos", args.demos] if args.demos else []
    parts += ["--num-demos", str(args.num_demos)] if args.num_demos else []
    parts += ["--set", *args.set] if args.set else []
    return shlex.join(parts + (["--record", args.record] if args.record else []))


def decorate(config, base: Policy, demos: Demos | None, out: Path, episodes: int, started_from: dict[str, Any],
             tensorboard: bool = False, encoder: Encoder | None = None) -> dict[str, Any]:
    """Train (or resume) one seed in `out`, evaluate base and decorated on the same test seeds, and return one row of evidence.

    `started_from` (see `origin`) tells which base policy and demonstrations these are; a run is resumed only with the same ones.
    With an `encoder` the task is seen through it, and so are the demonstrations.
    """
    trainer = make_trainer(config, base, demos, pixel_spec(get_task(config.task), encoder) if encoder else None)
    run = Run(out, "decorated", flat(config) | started_from, flat(OnlineConfig()))  # after what may be refused
    with run.alone():
        if run.finished:
            print(run.already(), flush=True)
        policy = _trained(trainer, run, tensorboard, encoder)
        tables = {"base": _base_episodes(base, trainer.spec, episodes, config, started_from),
                  "decorated": reported(policy, trainer.spec, episodes, config.seed)}
        for name, table in tables.items():
            with atomic_file(out / f"{name}_episodes.csv") as temporary:
                table.to_csv(temporary, index=False)
        row = dict(task=config.task, method=config.method, policy=base.kind, seed=config.seed,
                   train_minutes=round(trainer.train_seconds / 60, 2), cores=describe_machine()["cores"], bf16=trainer.in_bf16,
                   env_steps=trainer.step, first_reward_step=trainer.first_reward or None,
                   updates=trainer.agent.updates, episodes=episodes,
                   **outcome("base", tables["base"]), **outcome("decorated", tables["decorated"]),
                   load_average=round(float(trainer.loads[0] / trainer.loads[1]) if trainer.loads[1] else load_average(), 1))
        run.finish(**row)
    return row


def _trained(trainer: Trainer, run: Run, tensorboard: bool, encoder: Encoder | None) -> Decorated | Policy:
    """The policy that a run ends with, after saving it and the run's metrics; its evaluations are told while it trains."""
    board, shown = Board(run.folder) if tensorboard else None, set()

    def show(t: Trainer) -> None:
        if board:
            board.update(t.rows)
        for row in t.rows:
            if "success_once" in row and row["step"] not in shown:
                shown.add(row["step"])
                print(f"  step {row['step']}, {row['updates']} updates, {row['seconds'] / 60:.1f} min, success {row['success_once']:.2f}, "
                      f"at the end {row['success_at_end']:.2f}", flush=True)

    policy = trainer.train(run, show)
    if board:
        board.close()
    run.write_metrics(trainer.rows)
    with atomic_folder(run.folder / "decorated") as temporary:  # without its encoder it would pass for a policy that is told the state
        trainer.save_policy(policy, temporary)
        if encoder:
            inside = temporary / "base"  # of a decorated policy; fine-tuning leaves a plain one
            save_encoder(encoder, (inside if inside.is_dir() else temporary) / ENCODER)
    return policy


def _base_episodes(base: Policy, spec: TaskSpec, episodes: int, config: OnlineConfig, started_from: dict[str, Any]
                   ) -> pd.DataFrame:
    """The base policy's test episodes: the same for every method that starts from it, and for every seed unless it samples, so they are run
    once and kept, where the kit's own code decides them: that of a task or policy from elsewhere is not seen to change."""
    code, arguments = behind(spec.make)
    if not all(one.__module__.startswith("pdkit.") for one in (*code, type(base))):
        return reported(base, spec, episodes, config.seed)
    draw = [config.seed] if base.samples else []
    weights = [started_from[name] for name in ("base", "encoder", "objects") if name in started_from]
    of_task = {field.name: getattr(spec, field.name) for field in fields(spec)} | {
        "make": [*(f"{one.__module__}.{one.__qualname__}" for one in code), *arguments]}
    what = json.dumps([of_task, config.start_fraction, episodes, *weights, base.kind, base.config, describe_machine()["versions"],
                       code_checksum(), *draw])
    kept = runs_root() / "base_episodes" / f"{spec.name}-{hashlib.sha256(what.encode()).hexdigest()[:16]}.csv"
    if not kept.exists():
        table = reported(base, spec, episodes, config.seed)
        with atomic_file(kept) as temporary:
            table.to_csv(temporary, index=False)
    return pd.read_csv(kept)
