"""`pdkit sweep SPEC`: a grid of trainings or notebooks, two at a time, resumable, recorded.

SPEC is a TOML (or JSON) file:

    name = "ablations"        # folder runs/sweeps/NAME
    kind = "train"            # train: `pdkit train decorated`; base: `pdkit train base`; notebook: `pdkit nb`
    seeds = [0, 1, 2]         # every cell is run with each
    record = "ablations"      # optional: finished rows go to data/results/NAME.csv and NAME_curves.csv
    minutes = 4.0             # optional: what a job takes (kind train is estimated without it)
    [fixed]                   # values of every cell
    task = "Door"
    [grid]                    # every combination of these lists is a cell
    alpha = [0.1, 0.3]
    [[cells]]                 # further cells, over the fixed values
    critic_input = "concat"
    recipe = "critic-concat"  # optional: what a cell is called; by default the values in which it differs
    seeds = [0]               # optional: its own seeds
    [bases."runs/base/own"]   # optional: base policies that are not shipped, by the folder that cells name as `base`, with what
    task = "Door"             #   `kind = "base"` takes; a sweep that needs one that is not there makes it first
    policy = "diffusion"

All cells run with the first seed, then all with the next: a sweep that is stopped early compares them on fewer seeds.

A training's values are the options of `pdkit train decorated` (task, method, profile, episodes, base, demos, num_demos) and
any field of its configuration; a base policy's are these options of `pdkit train base` (task, policy, episodes, demos, num_demos) and what
it takes by --set; a notebook's are `notebook` and its parameters. Paths are relative to the project's folder.
"""
from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import itertools
import json
import re
import shlex
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from . import nb
from .cli import Parser
from .demos import Demos, sources
from .errors import PdkitError, unknown
from .files import ROOT, read_json, runs_root
from .imitate import ImitateConfig, configured, untrained
from .main_job import duration, expected_minutes
from .methods.registry import base_folder, method_config
from .policies import Policy, load_policy
from .policies.base import read_card
from .profiles import flat
from .runs import NO_MATTER
from .sweep_progress import Progress
from .sweep_ray import Ray, must_be_installed
from .sweep_run import LOG, Backend, Job, JobFunction, Local, run_job, run_jobs
from .tasks import TASKS, get_task
from .tasks.partnet import object_set

KINDS = ("train", "base", "notebook")
DEFAULTS = {"method": "policy_decorator", "profile": "lesson", "episodes": 200}  # of a training
OPTIONS = ("task", "method", "profile", "recipe", "episodes", "base", "demos", "num_demos")  # of the command; all else is --set
BASE_DEFAULTS = {"policy": "bet", "episodes": 200}  # of the training of a base policy
BASE_OPTIONS = ("task", "policy", "num_demos", "demos", "episodes")
NUMBERS = ("episodes", "num_demos")  # of all these; the others are words
NAME = re.compile(r"[\w.-]+")
RECIPE = re.compile(r"[\w.,=+-]+")
OWN_BASE = re.compile(r"runs(/(?!\.)[\w.+-]+)+")
KEYS = ("name", "kind", "seeds", "record", "minutes", "fixed", "grid", "cells", "bases")


@dataclass(frozen=True)
class Spec:
    """A checked spec file."""

    path: Path
    name: str
    kind: str
    seeds: tuple[int, ...]
    cells: tuple[dict[str, Any], ...]  # every cell's values, `recipe` among them
    record: str = ""
    minutes: float | None = None
    bases: dict[str, dict[str, Any]] = field(default_factory=dict)  # by folder: what makes it


# ---- reading ---------------------------------------------------------------------------------------------------------

