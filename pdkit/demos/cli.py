"""`pdkit demos`: make demonstrations, or look at what there is."""
from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path

import numpy as np

from ..cli import Parser
from ..errors import PdkitError
from ..files import DATA, check_writable, runs_root
from ..seeds import ROLLOUT, TEST
from ..tasks import TASKS, get_task
from . import sources
from .experts import EXPERTS
from .format import Demos, load_demos, save_demos

LAST_SEED = 4_000_000_000  # of a first episode: simulators take 32 bits, and the next episodes' seeds must fit, too
SOURCES = ("scripted", "agent", "human", "hub")


def main(argv: list[str]) -> int:
    parser = Parser(prog="pdkit demos", description="Make demonstrations of a task, or describe a file of them.")
    parser.add_argument("task", nargs="?", help=f"one of: {', '.join(TASKS)}")
    parser.add_argument("--num", type=int, help="episodes to make, or at most to take from the hub (default 100) or of 25 by humans")
    parser.add_argument("--source", choices=SOURCES, help="who acts (default: a scripted expert where there is one, else an agent); "
                                                             "human and hub (ManiSkill's motion planning) are fetched from the network")
    parser.add_argument("--first-seed", type=int, help="seed of the first episode (scripted: 0, agent: 3000000)")
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation of Gaussian noise on the actions")
    parser.add_argument("--tail", type=int, default=40, help="agent: steps kept after the first success")
    parser.add_argument("--policy", help="agent: folder of a decorated policy (default: the shipped one)")
    parser.add_argument("--from", dest="file", metavar="FILE", help="hub: what was downloaded already, its .zip, or a trajectory.h5 with "
                                                                    "its trajectory.json beside it")
    parser.add_argument("--out", help="file to write (default runs/demos/TASK-SOURCE-NUM.safetensors)")
    parser.add_argument("--show", metavar="FILE", help="check and describe a file instead")
    parser.add_argument("--list", action="store_true", help="describe the bundled files")
    parser.add_argument("--pixels", action="store_true", help="draw what a visual policy's cameras see along the demonstrations in --show, "
                                                              "or the task's bundled ones, and keep the pictures under runs/")
    args = parser.parse_args(argv)
    if args.pixels:
        return _draw(args)
    if args.show or args.list:
        for path in [Path(args.show)] if args.show else sorted((DATA / "demos").glob("*.safetensors")):
            describe(load_demos(path), path)
        return 0
    if not args.task:
        raise PdkitError("Name a task, for example `pdkit demos StackCube --num 1000`, or use --list.")
    source = args.source or ("scripted" if args.task in EXPERTS else "agent")
    args.num = (25 if source == "human" else 100) if args.num is None else args.num
    if args.num < 1:
        raise PdkitError(f"--num must be at least 1, not {args.num}.")
    for name, value, most in (("--first-seed", args.first_seed, LAST_SEED), ("--noise", args.noise, 10.0), ("--tail", args.tail, 10_000)):
        if value is not None and not 0 <= value <= most:
            raise PdkitError(f"{name} must be from 0 to {most:,}, not {value}.")
    if source in ("human", "hub") and (args.noise or args.first_seed is not None):
        raise PdkitError(f"--noise and --first-seed are of demonstrations that are made here; leave them out with --source {source}.")
    get_task(args.task)
    tries = max(4 * args.num, args.num + 50)  # with those that fail
    if source in ("scripted", "agent") and args.first_seed is not None and TEST - tries < args.first_seed < ROLLOUT:
        raise PdkitError(f"Seeds from {TEST:,} to {ROLLOUT - 1:,} are of the episodes by which policies are tested and chosen: take a "
                         "--first-seed well below or above.")
    if args.file and source != "hub":
        raise PdkitError("--from names a file of ManiSkill's hub; add --source hub.")
    out = Path(args.out) if args.out else runs_root() / "demos" / f"{args.task}-{source}-{args.num}.safetensors"
    check_writable(out)  # before the work, not after
    demos = _make(args, source)
    save_demos(demos, out)
    describe(demos, out)
    return 0


