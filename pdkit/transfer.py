"""`pdkit evaluate`: a saved policy on the test episodes of one task or several, such as on source and on novel objects (Fig. 12)."""
from __future__ import annotations

import argparse
import itertools
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from . import recorded, video
from .cli import Parser, parse_settings
from .decorated import Decorated, load_decorated
from .demos.cli import Progress
from .diffusion_analysis import resampled
from .errors import PdkitError, unknown
from .evaluate import evaluate
from .files import check_writable
from .methods.jsrl import CARD, JumpStart, load_jump_start
from .oracle import by_bound
from .pixels.encoders import Encoder
from .pixels.task import encoder_of, pixel_spec
from .policies import DiffusionPolicy, Policy, load_policy
from .runs import commit
from .seeds import reported_seeds
from .stats import wilson
from .sweep_spec import check_names
from .tasks import get_task
from .tasks.spec import TaskSpec
from .torch_setup import set_threads

SAMPLING = ("temperature", "sampler", "sampler_steps", "spacing", "chunk")  # of a Diffusion Policy, whatever it was trained with


def load_any(folder: str | Path) -> tuple[str, Policy | Decorated | JumpStart]:
    """What is saved in `folder`, "base", "decorated" or "jsrl", and the policy. Raises PdkitError when it is none of them."""
    folder = Path(folder)
    if (folder / CARD).exists():
        return "jsrl", load_jump_start(folder)
    if (folder / "decorated.json").exists():
        return "decorated", load_decorated(folder)
    return "base", load_policy(folder)


def beneath(policy: Policy | Decorated | JumpStart) -> Policy:
    """The base policy under a decorated one, JSRL's guide, or a base policy itself."""
    return policy.base if isinstance(policy, Decorated) else policy.guide if isinstance(policy, JumpStart) else policy


def sampled(policy: Policy | Decorated | JumpStart, settings: dict[str, Any]) -> Policy | Decorated | JumpStart:
    """The same weights with other sampling (SAMPLING); raises PdkitError for a policy that has none, or an unknown name."""
    if not settings:
        return policy
    if not isinstance(policy, DiffusionPolicy):
        raise PdkitError(f"--sampling is for a base policy that samples, a Diffusion Policy; this is a {type(policy).__name__}.")
    if strange := set(settings) - set(SAMPLING):
        raise unknown("sampling", min(strange), SAMPLING)
    if policy.config["late_steps"] and (strange := set(settings) - {"temperature", "chunk"}):
        raise PdkitError(f"DPPO fine-tuned this policy's last steps of sampling as they are; {min(strange)} would change which these are.")
    return resampled(policy, **settings)


def transfer(policy: Policy | Decorated | JumpStart, tasks: Sequence[str], episodes: int, encoder: Encoder | None = None,
             **options: Any) -> pd.DataFrame:
    """Success on the first `episodes` test seeds of each task, one row a task; `options` go to `evaluate`, `encoder` is what the policy
    sees the tasks through.

    Columns: task, episodes, success with Wilson's 95 % interval (low, high), success_at_end. Raises PdkitError for an unknown task,
    or one whose observations or actions are not the policy's.
    """
    specs = [pixel_spec(get_task(task), encoder) if encoder else get_task(task) for task in tasks]
    config = beneath(policy).config
    for spec in specs:
        if (config["obs_dim"], config["act_dim"]) != (spec.obs_dim, spec.act_dim):
            raise PdkitError(f"This policy takes {config['obs_dim']} numbers and gives {config['act_dim']}; {spec.name} gives "
                             f"{spec.obs_dim} and takes {spec.act_dim}: choose a task with the policy's own robot and observations.")
    rows = []
    for task, spec in zip(tasks, specs, strict=True):
        policy.reset(0)
        table = evaluate(spec, policy.act, reported_seeds(episodes), window=policy.window, chunk=policy.chunk, num_envs=25, **options)
        rate = wilson(int(table.success_once.sum()), episodes)
        rows.append(dict(task=task, episodes=episodes, success=rate.value, low=rate.low, high=rate.high,
                         success_at_end=float(table.success_at_end.mean())))
    return pd.DataFrame(rows)