def load_spec(path: str | Path) -> Spec:
    """The spec at `path`. Raises PdkitError for a file that is no spec, an unknown key or a value of the wrong kind."""
    path = Path(path)
    values = _read(path)
    for key in values:
        if key not in KEYS:
            raise unknown(f"key of {path.name}", key, KEYS)
    for key in ("name", "record"):
        if not (isinstance(values.get(key, "x"), str) and NAME.fullmatch(values.get(key, "x"))):
            raise PdkitError(f"{path.name}: {key} must be a word of letters, digits, dots and dashes, not {values[key]!r}.")
    for key, kind in (("fixed", dict), ("grid", dict), ("cells", list), ("seeds", list), ("bases", dict)):
        if not isinstance(values.get(key, kind()), kind):
            raise PdkitError(f"{path.name}: {key} must be a {'table' if kind is dict else 'list'}, not {values[key]!r}.")
    if values.get("kind") not in KINDS:
        raise unknown(f"kind in {path.name}", values.get("kind", ""), KINDS)
    seeds, minutes = values.get("seeds", [0]), values.get("minutes")
    if minutes is not None and (isinstance(minutes, bool) or not isinstance(minutes, int | float) or minutes <= 0):
        raise PdkitError(f"{path.name}: minutes must be a number above 0, not {minutes!r}.")
    name = values.get("name", path.stem)
    cells = _cells(path.name, name, values.get("fixed", {}), values.get("grid", {}), values.get("cells", []))
    for given in (seeds, *(cell["seeds"] for cell in cells if "seeds" in cell)):
        if not isinstance(given, list) or not given or any(type(s) is not int or s < 0 for s in given) or len(set(given)) < len(given):
            raise PdkitError(f"{path.name}: seeds must be different whole numbers of 0 or more, not {given!r}.")
    bases = values.get("bases", {})
    for folder, base in bases.items():
        if values["kind"] != "train":
            raise PdkitError(f'{path.name}: bases are for kind = "train", not for {values["kind"]!r}; leave them out.')
        if not OWN_BASE.fullmatch(folder):
            raise PdkitError(f'{path.name}: a base policy that a sweep makes lies below runs/, such as "runs/base/own", not in {folder!r}.')
        if not isinstance(base, dict) or "task" not in base or "recipe" in base:
            raise PdkitError(f"{path.name}: what makes {folder} is a table with a task, such as task = \"Door\", and without a recipe.")
    return Spec(path, name, values["kind"], tuple(seeds), cells, values.get("record", ""), minutes, bases)


def _read(path: Path) -> dict[str, Any]:
    if path.suffix not in (".toml", ".json"):
        raise PdkitError(f"A sweep is described by a .toml or .json file, not by {path.name!r}.")
    try:
        values = tomllib.loads(path.read_text()) if path.suffix == ".toml" else json.loads(path.read_text())
    except OSError as error:
        raise PdkitError(f"Cannot read {path}: {error.strerror}.") from None
    except ValueError as error:  # TOMLDecodeError, JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise PdkitError(f"{path} is not a readable {path.suffix[1:].upper()} file: {str(error).rstrip('.')}.") from None
    if not isinstance(values, dict):
        raise PdkitError(f"{path} must hold a table with name, kind, fixed and grid.")
    return values


def _cells(file: str, name: str, fixed: dict[str, Any], grid: dict[str, Any], further: list[Any]) -> tuple[dict[str, Any], ...]:
    for key, values in grid.items():
        if key in fixed:
            raise PdkitError(f"{file}: {key} is given in fixed and in grid; give it once.")
        if not isinstance(values, list) or not values:
            raise PdkitError(f"{file}: grid holds lists of at least one value; {key} is {values!r}.")
    if not all(isinstance(cell, dict) for cell in further):
        raise PdkitError(f"{file}: cells must be a list of tables.")
    varied = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())] if grid else []
    varied += further or ([] if grid else [{}])
    for values in (fixed, grid, *varied):
        if "seed" in values or (values in (fixed, grid) and "seeds" in values):
            raise PdkitError(f"{file}: give seeds at the top (seeds = [0, 1]), not seed among the values.")
    return tuple({"recipe": _recipe(cell, name)} | fixed | cell for cell in varied)


def _recipe(cell: dict[str, Any], name: str) -> str:
    """What a cell is called: the values in which it differs."""
    parts = [str(value) if key == "method" else f"{key}={value}" for key, value in cell.items() if key not in ("task", "notebook", "seeds")]
    return ",".join(parts) or name


