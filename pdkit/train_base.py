"""`pdkit train base`: a base policy, from demonstrations; an interrupted training goes on with the same command."""
from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from .cli import parse_settings
from .demos import Demos, sources
from .demos.cli import Progress
from .durations import duration
from .errors import PdkitError
from .evaluate import outcome, reported
from .files import check_replaceable, discard, runs_root, write_json
from .imitate import Diverged, ImitateConfig, configured, imitate
from .pixels.cameras import view_of
from .pixels.learn import check_pixels, imitate_pixels, look_up, visual_settings
from .pixels.pictures import pictures_of
from .pixels.task import encoder_of, pixel_spec, save_visual
from .policies import POLICIES, load_policy, save_policy
from .policies.base import read_card
from .profiles import base_values
from .runs import Run, kept_so_far, only_here
from .tasks import get_task
from .torch_setup import pick_device


def base_demos(args) -> Demos:
    """The demonstrations that the arguments name."""
    demos = sources.given(args.task, args.demos)
    return demos.first(args.num_demos) if args.num_demos is not None else demos


def train_base(args) -> int:
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
                test = {"episodes": args.episodes} | outcome("base", reported(load_policy(out), spec, args.episodes, config.seed))
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
        with only_here(folder):
            discard(folder)
    run = Run(folder, "base", what, asdict(ImitateConfig()))
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
