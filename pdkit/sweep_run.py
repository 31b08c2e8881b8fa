"""Running many jobs side by side: what one job loses, the others keep.

A job is a `pdkit` command in a folder of its own. It is finished when its result.json is there, which is written atomically
and last; so a second go skips what is finished, and what was interrupted resumes from its own checkpoint. The same job function runs
in processes of this machine (`Local`) or on Ray (pdkit/sweep_ray.py). Nothing heavy is imported here: every worker does.
"""
from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from .errors import PdkitError
from .files import ROOT, read_json, write_json
from .nb import RESULT

if TYPE_CHECKING:
    from .sweep_progress import Progress

LOG, FAILED = "log.txt", "failed.txt"
STOP_SECONDS = 10.0  # what a job gets to end cleanly after Ctrl-C, before it is killed
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}


@dataclass(frozen=True)
class Job:
    """One training or notebook with one set of values."""

    kind: str  # train, base or notebook
    labels: dict[str, Any]  # task, recipe and seed: the keys of its recorded row
    words: tuple[str, ...]  # arguments of pdkit, without --out
    folder: Path  # its name holds a hash of the parameters
    parameters: dict[str, Any]
    config: dict[str, Any] = field(default_factory=dict)  # everything that these parameters amount to today (of a notebook: its code, too)
    settings: dict[str, Any] = field(default_factory=dict)  # what of it a recorded row tells: all but the seed and what does not matter
    like: str = ""  # jobs that are alike take alike long: a method, a notebook
    minutes: float | None = None  # expected
    out: str = ""  # where the command writes; empty: to `run` in the folder

    @property
    def name(self) -> str:
        return f"{self.labels['task']} {self.labels['recipe']} seed {self.labels['seed']}"

    @property
    def result(self) -> Path:
        return self.folder / RESULT

    @property
    def command(self) -> str:
        """The line that makes this row again, without the sweep."""
        return "pdkit " + shlex.join([*self.words, *(["--out", self.out] if self.out else [])])


JobFunction = Callable[[Job], dict[str, Any]]


# ---- what a worker does ----------------------------------------------------------------------------------------------

def run_job(job: Job) -> dict[str, Any]:
    """Run the job's command to its end and return its row, its curve and the settings it ran with. Raises PdkitError."""
    from .runs import commit  # brings pandas, which the scheduler does without

    out, path = ROOT / job.out if job.out else job.folder / "run", os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    code_of = {"commit": commit()}  # before the command, which takes hours, loads it
    with open(job.folder / LOG, "ab") as log:
        start = log.tell()
        process = subprocess.Popen([sys.executable, "-m", "pdkit", *job.words, "--out", str(out)], cwd=ROOT, stdin=subprocess.DEVNULL,
                                   stdout=log, stderr=log, env=os.environ | ONE_THREAD | {"PYTHONPATH": path})
        try:
            code = process.wait()
        except KeyboardInterrupt:  # let it remove its temporary files
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(STOP_SECONDS / 2)
            raise
        finally:
            process.kill()
    if code:
        raise PdkitError(_killed_by(-code) if code < 0 else _last_line(job.folder / LOG, start))
    made = {"train": _trained, "base": _imitated, "notebook": _played}[job.kind](job, out)
    return made | {"row": code_of | made["row"]}


def _trained(job: Job, out: Path) -> dict[str, Any]:
    import pandas as pd

    from .runs import commits

    folder = out / "{task}-{recipe}-seed{seed}".format(**job.labels)
    manifest = read_json(folder / "manifest.json")
    curve = json.loads(pd.read_csv(folder / "metrics.csv").to_json(orient="records", double_precision=15))
    return {"row": manifest["results"] | {"commit": commits(manifest)}, "curve": curve, "settings": manifest["parameters"]}


def _imitated(job: Job, out: Path) -> dict[str, Any]:
    from .runs import commits

    card = read_json(out / "policy.json")
    info = card["info"]
    row = {"policy": card["kind"], "demos": info["demos"], "train_minutes": round(info["seconds"] / 60, 2),
           "cores": info["machine"]["cores"], "device": info["device"], "iteration": info["selected"]["iteration"],
           "commit": commits(info), **info["test"]}
    return {"row": row, "curve": [], "settings": base_settings(card)}


def base_settings(card: dict[str, Any]) -> dict[str, Any]:
    """What a base policy was made with, from its policy.json."""
    info = card["info"]
    return {"policy": card["kind"], "demos_checksum": info["demos_checksum"]} | info["imitate"] | card["config"]


def _played(job: Job, out: Path) -> dict[str, Any]:
    return {"row": _scalars(job.parameters) | _scalars(read_json(out / RESULT)), "curve": [], "settings": job.config}