# ---- from cells to jobs ----------------------------------------------------------------------------------------------

def make_jobs(spec: Spec) -> list[Job]:
    """Every job, each checked as the command itself would: nothing runs before all are known to be right."""
    make = {"train": _training, "base": _imitation, "notebook": _notebook}[spec.kind]
    every = dict.fromkeys([*spec.seeds, *(seed for cell in spec.cells for seed in _seeds(spec, cell))])
    jobs = [make(spec, {name: value for name, value in cell.items() if name != "seeds"}, seed)
            for seed in every for cell in spec.cells if seed in _seeds(spec, cell)]
    seen: dict[str, Job] = {}
    for job in jobs:
        if not isinstance(job.labels["recipe"], str) or not RECIPE.fullmatch(job.labels["recipe"]):
            raise PdkitError(f"Give the cell {job.labels['recipe']!r} a recipe (its name) of letters, digits and . , = + -.")
        content = json.dumps({k: v for k, v in job.parameters.items() if k != "recipe"}, sort_keys=True)
        for mark, what in ((job.name, "are called the same; give them a recipe each"), (content, "are the same job; leave one out")):
            if mark in seen:
                raise PdkitError(f"The cells {seen[mark].labels['recipe']} and {job.labels['recipe']} {what}.")
            seen[mark] = job
    return jobs


def _seeds(spec: Spec, cell: dict[str, Any]) -> Sequence[int]:
    return cell.get("seeds", spec.seeds)


def _with_task(spec: Spec, cell: dict[str, Any], options: Sequence[str]) -> dict[str, Any]:
    """The cell of a training. Raises PdkitError where it has no task, or an option of the wrong kind."""
    if "task" not in cell:
        raise PdkitError(f"{spec.path.name}: a training needs a task, such as task = \"Door\".")
    for name in options:
        value = cell.get(name, 1 if name in NUMBERS else "")
        if name in NUMBERS and (type(value) is not int or value < 1):
            raise PdkitError(f"{spec.path.name}: {name} must be a whole number of at least 1, not {value!r}.")
        if name not in NUMBERS and not isinstance(value, str):
            raise PdkitError(f"{spec.path.name}: {name} must be a word in quotes, not {value!r}.")
    return cell


def _training(spec: Spec, cell: dict[str, Any], seed: int) -> Job:
    cell = _with_task(spec, DEFAULTS | cell, OPTIONS)
    settings = {name: value for name, value in cell.items() if name not in OPTIONS}
    base, weights = _base(spec, cell)
    config = method_config(cell["method"], cell["task"], cell["profile"], seed, policy=base, **settings)
    if config.demo_fraction:
        _demos(cell)
    words = ["train", "decorated", *_options(OPTIONS, cell), "--seeds", str(seed), *_set(settings)]
    return _job(spec, cell | {"seed": seed}, {"task": cell["task"], "recipe": cell["recipe"], "seed": seed}, words, like=cell["method"],
                config=flat(config) | weights,
                minutes=spec.minutes or expected_minutes(config, cell["episodes"]))


def _base(spec: Spec, cell: dict[str, Any]) -> tuple[Policy, dict[str, str]]:
    """The base policy of a training, and its weights' checksum as `base`; one that has not been made yet is untrained, without one."""
    if not is_made(cell.get("base", ""), spec):
        made = _with_task(spec, BASE_DEFAULTS | spec.bases[cell["base"]], BASE_OPTIONS)
        if made["task"] != cell["task"]:
            raise PdkitError(f"{spec.path.name}: the base policy {cell['base']} is one of {made['task']}, not {cell['task']}.")
        return _configured(made, _settings(made))[1], {}
    folder = ROOT / cell["base"] if "base" in cell else base_folder(cell["method"], cell["task"])
    return load_policy(folder), {"base": read_card(folder)["weights_sha256"]}


def is_made(base: str, spec: Spec) -> bool:
    """Whether a base policy, the default one (empty) included, is there, or none that the spec makes."""
    return base not in spec.bases or (ROOT / base / "policy.json").exists()


