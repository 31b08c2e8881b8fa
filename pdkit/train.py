"""`pdkit train`: base policies from demonstrations, and decorated ones over several seeds with the evidence recorded."""
from __future__ import annotations

import ast
import contextlib
import hashlib
import json
import math
import shlex
import sys
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pandas as pd

from .cli import Parser
from .decorated import Decorated
from .demos import Demos, sources
from .demos.cli import Progress
from .errors import PdkitError
from .evaluate import evaluate
from .files import DATA, atomic_file, atomic_folder, check_replaceable, code_checksum, discard, locked, read_json, runs_root, write_json
from .imitate import Diverged, configured, imitate
from .machine import load_average
from .main_job import duration
from .methods import METHODS
from .methods.registry import base_folder as shipped_base
from .methods.registry import make_trainer, method_config, trainer_of
from .online import Trainer
from .online_config import OnlineConfig
from .pixels.cameras import view_of
from .pixels.encoders import Encoder, save_encoder
from .pixels.learn import check_pixels, imitate_pixels, look_up, visual_settings
from .pixels.pictures import encoded, pictures_of
from .pixels.task import ENCODER, encoder_of, pixel_spec, save_visual
from .policies import POLICIES, Policy, load_policy, save_policy
from .policies.base import read_card
from .profiles import PROFILES, base_values, differences, flat
from .recorded import SETTINGS, mark, record, told_of
from .runs import Run, commits, describe_machine, kept_so_far, origin
from .seeds import reported_seeds
from .sweep_spec import check_names
from .tasks import get_task
from .tasks.partnet import object_set
from .tasks.spec import TaskSpec, behind
from .tensorboard import Board
from .torch_setup import pick_device, set_threads


def main(argv: list[str]) -> int:
    parser = Parser(prog="pdkit train", description="Train a base policy, or decorate one.")
    kinds = parser.add_subparsers(dest="kind", required=True, parser_class=Parser)
    base = kinds.add_parser("base", help="imitate demonstrations")
    base.add_argument("task")
    base.add_argument("--profile", default="lesson", help="lesson (the defaults: minutes on a CPU) or paper (the official code's "
                                                         "settings, for bet and diffusion: days)")
    base.add_argument("--policy", default="bet", help=f"one of: {', '.join(POLICIES)}")
    base.add_argument("--demos", help="demonstration file (default: the bundled one)")
    base.add_argument("--num-demos", type=int, help="use only the first so many")
    base.add_argument("--out", help="folder of the checkpoint (default runs/base/TASK-POLICY)")
    base.add_argument("--pixels", action="store_true", help="see pictures instead of the object's state: train an encoder with the policy")
    base.add_argument("--device", default="auto", help="where it is trained: auto (CUDA where there is one), cpu or cuda")
    base.add_argument("--episodes", type=int, default=0, help="test episodes, told in its policy.json (default: none)")
    decorated = kinds.add_parser("decorated", help="improve a base policy by online RL on sparse reward, by any of the methods")
    decorated.add_argument("task")
    decorated.add_argument("--profile", default="lesson", help=f"one of: {', '.join(PROFILES)}")
    decorated.add_argument("--method", default="policy_decorator", help=f"one of: {', '.join(METHODS)}")
    decorated.add_argument("--base", help="folder of the base policy (default: the shipped one that the method starts from)")
    decorated.add_argument("--demos", help="demonstration file (default: the bundled one)")
    decorated.add_argument("--num-demos", type=int, help="use only the first so many (default: as many as the base policy saw)")
    decorated.add_argument("--seeds", type=int, nargs="+", default=[0])
    decorated.add_argument("--episodes", type=int, default=200, help="test episodes (default 200)")
    decorated.add_argument("--out", help="folder of the runs (default runs/train)")
    decorated.add_argument("--record", help="name under data/results: rows are added to NAME.csv and NAME_curves.csv")
    decorated.add_argument("--recipe", help="what to call this configuration in the record, and the run's folder (default: the profile's "
                                            "name, or the method's)")
    decorated.add_argument("--pixels", action="store_true", help="start from the shipped visual policy (--base may name another)")
    decorated.add_argument("--tensorboard", action="store_true", help="also write event files to the folder of each run")
    for one in (base, decorated):
        one.add_argument("--threads", type=int, default=1)
        one.add_argument("--set", metavar="NAME=VALUE", nargs="+", action="extend", default=[], help="change a field of the configuration")
    args = parser.parse_args(argv)
    set_threads(args.threads)
    return (_base if args.kind == "base" else _decorated)(args)


