"""The notebook runner: parameters checked before anything runs, results only from complete runs, errors kept."""
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import nbformat
import numpy as np
import pytest

from pdkit import nb, nb_cells
from pdkit.cli import main
from pdkit.errors import PdkitError
from pdkit.nb_cells import parse_parameters

PARAMETERS = '''
profile = "lesson"  # smoke, lesson or paper
out = ""  # folder for the results
alpha = 0.1  # residual bound
steps = 10  # environment steps
flag = False  # a switch
seeds = [0, 1]  # training seeds
name: Optional[str] = None  # a label
'''.strip()
IMPORTS = "from typing import Optional\n"


def write(path: Path, *sources: str, parameters: str = PARAMETERS) -> Path:
    """A notebook: a title, the parameters cell, and one code cell for each source."""
    cells = [nbformat.v4.new_markdown_cell("# A title\nand a text"), nbformat.v4.new_code_cell(parameters)]
    cells[1].metadata["tags"] = ["parameters"]
    cells += [nbformat.v4.new_code_cell(source) for source in sources]
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty notebooks folder in place of the project's."""
    monkeypatch.setattr(nb, "NOTEBOOKS", tmp_path / "note books")
    return nb.NOTEBOOKS


SIMPLE = PARAMETERS.replace("name: Optional[str] = None", 'name = "x"')
FINISH = ("import os, sys\nfrom pdkit import nb\n"
          "nb.finish({'alpha': alpha, 'steps': steps, 'seeds': seeds, 'name': name, 'profile': profile,"
          "'python': sys.executable, 'cwd': os.getcwd()}, out)")


def errors_in(path: Path) -> list[str]:
    return [output.ename for cell in nbformat.read(path, 4).cells for output in cell.get("outputs", [])
            if output.output_type == "error"]


# ---- running ---------------------------------------------------------------------------------------------------------

def test_runs_with_given_values_in_this_interpreter_and_the_notebooks_folder(folder, tmp_path, capsys, monkeypatch):
    kernels = tmp_path / "jupyter" / "kernels" / "python3"  # a kernelspec of the user that points elsewhere
    kernels.mkdir(parents=True)
    spec = {"argv": ["/bin/false"], "display_name": "x", "language": "python"}
    (kernels / "kernel.json").write_text(json.dumps(spec))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))
    write(folder / "01_first.ipynb", FINISH, parameters=SIMPLE)
    before = Path.cwd()
    given = {"alpha": np.float64(0.5), "steps": np.int64(3), "seeds": (4, 5), "name": 'é "q"', "profile": "smoke"}
    result = nb.run_notebook("01", given, tmp_path / "out")
    assert result == {"alpha": 0.5, "steps": 3, "seeds": [4, 5], "name": 'é "q"', "profile": "smoke",
                      "python": sys.executable, "cwd": str(folder)}
    assert result == json.loads((tmp_path / "out" / "result.json").read_text())
    assert (tmp_path / "out" / "01_first.ipynb").exists() and Path.cwd() == before
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["01_first.ipynb", "parameters.json", "result.json"]
    assert "01_first  cell 3/3" in capsys.readouterr().out


def test_a_file_elsewhere_runs_and_two_of_one_name_have_folders_of_their_own(folder, tmp_path, capsys, monkeypatch):
    """Submissions: as many notebooks of one name as there are students, none of which is taken for the kit's own."""
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path / "runs"))
    write(folder / "01_first.ipynb", "raise ValueError", FINISH, parameters=SIMPLE)
    where = {}
    for student, steps in (("alice", 1), ("bob", 2)):
        path = write(tmp_path / student / "01_first.ipynb", f"steps = {steps}", FINISH, parameters=SIMPLE)
        assert main(["nb", str(path), "--profile", "smoke"]) == 0
        out = capsys.readouterr().out
        where[student] = Path(out.split("results go to ")[1].splitlines()[0])
        assert json.loads((where[student] / "result.json").read_text())["steps"] == steps
    assert where["alice"] != where["bob"] and {path.parent for path in where.values()} != {tmp_path / "runs" / "nb" / "01_first"}
    assert main(["nb", str(tmp_path / "carol" / "01_first.ipynb")]) == 2 and "carol" in capsys.readouterr().err