def _draw(args) -> int:
    """Pictures along demonstrations, as a policy trained with --pixels sees them."""
    from ..pixels.pictures import picture_file, pictures_of

    if not (args.show or args.task):
        raise PdkitError("Name a task whose demonstrations are to be drawn, or a file of them with --show.")
    demos = load_demos(Path(args.show)) if args.show else sources.bundled(args.task)
    pictures = pictures_of(demos, Progress(demos.num, "drawn"))
    cameras, height, width = len(pictures.rgb[0]) // 3, *pictures.rgb.shape[2:]
    print(f"{picture_file(demos)}: {len(pictures.rgb)} frames of {cameras} camera(s), {height} x {width}"
          f"{', with distances' if pictures.depth.size else ''}; {demos.num} demonstrations replayed as recorded")
    return 0


def _make(args, source: str) -> Demos:
    if source == "human":
        demos = sources.human(args.task)
        return demos.first(min(args.num, demos.num))
    if source == "hub":
        from .hub import from_hub

        demos = from_hub(args.task, args.num, args.file, Progress(args.num))
        if demos.num < args.num:
            print(f"\n{demos.num} demonstrations instead of {args.num}: there are no more that are solved here", file=sys.stderr)
        return demos
    if source == "scripted":
        return sources.scripted(args.task, args.num, args.first_seed or 0, args.noise, Progress(args.num))
    from ..decorated import load_decorated

    folder = Path(args.policy) if args.policy else DATA / "checkpoints" / args.task / "decorated"
    if not args.policy and not folder.exists():
        others = ", use --source scripted" * (args.task in EXPERTS)
        raise PdkitError(f"The kit has no decorated policy of {args.task} that could demonstrate it: name one with --policy{others}, or "
                         "make a file of your own episodes by pdkit.demos.from_episodes and save_demos.")
    first = 3_000_000 if args.first_seed is None else args.first_seed
    command = f"pdkit demos {args.task} --source agent --num {args.num} --noise {args.noise} --tail {args.tail} --first-seed {first}"
    command += f" --policy {shlex.quote(args.policy)}" if args.policy else ""
    how = f"rollouts of a policy decorated by this project, action noise {args.noise}, successes only, cut {args.tail} steps after success"
    return sources.from_agent(load_decorated(folder), args.task, args.num, first_seed=first, noise=args.noise, tail=args.tail, how=how,
                              command=command, progress=Progress(args.num))


class Progress:
    """How many of `num`, what was done with them, and the time left, on one line of a terminal (every tenth part elsewhere)."""

    def __init__(self, num: int, done: str = "kept of {tried} tried"):
        self.num, self.done, self.started, self.shown = num, done, time.monotonic(), -1

    def __call__(self, kept: int, tried: int) -> None:
        passed = time.monotonic() - self.started
        left = passed / max(kept, 1) * (self.num - kept)
        line = f"{kept}/{self.num} {self.done.format(tried=tried)}, about {left:.0f} s left"
        if sys.stderr.isatty():
            print(f"\r{line}   ", end="\n" if kept >= self.num else "", file=sys.stderr, flush=True)
        elif kept * 10 // self.num > self.shown:
            self.shown = kept * 10 // self.num
            print(line, file=sys.stderr, flush=True)


def describe(demos: Demos, path: Path) -> None:
    """Print what a file holds."""
    first = [int(np.argmax(e["success"])) + 1 for e in demos.episodes() if e["success"].any()]
    print(f"{path}: {demos.num} {demos.label} demonstrations of {demos.task}, {int(demos.lengths.sum())} steps")
    print(f"  made by: {demos.how}\n  again with: {demos.command}")
    print(f"  length {demos.lengths.min()}-{demos.lengths.max()} (median {np.median(demos.lengths):.0f}); {len(first)} succeed"
          + (f", first at step {min(first)}-{max(first)} (median {np.median(first):.0f})" if first else ""))
    print(f"  sha256 of the arrays {demos.checksum}")