def _scalars(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The numbers, words and switches among nested values, by dotted name: what fits into a table."""
    found = {}
    for name, value in values.items():
        if isinstance(value, dict):
            found |= _scalars(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float | str):
            found[prefix + name] = value
    return found


def _killed_by(number: int) -> str:
    return f"it was killed by {signal.Signals(number).name}" + (" (is memory short?)" if number == signal.SIGKILL else "")


def _last_line(log: Path, start: int) -> str:
    lines = log.read_bytes()[start:].decode(errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else "it failed without a word"


def work(function: JobFunction, job: Job) -> dict[str, Any]:
    """What result.json shall hold: what the function gives, the parameters and the seconds it took."""
    job.folder.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    return {"parameters": job.parameters, **function(job), "seconds": round(time.monotonic() - started, 1)}


def reason(error: BaseException) -> str:
    """An exception in one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, PdkitError) else f"{type(error).__name__}: {text}".rstrip(": ")


def _child(function: JobFunction, job: Job, parent: int) -> None:
    """A worker process: one job, in a session of its own, so that the scheduler can end all that it started."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # it may have been ignored in a background shell
    os.environ |= ONE_THREAD
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    job.folder.mkdir(parents=True, exist_ok=True)
    (job.folder / FAILED).unlink(missing_ok=True)
    log = os.open(job.folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    try:
        write_json(job.result, work(function, job))
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:  # whatever a job may raise costs this job only
        if not isinstance(error, PdkitError):
            traceback.print_exc()
        (job.folder / FAILED).write_text(reason(error))
        sys.exit(1)


def _end_with(parent: int) -> None:
    """Kill this worker and what it started when the scheduler is gone (killed, so that it could not do so itself)."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os.killpg(os.getpgrp(), signal.SIGKILL)


# ---- where jobs run --------------------------------------------------------------------------------------------------

class Backend(Protocol):
    """Starts jobs and tells which have ended."""

    def start(self, function: JobFunction, job: Job) -> Any: ...

    def ended(self, handles: Sequence[Any], timeout: float) -> list[Any]: ...

    def problem(self, handle: Any, job: Job) -> str:
        """What went wrong with a job that has ended; empty when its result is there."""

    def stop(self, handles: Sequence[Any]) -> None: ...


class Local:
    """A process for each job; the number at a time is the caller's business."""

    def __init__(self):
        self._context = multiprocessing.get_context("spawn")  # fork is unsafe once torch has threads

    def start(self, function: JobFunction, job: Job) -> Any:
        process = self._context.Process(target=_child, args=(function, job, os.getpid()), daemon=True)
        process.start()
        return process

    def ended(self, handles: Sequence[Any], timeout: float) -> list[Any]:
        ready = wait([handle.sentinel for handle in handles], timeout)
        return [handle for handle in handles if handle.sentinel in ready]

    def problem(self, handle: Any, job: Job) -> str:
        handle.join()
        self._kill(handle)  # what a killed worker left behind
        if handle.exitcode < 0:
            return _killed_by(-handle.exitcode)
        if handle.exitcode:
            told = job.folder / FAILED
            return told.read_text() if told.exists() else f"its worker ended with exit code {handle.exitcode}"
        return "" if job.result.exists() else f"it ended without writing {RESULT}"

    def stop(self, handles: Sequence[Any]) -> None:
        """End running jobs: first as Ctrl-C does, then, after STOP_SECONDS, by force."""
        try:
            for handle in handles:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(handle.pid, signal.SIGINT)
            deadline = time.monotonic() + STOP_SECONDS
            for handle in handles:
                handle.join(max(0.0, deadline - time.monotonic()))
        finally:  # also at a second Ctrl-C
            for handle in handles:
                self._kill(handle)
                handle.join()

    @staticmethod
    def _kill(handle: Any) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: no permission for a group of zombies
            os.killpg(handle.pid, signal.SIGKILL)
        handle.kill()


# ---- the scheduler ---------------------------------------------------------------------------------------------------

def run_jobs(jobs: Sequence[Job], function: JobFunction, backend: Backend, limit: int, progress: Progress) -> dict[str, str]:
    """Run all jobs, at most `limit` at a time; returns what went wrong, by job name. Ctrl-C ends the running ones and goes on up."""
    waiting, running, problems = deque(jobs), [], {}
    try:
        while waiting or running:
            while waiting and len(running) < limit:
                job = waiting.popleft()
                running.append((backend.start(function, job), job))
                progress.started(job)
            ended = backend.ended([handle for handle, _ in running], 1.0)
            for handle, job in [pair for pair in running if any(pair[0] is one for one in ended)]:
                running = [pair for pair in running if pair[1] is not job]
                if problem := backend.problem(handle, job):
                    problems[job.name] = problem
                progress.ended(job, problem)
            progress.tick()
    finally:
        backend.stop([handle for handle, _ in running])
        progress.close()
    return problems