def film(policy: Policy | Decorated | JumpStart, spec: TaskSpec, path: str | Path, episodes: int) -> Path:
    """Write a test episode as a video: of a policy that has one beneath it beside that one, the first of `episodes` that only the upper
    solves, if there is one. Raises PdkitError where the task cannot be drawn, or no encoder works.
    """
    if reason := video.try_render(spec):
        raise PdkitError(reason)
    path, seeds, apart = Path(path), reported_seeds(episodes), max(2, round(spec.rate / 20))
    if (base := beneath(policy)) is not policy:
        name = "JSRL" if isinstance(policy, JumpStart) else "decorated"
        pairs = video.contrasts(spec, base, policy, seeds, stride=apart, tries=episodes, name=name)
        clips = pairs[0] if pairs else video.record_all(spec, {"base": base, name: policy}, seeds[0], stride=apart)
    else:
        clips = video.record_all(spec, {policy.kind: policy}, seeds[0], stride=apart)
    path.parent.mkdir(parents=True, exist_ok=True)
    written = video.write_video(video.side_by_side(*clips), path, fps=spec.rate / apart)  # as fast as it happens
    if not written:
        raise PdkitError(f"{path} was not written; try a name that ends in .webp, which needs no encoder.")
    return written


def refuse_to_replace(name: str, tasks: Sequence[str], recipes: Sequence[str], folder: str, sampling: dict[str, Any] | None = None) -> None:
    """Raise PdkitError where data/results/NAME holds one of these rows (a task and recipe each) of a policy in another folder, or of the
    same one that sampled otherwise.

    A row is known by its task and recipe, which do not tell two policies of one kind apart: recording would replace the other's.
    """
    try:
        rows, _ = recorded.load(name)
    except PdkitError:  # nothing is recorded
        return
    for row in rows[rows.task.isin(tasks) & rows.recipe.isin(recipes)].itertuples():
        words = shlex.split(str(row.command))  # pdkit evaluate FOLDER ..., or what else made the row
        holder = words[2] if words[:2] == ["pdkit", "evaluate"] else row.command
        drawn = [*itertools.takewhile(lambda word: not word.startswith("--"), words[words.index("--sampling") + 1:])] \
            if "--sampling" in words else []
        if Path(holder).resolve() != Path(folder).resolve() or parse_settings(drawn, "--sampling") != (sampling or {}):
            raise PdkitError(f"data/results/{name}.csv holds {row.task}'s {row.recipe!r} of {holder}, which recording {folder} would "
                             "replace; choose another name for --record (without --oracle: or --recipe), or take that row out first.")


def corrected(kind: str, policy: Policy | Decorated | JumpStart, args: argparse.Namespace) -> int:
    """`pdkit evaluate --oracle`: success by the bound (pdkit/oracle.py), printed, and recorded if asked, a row a task and bound."""
    if kind != "base" or encoder_of(args.policy):
        raise PdkitError("--oracle corrects a base policy that is told the state; name the folder of one.")
    named = [f"{policy.kind},alpha={alpha:g}" for alpha in args.oracle]
    if args.record:
        refuse_to_replace(args.record, args.tasks, named, args.policy)
    for task in args.tasks:
        rows = by_bound(get_task(task), policy, args.oracle, reported_seeds(args.episodes),
                        Progress(args.episodes * len(args.oracle), "episodes"))
        for row in rows.itertuples():
            print(f"{task}, corrected by at most {row.alpha:g}: {wilson(round(row.success * row.episodes), row.episodes)}")
        if args.record:
            own = shlex.quote(args.policy)
            again = [f"pdkit evaluate {own} --tasks {task} --episodes {args.episodes} --oracle {alpha:g} --record {args.record}"
                     for alpha in rows.alpha]
            recorded.record(args.record, rows.assign(policy=policy.kind, recipe=named, seed=0, command=again, commit=commit()),
                            pd.DataFrame())
    return 0


