"""The main job, `pdkit run`: notebook 05 without a browser, told beforehand, summed up afterwards, resumable."""
from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import nb, page
from .cli import Parser
from .durations import duration, expected_minutes
from .errors import PdkitError
from .files import ROOT, read_json, runs_root
from .methods.registry import base_folder, check_read
from .online_config import OnlineConfig
from .plots import Picture
from .policies import Policy
from .profiles import PROFILES, online_config, policy_values
from .runs import Run, kept_so_far
from .stats import Paired

NOTEBOOK = "05_policy_decorator"
OWN_OPTIONS = ("task", "profile", "seed", "out")
TRAINING = "training"  # the run folder of the training, inside the job's folder


def command(parameters: dict[str, Any]) -> str:
    """The shell line that runs the job with these notebook parameters again."""
    named = [f"--{name} {parameters[name]}" for name in ("task", "profile", "seed") if name in parameters]
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in parameters.items()}
    others = [shlex.quote(f"{name}={text}") for name, text in texts.items() if name not in OWN_OPTIONS]
    return " ".join(["./pd run", *named, *(f"-p {other}" for other in others)])


@dataclass(frozen=True)
class Report:
    """What the job found, as sections of a page and as lines of text."""

    task: str
    run: Run  # of the training, finished
    once: Paired  # base against decorated, solved at any step
    at_end: Paired  # the same, solved at the last step
    command: str

    def sections(self, curve: Picture, duel: Picture, correction: Picture, *, sheets: Sequence[tuple[str, Picture]] = (),
                 film: Path | None = None, instead: str = "") -> list[page.Section]:
        """The page: `sheets` are contact sheets by what happened (gained, lost); `instead` is said where there are none."""
        manifest, trained = self.run.manifest, self.run.manifest["results"]
        numbers = page.numbers([
            (f"{self.once.base.value:.1%}", "base policy", str(self.once.base)),
            (f"{self.once.other.value:.1%}", "decorated policy", str(self.once.other)),
            (f"{self.at_end.other.value:.1%}", "decorated, solved at the last step", f"base: {self.at_end.base.value:.1%}"),
            (f"{trained['train_minutes']:.1f} min", "of training",
             f"{trained['env_steps']:,} steps, {trained['updates']:,} updates")])
        seen = [page.figure(sheet, f"Episodes {what}: both policies from the same start. Green: solved by then.")
                for what, sheet in sheets]
        seen += [page.video(film, "The same episode: base policy left, decorated policy right.")] if film else []
        made = {"started": manifest["started"], "finished": manifest["finished"], **manifest["machine"]}
        return [
            page.Section("Result", [numbers, f"{self.once.n} test episodes, the same for both. {self.once.method}."]),
            page.Section("Learning curve", [page.figure(curve, "Dots: success on selection episodes, which are never the test episodes.")]),
            page.Section("Who gains, who loses", [page.figure(duel, f"p = {self.once.p:.1g} (McNemar's exact test).")]),
            page.Section("Episodes", seen or [instead]),
            page.Section("The correction", [page.figure(correction)]),
            page.Section("How to make it again", [page.code(self.command), page.details("Machine and versions", page.table(made)),
                                                  page.details("All settings", page.table(manifest["parameters"]))])]

    def summary(self, written: Path) -> list[str]:
        """The result in a few lines."""
        once, at_end, trained = self.once, self.at_end, self.run.manifest["results"]
        difference = f"{100 * once.difference:+.1f} points ({100 * once.low:+.1f} to {100 * once.high:+.1f})"
        return [f"base        {once.base}", f"decorated   {once.other}",
                f"difference  {difference}; {len(once.gained)} episodes gained, {len(once.lost)} lost",
                f"at the end  {at_end.base} -> {at_end.other}",
                f"training    {trained['train_minutes']:.1f} minutes, {trained['env_steps']:,} environment steps, "
                f"{trained['updates']:,} updates", f"policy      {self.run.folder / 'policy'}", f"page        {written}"]