def parse_settings(settings: list[str], option: str = "--set") -> dict[str, Any]:
    """NAME=VALUE strings as a dict, values read as Python literals (bare words as strings). Raises PdkitError, which names `option`."""
    values = {}
    for item in settings:
        name, equals, text = item.partition("=")
        if not equals or not name:
            raise PdkitError(f"{option} takes NAME=VALUE, not {item!r}.")
        try:
            values[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            values[name] = text
    return values


def base_demos(args) -> Demos:
    """The demonstrations that the arguments name."""
    demos = sources.given(args.task, args.demos)
    return demos.first(args.num_demos) if args.num_demos is not None else demos


def _base(args) -> int:
    if args.episodes < 0:
        raise PdkitError("--episodes must be 0 (no test) or more.")
    demos = base_demos(args)
    settings = base_values(args.policy, args.task, args.profile, args.pixels) | parse_settings(args.set)
    shift, eyes = (settings.pop(name, None) if args.pixels else None for name in ("random_shift", "encoder"))
    if args.pixels:
        check_pixels(args.policy, shift, view_of(args.task), eyes)
    encoder = encoder_of(str(eyes)) if eyes is not None else None
    if eyes is not None and not encoder:
        raise PdkitError(f"There is no encoder in {eyes}; name the folder of a policy trained by `pdkit train base {args.task} --pixels`.")
    config, architecture = configured(args.policy, settings)
    device = pick_device(args.device) if POLICIES[args.policy].learns else "cpu"
    out = Path(args.out).resolve() if args.out else runs_root() / "base" / f"{args.task}-{args.policy}{'-pixels' if args.pixels else ''}"
    check_replaceable(out, "policy.json")  # before the work, not after
    folder = out.with_name(f"{out.name}.training")
    check_replaceable(folder, "manifest.json")
    print(f"{args.policy} on {demos.num} demonstrations of {args.task} ({demos.label}), on {device}: {config}", flush=True)

    def show(row: dict[str, float]) -> None:
        to_do = config.iterations - row["iteration"]
        if "seconds_a_step" in row:
            left = duration(to_do * row["seconds_a_step"] / 60)
            print(f"  {row['seconds_a_step']:.2g} seconds a gradient step: {left} left, evaluations aside", flush=True)
            return
        text = ", ".join(f"{k} {v:,.0f}" if k in ("iteration", "seconds") else f"{k} {v:.3g}" for k, v in row.items())
        left = f"; {duration(row['seconds'] / row['iteration'] * to_do / 60)} left" if row["iteration"] and to_do else ""
        print(f"  {text}{left}", flush=True)

    pictures = None
    if args.pixels:
        # Wrong settings are refused before anything is drawn.
        POLICIES[args.policy](visual_settings(args.policy, view_of(args.task), get_task(args.task)) | architecture)
        if encoder:
            pixel_spec(get_task(args.task), encoder)
        pictures = pictures_of(demos, Progress(demos.num, "drawn"))
    what = {"policy": args.policy, "task": demos.task, "demos": demos.checksum, "num_demos": demos.num, "pixels": args.pixels,
            "random_shift": shift, "encoder": encoder.checksum if encoder else None} | asdict(config) | architecture
    try:
        with _training(folder, what) as run:
            if encoder:
                policy, history = look_up(demos, pictures, encoder, config, architecture, progress=show)
            elif pictures:
                policy, encoder, history = imitate_pixels(args.policy, demos, pictures, config, architecture, shift=shift, device=device,
                                                          progress=show, run=run)
            else:
                policy, history = imitate(args.policy, demos, config, architecture, device=device, progress=show, run=run)
            best = max(history, key=lambda row: row.get("success_once", row["iteration"]))
            info = {"task": args.task, "demos": demos.num, "demos_checksum": demos.checksum, "label": demos.label,
                    "imitate": asdict(config), "selected": best, "seconds": history[-1]["seconds"],
                    "command": shlex.join(["pdkit", "train", *sys.argv[2:]]), "device": device} | {
                name: run.manifest[name] for name in ("machine", "resumed") if name in run.manifest}
            if args.pixels:
                save_visual(policy, encoder, out, info)
            else:
                save_policy(policy, out, info)
            print(f"wrote {out}", flush=True)
            if args.episodes:  # after the policy is safe
                spec = pixel_spec(get_task(args.task), encoder) if encoder else get_task(args.task)
                test = {"episodes": args.episodes} | _outcome("base", _episodes(load_policy(out), spec, args.episodes, config.seed))
                write_json(out / "policy.json", read_card(out) | {"info": info | {"test": test}})
                print("  " + ", ".join(f"{k} {v}" for k, v in test.items()), flush=True)
            discard(folder)
    except KeyboardInterrupt:
        print(f"\nInterrupted. {kept_so_far(folder)} the same command.", file=sys.stderr)
        return 130
    return 0


@contextlib.contextmanager
def _training(folder: Path, what: dict[str, Any]) -> Iterator[Run]:
    """The run of an imitation that is not done: its folder stays if there is anything to go on from. Raises PdkitError where another
    process works in it, or where it holds a training of something else."""
    if folder.exists() and not (folder / "checkpoint" / "state.json").exists():  # a killed process left nothing else
        with locked(folder / "lock", f"Another process is at work in {folder}; wait for it, or choose another folder."):
            discard(folder)
    run = Run(folder, "base", what)
    with run.alone():
        if run.has_checkpoint:
            print(kept_so_far(folder).partition(";")[0] + "; it goes on from there.", flush=True)
        try:
            yield run
        except Diverged:
            discard(folder)
            raise
        finally:
            if not run.has_checkpoint:
                discard(folder)


def _decorated(args) -> int:
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
    run = Run(out, "decorated", flat(config) | started_from)  # after what may be refused
    with run.alone():
        if run.finished:
            print(run.already(), flush=True)
        policy = _trained(trainer, run, tensorboard, encoder)
        tables = {"base": _base_episodes(base, trainer.spec, episodes, config, started_from),
                  "decorated": _episodes(policy, trainer.spec, episodes, config.seed)}
        for name, table in tables.items():
            with atomic_file(out / f"{name}_episodes.csv") as temporary:
                table.to_csv(temporary, index=False)
        row = dict(task=config.task, method=config.method, policy=base.kind, seed=config.seed,
                   train_minutes=round(trainer.train_seconds / 60, 2), cores=describe_machine()["cores"], bf16=trainer.in_bf16,
                   env_steps=trainer.step, first_reward_step=trainer.first_reward or None,
                   updates=trainer.agent.updates, episodes=episodes,
                   **_outcome("base", tables["base"]), **_outcome("decorated", tables["decorated"]),
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


def _episodes(actor: Policy | Decorated, spec: TaskSpec, episodes: int, draw: int) -> pd.DataFrame:
    """The test episodes. A policy that samples acts on random numbers of its own in each run (`draw`): with the same ones in all, a base
    policy's luck with them would look like what every run lost or gained."""
    actor.reset(draw)
    return evaluate(spec, actor.act, reported_seeds(episodes), window=actor.window, chunk=actor.chunk,
                    num_envs=50)


def _base_episodes(base: Policy, spec: TaskSpec, episodes: int, config: OnlineConfig, started_from: dict[str, Any]
                   ) -> pd.DataFrame:
    """The base policy's test episodes: the same for every method that starts from it, and for every seed unless it samples, so they are run
    once and kept, where the kit's own code decides them: that of a task or policy from elsewhere is not seen to change."""
    code, arguments = behind(spec.make)
    if not all(one.__module__.startswith("pdkit.") for one in (*code, type(base))):
        return _episodes(base, spec, episodes, config.seed)
    draw = [config.seed] if base.samples else []
    weights = [started_from[name] for name in ("base", "encoder", "objects") if name in started_from]
    of_task = {field.name: getattr(spec, field.name) for field in fields(spec)} | {
        "make": [*(f"{one.__module__}.{one.__qualname__}" for one in code), *arguments]}
    what = json.dumps([of_task, config.start_fraction, episodes, *weights, base.kind, base.config, describe_machine()["versions"],
                       code_checksum(), *draw])
    kept = runs_root() / "base_episodes" / f"{spec.name}-{hashlib.sha256(what.encode()).hexdigest()[:16]}.csv"
    if not kept.exists():
        table = _episodes(base, spec, episodes, config.seed)
        with atomic_file(kept) as temporary:
            table.to_csv(temporary, index=False)
    return pd.read_csv(kept)


def _outcome(name: str, table: pd.DataFrame) -> dict[str, float | None]:
    """Means over the test episodes, as columns of the row."""
    means = table[["success_once", "success_at_end", "action_change", "jerk"]].mean()
    jerk = None if math.isnan(means.jerk) else round(means.jerk, 1)
    return {f"{name}_success": round(means.success_once, 4), f"{name}_success_at_end": round(means.success_at_end, 4),
            f"{name}_action_change": round(means.action_change, 4), f"{name}_jerk": jerk}
