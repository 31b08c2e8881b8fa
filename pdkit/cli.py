"""The command line: `pdkit VERB ...`, or `./pd VERB ...` which does the set-up first.

This module imports only the standard library, so that `pd --help` answers at once, even before the set-up.
"""
from __future__ import annotations

import argparse
import ast
import os
import re
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NoReturn

from . import __version__
from .errors import PdkitError, unknown
from .files import ROOT
from .machine import cores

VERBS = {  # verb: (what it does, the function that does it, given the remaining arguments)
    "run": ("the main job: a base policy, decorated by online RL, on Adroit Door or another task", "pdkit.main_job:main"),
    "test": ("pass the tests (further arguments go to pytest; --slow adds those that take minutes)", "pdkit.cli:test"),
    "lab": ("open the notebooks in JupyterLab", "pdkit.cli:lab"),
    "doctor": ("check this machine, with the fix beside each problem", "pdkit.doctor:main"),
    "demos": ("make demonstrations of a task, or look at them", "pdkit.demos.cli:main"),
    "train": ("train a base policy or a decorated one", "pdkit.train:main"),
    "evaluate": ("success of a saved policy on a task's test episodes, or on several tasks'", "pdkit.transfer:main"),
    "nb": ("run a notebook without a browser, with other parameters", "pdkit.nb:main"),
    "sweep": ("run a grid of trainings or notebooks, two at a time or on Ray", "pdkit.sweep:main"),
    "report": ("list the paper's claims with what was measured", "pdkit.report:main"),
    "bench": ("measure speed on this machine", "pdkit.bench:main"),
}


class Parser(argparse.ArgumentParser):
    """argparse whose complaints are one sentence (PdkitError), like every other error of the kit."""

    def error(self, message: str) -> NoReturn:
        raise PdkitError(f"{self.prog}: {message}; `{self.prog} --help` lists what it takes.")


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


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return the exit code: 0 done, 1 failed checks or tests, 2 bad input, 130 interrupted."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        return _dispatch(argv)
    except PdkitError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nInterrupted; nothing half-written was left behind.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader (`| head`) has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _dispatch(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_help())
        return 0
    if argv[0] in ("-V", "--version"):
        print(f"pdkit {__version__}")
        return 0
    check_verb(argv[0])
    return int(_function(argv[0])(argv[1:]) or 0)


def check_verb(verb: str) -> None:
    """Raise PdkitError listing the verbs when `verb` is not one."""
    if verb not in VERBS:
        raise unknown("verb", verb, VERBS)


def _function(verb: str) -> Callable[[list[str]], int | None]:
    """The function of a verb, imported only now: torch and the simulators take seconds."""
    module_name, name = VERBS[verb][1].split(":")
    try:
        return getattr(import_module(module_name), name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] == "pdkit":
            raise
        raise PdkitError(
            f"The package {error.name!r} is not installed in {sys.prefix}; "
            f"run ./pd {verb}, or pip install -r environment.txt."
        ) from error


def _help() -> str:
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {verb:{width}}  {text}" for verb, (text, _) in VERBS.items())
    return (
        f"pdkit {__version__}: learn, take apart and reproduce Policy Decorator.\n\n"
        "usage: pdkit VERB [arguments]     (./pd VERB does the set-up first, where it is still to do)\n\n"
        f"{verbs}\n\n"
        "pdkit VERB --help tells what a verb takes."
    )


def test(argv: list[str]) -> int:
    """`pdkit test [pytest arguments]`: paths are relative to the project folder, wherever it is called from.

    All tests together share the cores (pytest-xdist); those of a path that is given run one after the other, as does all with `-n 0`.
    """
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"  # before torch and numpy load: tests are small, and threads only get in each other's way
    import pytest

    os.chdir(ROOT)
    serial = re.compile(r"-[vqxl]*n|--numprocesses|--pdb|--trace|--capture|-[vqxl]*s[vqxl]*$|(-p)?no:xdist")  # -sv, too
    paths = [a for before, a in zip(["", *argv], argv, strict=False) if re.match(r"[^-=*?\s][^:=*?\s]*\.py(::|$)", a) and before[:1] != "-"]
    lost = [a for a in paths if not os.path.exists(a.split("::")[0])]
    if lost:
        raise PdkitError(f"There is no test file {lost[0]} in {ROOT}.")
    alone = any(os.path.exists(a.split("::")[0]) or serial.match(a) for a in argv) or not find_spec("xdist")
    workers = min(4, cores())
    return int(pytest.main(argv if alone or workers < 2 else ["-n", str(workers), "--dist", "worksteal", *argv]))


def lab(argv: list[str]) -> int:
    """`pdkit lab [jupyter lab arguments]`: JupyterLab in notebooks/, in place of this process."""
    notebooks = ROOT / "notebooks"
    if not notebooks.is_dir():
        raise PdkitError(f"{notebooks} does not exist; the checkout is incomplete, get it again.")
    if find_spec("jupyterlab") is None:
        raise PdkitError(f"JupyterLab is not installed in {sys.prefix}; run ./pd lab, which installs it.")
    root = ["--allow-root"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    os.chdir(notebooks)
    os.execv(sys.executable, [sys.executable, "-m", "jupyterlab", *root, *argv])