def bases_to_make(spec: Spec, jobs: Sequence[Job]) -> list[Job]:
    """The jobs that make the base policies which unfinished ones of these trainings need and which are not there. Raises PdkitError as
    `make_jobs` and `finished` do."""
    needed = dict.fromkeys(base for job in jobs if not is_made(base := job.parameters.get("base", ""), spec) and not finished(job))
    cells = {base: {"recipe": base.replace("/", "-")} | spec.bases[base] for base in needed}
    return [replace(_imitation(spec, cell, cell.get("seed", 0)), kind="base", out=base) for base, cell in cells.items()]


def _settings(cell: dict[str, Any]) -> dict[str, Any]:
    """What a cell of a base policy gives by --set, but for the seed."""
    return {name: value for name, value in cell.items() if name not in (*BASE_OPTIONS, "recipe", "seed")}


def _configured(cell: dict[str, Any], settings: dict[str, Any]) -> tuple[ImitateConfig, Policy]:
    """How a base policy's cell trains, and the policy before that."""
    config, architecture = configured(cell["policy"], settings)
    return config, untrained(cell["policy"], get_task(cell["task"]), architecture)


def _imitation(spec: Spec, cell: dict[str, Any], seed: int) -> Job:
    cell = _with_task(spec, BASE_DEFAULTS | cell, BASE_OPTIONS)
    settings = _settings(cell) | {"seed": seed}
    config, policy = _configured(cell, settings)
    demos = _demos(cell)
    demos = demos.first(cell.get("num_demos", demos.num))
    words = ["train", "base", *_options(BASE_OPTIONS, cell), *_set(settings)]
    return _job(spec, cell | {"seed": seed}, {"task": cell["task"], "recipe": cell["recipe"], "seed": seed}, words,
                like=f"{cell['task']} {cell['policy']}", minutes=spec.minutes,
                config=asdict(config) | {name: value for name, value in policy.config.items() if name not in policy.made}
                | {"demos_checksum": demos.checksum})


def _demos(cell: dict[str, Any]) -> Demos:
    """The demonstrations of a training. Raises PdkitError where there are none, or those of another task."""
    return sources.given(cell["task"], ROOT / cell["demos"]) if "demos" in cell else sources.bundled(cell["task"])


def _options(names: Sequence[str], cell: dict[str, Any]) -> list[str]:
    """The task and the options that a cell gives, as words of a command."""
    return [cell["task"], *(word for name in names[1:] if name in cell for word in (f"--{name.replace('_', '-')}", str(cell[name])))]


def _set(settings: dict[str, Any]) -> list[str]:
    return ["--set", *(f"{name}={_literal(value)}" for name, value in settings.items())] if settings else []


def _literal(value: Any) -> str:
    """A value as `--set` reads it, without blanks where possible."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":")) if isinstance(value, list) else repr(value)


def _notebook(spec: Spec, cell: dict[str, Any], seed: int) -> Job:
    name = cell.pop("notebook", None)
    if not isinstance(name, str):
        raise PdkitError(f"{spec.path.name}: a notebook sweep needs notebook = \"05\" (or another one) in fixed.")
    stem, recipe = nb.find_notebook(name).stem, cell.pop("recipe")
    values = nb.checked_parameters(name, cell | {"seed": seed})
    words = ["nb", stem, *(word for k, v in values.items() for word in ("-p", f"{k}={json.dumps(v)}"))]
    labels = {"task": str(values.get("task", stem)), "recipe": recipe, "seed": seed}
    return _job(spec, {"notebook": stem, "recipe": recipe} | values, labels, words, like=stem, minutes=spec.minutes)


def _job(spec: Spec, parameters: dict[str, Any], labels: dict[str, Any], words: list[str], **others: Any) -> Job:
    objects = object_set(TASKS[labels["task"]]) if labels["task"] in TASKS else ""
    marks = parameters | ({"objects": objects} if objects else {})  # what was run on other objects is another job
    key = hashlib.sha256(json.dumps(marks, sort_keys=True).encode()).hexdigest()[:10]
    folder = runs_root() / "sweeps" / spec.name / f"{labels['task']}-{labels['recipe']}-seed{labels['seed']}-{key}"
    return Job(spec.kind, labels, tuple(words), folder, parameters, **others)


# ---- running ---------------------------------------------------------------------------------------------------------

def finished(job: Job) -> dict[str, Any] | None:
    """The job's result if it came to its end. Raises PdkitError when it ran with settings that its profile no longer has."""
    if not job.result.exists():
        return None
    result = read_json(job.result)
    then, now = result.get("settings", {}), json.loads(json.dumps(job.config))
    if differing := sorted(name for name in (then.keys() & now.keys()) - NO_MATTER if then[name] != now[name]):
        raise PdkitError(f"{job.name} was finished with other values of {', '.join(differing)} than its method and profile now give; "
                         f"delete {job.folder} to run it again.")
    return result


