"""Executing one notebook by papermill, in a kernel of this interpreter, with progress and errors in one sentence."""
from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import nbformat
import papermill
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient.exceptions import CellTimeoutError

from .errors import PdkitError
from .files import ROOT
from .nb import PROGRESS_FILE, Line
from .nb_cells import code_cells, read_notebook

MOST = 600  # letters of a notebook's own words that a line shows, its middle left out


class ThisInterpreter(AsyncKernelManager):
    """A kernel manager whose kernelspec is made here: always this interpreter, whatever the machine has registered."""

    environment: dict[str, str] = {}

    @classmethod
    def with_environment(cls, environment: dict[str, str]) -> type[ThisInterpreter]:
        """The same with further environment variables for the kernel."""
        return type("ThisInterpreter", (cls,), {"environment": environment})

    @property
    def kernel_spec(self) -> KernelSpec:
        return KernelSpec(
            # Without frozen modules the debugger is quiet; without history, parallel kernels share no database.
            argv=[sys.executable, "-Xfrozen_modules=off", "-m", "ipykernel_launcher",
                  "--HistoryManager.enabled=False", "--log-level=CRITICAL", "-f", "{connection_file}"],
            display_name="pdkit", language="python", env={"PYTHONPATH": _python_path(), **self.environment},
        )


def _python_path() -> str:
    """PYTHONPATH with this package on it: the kernel starts in another folder, and pdkit may not be installed."""
    return os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))


def execute(path: Path, values: dict[str, Any], out: Path, timeout: float | None, progress: bool) -> None:
    """Run the notebook at `path` with checked `values`, its output into the folder `out`. Raises PdkitError."""
    output, note = out / path.name, out / f"progress.tmp-{os.getpid()}"
    total = len(code_cells(read_notebook(path))) + 1  # papermill adds the cell with the given values
    deadline = None if timeout is None else time.monotonic() + timeout
    watch = _Progress(path.stem, total, note, progress)
    try:
        with watch:
            papermill.execute_notebook(
                path, output, values, kernel_name="python3", language="python", progress_bar=False, start_timeout=180,
                kernel_manager_class=ThisInterpreter.with_environment({PROGRESS_FILE: str(note)}),
                on_cell_start=watch.cell,
                timeout_func=lambda cell=None: deadline and max(0.1, deadline - time.monotonic()),
                resources={"metadata": {"path": str(path.parent)}},  # the kernel's folder, as in JupyterLab
            )
    except papermill.PapermillExecutionError as error:
        raise PdkitError(f"Notebook {path.stem} failed in cell {watch.index + 1} ({_one_line(error.ename)}: "
                         f"{_one_line(error.evalue)}); the traceback is in {output}.") from None
    except CellTimeoutError:
        raise _kept(output, watch, "TimeoutError", f"did not finish within {timeout:g} s") from None
    except RuntimeError as error:  # DeadKernelError, and a kernel that never answered
        raise _kept(output, watch, "DeadKernelError", f"stopped: {_one_line(str(error))}") from None
    except KeyboardInterrupt:
        _kept(output, watch, "KeyboardInterrupt", "was interrupted")
        raise


def _one_line(text: str) -> str:
    """A notebook's words for a terminal: without line breaks, and without the escape sequences by which they could command it."""
    line = "".join(letter for letter in " ".join(text.split()) if letter.isprintable()).rstrip(".")
    return line if len(line) <= MOST else f"{line[:MOST // 2]} ... {line[-MOST // 2:]}"  # what to do stands at the end


def _kept(output: Path, watch: _Progress, kind: str, what: str) -> PdkitError:
    """Put an error into the executed notebook where it stopped: after a dead kernel it would look complete."""
    sentence = f"Notebook {output.stem} {what}, in cell {watch.index + 1}"
    if output.exists():
        notebook = nbformat.read(output, as_version=4)
        error = nbformat.v4.new_output("error", ename=kind, evalue=sentence, traceback=[f"{kind}: {sentence}"])
        notebook.cells[watch.index].outputs.append(error)
        notebook.cells[watch.index].metadata.setdefault("papermill", {}).update(exception=True, status="failed")
        nbformat.write(notebook, output)
    return PdkitError(f"{sentence}; what it had done is in {output}.")


class _Progress:
    """`05_policy_decorator  cell 7/20  1:23  <the notebook's own line>`, kept up to date while a cell runs."""

    def __init__(self, name: str, total: int, note: Path, shown: bool):
        self.index = 0  # of the running code cell, among all cells
        self._name, self._total, self._note, self._shown = name, total, note, shown
        self._done, self._start, self._stop = 0, time.monotonic(), threading.Event()
        self._line, self._thread = Line(every=1.0), threading.Thread(target=self._watch, daemon=True)

    def cell(self, cell: Any, cell_index: int) -> None:
        """nbclient calls this before each cell."""
        if cell.cell_type == "code":
            self.index, self._done = cell_index, self._done + 1

    def __enter__(self) -> None:
        if self._shown:
            self._thread.start()

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        if self._shown:
            self._thread.join()
            self._line.close(self._text("done" if error[0] is None else "stopped"))
        self._note.unlink(missing_ok=True)

    def _watch(self) -> None:
        while not self._stop.wait(1.0):
            try:
                note = _one_line(self._note.read_text(errors="replace"))
            except OSError:
                note = ""
            self._line.update(self._text(note))

    def _text(self, note: str) -> str:
        minutes, seconds = divmod(int(time.monotonic() - self._start), 60)
        return f"{self._name}  cell {self._done}/{self._total}  {minutes}:{seconds:02d}  {note}".rstrip()