def test_a_readers_own_copies_are_not_the_kits_notebooks(folder):
    """Neither JupyterLab's duplicates nor what lies in notebooks/mine makes `05` ambiguous, or is held to the kit's conventions."""
    for name in ("05_a", "05_a-Copy1", "mine/05_a", ".ipynb_checkpoints/05_a-checkpoint"):
        write(folder / f"{name}.ipynb", FINISH, parameters=SIMPLE)
    assert list(nb.notebooks()) == ["05_a"] and nb.find_notebook("05") == folder / "05_a.ipynb"
    own = nb.find_notebook(str(folder / "mine" / "05_a.ipynb"))
    with pytest.raises(PdkitError, match="There is no notebook .*mine/06_b.ipynb"):
        nb.find_notebook(str(folder / "mine" / "06_b.ipynb"))
    assert nb.name_of(own) == "mine/05_a" and nb.default_folder("mine/05_a", {}) != nb.default_folder("05_a", {})


def test_a_relative_folder_is_one_of_the_kits(tmp_path, monkeypatch):
    monkeypatch.setattr(nb, "ROOT", tmp_path / "kit")
    monkeypatch.chdir(tmp_path)
    assert nb.folder("runs/x") == tmp_path / "kit" / "runs" / "x" and nb.folder(tmp_path / "y") == tmp_path / "y"


def test_a_failing_cell_is_one_sentence_and_leaves_no_old_result(folder, tmp_path):
    write(folder / "01_first.ipynb", "raise ValueError('boom\\nand more')", FINISH, parameters=SIMPLE)
    (tmp_path / "result.json").write_text('{"old": 1}')
    with pytest.raises(PdkitError, match=r"01_first failed in cell \d+ \(ValueError: boom and more\); the traceback"):
        nb.run_notebook("01_first", {}, tmp_path, progress=False)
    assert not (tmp_path / "result.json").exists()
    assert errors_in(tmp_path / "01_first.ipynb") == ["ValueError"]


def test_of_a_long_sentence_its_end_is_kept(folder, tmp_path):
    write(folder / "01_first.ipynb", "raise ValueError('x' * 2_000 + ' Did you mean y?')", FINISH, parameters=SIMPLE)
    with pytest.raises(PdkitError, match=r"\(ValueError: x{300} \.\.\. x+ Did you mean y\?\); the traceback"):
        nb.run_notebook("01_first", {}, tmp_path, progress=False)


@pytest.mark.parametrize("words, refused", [
    ("or StackCube", True), ("or StackCube, the paper's", True), ("TurnFaucet or PushChair", True),
    ("Door, StackCube, or another one that comes with a base policy", False), ("or another task that comes with demonstrations", False),
    ("Door, StackCube, or Pen (PPO alone): what is compared", False), ("", False), ("or any, such as Pen", False),
    ("or None: all", False), ("or StackCube (slower)", True), ("or Pen, or StackCube", True)])
def test_a_task_is_refused_where_the_comment_names_the_two_that_there_are(words, refused):
    known = nb_cells.parse_parameters(f"task = 'Door'  # {words}")
    named = [word for word in ("StackCube", "TurnFaucet", "PushChair", "Pen") if word in words]
    for task, ok in (("Door", True), *((word, True) for word in named), ("Hammer", not refused), ("Mine", not refused)):
        if ok:
            assert nb_cells.checked("x", known, {"task": task}) == {"task": task}
        else:
            with pytest.raises(PdkitError, match=f"Unknown task of x '{task}'"):
                nb_cells.checked("x", known, {"task": task})


def test_a_list_that_says_so_may_not_be_empty():
    known = nb_cells.parse_parameters("ks = [1, 5]  # numbers of neighbours, at least one\nshow = [1]  # tasks to draw")
    assert nb_cells.checked("x", known, {"ks": [3], "show": []}) == {"ks": [3], "show": []}
    with pytest.raises(PdkitError, match=r"Parameter ks takes at least one entry, such as \[1, 5\]\."):
        nb_cells.checked("x", known, {"ks": []})


