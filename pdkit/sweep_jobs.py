"""The jobs of a sweep: what each cell and seed amounts to, checked as its command itself would, and which of them are done already."""
from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from . import nb
from .demos import Demos, sources
from .durations import evaluation_minutes, expected_minutes
from .errors import PdkitError
from .files import ROOT, read_json, runs_root
from .imitate import ImitateConfig, configured, untrained
from .methods.registry import base_folder, method_config, trainer_of
from .nb_cells import notebook_checksum, parameters_of
from .policies import Policy, load_policy
from .policies.base import read_card
from .profiles import flat
from .recorded import SETTINGS, UNTIED, essence, load, settings_of, told_of, unlike
from .runs import NO_MATTER
from .sweep_run import Job, base_settings
from .sweep_spec import Spec
from .tasks import TASKS, get_task
from .tasks.partnet import object_set

DEFAULTS = {"method": "policy_decorator", "profile": "lesson", "episodes": 200}  # of a training
OPTIONS = ("task", "method", "profile", "recipe", "episodes", "base", "demos", "num_demos")  # of the command; all else is --set
BASE_DEFAULTS = {"policy": "bet", "episodes": 200}  # of the training of a base policy
BASE_OPTIONS = ("task", "policy", "num_demos", "demos", "episodes")
NUMBERS = ("episodes", "num_demos")  # of all these; the others are words
RECIPE = re.compile(r"[\w.,=+-]+")
OF_BASE = "base: "  # in a training's settings, before what makes its base policy


def make_jobs(spec: Spec) -> list[Job]:
    """Every job, each checked by its names and configuration before any runs. What takes the loaded policy to tell (that it is none which
    the method can start from, or that a setting does not suit the method) the job's own first second tells, and costs that job alone."""
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
    return _as_recorded(spec, jobs) if spec.kind == "train" and spec.record and not spec.minutes else jobs


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
    base, card = _base(spec, cell)
    given = {"base": card["weights_sha256"]} if card else {}
    config = method_config(cell["method"], cell["task"], cell["profile"], seed, policy=base, **settings)
    if config.demo_fraction or trainer_of(cell["method"]).needs_demos:
        shown = _demos(cell)
        if card:
            demos = sources.learned_from(shown, card, cell.get("num_demos"))
            given |= {"demos": demos.checksum, "num_demos": demos.num}
    words = ["train", "decorated", *_options(OPTIONS, cell), "--seeds", str(seed), *_set(settings)]
    return _job(spec, cell | {"seed": seed}, {"task": cell["task"], "recipe": cell["recipe"], "seed": seed}, words, like=cell["method"],
                config=flat(config) | given,
                settings=flat(config) | (_own_base(spec, cell) if cell.get("base") in spec.bases else given),
                minutes=spec.minutes or expected_minutes(config, cell["episodes"]))


def _as_recorded(spec: Spec, jobs: list[Job]) -> list[Job]:
    """These trainings with the minutes that their recipe, or else their method, took for about as many steps where the spec records: over
    whatever policy, on whatever machine and beside whatever else ran."""
    try:
        rows = load(spec.record)[0]
    except PdkitError:  # nothing is recorded
        return jobs
    if not {"method", "train_minutes", "env_steps"} <= set(rows):
        return jobs
    rows = rows[(rows.env_steps > 0) & rows.train_minutes.notna()]
    rows = rows.assign(a_step=rows.train_minutes / rows.env_steps)
    timed = []
    for job in jobs:
        steps = job.config["total_steps"]
        alike = rows[(rows.task == job.labels["task"]) & (rows.method == job.like) & rows.env_steps.between(steps / 2, steps * 2)]
        same = alike[alike.recipe == job.labels["recipe"]]
        a_step = (same if len(same) else alike).a_step.median()
        minutes = a_step * steps + evaluation_minutes(job.parameters["episodes"]) if len(alike) else job.minutes
        timed.append(replace(job, minutes=minutes))
    return timed


def _base(spec: Spec, cell: dict[str, Any]) -> tuple[Policy, dict[str, Any]]:
    """The base policy of a training, and its card; one that has not been made yet is untrained, and its card empty."""
    if not is_made(cell.get("base", ""), spec):
        made = _with_task(spec, BASE_DEFAULTS | spec.bases[cell["base"]], BASE_OPTIONS)
        if made["task"] != cell["task"]:
            raise PdkitError(f"{spec.path.name}: the base policy {cell['base']} is one of {made['task']}, not {cell['task']}.")
        return _configured(made, _settings(made))[1], {}
    folder = ROOT / cell["base"] if "base" in cell else base_folder(cell["method"], cell["task"])
    return load_policy(folder), read_card(folder)


def is_made(base: str, spec: Spec) -> bool:
    """Whether a base policy, the default one (empty) included, is there, or none that the spec makes."""
    return base not in spec.bases or (ROOT / base / "policy.json").exists()


def unlike_recorded(spec: Spec, jobs: Sequence[Job]) -> list[str]:
    """The base policies of these trainings that are there and have other weights than those behind the recorded rows, by folder."""
    used = dict.fromkeys(base for job in jobs if (base := job.parameters.get("base")) in spec.checksums and is_made(base, spec))
    return [base for base in used if read_card(ROOT / base)["weights_sha256"] != spec.checksums[base]]


