"""Files and folders are replaced whole or not at all, and nothing that is not ours."""
import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pdkit import runs
from pdkit.errors import PdkitError
from pdkit.files import atomic_folder, check_replaceable, check_writable, locked, recover


def save(folder, text):
    with atomic_folder(folder) as temporary:
        (temporary / "policy.json").write_text(text)


def test_a_folder_of_ours_is_replaced_whole(tmp_path):
    save(tmp_path / "p", "one")
    (tmp_path / "p" / "more").write_text("x")
    save(tmp_path / "p", "two")
    assert [path.name for path in (tmp_path / "p").iterdir()] == ["policy.json"]
    assert (tmp_path / "p" / "policy.json").read_text() == "two" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("given", ["thesis", "."])
def test_a_folder_with_something_else_is_left_as_it_is(tmp_path, monkeypatch, given):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "1.tex").write_text("x")
    monkeypatch.chdir(tmp_path)
    for refused in (lambda: save(given, "one"), lambda: check_replaceable(given, "policy.json")):
        with pytest.raises(PdkitError, match="holds something else"):
            refused()
    assert (tmp_path / "thesis" / "1.tex").read_text() == "x" and len(list(tmp_path.iterdir())) == 1


def test_an_empty_folder_may_be_used_and_a_file_and_the_root_may_not(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    save(tmp_path / "empty", "one")
    check_replaceable(tmp_path / "new", "policy.json")
    with pytest.raises(PdkitError, match="is a file"):
        check_replaceable(tmp_path / "file", "policy.json")
    with pytest.raises(PdkitError, match="cannot be replaced"):
        save("/", "one")


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    save(tmp_path / "disk" / "p", "one")
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "p")
    save(tmp_path / "link", "two")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "disk" / "p" / "policy.json").read_text() == "two"


def test_a_folder_that_cannot_be_read_is_one_sentence(tmp_path, monkeypatch):
    def refuse(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(PdkitError, match="No permission"):
        check_replaceable(tmp_path, "policy.json")


@pytest.mark.parametrize("own", [False, True])
def test_what_a_killed_process_moved_away_is_put_back(tmp_path, own):
    """Killed between the two renames: only the old folder, under another name, and the new one, under a third, are left. In a restarted
    container this process may have the number of the killed one."""
    killed = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True, check=True)
    number = os.getpid() if own else int(killed.stdout)
    for name, text in (("old-", "old"), ("", "new")):
        folder = tmp_path / f"checkpoint.tmp-{name}{number}"
        folder.mkdir()
        (folder / "state.json").write_text(text)
    alive = tmp_path / f"checkpoint.tmp-{os.getppid()}"
    alive.mkdir()
    recover(tmp_path / "checkpoint")
    assert (tmp_path / "checkpoint" / "state.json").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint", alive.name]


def test_one_process_at_a_time_works_behind_a_lock(tmp_path, monkeypatch):
    path = tmp_path / "lock"
    other = [sys.executable, "-c", "import sys; from pdkit.files import locked\nwith locked(sys.argv[1], 'busy now'): pass", str(path)]
    with locked(path, "unused"):
        held = subprocess.run(other, capture_output=True, text=True)
    assert held.returncode and "PdkitError: busy now" in held.stderr
    assert subprocess.run(other).returncode == 0  # it is free again
    with pytest.raises(PdkitError, match="Cannot write .*lock: No such file"):
        with locked(tmp_path / "none" / "lock", "unused"):
            pass
    entered = []
    monkeypatch.setattr("pdkit.files.fcntl.flock", refuse)  # a disk without locks: work goes on
    with locked(path, "unused"):
        entered.append(True)
    assert entered


def refuse(*_):
    raise OSError(errno.ENOLCK, "No locks available")


def test_a_run_that_another_code_resumes_names_both(tmp_path, monkeypatch):
    """What was computed half by one commit, half by another is neither's; opening it again with the same one adds nothing."""
    def opened():
        run = runs.Run(tmp_path, "online", {"a": 1})
        with run.alone():
            return run

    found = {"git": "one", "cores": 2}
    monkeypatch.setattr(runs, "describe_machine", lambda: dict(found))
    runs.Run(tmp_path, "online", {"a": 1})
    assert runs.commits(runs.Run(tmp_path, "online", {"a": 1}).manifest) == "one"
    found["git"] = "two"
    for _ in range(2):
        assert runs.commits(opened().manifest) == "one then two"
    runs.Run(tmp_path, "online", {"a": 1}).finish()
    found["git"] = "three"  # only reads what is finished
    manifest = opened().manifest
    assert runs.commits(manifest) == "one then two" and len(manifest["resumed"]) == 1


def test_what_cannot_be_written_is_told_before_the_work(tmp_path):
    check_writable(tmp_path / "new" / "file.json")
    assert list((tmp_path / "new").iterdir()) == []
    (tmp_path / "file").write_text("x")
    for path, told in ((tmp_path, "is a folder; name a file"), (tmp_path / "file" / "below", "Cannot write .*below")):
        with pytest.raises(PdkitError, match=told):
            check_writable(path)