def sweep(jobs: Sequence[Job], backend: Backend, limit: int, function: JobFunction = run_job) -> dict[str, str]:
    """Run what is not finished and return what went wrong, by job name."""
    results = {job.name: finished(job) for job in jobs}
    todo = [job for job in jobs if results[job.name] is None]
    measured = [(job.like, results[job.name]["seconds"], job.minutes) for job in jobs if results[job.name]]
    progress = Progress(todo, len(jobs) - len(todo), limit, measured)
    left = progress.seconds_left() if todo else 0.0
    print(f"{len(jobs)} jobs, {len(jobs) - len(todo)} finished, {len(todo)} to do, {limit} at a time: "
          f"{'time not known yet' if left is None else duration(left / 60)}", flush=True)
    return run_jobs(todo, function, backend, limit, progress)


def record_results(name: str, jobs: Sequence[Job], command: str) -> int:
    """Merge the finished jobs' rows and curves into data/results; returns how many."""
    import pandas as pd

    from .recorded import record

    results = [(job, result) for job in jobs if (result := finished(job))]
    if results:
        rows = [result["row"] | job.labels | {"command": job.command, "sweep": command} for job, result in results]
        record(name, pd.DataFrame(rows), pd.DataFrame([point | job.labels for job, result in results for point in result["curve"]]))
    return len(results)


def missing(jobs: Sequence[Job], name: str) -> list[Job]:
    """The jobs without a row in data/results/NAME.csv whose command trains, or runs, the same."""
    from .recorded import load

    try:
        rows = load(name)[0]
    except PdkitError:  # nothing is recorded yet
        return list(jobs)
    done = set(zip(rows.task, rows.recipe, rows.seed, map(essence, rows.command), strict=True))
    return [job for job in jobs if (*(job.labels[key] for key in ("task", "recipe", "seed")), essence(job.command)) not in done]


def essence(command: str) -> tuple[str, ...]:
    """The parts of a command on which its row depends, sorted; a command other than `pdkit train decorated` counts as it stands."""
    head, *options = command.split(" --")
    if not head.startswith("pdkit train decorated"):
        return (command,)
    parts = {head}
    for name, _, value in (option.partition(" ") for option in options):
        if name == "set":
            parts |= {f"set {word}" for word in shlex.split(value) if word.partition("=")[0] not in NO_MATTER}
        elif name not in ("record", "threads") and (name, value) != ("method", DEFAULTS["method"]):
            parts.add(f"{name} {value}")
    return tuple(sorted(parts))


