"""`pd`: finding itself, Python and its virtual environment; stamping only what is complete; saying what is wrong.

No test installs anything: the virtual environment's python (with its pip) and uv are small scripts that keep a log, and
PATH holds nothing but the few tools that `pd` names.
"""
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib

import pytest

from pdkit.files import ROOT

SHELLS = [shell for shell in ("dash", "sh", "bash") if shutil.which(shell)]

FAKE_PYTHON = f"""#!/bin/sh
# A virtual environment's python: logs what it is asked, and fails at `pip install` while the file `offline` exists.
here=$(cd "$(dirname "$0")/../.." && pwd)
case "$*" in
    *"pip "*install*) echo install >>"$here/log"; [ ! -e "$here/offline" ] ;;
    *pip*--version*|*compileall*) exit 0 ;;
    *"-m pdkit"*) printf '%s|' "run in $PWD" "$@" >>"$here/log"; echo >>"$here/log" ;;
    *) exec {sys.executable} "$@" ;;
esac
"""


@pytest.fixture
def project(tmp_path):
    """A copy of what `pd` needs, in a folder with a space, with a virtual environment whose python only logs."""
    folder = tmp_path / "a folder"
    (folder / "pdkit").mkdir(parents=True)
    for name in ("pd", "environment.txt", "pyproject.toml", "pdkit/__init__.py", "pdkit/__main__.py", "pdkit/cli.py",
                 "pdkit/errors.py", "pdkit/files.py"):
        shutil.copy(ROOT / name, folder / name)
    python = folder / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(FAKE_PYTHON)
    python.chmod(0o755)
    (folder / ".venv" / "pyvenv.cfg").write_text("")
    return folder


def pd(project, *arguments, shell=None, cwd=None, script=None, **environment):
    """Run pd and return the finished process; uv, pip and apt are out of its reach."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("PDKIT_")}
    tools = project.parent / "tools"
    if not tools.exists():
        tools.mkdir()
        for tool in "sh dirname readlink cat cksum uname df awk ls rm mkdir mv sleep env grep".split():
            (tools / tool).symlink_to(shutil.which(tool))
        (tools / "id").write_text("#!/bin/sh\necho 1000\n")
        (tools / "id").chmod(0o755)
    command = [*([shutil.which(shell)] if shell else []), str(script or project / "pd"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd or project,
                          env={**clean, "PDKIT_PYTHON": sys.executable, "PATH": str(tools), **environment})


def log(project):
    return (project / "log").read_text().splitlines() if (project / "log").exists() else []


def stamp(project):
    return project / ".venv" / "pdkit-setup-complete"


@pytest.mark.parametrize("shell", SHELLS)
def test_set_up_once_then_start_at_once_from_anywhere(project, tmp_path, shell):
    first = pd(project, "run", "--seed", "a b", shell=shell)
    assert first.returncode == 0, first.stderr
    assert "minutes" in first.stderr and "set-up complete" in first.stderr  # told beforehand, and when done
    assert stamp(project).exists() and not (project / ".venv.lock").exists()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "link").symlink_to("../a folder/pd")
    second = pd(project, "doctor", shell=shell, cwd=tmp_path / "elsewhere", script=tmp_path / "elsewhere" / "link")
    assert (second.returncode, second.stderr) == (0, "")
    assert log(project) == ["install", f"run in {project}|-P|-m|pdkit|run|--seed|a b|",
                            f"run in {tmp_path}/elsewhere|-P|-m|pdkit|doctor|"]


@pytest.mark.parametrize("name", ["environment.txt", "pyproject.toml"])
def test_a_changed_environment_is_installed_again(project, name):
    pd(project, "run")
    with open(project / name, "a") as handle:
        handle.write("# changed\n")
    assert pd(project, "run").returncode == 0 and log(project).count("install") == 2


def test_a_moved_project_is_set_up_again(project):  # the editable install and the scripts hold its old place
    pd(project, "run")
    moved = project.rename(project.parent / "moved")
    assert pd(moved, "run").returncode == 0 and log(moved).count("install") == 2


def test_the_environment_of_another_checkout_is_left_alone(project, tmp_path):
    """A link to it as .venv: installing through it would turn the other's commands to this checkout."""
    pd(project, "run")
    other = tmp_path / "other"
    shutil.copytree(project, other, symlinks=True, ignore=shutil.ignore_patterns(".venv", "log"))
    (other / ".venv").symlink_to(project / ".venv")
    refused = pd(other, "run")
    assert refused.returncode == 2 and f"is the environment of the checkout in {project}; remove this link" in refused.stderr
    assert pd(project, "run").returncode == 0 and log(project).count("install") == 1


def test_a_failed_install_is_one_sentence_never_stamped_and_resumed(project):
    (project / "offline").touch()
    failed = pd(project, "run")
    assert failed.returncode == 2 and "could not be installed" in failed.stderr.splitlines()[-1]
    assert not stamp(project).exists() and log(project) == ["install"]
    assert not (project / ".venv.lock").exists()
    (project / "offline").unlink()
    assert pd(project, "run").returncode == 0 and stamp(project).exists()