def test_the_lessons_that_have_two_tasks_alone():
    paths = sorted(nb.NOTEBOOKS.glob("*.ipynb"))
    tasks = {path.stem[:2]: nb_cells._tasks(known["task"]) for path in paths if "task" in (known := nb_cells.parameters_of(path))}
    assert {name for name, own in tasks.items() if own == {"Door", "StackCube"}} == {"06", "07", "08", "09", "10", "11", "13"}
    assert tasks["14"] == {"TurnFaucet", "PushChair"} and not tasks["00"] | tasks["05"] | tasks["16"]


def test_what_fails_after_its_result_has_none_and_does_not_command_the_terminal(folder, tmp_path):
    write(folder / "01_first.ipynb", FINISH, "raise type('\\x1b[3JValueError', (Exception,), {})('\\x1b[2Jboom\\x07')", parameters=SIMPLE)
    with pytest.raises(PdkitError) as error:
        nb.run_notebook("01_first", {}, tmp_path, progress=False)
    assert not (tmp_path / "result.json").exists() and "([3JValueError: [2Jboom)" in str(error.value)


def test_a_notebook_without_result_is_an_error(folder, tmp_path):
    write(folder / "01_first.ipynb", "x = 1", parameters=SIMPLE)
    with pytest.raises(PdkitError, match="wrote no result.json"):
        nb.run_notebook("01_first", {}, tmp_path, progress=False)


def test_timeout_keeps_the_error_and_ends_the_kernel(folder, tmp_path):
    mark = tmp_path / "pid"
    slow = f"import os, time\nopen({str(mark)!r}, 'w').write(str(os.getpid()))\ntime.sleep(60)"
    write(folder / "01_first.ipynb", slow, FINISH, parameters=SIMPLE)
    start = time.monotonic()
    with pytest.raises(PdkitError, match="did not finish within 4 s"):
        nb.run_notebook("01_first", {}, tmp_path, timeout=4, progress=False)
    assert time.monotonic() - start < 25
    assert errors_in(tmp_path / "01_first.ipynb")[-1] == "TimeoutError"
    with pytest.raises(ProcessLookupError):
        os.kill(int(mark.read_text()), 0)


def test_a_dead_kernel_keeps_the_error(folder, tmp_path):
    write(folder / "01_first.ipynb", "import os; os._exit(1)", FINISH, parameters=SIMPLE)
    with pytest.raises(PdkitError, match="(?i)kernel died"):
        nb.run_notebook("01_first", {}, tmp_path, progress=False)
    assert errors_in(tmp_path / "01_first.ipynb") == ["DeadKernelError"]


