"""doctor: each problem is found, named with its fix, and only what the main job needs is a failure."""
import json
import os

import pytest

from pdkit import cli, doctor
from pdkit.doctor import Check
from pdkit.files import sha256


def statuses(checks):
    return [check.status for check in checks]


def test_a_crash_or_a_hang_in_a_probe_is_a_line(monkeypatch):
    assert doctor.probe("print('a'); print('b')") == (True, "b")
    assert doctor.probe("import os; os.abort()")[1].startswith("crashed with signal 6")
    assert doctor.probe("raise OSError('no driver')") == (False, "OSError: no driver")
    monkeypatch.setattr(doctor, "TIMEOUT", 0.5)
    assert doctor.probe("import time; time.sleep(9)") == (False, "no answer within 0.5 s")


def test_packages_are_compared_with_environment_txt(tmp_path):
    environment = tmp_path / "environment.txt"
    environment.write_text("# a comment\nnumpy==1.26.4  # why\npytest==0.1\nsurely-not-installed==1.0\n-e .\n")
    checks = doctor.check_packages(environment)
    assert statuses(checks) == ["WARN", "FAIL"]
    assert "tested with 0.1" in checks[0].text and "surely-not-installed" in checks[1].text
    assert all(check.fix for check in checks)


def test_a_build_of_the_pinned_version_is_that_version(tmp_path, monkeypatch):
    environment = tmp_path / "environment.txt"
    environment.write_text("torch==2.13.0\n")
    for version, status in (("2.13.0+cpu", "OK"), ("2.13.0+cu130", "OK"), ("2.13.1", "WARN")):
        monkeypatch.setattr(doctor.metadata, "version", lambda name, version=version: version)
        assert statuses(doctor.check_packages(environment)) == [status]


def test_data_are_compared_with_their_checksums(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "DATA", tmp_path)
    assert statuses(doctor.check_data()) == ["FAIL"]
    for name in ("good", "altered"):
        (tmp_path / name).write_text(name)
    sums = {name: sha256(tmp_path / name) for name in ("good", "altered")}
    (tmp_path / "checksums.json").write_text(json.dumps(sums))
    assert statuses(doctor.check_data()) == ["OK"]
    (tmp_path / "altered").write_text("x")
    (tmp_path / "checksums.json").write_text(json.dumps({**sums, "gone": "0"}))
    checks = doctor.check_data()
    assert [(c.status, c.text) for c in checks] == [("FAIL", "missing: gone"), ("FAIL", "altered: altered")]
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "x.csv").write_text("recorded since")
    (tmp_path / "checksums.json").write_text(json.dumps({"good": sums["good"], "results/x.csv": "0"}))
    assert [(c.status, c.text) for c in doctor.check_data()] == [("WARN", "other results than the shipped ones: results/x.csv")]
    (tmp_path / "checksums.json").write_text("{")
    assert statuses(doctor.check_data()) == ["FAIL"]


def test_a_runs_folder_that_cannot_be_written_is_a_failure(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path / "file" / "runs"))
    assert statuses(doctor.check_disk())[1] == "FAIL"
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path / "runs"))
    assert statuses(doctor.check_disk())[1] == "OK"
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1e8}))
    assert statuses(doctor.check_disk()) == ["FAIL", "OK"]


@pytest.mark.parametrize("answers, expected", [
    ({"egl": True, "osmesa": False, "glfw": False}, ["OK", "--", "--"]),
    ({"egl": False, "osmesa": False, "glfw": False}, ["WARN", "WARN", "WARN"]),
])
def test_one_way_to_draw_is_enough(monkeypatch, answers, expected):
    monkeypatch.setattr(doctor.sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(doctor, "probe", lambda code, env: (answers[env["MUJOCO_GL"]], "said"))
    assert statuses(doctor.check_mujoco_pictures()) == expected
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert statuses(doctor.check_mujoco_pictures())[len(expected):] == (["WARN"] if answers["egl"] else [])


def test_more_threads_than_cores_is_a_warning(monkeypatch):
    seen = {"version": "2", "threads": 10_000, "float32": 100.0, "bfloat16": 300.0, "cuda": ""}
    monkeypatch.setattr(doctor, "probe", lambda code: (True, json.dumps(seen)))
    torch, threads, bf16 = doctor.check_torch()
    assert (torch.status, threads.status, bf16.status) == ("OK", "WARN", "OK") and "OMP_NUM_THREADS" in threads.fix
    seen.update(threads=1, bfloat16=50.0)
    monkeypatch.setattr(doctor, "cpu_has_bf16", lambda: False)
    assert statuses(doctor.check_torch()) == ["OK", "OK", "--"]
    monkeypatch.setattr(doctor, "cpu_has_bf16", lambda: True)
    assert statuses(doctor.check_torch()) == ["OK", "OK", "WARN"]


@pytest.mark.parametrize("status, code", [("OK", 0), ("WARN", 0), ("--", 0), ("FAIL", 1)])
def test_only_a_failure_fails(monkeypatch, capsys, status, code):
    monkeypatch.setattr(doctor, "CHECKS", (lambda: [Check("OK", "a", "fine"), Check(status, "b", "text", "mend it")],))
    assert cli.main(["doctor"]) == code
    out = capsys.readouterr().out
    assert f"[{status}]" in out and "fix: mend it" in out
    assert cli.main(["doctor", "--json"]) == code
    told = json.loads(capsys.readouterr().out)
    assert told["ok"] is (code == 0) and told["checks"][1]["fix"] == "mend it"


def test_the_real_simulators_and_torch_are_found(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", str(min(2, os.cpu_count())))
    assert doctor.check_simulators()[0].status == "OK"  # the main job's
    assert doctor.check_torch()[0].status == "OK"
    assert all(check.status in ("OK", "WARN") for check in doctor.check_sapien_pictures() + doctor.check_ffmpeg())
