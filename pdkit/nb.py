"""Notebooks: what a lesson calls (`folder`, `Line`, `finish`), and running one without a browser (`pdkit nb`)."""
from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from .errors import PdkitError, unknown
from .files import ROOT, read_json, runs_root, write_json

NOTEBOOKS = ROOT / "notebooks"
MINE = "mine"  # the folder below it for a reader's own copies; git leaves it alone
RESULT = "result.json"  # its presence alone says that a notebook came to its end
PROGRESS_FILE = "PDKIT_PROGRESS"  # environment variable: where a kernel leaves its progress line for the runner


# ---- what a notebook calls -------------------------------------------------------------------------------------------

def folder(out: str | Path = "", name: str = "") -> Path:
    """The folder for a notebook's files: the parameter `out`, or runs/nb/NAME/lab when that is empty; it is made.

    A relative `out` is one in the kit's folder: a kernel runs in notebooks/, where results have no business.
    """
    name = name or Path(os.environ.get("JPY_SESSION_NAME", "unnamed")).stem  # set by JupyterLab for its kernels
    path = ROOT / out if str(out) else runs_root() / "nb" / name / "lab"
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PdkitError(f"Cannot make the folder {path}: {error.strerror}; choose another one (out, PDKIT_RUNS).") \
            from None
    return path


def finish(result: dict[str, Any], out: str | Path = "") -> None:
    """Write `result` as result.json in the folder `out`, atomically: the last thing a notebook does.

    Numbers, strings, lists and dicts of them (numpy too). Raises PdkitError for anything else or an empty result.
    """
    if not isinstance(result, dict) or not result:
        raise PdkitError("nb.finish takes a dictionary with at least one entry.")
    path = folder(out) / RESULT
    try:
        write_json(path, result)
    except TypeError as error:
        raise PdkitError(f"nb.finish cannot write this result as JSON: {error}.") from None
    print(f"Result written to {path}")


class Line:
    """One line of progress, updated in place at most every `every` seconds.

    In a notebook a display of the running cell that is replaced until it is closed, so that an executed notebook holds one output for
    each last word, in the cell that said it; on a terminal the same line again; elsewhere (a log file) a new line, at most every 30 s.
    """

    def __init__(self, every: float = 2.0):
        self._shell = sys.modules.get("IPython") and sys.modules["IPython"].get_ipython()
        self._kernel = hasattr(self._shell, "kernel")
        self._terminal = not self._kernel and sys.stdout.isatty()
        self._every = every if self._kernel or self._terminal else max(every, 30.0)
        self._handle, self._cell = None, 0
        self._last = -float("inf")

    def update(self, text: str) -> None:
        """Show `text`, unless the last one is too recent."""
        if time.monotonic() - self._last >= self._every:
            self._show(text)

    def close(self, text: str) -> None:
        """Show `text` in any case, as the last word."""
        self._show(text)
        self._handle = None
        if self._terminal:
            print()

    def _show(self, text: str) -> None:
        self._last = time.monotonic()
        if note := os.environ.get(PROGRESS_FILE):
            Path(note).write_text(text)
        if self._kernel:
            self._display({"text/plain": text})
        elif self._terminal:
            width = shutil.get_terminal_size().columns - 1
            print(f"\r{text[:width]:{width}}", end="", flush=True)
        else:
            print(text, flush=True)

    def _display(self, data: dict[str, str]) -> None:
        from IPython.display import display

        if self._handle is None or self._cell != self._shell.execution_count:
            self._handle, self._cell = display(data, raw=True, display_id=True), self._shell.execution_count
        else:
            self._handle.update(data, raw=True)


# ---- finding and running one -----------------------------------------------------------------------------------------

def notebooks() -> dict[str, Path]:
    """Every notebook of the kit by its name, the path below notebooks/ without .ipynb: without a reader's own, those in notebooks/mine and
    JupyterLab's duplicates."""
    found = {name_of(path): path for path in sorted(NOTEBOOKS.rglob("*.ipynb"))}
    return {name: path for name, path in found.items()
            if not {".ipynb_checkpoints", MINE} & set(Path(name).parts) and "-Copy" not in path.stem}


def name_of(path: Path) -> str:
    """What the notebook at `path` is called: its path below notebooks/ without .ipynb, or for one elsewhere the whole path."""
    return path.relative_to(NOTEBOOKS).with_suffix("").as_posix() if path.is_relative_to(NOTEBOOKS) else str(path)


def find_notebook(name: str) -> Path:
    """The notebook called `name`, the only one whose name starts so (`05`), or the one in the file `name` (.ipynb). Raises PdkitError."""
    if str(name).endswith(".ipynb") and Path(name).is_file():
        return Path(name).resolve()
    known, given = notebooks(), str(name)
    name = given.removeprefix("notebooks/").removesuffix(".ipynb")
    if name in known:
        return known[name]
    matches = [key for key in known if name and key.startswith(name)]
    if len(matches) > 1:
        raise PdkitError(f"{name!r} could be any of these notebooks: {', '.join(matches)}; write more of the name.")
    if not matches and given.endswith(".ipynb"):
        raise PdkitError(f"There is no notebook {given}, neither a file nor one of the kit's.")
    if not matches:
        raise unknown("notebook", name, known) if known else PdkitError(f"There are no notebooks in {NOTEBOOKS}.")
    return known[matches[0]]