def test_a_lock_left_by_a_killed_set_up_is_taken_over(project):
    (project / ".venv.lock").mkdir()
    gone = subprocess.Popen(["true"])
    gone.wait()
    (project / ".venv.lock" / "pid").write_text(str(gone.pid))
    assert pd(project, "run").returncode == 0 and stamp(project).exists()


def test_another_set_up_is_waited_for(project):
    other = subprocess.Popen(["sleep", "60"])
    (project / ".venv.lock").mkdir()
    (project / ".venv.lock" / "pid").write_text(str(other.pid))
    done = []
    waiting = threading.Thread(target=lambda: done.append(pd(project, "run")))
    waiting.start()
    time.sleep(2.5)
    assert not done and log(project) == []
    other.kill()
    other.wait()
    waiting.join(20)
    assert done[0].returncode == 0 and f"waiting for another set-up (process {other.pid})" in done[0].stderr


def test_an_interrupted_set_up_says_so_and_leaves_no_stamp_and_no_lock(project):
    python = project / ".venv" / "bin" / "python"
    python.write_text(FAKE_PYTHON.replace("echo install", "sleep 2; echo install"))
    pd(project)  # makes the folder of tools
    process = subprocess.Popen([project / "pd", "run"], stderr=subprocess.PIPE, text=True, start_new_session=True,
                               env={"PATH": str(project.parent / "tools"), "PDKIT_PYTHON": sys.executable})
    while not (project / ".venv.lock" / "pid").exists():
        time.sleep(0.05)
    time.sleep(0.5)
    os.killpg(process.pid, signal.SIGINT)  # what a terminal sends at Ctrl-C
    error = process.communicate(timeout=20)[1]
    assert process.returncode == 130 and error.splitlines()[-1].startswith("pdkit: set-up interrupted")
    assert not stamp(project).exists() and not (project / ".venv.lock").exists()
    assert pd(project, "run").returncode == 0 and stamp(project).exists()


def test_uv_is_used_when_it_is_there(project):
    pd(project)  # makes the folder of tools
    uv = project.parent / "tools" / "uv"
    uv.write_text(f"#!/bin/sh\necho uv \"$@\" >>'{project}/log'\n")
    uv.chmod(0o755)
    assert pd(project, "run").returncode == 0
    python = project / ".venv" / "bin" / "python"
    assert log(project)[0] == f"uv pip install --python {python} -r environment.txt"


def test_unknown_verbs_and_help_need_no_set_up(project):
    wrong = pd(project, "tset")
    assert wrong.returncode == 2 and wrong.stderr.startswith("Unknown verb 'tset'") and not wrong.stdout
    assert "usage: pdkit VERB" in pd(project).stdout and "usage: pdkit VERB" in pd(project, "--help").stdout
    assert log(project) == [] and not stamp(project).exists()


def test_a_wrong_python_is_one_sentence(project, tmp_path):
    old = tmp_path / "python3.9"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    done = pd(project, "run", PDKIT_PYTHON=str(old))
    assert done.returncode == 2
    assert done.stderr == f"PDKIT_PYTHON is {old}, which is not a working Python 3.11 or 3.12.\n"


def test_no_python_at_all_is_said_with_the_line_that_installs_one(project):
    done = pd(project, "run", PDKIT_PYTHON="")
    assert done.returncode == 2 and "found none; install it: " in done.stderr.splitlines()[-1]
    assert log(project) == []


def test_a_folder_that_is_no_virtual_environment_is_never_cleared(project, tmp_path):
    precious = tmp_path / "home"
    precious.mkdir()
    (precious / "thesis.txt").write_text("years of work")
    done = pd(project, "run", PDKIT_VENV=str(precious))
    assert done.returncode == 2 and "is not a virtual environment" in done.stderr.splitlines()[-1]
    assert (precious / "thesis.txt").read_text() == "years of work"


def test_no_permission_is_one_sentence(project):
    done = pd(project, "run", PDKIT_VENV="/proc/no/venv")
    assert done.returncode == 2 and done.stderr.startswith("No permission to write /proc/no/venv.lock")


@pytest.mark.parametrize("shell", SHELLS)
def test_the_scripts_parse(shell):
    subprocess.run([shell, "-n", ROOT / "pd"], check=True)
    if shell == "bash":
        subprocess.run([shell, "-n", ROOT / ".ci" / "run"], check=True)


def test_they_are_executable_and_ci_only_calls_pd_test():
    assert os.access(ROOT / "pd", os.X_OK) and os.access(ROOT / ".ci" / "run", os.X_OK)
    assert "./pd test" in (ROOT / ".ci" / "run").read_text()


@pytest.mark.skipif(not shutil.which("shellcheck"), reason="shellcheck is not installed")
def test_shellcheck_has_nothing_to_say():
    subprocess.run(["shellcheck", ROOT / "pd", ROOT / ".ci" / "run"], check=True)


def test_environment_is_pinned_and_ends_with_the_project():
    lines = [line.split("#")[0].strip() for line in (ROOT / "environment.txt").read_text().splitlines()]
    lines = [line for line in lines if line]
    assert lines[-1] == "-e ." and all("==" in line and "+" not in line for line in lines[:-1])


def test_the_command_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"pdkit": "pdkit.cli:main"}