def main(argv: list[str]) -> int:
    """`pdkit run [--task T] [--profile P] [--seed N] [-p name=value ...]`; 0 when done, 130 when interrupted."""
    parser = Parser(prog="pdkit run", description="Decorate a base policy by online RL, compare the two, write a page.")
    parser.add_argument("--task", default="Door", help="one that comes with a base policy, such as StackCube (default: Door)")
    parser.add_argument("--profile", default="lesson", help=f"{', '.join(PROFILES)} (default: lesson)")
    parser.add_argument("--seed", default="0", help="of the training (default: 0)")
    parser.add_argument("-p", dest="parameters", metavar="NAME=VALUE", action="append", default=[],
                        help="another parameter of the notebook, e.g. alpha=0.2; `pdkit nb 05 --list` names them")
    parser.add_argument("--out", help="folder for the results (default: below runs/main, one for each set of values)")
    args = parser.parse_args(argv)
    values = _values(args)
    config = configured(values)
    if not values.get("base"):
        base_folder("policy_decorator", values["task"])  # an error where the kit has none
    out = Path(args.out).expanduser().resolve() if args.out else _folder(values)
    print(f"{values['task']}, profile {values['profile']}, seed {values['seed']}: {_announcement(config, values, out)}\n"
          f"Results go to {out}\nCtrl-C stops it; the same command goes on from the last checkpoint.", flush=True)
    try:
        result = nb.run_notebook(NOTEBOOK, values, out)
    except KeyboardInterrupt:
        print(f"\nInterrupted. {kept_so_far(out / TRAINING)} {command(values)}{f' --out {args.out}' if args.out else ''}")
        return 130
    print(*result["summary"], sep="\n")
    return 0


def _values(args: Any) -> dict[str, Any]:
    """The notebook's parameters as asked for, checked and of the right types."""
    from .nb_cells import from_text, parameters_of, parse_assignment

    known = parameters_of(nb.find_notebook(NOTEBOOK))
    pairs = [("task", args.task), ("profile", args.profile), ("seed", args.seed)]
    pairs += [parse_assignment(text) for text in args.parameters]
    names = [name for name, _ in pairs]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise PdkitError(f"Parameter {twice[0]} is given twice (task, profile and seed have options of their own).")
    typed = {name: from_text(text, known[name]) if name in known else text for name, text in pairs}
    return nb.checked_parameters(NOTEBOOK, typed)


def found(path: str) -> Path:
    """What a parameter names, as it stands or below the kit's folder: a notebook runs in notebooks/, where data/... is not found."""
    return Path(path) if Path(path).exists() else ROOT / path


def configured(values: dict[str, Any], policy: Policy | None = None) -> OnlineConfig:
    """The training's configuration for the notebook's parameters: -1 stands for the profile's value, which is another one over a base
    `policy` that decides on several actions at once."""
    named = {name: values[name] for name in ("alpha", "H", "total_steps") if values.get(name, -1) != -1}
    both = sorted(named.keys() & values.get("changes", {}).keys())
    if both:
        raise PdkitError(f"{both[0]} is given as a parameter and in changes; give it once.")
    check_read("policy_decorator", values.get("changes", {}))
    task, profile = values.get("task", "Door"), values.get("profile", "lesson")
    over = policy_values(task, profile, policy.kind, policy.chunk) if policy is not None else {}
    return online_config(task, profile, values.get("seed", 0), **over | named | values.get("changes", {}))


def reported_episodes(values: dict[str, Any]) -> int:
    """How many test episodes each policy gets, for the notebook's parameters."""
    asked = values.get("eval_episodes", -1)
    return asked if asked > 0 else (4 if values.get("profile") == "smoke" else 200)


def _folder(values: dict[str, Any]) -> Path:
    """runs/main/TASK-PROFILE-seedN, with a short hash of the other values if any: the same ones find it again."""
    others = {name: value for name, value in sorted(values.items()) if name not in OWN_OPTIONS}
    mark = "-" + hashlib.sha256(json.dumps(others).encode()).hexdigest()[:8] if others else ""
    return runs_root() / "main" / f"{values['task']}-{values['profile']}-seed{values['seed']}{mark}"


def _announcement(config: OnlineConfig, values: dict[str, Any], out: Path) -> str:
    if (out / TRAINING / "manifest.json").exists() and read_json(out / TRAINING / "manifest.json").get("finished"):
        return "already trained here; only evaluated and pictured again (delete the folder to train anew)."
    time = duration(expected_minutes(config, reported_episodes(values)))
    cores = os.cpu_count() or 1
    return f"{config.total_steps:,} environment steps, {time} on 2 cores (this machine has {cores})."