def run_notebook(name: str, parameters: dict[str, Any] | None, out: str | Path, timeout: float | None = None,
                 progress: bool = True) -> dict[str, Any]:
    """Run the notebook `name` in a fresh kernel of this interpreter and return what its last cell gave to `finish`.

    parameters: values for names of its `parameters` cell, checked before anything runs.
    out:        folder for the executed notebook, parameters.json and result.json; a result.json of an earlier run
                there is removed first, because its presence says that this run came to its end.
    timeout:    seconds for the whole notebook.

    Raises PdkitError, in one sentence: unknown notebook or parameter, wrong type, `out` not writable, a cell that
    fails, the timeout, a dead kernel, no result. The executed notebook is kept with the error in it.
    """
    from .nb_run import execute

    out = Path(out).resolve()
    with contextlib.suppress(OSError):  # `folder` tells what is wrong with it
        (out / RESULT).unlink()
    path, values = find_notebook(name), checked_parameters(name, parameters or {})
    write_json(folder(out) / "parameters.json", values)  # finds out now whether the folder can be written
    try:
        execute(path, {**values, "out": str(out)}, out, timeout, progress)
    except BaseException:  # Ctrl-C, too: a notebook that wrote its result and then failed did not come to its end
        (out / RESULT).unlink(missing_ok=True)
        raise
    if not (out / RESULT).exists():
        raise PdkitError(f"Notebook {path.stem} ran to its end but wrote no {RESULT} into {out}; "
                         "its last cell must call nb.finish(result, out).")
    return read_json(out / RESULT)


def checked_parameters(name: str, parameters: dict[str, Any]) -> dict[str, Any]:
    """`parameters` for the notebook `name` as JSON types. Raises PdkitError for a name or a type that does not fit."""
    from .nb_cells import REQUIRED, checked, parameters_of

    path = find_notebook(name)
    known = parameters_of(path)
    for required in REQUIRED:
        if required not in known:
            raise PdkitError(f"Notebook {path.stem} lacks the parameter `{required}`, which every notebook has.")
    if "out" in parameters:
        raise PdkitError("The parameter `out` is given by --out (in Python: run_notebook(..., out=...)).")
    return checked(path.stem, known, parameters)


# ---- pdkit nb --------------------------------------------------------------------------------------------------------

def main(argv: list[str]) -> int:
    """`pdkit nb NAME -p key=value ...`; returns 0, or raises PdkitError."""
    from .cli import Parser
    from .nb_cells import PROFILES

    parser = Parser(prog="pdkit nb", description="Run a notebook without a browser, with other parameters.")
    parser.add_argument("name", nargs="?", help="name of a notebook in notebooks/, its beginning (05), or a file (.ipynb)")
    parser.add_argument("-p", dest="parameters", metavar="NAME=VALUE", action="append", default=[],
                        help="set a parameter of the notebook; may be repeated")
    parser.add_argument("--profile", help=f"short for -p profile=...: {', '.join(PROFILES)}")
    parser.add_argument("--out", help="folder for the results (default: below runs/nb/, one for each set of values)")
    parser.add_argument("--timeout", type=float, metavar="SECONDS", help="stop after so long")
    parser.add_argument("--list", action="store_true", help="list the notebooks, or the parameters of NAME")
    args = parser.parse_args(argv)
    if args.list or not args.name:
        print("\n".join(_parameter_list(args.name) if args.name else _notebook_list()))
        return 0
    if args.timeout is not None and not args.timeout > 0:
        raise PdkitError(f"--timeout must be more than 0 seconds, not {args.timeout:g}.")
    path = find_notebook(args.name)
    values = checked_parameters(args.name, _typed(path, args))
    out = Path(args.out).resolve() if args.out else default_folder(name_of(path), values)
    print(f"Running {path.name}; results go to {out}", flush=True)
    result = run_notebook(args.name, values, out, args.timeout)
    print(json.dumps(result, indent=1))
    return 0


def default_folder(name: str, values: dict[str, Any]) -> Path:
    """runs/nb/NAME/PROFILE, with a short hash of the other values if any: the same values find their folder again.

    NAME is a notebook's (`name_of`); of one elsewhere it is the file's, with a short hash of its folder, as two may hold the same.
    """
    if Path(name).is_absolute():
        name = f"{Path(name).stem}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    others = {key: value for key, value in sorted(values.items()) if key != "profile"}
    mark = "-" + hashlib.sha256(json.dumps(others).encode()).hexdigest()[:8] if others else ""
    return runs_root() / "nb" / name / (values.get("profile", "lesson") + mark)


def _typed(path: Path, args: Any) -> dict[str, Any]:
    """The -p and --profile arguments with the types of the notebook's parameters."""
    from .nb_cells import from_text, parameters_of, parse_assignment

    known, values = parameters_of(path), {}
    pairs = [parse_assignment(text) for text in args.parameters]
    pairs += [("profile", args.profile)] if args.profile is not None else []
    for name, text in pairs:
        if name in values:
            raise PdkitError(f"Parameter {name} is given twice.")
        values[name] = from_text(text, known[name]) if name in known else text
    return values


def _notebook_list() -> list[str]:
    from .nb_cells import read_notebook

    lines = []
    for name, path in notebooks().items():
        text = "\n".join(cell.source for cell in read_notebook(path).cells if cell.cell_type == "markdown")
        title = next((line.lstrip("# ") for line in text.splitlines() if line.startswith("#")), "")
        lines.append(f"{name:32} {title}".rstrip())
    return lines or [f"There are no notebooks in {NOTEBOOKS}."]


def _parameter_list(name: str) -> list[str]:
    from .nb_cells import parameters_of

    return [f"{p.name} = {p.default!r}".ljust(32) + f" {p.help}" for p in parameters_of(find_notebook(name)).values()]


def check_notebook(path: str | Path) -> list[str]:
    """What breaks the notebook conventions at `path`, one sentence each; empty when nothing does."""
    from .nb_cells import check_notebook

    return check_notebook(path)