def test_interrupting_the_runner_ends_the_kernel(tmp_path):
    mark = tmp_path / "pid"
    slow = f"import os, time\nopen({str(mark)!r}, 'w').write(str(os.getpid()))\ntime.sleep(60)"
    write(tmp_path / "notebooks" / "01_first.ipynb", slow, parameters=SIMPLE)
    code = ("import sys; from pathlib import Path; from pdkit import cli, nb; nb.NOTEBOOKS = Path(sys.argv[1]);"
            "sys.exit(cli.main(['nb', '01', '--out', sys.argv[2]]))")
    process = subprocess.Popen([sys.executable, "-c", code, tmp_path / "notebooks", tmp_path / "out"],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not (mark.exists() and mark.read_text()) and process.poll() is None:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130 and stderr.strip().startswith("Interrupted") and "Traceback" not in stderr
    assert errors_in(tmp_path / "out" / "01_first.ipynb")[-1] == "KeyboardInterrupt"
    with pytest.raises(ProcessLookupError):
        os.kill(int(mark.read_text()), 0)


def test_the_notebooks_own_progress_line_reaches_the_terminal(folder, tmp_path, capsys, monkeypatch):
    slow = "import time\nfrom pdkit import nb\nline = nb.Line()\nline.update('step 7 of 9')\ntime.sleep(2.5)"
    ends = "line.update('half')\nline.close('all 9 steps')\nline.close('and one more')"
    write(folder / "01_first.ipynb", slow, ends, "line.close('none left')", FINISH, parameters=SIMPLE)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    nb.run_notebook("01", {}, tmp_path)
    assert "step 7 of 9" in capsys.readouterr().out
    shown = [[output.data["text/plain"] for output in cell.outputs if "data" in output]
             for cell in nbformat.read(tmp_path / "01_first.ipynb", 4).cells[3:6]]
    # Replaced in place until the last word, which stays where it was said.
    assert shown == [["step 7 of 9"], ["all 9 steps", "and one more"], ["none left"]]


# ---- what the command line refuses before anything runs --------------------------------------------------------------

@pytest.mark.parametrize("arguments, message", [
    (["99"], "Unknown notebook '99'"),
    (["0"], "could be any of these notebooks: 01_first, 02_second"),
    (["01", "-p", "alhpa=0.2"], "Unknown parameter of 01_first 'alhpa'.*Did you mean 'alpha'"),
    (["01", "-p", "alpha=big"], "Parameter alpha must be float.*got 'big'"),
    (["01", "-p", "steps=1.5"], "Parameter steps must be int"),
    (["01", "-p", "steps=true"], "Parameter steps must be int"),
    (["01", "-p", "flag=1"], "Parameter flag must be bool"),
    (["01", "-p", "seeds=3"], "Parameter seeds must be list"),
    (["01", "-p", 'seeds=[1,"a"]'], r"Parameter seeds \(each entry\) must be int"),
    (["01", "-p", "alpha"], "is not name=value"),
    (["01", "-p", "alpha=1", "-p", "alpha=2"], "Parameter alpha is given twice"),
    (["01", "-p", "out=x"], "given by --out"),
    (["01", "--profile", "huge"], "Unknown profile 'huge'"),
    (["04", "-p", "task=Pen"], "Unknown task of 04_fourth 'Pen'; choose one of: Door, StackCube."),
    (["01", "--timeout", "0"], "--timeout must be more than 0"),
    (["01", "--timeout", "soon"], "pdkit nb: argument --timeout: invalid float value"),
    (["01", "--bogus"], "pdkit nb: unrecognized arguments: --bogus"),
    (["01", "--out", "{file}/x"], "Cannot make the folder .*file.x"),
    (["02"], "02_second.ipynb is wrong: the value of alpha is not a literal"),
    (["03"], "03_third.ipynb is not a readable notebook"),
])
def test_bad_input_is_one_sentence_and_nothing_runs(folder, tmp_path, capsys, arguments, message):
    write(folder / "01_first.ipynb", "raise SystemError('it ran')", parameters=SIMPLE)
    write(folder / "02_second.ipynb", FINISH, parameters='profile = ""\nout = ""\nalpha = 1 / 3')
    (folder / "03_third.ipynb").write_text('{"cells": [')
    write(folder / "04_fourth.ipynb", "raise SystemError('it ran')", parameters=f"{SIMPLE}\ntask = 'Door'  # or StackCube, the paper's")
    (tmp_path / "file").write_text("")
    if arguments == ["0"]:
        for name in ("03_third", "04_fourth"):
            (folder / f"{name}.ipynb").unlink()
    assert main(["nb", *(argument.format(file=tmp_path / "file") for argument in arguments)]) == 2
    captured = capsys.readouterr()
    assert len(captured.err.strip().splitlines()) == 1
    assert __import__("re").search(message, captured.err), captured.err


def test_values_are_read_with_the_type_of_the_default(folder, tmp_path, monkeypatch):
    write(folder / "01_first.ipynb", FINISH, parameters=PARAMETERS)
    seen = {}
    monkeypatch.setattr(nb, "run_notebook", lambda name, values, out, timeout: seen.update(values, out=out) or {})
    text = ["alpha=1", "flag=True", "seeds=(3, 4)", "name=0.5", "steps=7"]
    assert main(["nb", "01_first.ipynb", "--profile", "smoke", *(x for p in text for x in ("-p", p))]) == 0
    out = seen.pop("out")
    assert seen == {"alpha": 1.0, "flag": True, "seeds": [3, 4], "name": "0.5", "steps": 7, "profile": "smoke"}
    assert type(seen["alpha"]) is float
    assert out.parent == nb.runs_root() / "nb" / "01_first" and out.name.startswith("smoke-")
    assert main(["nb", "01", "-p", "name=null", "-p", "name=x"]) == 2
    seen.clear()
    assert main(["nb", "01", "-p", "name=null"]) == 0 and seen["name"] is None


def test_list_shows_titles_and_parameters(folder, capsys):
    write(folder / "01_first.ipynb", FINISH)
    assert main(["nb", "--list"]) == 0 and capsys.readouterr().out.split() == ["01_first", "A", "title"]
    assert main(["nb", "01", "--list"]) == 0
    assert "alpha = 0.1" in (text := capsys.readouterr().out) and "residual bound" in text


# ---- what notebooks call ---------------------------------------------------------------------------------------------

def test_finish_writes_whole_results_only(tmp_path):
    nb.finish({"mean": np.float32(0.5), "rows": np.arange(2)}, tmp_path)
    assert json.loads((tmp_path / "result.json").read_text()) == {"mean": 0.5, "rows": [0, 1]}
    for wrong in ({}, [1], {"x": object()}):
        with pytest.raises(PdkitError):
            nb.finish(wrong, tmp_path)
    assert json.loads((tmp_path / "result.json").read_text())["mean"] == 0.5
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_folder_defaults_below_runs(tmp_path):
    assert nb.folder("", "05_x") == nb.runs_root() / "nb" / "05_x" / "lab"
    (tmp_path / "file").write_text("")
    with pytest.raises(PdkitError, match="Cannot make the folder"):
        nb.folder(tmp_path / "file" / "x")


def test_line_prints_rarely_outside_a_terminal(capsys):
    line = nb.Line()
    for step in range(5):
        line.update(f"step {step}")
    line.close("end")
    assert capsys.readouterr().out == "step 0\nend\n"


# ---- conventions -----------------------------------------------------------------------------------------------------

def test_a_notebook_that_keeps_the_conventions(tmp_path):
    assert nb.check_notebook(write(tmp_path / "a.ipynb", "%matplotlib inline\nx = '!ls'", FINISH)) == []


@pytest.mark.parametrize("sources, parameters, message", [
    (["!ls", FINISH], PARAMETERS, "runs a shell"),
    (["x = !ls", FINISH], PARAMETERS, "runs a shell"),
    (["%pip install x", FINISH], PARAMETERS, "runs a shell"),
    (["%%bash\nls", FINISH], PARAMETERS, "runs a shell"),
    (["x = 1\n" * 41, FINISH], PARAMETERS, "more than 40 lines"),
    (["x = 1"] * 34 + [FINISH], PARAMETERS, "more than 35"),
    (["x = 1"], PARAMETERS, "does not call"),
    ([FINISH], PARAMETERS.replace("out =", "outt ="), "lacks `out`"),
    ([FINISH], PARAMETERS + "\nbeta = alpha  # help", "beta is not a literal"),
    ([FINISH], PARAMETERS + "\nbeta = [1,\n2]  # help", "beta takes more than one line"),
    ([FINISH], PARAMETERS + "\nbeta = 1", "beta has no comment"),
    ([FINISH], PARAMETERS + "\nimport os", "is not `name = literal`"),
    ([FINISH], PARAMETERS + "\nalpha = 2  # again", "alpha is set twice"),
    ([FINISH], PARAMETERS + "\nbeta = None  # help", "beta needs a type"),
    ([FINISH], PARAMETERS + "\nbeta: float | None = None  # help", "type of beta must be one of"),
    ([FINISH], PARAMETERS + "\nbeta: int = 'x'  # help", "default of beta is not of its type"),
])
def test_broken_conventions_are_named(tmp_path, sources, parameters, message):
    problems = nb.check_notebook(write(tmp_path / "a.ipynb", *sources, parameters=parameters))
    assert len(problems) == 1 and message in problems[0], problems


def test_outputs_and_tags_are_noticed(tmp_path):
    path = write(tmp_path / "a.ipynb", FINISH)
    notebook = nbformat.read(path, 4)
    notebook.cells[2].outputs = [nbformat.v4.new_output("stream", text="x")]
    notebook.cells[1].metadata["tags"] = []
    nbformat.write(notebook, path)
    problems = " ".join(nb.check_notebook(path))
    assert "holds outputs" in problems and "exactly one code cell tagged" in problems and "first code cell" in problems


def test_parameters_know_their_help_and_type():
    known = parse_parameters(PARAMETERS)
    assert known["alpha"].help == "residual bound" and known["alpha"].kind is float
    assert known["name"].optional and known["name"].kind is str and known["name"].default is None


@pytest.mark.parametrize("path", nb.notebooks().values(), ids=nb.notebooks().keys())
def test_the_lessons_keep_the_conventions(path):
    assert nb.check_notebook(path) == []
