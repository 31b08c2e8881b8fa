"""The command line: fast, one sentence for each mistake, the right exit codes."""
import os
import subprocess
import sys
import time

import pytest

from pdkit import cli
from pdkit.errors import PdkitError


def pdkit(*arguments, cwd=cli.ROOT):
    return subprocess.run([sys.executable, "-m", "pdkit", *arguments], capture_output=True, text=True, cwd=cwd)


def test_help_is_fast_and_loads_no_package():
    code = "import sys; from pdkit.cli import main; main([]); print({'torch', 'numpy'} & set(sys.modules))"
    start = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=cli.ROOT)
    assert done.stdout.splitlines()[-1] == "set()" and time.monotonic() - start < 5
    assert all(f"  {verb} " in done.stdout for verb in cli.VERBS)


def test_help_runs_without_site_packages():  # before the set-up, `pd` runs it with whatever Python there is
    done = subprocess.run([sys.executable, "-S", "-m", "pdkit", "--help"], capture_output=True, text=True, cwd=cli.ROOT)
    assert done.returncode == 0 and "usage: pdkit VERB" in done.stdout, done.stderr


@pytest.mark.parametrize("arguments, sentence", [
    (["tset"], f"Unknown verb 'tset'; choose one of: {', '.join(sorted(cli.VERBS))}. Did you mean 'test'?"),
    (["nb", "--nope"], "pdkit nb: unrecognized arguments: --nope; `pdkit nb --help` lists what it takes."),
    (["doctor", "x"], "pdkit doctor: unrecognized arguments: x; `pdkit doctor --help` lists what it takes."),
])
def test_bad_input_is_one_sentence_on_stderr_and_exit_code_2(arguments, sentence):
    done = pdkit(*arguments)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", sentence + "\n")


@pytest.mark.parametrize("raised, code, said", [
    (PdkitError("It broke; mend it."), 2, "It broke; mend it."),
    (KeyboardInterrupt(), 130, "Interrupted"),
])
def test_exit_codes_and_arguments_passed_on(monkeypatch, capsys, raised, code, said):
    seen = []

    def verb(argv):
        seen.append(argv)
        raise raised

    monkeypatch.setattr(cli, "_function", lambda name: verb)
    assert cli.main(["run", "--seed", "3"]) == code and seen == [["--seed", "3"]]
    error = capsys.readouterr().err.strip()
    assert error.startswith(said) and len(error.splitlines()) == 1


def test_a_missing_package_is_named_with_the_fix(monkeypatch, capsys):
    monkeypatch.setitem(cli.VERBS, "bench", ("", "surely_not_installed.bench:main"))
    assert cli.main(["bench"]) == 2
    assert "'surely_not_installed' is not installed" in capsys.readouterr().err


def test_a_closed_pipe_is_no_traceback():
    command = f"{sys.executable} -m pdkit --help | true"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, cwd=cli.ROOT)
    assert "Traceback" not in done.stderr


def test_the_test_verb_runs_pytest_with_one_thread_and_passes_arguments_on(tmp_path, monkeypatch):
    inner = tmp_path / "test_inner.py"
    threads = "os.environ['OMP_NUM_THREADS']"
    inner.write_text(f"import os\ndef test_a(): assert {threads} == '1'\ndef test_b(): assert False\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    plain = ["-q", "-c", tmp_path / "pytest.ini", "--rootdir", tmp_path, "-p", "no:cacheprovider", inner]
    monkeypatch.setenv("OMP_NUM_THREADS", "7")  # the verb's own setting wins
    assert pdkit("test", *plain, "-k", "test_a").returncode == 0
    assert pdkit("test", *plain).returncode == 1


def test_a_test_file_that_is_not_there_is_named():
    done = pdkit("test", "tests/test_nothing.py::test_it")
    assert done.returncode == 2 and "There is no test file tests/test_nothing.py::test_it in " in done.stderr


SHARED = ["--dist", "worksteal"]


@pytest.mark.parametrize("cores, argv, before", [
    (2, ["--slow"], ["-n", "2", *SHARED]), (64, [], ["-n", "4", *SHARED]), (2, ["-k", "sac"], ["-n", "2", *SHARED]),
    (1, [], []), (2, ["tests/test_cli.py::test_lab"], []), (2, ["-n", "0"], []), (2, ["--pdb"], []),
    (2, ["-s"], []), (2, ["-vs"], []), (2, ["-sv"], []), (2, ["-vn0"], []),
    (2, ["--capture", "no"], []), (2, ["-p", "no:xdist"], []), (2, ["-pno:xdist"], []),
    (2, ["-k", "test_x.py"], ["-n", "2", *SHARED]), (2, ["-o", "python_files=check_*.py"], ["-n", "2", *SHARED]),
    (2, ["-v"], ["-n", "2", *SHARED]), (2, ["-rs"], ["-n", "2", *SHARED]),
])
def test_all_tests_share_the_cores_and_those_of_a_path_do_not(monkeypatch, cores, argv, before):
    called = []
    monkeypatch.setattr(pytest, "main", lambda argv: called.extend(argv) or 0)
    monkeypatch.setattr(cli, "cores", lambda: cores)
    monkeypatch.setattr(cli, "find_spec", lambda name: True)
    monkeypatch.chdir(cli.ROOT)
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "1")  # put back afterwards
    assert cli.test(argv) == 0 and called == [*before, *argv]


def test_without_the_package_that_shares_them_tests_run_one_after_the_other(monkeypatch):
    called = []
    monkeypatch.setattr(pytest, "main", lambda argv: called.extend(argv) or 0)
    monkeypatch.setattr(cli, "cores", lambda: 2)
    monkeypatch.setattr(cli, "find_spec", lambda name: None)
    monkeypatch.chdir(cli.ROOT)
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    assert cli.test(["--slow"]) == 0 and called == ["--slow"]


def test_lab_opens_the_notebooks_folder(monkeypatch, tmp_path):
    (tmp_path / "notebooks").mkdir()
    monkeypatch.setattr(cli, "ROOT", tmp_path)
    monkeypatch.chdir(tmp_path)
    seen = []
    monkeypatch.setattr(cli.os, "execv", lambda path, argv: seen.append((path, argv, cli.os.getcwd())))
    cli.main(["lab", "--port", "9000"])
    (path, argv, folder), = seen
    assert path == sys.executable and argv[1:3] == ["-m", "jupyterlab"] and argv[-2:] == ["--port", "9000"]
    assert folder == str((tmp_path / "notebooks").resolve())


@pytest.mark.parametrize("backend, words, sentence", [
    ("none", ["evaluate", "data/checkpoints/Door/base", "--tasks", "Door", "--episodes", "1"], "MuJoCo does not start with MUJOCO_GL=none"),
    pytest.param("glfw", ["demos", "Door", "--pixels", "--num", "1"], "MuJoCo cannot draw here with glfw",
                 marks=pytest.mark.skipif(sys.platform != "linux", reason="elsewhere GLFW needs no display")),
])
def test_a_graphics_library_that_does_not_work_is_one_sentence(backend, words, sentence, tmp_path):
    out = ["--out", str(tmp_path / "seen.safetensors")] if words[0] == "demos" else []
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run([sys.executable, "-W", "ignore", "-m", "pdkit", *words, *out], capture_output=True, text=True, cwd=cli.ROOT,
                          env=environment | {"MUJOCO_GL": backend})
    assert done.returncode == 2 and done.stderr.startswith(sentence) and done.stderr.count("\n") == 1, done.stderr
    assert not list(tmp_path.iterdir())