def bases_to_make(spec: Spec, jobs: Sequence[Job]) -> list[Job]:
    """The jobs that make the base policies which unfinished ones of these trainings need and which are not there.

    Raises PdkitError as `make_jobs` and `finished` do, and for a policy that is there and was made otherwise than the spec says now.
    """
    needed = dict.fromkeys(base for job in jobs if (base := job.parameters.get("base")) in spec.bases and not finished(job))
    cells = {base: {"recipe": base.replace("/", "-")} | spec.bases[base] for base in needed}
    makes = [replace(_imitation(spec, cell, cell.get("seed", 0)), kind="base", out=base, minutes=None) for base, cell in cells.items()]
    for job in makes:
        if is_made(job.out, spec) and (changed := _differing(base_settings(read_card(ROOT / job.out)), job)):
            raise PdkitError(f"{job.out} was made with other values of {', '.join(changed)} than {spec.path.name} gives it; delete it and "
                             "run the sweep again, or name another folder.")
    return [job for job in makes if not is_made(job.out, spec)]


def _settings(cell: dict[str, Any]) -> dict[str, Any]:
    """What a cell of a base policy gives by --set, but for the seed."""
    return {name: value for name, value in cell.items() if name not in (*BASE_OPTIONS, "recipe", "seed")}


def _configured(cell: dict[str, Any], settings: dict[str, Any]) -> tuple[ImitateConfig, Policy]:
    """How a base policy's cell trains, and the policy before that."""
    with contextlib.chdir(ROOT):  # what a setting's path is relative to, as where the job runs
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
                config={"policy": policy.kind, "demos_checksum": demos.checksum} | asdict(config)
                | {name: value for name, value in policy.config.items() if name not in policy.made})


def _demos(cell: dict[str, Any]) -> Demos:
    """The demonstrations of a training. Raises PdkitError where there are none, or those of another task."""
    return sources.given(cell["task"], ROOT / cell["demos"] if "demos" in cell else None)


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
    path, recipe = nb.find_notebook(name), cell.pop("recipe")
    name, stem = nb.name_of(path), path.stem
    if "seed" not in (known := parameters_of(path)) and seed:
        raise PdkitError(f"{spec.path.name}: the notebook {stem} has no parameter `seed`; leave seeds out, and it runs once a cell.")
    values = nb.checked_parameters(name, cell | ({"seed": seed} if "seed" in known else {}))
    words = ["nb", name, *(word for k, v in values.items() for word in ("-p", f"{k}={json.dumps(v)}"))]
    labels = {"task": str(values.get("task", stem)), "recipe": recipe, "seed": seed}
    return _job(spec, {"notebook": name, "recipe": recipe} | values, labels, words, like=name, minutes=spec.minutes,
                config={"the notebook's code": notebook_checksum(path)}
                | {p.name: p.default for p in known.values() if p.name not in ("out", *UNTIED)} | values)


def _own_base(spec: Spec, cell: dict[str, Any]) -> dict[str, Any]:
    """What makes the base policy that a spec names: a training's settings hold that, as its weights are others on each machine."""
    made = {"recipe": "base"} | spec.bases[cell["base"]]
    return {f"{OF_BASE}{name}": value for name, value in _imitation(spec, made, made.get("seed", 0)).config.items()}


def _job(spec: Spec, parameters: dict[str, Any], labels: dict[str, Any], words: list[str], config: dict[str, Any],
         settings: dict[str, Any] | None = None, **others: Any) -> Job:
    objects = object_set(TASKS[labels["task"]]) if labels["task"] in TASKS else ""
    marks = parameters | ({"objects": objects} if objects else {})  # what was run on other objects is another job
    key = hashlib.sha256(json.dumps(marks, sort_keys=True).encode()).hexdigest()[:10]
    folder = runs_root() / "sweeps" / spec.name / f"{labels['task']}-{labels['recipe']}-seed{labels['seed']}-{key}"
    return Job(spec.kind, labels, tuple(words), folder, parameters, config, told_of(settings or config), **others)


def finished(job: Job) -> dict[str, Any] | None:
    """The job's result if it came to its end. Raises PdkitError when it ran with settings that its profile no longer has."""
    if not job.result.exists():
        return None
    result = read_json(job.result)
    if changed := _differing(result.get("settings", {}), job):
        raise PdkitError(f"{job.name} was finished with other values of {', '.join(changed)} than its method and profile now give; "
                         f"delete {job.folder} to run it again.")
    return result


def outdated(jobs: Sequence[Job]) -> list[Job]:
    """Those that were finished with settings that their profiles, or notebooks, no longer have: `finished` refuses each."""
    return [job for job in jobs if job.result.exists() and _differing(read_json(job.result).get("settings", {}), job)]


def _differing(then: dict[str, Any], job: Job) -> list[str]:
    """The settings, of those that matter, in which what was run differs from the job as it is now."""
    now = json.loads(json.dumps(job.config))
    return sorted(name for name in (then.keys() & now.keys()) - NO_MATTER if then[name] != now[name])


def missing(jobs: Sequence[Job], name: str) -> list[Job]:
    """The jobs without a row in data/results/NAME.csv whose command trains, or runs, the same. A row whose profile, base policy,
    demonstrations, notebook's code or defaults have changed since counts as none (rows that do not tell their settings count)."""
    try:
        rows = load(name)[0]
    except PdkitError:  # nothing is recorded yet
        return list(jobs)
    marks = rows[SETTINGS].fillna("") if SETTINGS in rows else [""] * len(rows)
    done = dict(zip(zip(rows.task, rows.recipe, rows.seed, map(essence, rows.command), strict=True), marks, strict=True))
    known = settings_of(name)

    def there(job: Job) -> bool:
        key = (*(job.labels[name] for name in ("task", "recipe", "seed")), essence(job.command))
        return key in done and not unlike(known.get(done[key], {}), job.settings)

    return [job for job in jobs if not there(job)]