@contextlib.contextmanager
def _alone(name: str) -> Iterator[None]:
    """Refuse a second sweep of this name: both would work in the same folders."""
    folder = runs_root() / "sweeps" / name
    nb.folder(folder)
    with open(folder / "lock", "w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise PdkitError(f"The sweep {name} is running already; wait for it, or stop it with Ctrl-C there.") from None
        yield


def _listing(job: Job) -> str:
    state = "to do" if job.out else "finished" if finished(job) else "interrupted" if (job.folder / "run").exists() else "to do"
    return f"{state:11}  {'' if job.minutes is None else f'{job.minutes:4.1f} min'}  {job.command}"


def _run(jobs: Sequence[Job], args: argparse.Namespace) -> dict[str, str]:
    """`sweep` where the command line says."""
    backend = Ray(args.address, args.workers) if args.ray or args.address else Local()
    return sweep(jobs, backend, getattr(backend, "limit", args.workers or 2))


def _make(bases: Sequence[Job], args: argparse.Namespace) -> None:
    """Make base policies. Raises PdkitError where one fails: its trainings could not begin."""
    print("base policies first:", ", ".join(job.out for job in bases), flush=True)
    for job in bases:
        job.result.unlink(missing_ok=True)  # it was made once, and its folder is gone
    for name, problem in _run(bases, args).items():
        raise PdkitError(f"The base policy {name} could not be made: {problem.rstrip('.')}.")


def main(argv: list[str]) -> int:
    """`pdkit sweep SPEC`; 0 when all jobs are finished, 1 when some failed, 130 when interrupted."""
    parser = Parser(prog="pdkit sweep", description="Run a grid of trainings or notebooks; a second go resumes it.")
    parser.add_argument("spec", help="a .toml or .json file, such as data/sweeps/leaderboard.toml")
    parser.add_argument("--workers", type=int, help="jobs at a time (default 2; with --address, the cluster's processors)")
    parser.add_argument("--ray", action="store_true", help="use Ray on this machine")
    parser.add_argument("--address", metavar="CLUSTER", help="use the Ray cluster at this address")
    parser.add_argument("--record", metavar="NAME", help="add the finished rows to data/results/NAME.csv (default: the spec's `record`)")
    parser.add_argument("--seeds", type=int, nargs="+", metavar="SEED", help="only these of the spec's seeds")
    parser.add_argument("--recipes", nargs="+", metavar="RECIPE", help="only these of its cells, by their recipe (--dry-run shows them)")
    parser.add_argument("--missing", action="store_true", help="leave out what data/results has already, from whichever machine")
    parser.add_argument("--dry-run", action="store_true", help="list the jobs and run nothing")
    args = parser.parse_args(argv)
    if args.workers is not None and args.workers < 1:
        raise PdkitError(f"--workers must be at least 1, not {args.workers}.")
    if args.record is not None and not NAME.fullmatch(args.record):
        raise PdkitError(f"--record takes a name of letters, digits, dots and dashes, not {args.record!r}.")
    if args.ray or args.address:
        must_be_installed()
    spec = load_spec(args.spec)
    jobs, name = make_jobs(spec), args.record or spec.record
    for wanted, label in ((args.seeds, "seed"), (args.recipes, "recipe")):
        absent = [value for value in wanted or [] if value not in {job.labels[label] for job in jobs}]
        if absent:
            raise PdkitError(f"{spec.path.name} has no {label} {absent[0]}.")
        jobs = [job for job in jobs if not wanted or job.labels[label] in wanted]
    if args.missing:
        jobs = missing(jobs, name)
    bases = bases_to_make(spec, jobs)
    if args.dry_run:
        print(*map(_listing, [*bases, *jobs]), sep="\n")
        return 0
    path = spec.path.resolve()
    command = f"pdkit sweep {path.relative_to(ROOT) if path.is_relative_to(ROOT) else path.name}"
    command += f" --record {args.record}" if args.record else ""
    problems: dict[str, str] | None = None
    with _alone(spec.name):
        with contextlib.suppress(KeyboardInterrupt):
            if bases:
                _make(bases, args)
            problems = _run(jobs, args)
        if name:
            print(f"{record_results(name, jobs, command)} rows recorded in data/results/{name}.csv")
    if problems is None:
        print(f"\nInterrupted; {sum(job.result.exists() for job in jobs)} of {len(jobs)} jobs are finished and kept. "
              f"`{shlex.join(['pdkit', 'sweep', *argv])}` goes on.")
        return 130
    for job in jobs:
        if job.name in problems:
            print(f"FAILED {job.name}: {problems[job.name].rstrip('.')} (log: {job.folder / LOG})")
    return int(bool(problems))
