"""Jobs for tests/test_sweep.py, apart from it so that a worker that runs one loads nothing heavy."""
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from pdkit.errors import PdkitError
from pdkit.sweep_run import Job


def job(folder: Path, name: str, minutes: float | None = 1.0, **parameters) -> Job:
    return Job("train", {"task": "T", "recipe": name, "seed": 0}, ("x",), folder / name, parameters, like=name[0], minutes=minutes)


def note(one: Job) -> None:
    """What ran, in a file: one character each time."""
    with open(one.folder / "ran", "a") as handle:
        handle.write("x")


def play(one: Job) -> dict:
    """A job function for the workers below: the parameters say what happens."""
    note(one)
    if one.parameters.get("die"):
        os.kill(os.getpid(), signal.SIGKILL)
    if one.parameters.get("fail"):
        raise PdkitError("It broke; mend it.")
    if one.parameters.get("crash"):
        raise ZeroDivisionError("by nothing")
    if one.parameters.get("sleep"):
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        (one.folder / "pids").write_text(f"{os.getpid()} {child.pid}")
        time.sleep(60)
    if one.parameters.get("command"):
        return {"row": {"code": subprocess.run(one.parameters["command"]).returncode}, "curve": []}
    return {"row": {"value": one.parameters.get("value", 0)}, "curve": []}
