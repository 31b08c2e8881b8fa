"""`pdkit sweep SPEC`: a grid of trainings or notebooks, two at a time, resumable, recorded. What a SPEC holds: pdkit/sweep_spec.py."""
from __future__ import annotations

import argparse
import contextlib
import shlex
from collections.abc import Iterator, Sequence

from . import nb
from .cli import Parser
from .durations import duration
from .errors import PdkitError, unknown
from .files import ROOT, locked, runs_root
from .sweep_jobs import OF_BASE, bases_to_make, finished, make_jobs, missing, outdated, unlike_recorded
from .sweep_progress import Progress
from .sweep_ray import Ray, must_be_installed
from .sweep_run import LOG, Backend, Job, JobFunction, Local, run_job, run_jobs
from .sweep_spec import check_names, load_spec


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

    from .recorded import SETTINGS, mark, record

    results = [(job, result) for job in jobs if (result := finished(job))]
    if results:
        told = [{name: value for name, value in job.settings.items() if name in result.get("settings", {}) or name.startswith(OF_BASE)}
                for job, result in results]  # without fields that the configuration did not have when it ran
        rows = [result["row"] | job.labels | {"command": job.command, "sweep": command, SETTINGS: mark(settings)}
                for (job, result), settings in zip(results, told, strict=True)]
        curves = pd.DataFrame([point | job.labels for job, result in results for point in result["curve"]])
        record(name, pd.DataFrame(rows), curves, {mark(settings): settings for settings in told})
    return len(results)


@contextlib.contextmanager
def _alone(name: str) -> Iterator[None]:
    """Refuse a second sweep of this name: both would work in the same folders."""
    folder = runs_root() / "sweeps" / name
    nb.folder(folder)
    with locked(folder / "lock", f"The sweep {name} is running already; wait for it, or stop it with Ctrl-C there."):
        yield


def _listing(job: Job) -> str:
    begun = [ROOT / f"{job.out}.training"] if job.out else [job.folder / "run", job.folder / "run.training"]
    state = "finished" if not job.out and finished(job) else "interrupted" if any(path.exists() for path in begun) else "to do"
    return f"{state:11}  {'' if job.minutes is None else f'{job.minutes:4.1f} min'}  {job.command}"


def _run(jobs: Sequence[Job], args: argparse.Namespace) -> dict[str, str]:
    """`sweep` where the command line says."""
    backend = Ray(args.address, args.workers) if args.ray or args.address else Local()
    return sweep(jobs, backend, getattr(backend, "limit", args.workers or 2))


def _make(bases: Sequence[Job], jobs: Sequence[Job], args: argparse.Namespace) -> dict[str, str]:
    """Make base policies; returns what is wrong with the jobs that cannot begin for want of one, by job name."""
    if not bases:
        return {}
    print("base policies first:", ", ".join(job.out for job in bases), flush=True)
    for job in bases:
        job.result.unlink(missing_ok=True)  # it was made once, and its folder is gone
    problems = _run(bases, args)
    failed = {job.out: f"its base policy could not be made: {problems[job.name].rstrip('.')} (log: {job.folder / LOG})"
              for job in bases if job.name in problems}
    return {job.name: failed[base] for job in jobs if (base := job.parameters.get("base")) in failed}


def main(argv: list[str]) -> int:
    """`pdkit sweep SPEC`; 0 when all jobs are finished, 1 when some failed, 130 when interrupted."""
    parser = Parser(prog="pdkit sweep", description="Run a grid of trainings or notebooks; a second go resumes it.")
    parser.add_argument("spec", help="a .toml or .json file, such as data/sweeps/leaderboard.toml")
    parser.add_argument("--workers", type=int, help="jobs at a time (default 2; with --address, the cluster's processors)")
    parser.add_argument("--ray", action="store_true", help="use Ray on this machine")
    parser.add_argument("--address", metavar="CLUSTER", help="use the Ray cluster at this address")
    parser.add_argument("--record", metavar="NAME", help="add the finished rows to data/results/NAME.csv (default: the spec's `record`)")
    parser.add_argument("--seeds", type=int, nargs="+", metavar="SEED", help="only these of the spec's seeds")
    parser.add_argument("--tasks", nargs="+", metavar="TASK", help="only these of its tasks (of a notebook that is given none: its name)")
    parser.add_argument("--recipes", nargs="+", metavar="RECIPE", help="only these of its cells, by their recipe (--dry-run shows them)")
    parser.add_argument("--missing", action="store_true", help="leave out what data/results has already, from whichever machine "
                        "(not rows whose profile, base policy or notebook has changed since)")
    parser.add_argument("--dry-run", action="store_true", help="list the jobs and run nothing")
    args = parser.parse_args(argv)
    if args.workers is not None and args.workers < 1:
        raise PdkitError(f"--workers must be at least 1, not {args.workers}.")
    check_names(args.record)
    if args.ray or args.address:
        must_be_installed()
    spec = load_spec(args.spec)
    every, name = make_jobs(spec), args.record or spec.record
    jobs = every
    for wanted, label in ((args.seeds, "seed"), (args.tasks, "task"), (args.recipes, "recipe")):
        known = {job.labels[label] for job in every}
        for value in wanted or ():
            if value not in known:
                raise unknown(f"{label} of {spec.path.name}", value, known)
        jobs = [job for job in jobs if not wanted or job.labels[label] in wanted]
    if args.missing:
        jobs = missing(jobs, name)
        if not jobs:
            print(f"Nothing of it is missing in data/results/{name}.csv.")
            return 0
    if len(old := outdated(jobs)) > 1:
        raise PdkitError(f"{len(old)} jobs were finished with other values than their methods and profiles, or notebooks, now give; delete "
                         f"these folders to run them again: {' '.join(shlex.quote(str(job.folder)) for job in old)}")
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
            baseless = _make(bases, jobs, args)
            for base in unlike_recorded(spec, jobs):
                print(f"{base} is made as the recorded runs' was, but its weights are not the same (another processor or library rounds "
                      "otherwise): expect similar results, not the recorded ones.", flush=True)
            problems = baseless | _run([job for job in jobs if job.name not in baseless], args)
        if name:
            print(f"{record_results(name, jobs, command)} rows recorded in data/results/{name}.csv")
    if problems is None:
        print(f"\nInterrupted; {sum(job.result.exists() for job in jobs)} of {len(jobs)} jobs are finished and kept. "
              f"`{shlex.join(['pdkit', 'sweep', *argv])}` goes on.")
        return 130
    for job in jobs:
        if job.name in problems:
            log = "" if job.name in baseless else f" (log: {job.folder / LOG})"
            print(f"FAILED {job.name}: {problems[job.name].rstrip('.')}{log}")
    return int(bool(problems))