def main(argv: list[str]) -> int:
    parser = Parser(prog="pdkit evaluate", description="Success of a saved policy on the test episodes of one task or several.")
    parser.add_argument("policy", help="folder of a base policy, of a decorated one or of JSRL's")
    parser.add_argument("--tasks", nargs="+", required=True, help="for example TurnFaucetSource TurnFaucet")
    parser.add_argument("--episodes", type=int, default=100, help="test episodes of each task (default 100)")
    parser.add_argument("--record", help="name under data/results: a row a task is added to NAME.csv")
    parser.add_argument("--recipe", help="what --record calls the policy (default: base, decorated or jsrl, with its --sampling)")
    parser.add_argument("--film", metavar="FILE", help="write an episode as FILE (.mp4 or .webp) instead, of a decorated policy or "
                                                       "JSRL's one that its base does not solve, side by side")
    parser.add_argument("--oracle", nargs="+", type=float, metavar="ALPHA", help="success of a base policy that a demonstrator corrects by "
                        "at most so much (0: not at all; times the task's alpha_scale), instead: what a bound allows")
    parser.add_argument("--sampling", nargs="+", metavar="NAME=VALUE", default=[], help="let a Diffusion Policy sample otherwise than it "
                        f"was made to: {', '.join(SAMPLING)}")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(argv)
    if args.film and (args.oracle or args.record):
        raise PdkitError("--film writes an episode and nothing else; leave --oracle and --record out.")
    if args.oracle and args.sampling:
        raise PdkitError("--oracle corrects a base policy as it was made; leave --sampling out.")
    if args.episodes < 1:
        raise PdkitError(f"--episodes must be at least 1, not {args.episodes}.")
    if args.recipe and (args.film or args.oracle or not args.record):
        raise PdkitError("--recipe names the rows that --record adds of a policy as it is: add --record, leave --film and --oracle out.")
    check_names(args.record, args.recipe)
    set_threads(args.threads)
    kind, policy = load_any(args.policy)
    policy = sampled(policy, settings := parse_settings(args.sampling, "--sampling"))
    if args.film:
        if len(args.tasks) > 1 or encoder_of(args.policy):
            raise PdkitError("--film shows one task and policies that are told the state: name one task, and a policy without an encoder.")
        if Path(args.film).suffix not in (".mp4", ".webp"):
            raise PdkitError(f"--film writes .mp4 or .webp, not {args.film}.")
        check_writable(args.film)
        print(f"wrote {film(policy, get_task(args.tasks[0]), args.film, args.episodes)}")
        return 0
    if args.oracle:
        return corrected(kind, policy, args)
    recipe = args.recipe or ",".join([kind, *(f"{name}={type(DiffusionPolicy.defaults[name])(value)}" for name, value in settings.items())])
    if args.record:
        refuse_to_replace(args.record, args.tasks, [recipe], args.policy, settings)
    rows = transfer(policy, args.tasks, args.episodes, encoder_of(args.policy))
    for row in rows.itertuples():
        print(f"{row.task}: {wilson(round(row.success * row.episodes), row.episodes)}; at the last step {row.success_at_end:.1%}")
    if args.record:
        asked = ["--sampling", *args.sampling] if args.sampling else []
        called = ["--recipe", args.recipe] if args.recipe else []
        command = shlex.join(["pdkit", "evaluate", args.policy, "--tasks", *args.tasks, "--episodes", str(args.episodes), *asked,
                              "--record", args.record, *called])
        recorded.record(args.record, rows.assign(recipe=recipe, seed=0, command=command, commit=commit()), pd.DataFrame())
    return 0
