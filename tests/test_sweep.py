"""Sweeps: refused before anything runs, failures and killed workers cost one job, a second go resumes, Ctrl-C ends children too."""
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import nbformat
import pandas as pd
import pytest
from sweep_jobs import job, play

from pdkit import cli, nb, profiles, recorded, report, sweep, sweep_jobs, sweep_ray, sweep_run
from pdkit.demos.sources import bundled
from pdkit.durations import evaluation_minutes, expected_minutes
from pdkit.errors import PdkitError
from pdkit.files import DATA, ROOT, read_json, write_json
from pdkit.methods.registry import method_config
from pdkit.policies import load_policy
from pdkit.policies.base import read_card
from pdkit.profiles import flat, online_config
from pdkit.runs import commit
from pdkit.sweep_progress import Progress
from pdkit.sweep_run import Job, Local, run_jobs
from pdkit.sweep_spec import load_spec


def ran(one: Job) -> int:
    path = one.folder / "ran"
    return len(path.read_text()) if path.exists() else 0


def gone(pid: int, seconds: float = 10.0) -> bool:
    """Whether a process ends (or is only a zombie) within some seconds."""
    for _ in range(int(seconds / 0.1)):
        try:
            if Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.1)
    return False


def pids(one: Job, seconds: float = 60.0) -> list[int]:
    path, deadline = one.folder / "pids", time.monotonic() + seconds
    while not (path.exists() and len(path.read_text().split()) == 2):
        assert time.monotonic() < deadline, "the job never started"
        time.sleep(0.05)
    return [int(word) for word in path.read_text().split()]


# ---- scheduling ------------------------------------------------------------------------------------------------------

def test_failures_and_a_killed_worker_cost_one_job_each_and_a_second_go_runs_only_those(tmp_path, capsys):
    jobs = [job(tmp_path, "a", value=3), job(tmp_path, "b", fail=True), job(tmp_path, "c", die=True), job(tmp_path, "d", crash=True),
            job(tmp_path, "e", value=5)]
    problems = sweep.sweep(jobs, Local(), 2, play)
    assert problems == {"T b seed 0": "It broke; mend it.", "T c seed 0": "it was killed by SIGKILL (is memory short?)",
                        "T d seed 0": "ZeroDivisionError: by nothing"}
    assert [one.result.exists() for one in jobs] == [True, False, False, False, True]
    assert read_json(jobs[4].result)["row"] == {"value": 5} and read_json(jobs[4].result)["parameters"] == {"value": 5}
    assert "Traceback" in (jobs[3].folder / "log.txt").read_text()  # what is no sentence of ours is kept for the reader
    out = capsys.readouterr().out
    assert out.startswith("5 jobs, 0 finished, 5 to do, 2 at a time: about 2 minutes\n")
    assert re.search(r"\n\w+ T . seed 0; 2 of 5 done, 0 running, 3 failed\n$", out)
    mended = [job(tmp_path, one.labels["recipe"], value=1) for one in jobs]
    assert sweep.sweep(mended, Local(), 2, play) == {}
    assert [ran(one) for one in jobs] == [1, 2, 2, 2, 1] and not (jobs[1].folder / "failed.txt").exists()


def test_no_more_than_the_limit_run_at_once_and_all_do(tmp_path):
    class Counting(Local):
        most = alive = 0

        def start(self, function, one):
            self.alive += 1
            self.most = max(self.most, self.alive)
            return super().start(function, one)

        def problem(self, handle, one):
            self.alive -= 1
            return super().problem(handle, one)

    jobs, backend = [job(tmp_path, name) for name in "abcd"], Counting()
    assert run_jobs(jobs, play, backend, 2, Progress(jobs, 0, 2)) == {}
    assert backend.most == 2 and all(one.result.exists() for one in jobs)


def test_what_a_killed_worker_started_is_killed_too(tmp_path):
    one = job(tmp_path, "a", sleep=True)

    class Killing(Local):
        def ended(self, handles, timeout):
            os.kill(pids(one)[0], signal.SIGKILL)
            return super().ended(handles, timeout)

    assert list(run_jobs([one], play, Killing(), 1, Progress([one], 0, 1))) == [one.name]
    assert gone(pids(one)[1], 2)


SCHEDULER = """
import sys; sys.path.insert(0, {tests!r})
from pathlib import Path
from sweep_jobs import job, play
if __name__ == "__main__":
    from pdkit.sweep import Local, sweep
    sweep([job(Path({folder!r}), "a", sleep=True), job(Path({folder!r}), "b")], Local(), 1, play)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_the_scheduler_takes_all_its_children_with_it(tmp_path, number):
    script = tmp_path / "scheduler.py"
    script.write_text(SCHEDULER.format(tests=str(Path(__file__).parent), folder=str(tmp_path)))
    process = subprocess.Popen([sys.executable, script], env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True)
    one, two = job(tmp_path, "a"), job(tmp_path, "b")
    worker, child = pids(one)
    started = time.monotonic()
    process.send_signal(number)
    assert "KeyboardInterrupt" in process.communicate()[1] or number == signal.SIGKILL
    assert gone(worker) and gone(child) and time.monotonic() - started < 15
    assert not one.result.exists() and not two.folder.exists()  # no result of half a job, nothing further started


def test_the_time_left_follows_what_jobs_alike_took(tmp_path):
    jobs = [job(tmp_path, "a1", 1.0), job(tmp_path, "a2", 1.0), job(tmp_path, "b1", 2.0)]
    assert Progress(jobs, 0, 1).seconds_left() == 240 and Progress(jobs, 0, 2).seconds_left() == 120
    assert Progress(jobs, 0, 4).seconds_left() == 120  # no sooner than the longest
    measured = [("a", 30.0, 1.0), ("b", 240.0, 2.0)]
    assert Progress(jobs, 2, 1, measured).seconds_left() == 30 + 30 + 240
    assert Progress(jobs, 1, 1, measured[:1]).seconds_left() == 30 + 30 + 60  # unknown b: as far off as the others
    late = Progress(jobs[:1], 0, 1)
    late.started(jobs[0])
    late.running[jobs[0].name] = (jobs[0], time.monotonic() - 500)  # it takes longer than expected
    assert late.text() == "0 of 1 done, 1 running, 0 failed, less than a minute left"
    unknown = [job(tmp_path, "n1", None), job(tmp_path, "n2", None)]
    assert Progress(unknown, 0, 1).seconds_left() is None and "not known yet" in Progress(unknown, 0, 1).text()
    assert Progress(unknown, 1, 1, [("n", 50.0, None)]).seconds_left() == 100


# ---- specs -----------------------------------------------------------------------------------------------------------

SPEC = {"name": "tiny", "kind": "train", "seeds": [0], "fixed": {"task": "Door", "profile": "smoke", "episodes": 2},
        "grid": {"alpha": [0.1, 0.3]}}
BOOK = {"name": "book", "kind": "notebook", "fixed": {"notebook": "05", "profile": "smoke"}, "grid": {"alpha": [0.1]}}

BASE = {"kind": "base", "fixed": {"task": "Door", "num_demos": 2, "episodes": 2, "eval_episodes": 0, "batch": 8},
        "grid": {"policy": ["mlp", "bet"], "iterations": [3]}}


UNMADE = {"fixed": {"task": "Door", "base": "runs/none/own"}}


def written(folder: Path, **changes) -> Path:
    path = folder / "spec.json"
    path.write_text(json.dumps({k: v for k, v in (SPEC | changes).items() if v is not None}))
    return path


def test_cells_of_lists_and_paths_have_names_that_folders_can_have(tmp_path):
    scales = [[1.0] * 28, [0.5] * 28]
    jobs = sweep_jobs.make_jobs(load_spec(written(tmp_path, grid={"alpha_scale": scales}, seeds=[0])))
    assert [job.labels["recipe"] for job in jobs] == [f"alpha_scale={'+'.join(map(str, scale))}" for scale in scales]
    spec = load_spec(written(tmp_path, grid={"base": ["runs/base/own"], "changes": [{"utd": 0.2}]}))
    assert spec.cells[0]["recipe"] == "base=runs-base-own,changes=utd=0.2"


def test_cells_are_the_grid_and_the_further_ones_by_each_seed(tmp_path):
    path = written(tmp_path, seeds=[0, 1], grid={"alpha": [0.1, 0.3], "H": [0, 100]},
                   cells=[{"critic_input": "concat"}, {"recipe": "other", "method": "residual_rl"}])
    jobs = sweep_jobs.make_jobs(load_spec(path))
    assert len(jobs) == (2 * 2 + 2) * 2 and len({one.folder for one in jobs}) == 12
    assert [one.labels["recipe"] for one in jobs] == 2 * [
        "alpha=0.1,H=0", "alpha=0.1,H=100", "alpha=0.3,H=0", "alpha=0.3,H=100", "critic_input=concat", "other"]
    assert jobs[6].command == ("pdkit train decorated Door --method policy_decorator --profile smoke --recipe alpha=0.1,H=0 --episodes 2 "
                               "--seeds 1 --set alpha=0.1 H=0")
    assert jobs[-1].config["alpha"] == 1.0 and jobs[0].minutes == expected_minutes(online_config("Door", "smoke", alpha=0.1, H=0), 2)


def test_a_training_takes_as_long_as_recorded_ones_of_its_recipe_or_else_method(tmp_path, monkeypatch):
    monkeypatch.setattr(recorded, "DATA", tmp_path)
    (tmp_path / "results").mkdir()
    path = written(tmp_path, record="timed", fixed=SPEC["fixed"] | {"total_steps": 1_000}, grid=None, cells=[
        {"recipe": "a", "H": 1}, {"recipe": "b", "H": 2}, {"recipe": "c", "method": "residual_rl"},
        {"recipe": "long", "total_steps": 9_000}])
    guide = [one.minutes for one in sweep_jobs.make_jobs(load_spec(path))]
    rows = pd.DataFrame({"task": "Door", "recipe": ["a", "a", "a", "other", "a"], "seed": [0, 1, 2, 0, 3],
                         "method": "policy_decorator", "train_minutes": [7.0, 8.0, 90.0, 40.0, None],
                         "env_steps": [1_000, 1_000, 1_000, 2_000, 1_000]})
    rows.to_csv(tmp_path / "results" / "timed.csv", index=False)
    tests = evaluation_minutes(2)
    a, b, c, long = (one.minutes for one in sweep_jobs.make_jobs(load_spec(path)))
    assert a == pytest.approx(8 + tests)  # the median of its recipe's, for as many steps
    assert b == pytest.approx((8 + 20) / 2 + tests)  # of the method's: 7, 8, 20 and 90
    assert [c, long] == guide[2:]  # another method; far more steps than were ever timed
    rows.drop(columns="method").to_csv(tmp_path / "results" / "timed.csv", index=False)
    assert [one.minutes for one in sweep_jobs.make_jobs(load_spec(path))] == guide


def test_a_cell_may_have_its_own_seeds(tmp_path):
    path = written(tmp_path, seeds=[1, 0], cells=[{"critic_input": "concat", "seeds": [0]}, {"critic_input": "residual", "seeds": [3, 0]}])
    jobs = sweep_jobs.make_jobs(load_spec(path))
    assert [(one.labels["recipe"], one.labels["seed"]) for one in jobs] == [
        ("alpha=0.1", 1), ("alpha=0.3", 1), ("alpha=0.1", 0), ("alpha=0.3", 0), ("critic_input=concat", 0), ("critic_input=residual", 0),
        ("critic_input=residual", 3)]


def test_a_toml_file_says_the_same_as_a_json_file(tmp_path):
    toml = tmp_path / "spec.toml"
    toml.write_text('name = "tiny"\nkind = "train"\nseeds = [0]\n[fixed]\ntask = "Door"\nprofile = "smoke"\nepisodes = 2\n'
                    "[grid]\nalpha = [0.1, 0.3]\n")
    assert sweep_jobs.make_jobs(load_spec(toml)) == sweep_jobs.make_jobs(load_spec(written(tmp_path)))


def test_a_job_is_what_its_command_does(tmp_path):
    """Over a base policy that acts in chunks, and for a task that is learned from another one's demonstrations."""
    def config(**fixed):
        return sweep_jobs.make_jobs(load_spec(written(tmp_path, fixed=fixed, grid={})))[0].config

    base = "data/checkpoints/StackCube/diffusion"
    chunked = config(task="StackCube", base=base)
    assert chunked == json.loads(json.dumps(flat(method_config("policy_decorator", "StackCube", policy=load_policy(ROOT / base))))) | {
        "base": read_card(ROOT / base)["weights_sha256"], "demos": bundled("StackCube").checksum, "num_demos": 300}
    assert chunked["gamma"] == 0.922 != config(task="StackCube")["gamma"]
    unmade = {"runs/none/own": {"task": "StackCube", "policy": "diffusion", "horizon": 8}}  # chunks of 4, as it will have
    path = written(tmp_path, fixed=dict(task="StackCube", base="runs/none/own"), grid={}, bases=unmade)
    assert sweep_jobs.make_jobs(load_spec(path))[0].config == {
        name: value for name, value in chunked.items() if name not in ("base", "demos", "num_demos")}
    shown = "data/demos/TurnFaucetSource.safetensors"
    assert config(task="TurnFaucet", demos=shown)["task"] == "TurnFaucet"
    with pytest.raises(PdkitError, match="holds demonstrations of TurnFaucetSource, not of Door"):
        config(task="Door", demos=shown)


def test_the_folder_follows_every_parameter_and_nothing_else(tmp_path):
    def folder(**changes):
        return sweep_jobs.make_jobs(load_spec(written(tmp_path, **changes)))[0].folder

    assert folder() == folder(seeds=[0, 1], grid={"alpha": [0.1]}, minutes=3, record="x")
    different = [folder(), folder(seeds=[1]), folder(grid={"alpha": [0.2]}), folder(fixed=SPEC["fixed"] | {"episodes": 3}),
                 folder(fixed=SPEC["fixed"] | {"method": "residual_rl"}), folder(name="other")]
    assert len(set(different)) == len(different)


@pytest.mark.parametrize("changes, said", [
    ({"girds": {}}, "Unknown key of spec.json 'girds'"),
    ({"kind": "trian"}, "Did you mean 'train'?"),
    ({"kind": None}, "Unknown kind in spec.json ''"),
    ({"seeds": [0, 0]}, "seeds must be different"),
    ({"seeds": [-1]}, "seeds must be different"),
    ({"seeds": 3}, "seeds must be a list"),
    ({"name": "a/b"}, "name must be a word"),
    ({"record": "../x"}, "record must be a word"),
    ({"minutes": 0}, "minutes must be a number above 0"),
    ({"grid": {"alpha": 0.1}}, "grid holds lists"),
    ({"grid": {"alpha": []}}, "grid holds lists"),
    ({"grid": {"episodes": [1]}}, "given in fixed and in grid"),
    ({"grid": {"seed": [1]}}, "give seeds at the top"),
    ({"fixed": {"seeds": [1]}}, "give seeds at the top"),
    ({"cells": [{"alpha": 0.5, "seeds": [1, 1]}]}, "seeds must be different"),
    ({"cells": [3]}, "cells must be a list of tables"),
    ({"fixed": {"task": "Dor"}}, "Did you mean 'Door'?"),
    ({"fixed": {}}, "a training needs a task"),
    ({"grid": {"method": ["sac_fintune"]}}, "Did you mean 'sac_finetune'?"),
    ({"grid": {"alhpa": [0.1]}}, "Did you mean 'alpha'?"),
    ({"grid": {"alpha": [0.1, 7.0]}}, "must be in (0, 1], not 7.0"),
    ({"grid": {"alpha": ["wide"]}}, "alpha must be of type float"),
    ({"fixed": {"task": "Door", "profile": "fast"}}, "Unknown profile 'fast'"),
    ({"fixed": {"task": "Door", "episodes": 0}}, "episodes must be a whole number"),
    ({"fixed": {"task": "Door", "base": "runs/none"}}, "runs/none/policy.json does not exist"),
    ({"fixed": {"task": "Door", "demos": "runs/none.safetensors"}}, "none.safetensors"),
    ({"cells": [{"alpha": 0.1, "recipe": "a/b"}]}, "Give the cell 'a/b' a recipe"),
    ({"cells": [{"alpha": 0.1, "recipe": "again"}]}, "alpha=0.1 and again are the same job"),
    ({"cells": [{"alpha": 0.2, "recipe": "alpha=0.1"}]}, "are called the same"),
    ({"bases": {"data/own": {"task": "Door"}}}, "a base policy that a sweep makes lies below runs/"),
    ({"bases": {"runs/../own": {"task": "Door"}}}, "not in 'runs/../own'"),
    ({"bases": {"runs/base/own": {"task": "Door", "sha256": "12"}}}, "the sha256 of runs/base/own must be 64 hexadecimal digits, not '12'"),
    ({"bases": {"runs/base/own": 3}}, "what makes runs/base/own is a table with a task"),
    (BASE | {"bases": {"runs/base/own": {"task": "Door"}}}, "bases are for kind = \"train\", not for 'base'; leave them out"),
    (UNMADE | {"bases": {"runs/none/own": {"policy": "mlp"}}}, "what makes runs/none/own is a table with a task"),
    (UNMADE | {"bases": {"runs/none/own": {"task": "Door", "recipe": "x"}}}, "without a recipe"),
    (UNMADE | {"bases": {"runs/none/own": {"task": "Pen", "policy": "mlp"}}}, "the base policy runs/none/own is one of Pen, not Door"),
    (UNMADE | {"bases": {"runs/none/own": {"task": "Door", "policy": "mpl"}}}, "Did you mean 'mlp'"),
    (UNMADE | {"bases": {"runs/none/own": {"task": "Door", "itrations": 3}}}, "'iterations'?"),
    (BASE | {"fixed": {}}, "a training needs a task"),
    (BASE | {"grid": {"policy": ["bett"]}}, "Did you mean 'bet'?"),
    (BASE | {"grid": {"iterrations": [3]}}, "Did you mean 'iterations'?"),
    (BASE | {"grid": {"batch": ["big"]}, "fixed": {"task": "Door"}}, "batch must be of type int"),
    (BASE | {"fixed": {"task": "Door", "num_demos": 99}}, "99"),
    (BASE | {"fixed": {"task": "Door", "num_demos": "5"}}, "num_demos must be a whole number of at least 1, not '5'"),
    (BASE | {"fixed": {"task": "Door", "num_demos": True}}, "num_demos must be a whole number"),
    (BASE | {"fixed": {"task": "Door", "demos": 3}}, "demos must be a word in quotes, not 3"),
    (BASE | {"grid": {}, "cells": [{"policy": ["bet"], "recipe": "x"}]}, "policy must be a word in quotes"),
    (BASE | {"grid": {"policy": ["bet"], "embed": ["big"]}}, "bet's embed must be a whole number"),
    (BASE | {"grid": {"policy": ["vinn"], "rows": [3]}}, "Unknown field 'rows'"),
    (BASE | {"fixed": {"task": "Door", "episodes": 0}}, "episodes must be a whole number"),
    (BOOK | {"fixed": {}}, "needs notebook"),
    (BOOK | {"fixed": {"notebook": "99"}}, "Unknown notebook '99'"),
    (BOOK | {"grid": {"alhpa": [0.1]}}, "Did you mean 'alpha'?"),
    (BOOK | {"grid": {"alpha": ["wide"]}}, "Parameter alpha must be float"),
])
def test_what_is_wrong_is_one_sentence_before_anything_runs(tmp_path, monkeypatch, capsys, changes, said):
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path / "runs"))
    assert cli.main(["sweep", str(written(tmp_path, **changes))]) == 2
    out, err = capsys.readouterr()
    assert said in err and len(err.strip().splitlines()) == 1 and out == "" and not (tmp_path / "runs").exists()


@pytest.mark.parametrize("name, text, said", [
    ("a.toml", "name = ", "is not a readable TOML file"), ("a.json", "{", "is not a readable JSON file"),
    ("a.json", "[]", "must hold a table"), ("a.yaml", "a: 1", "a .toml or .json file"), ("a.toml", None, "Cannot read"),
])
def test_files_that_are_no_spec_are_refused(tmp_path, capsys, name, text, said):
    if text is not None:
        (tmp_path / name).write_text(text)
    assert cli.main(["sweep", str(tmp_path / name)]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("words, said", [(["--workers", "0"], "at least 1"), (["--record", "a/b"], "--record takes a name")])
def test_bad_options_are_refused(tmp_path, capsys, words, said):
    assert cli.main(["sweep", str(written(tmp_path)), *words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("name", [path.stem for path in sorted((DATA / "sweeps").glob("*.toml"))])
def test_the_specs_of_the_recorded_results_are_right(name):
    """Each is recorded under its name (or its name's first word: RECORD_TASK), and compares on one task with one budget, the same
    evaluations and at least three seeds."""
    spec = load_spec(DATA / "sweeps" / f"{name}.toml")
    jobs = sweep_jobs.make_jobs(spec)
    assert spec.name == name and spec.record in (name, name.partition("_")[0])
    seeds = {}
    for one in jobs:
        seeds.setdefault((one.labels["task"], one.labels["recipe"]), []).append(one.labels["seed"])
    least = 1 if name == "objects" else 3  # it plays fixed policies on fixed episodes: no seed would change anything
    assert all(len(own) >= least and own == [*range(len(own))] for own in seeds.values())
    if spec.kind == "train":
        for task in {one.labels["task"] for one in jobs}:
            budgets = {(one.config["total_steps"], one.parameters["episodes"]) for one in jobs if one.labels["task"] == task}
            assert len(budgets) == 1


# ---- real jobs -------------------------------------------------------------------------------------------------------

@pytest.fixture
def results(tmp_path, monkeypatch):
    """data/results and runs/ in a temporary folder."""
    monkeypatch.setattr(recorded, "DATA", tmp_path / "data")
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path / "runs"))
    return tmp_path / "data" / "results"


def test_a_real_grid_of_two_trainings_is_recorded_and_skipped_the_second_time(tmp_path, results, capsys, monkeypatch):
    path = written(tmp_path)
    assert cli.main(["sweep", str(path), "--dry-run"]) == 0
    listed = capsys.readouterr().out
    assert listed.count("to do") == 2 and "--set alpha=0.3" in listed and not (tmp_path / "runs").exists()
    assert cli.main(["sweep", str(path), "--record", "tiny"]) == 0, capsys.readouterr().out
    table, curves = pd.read_csv(results / "tiny.csv"), pd.read_csv(results / "tiny_curves.csv")
    assert list(table.recipe) == ["alpha=0.1", "alpha=0.3"] and (table.env_steps >= 600).all() and (table.episodes == 2).all()
    assert list(table.sweep) == ["pdkit sweep spec.json --record tiny"] * 2  # no folder of this machine
    assert table.commit.str.removesuffix("+changes").tolist() == [commit().removesuffix("+changes")] * 2
    assert table.command[1] == ("pdkit train decorated Door --method policy_decorator --profile smoke --recipe alpha=0.3 --episodes 2 "
                                "--seeds 0 --set alpha=0.3")
    assert set(curves.recipe) == set(table.recipe) and curves.success_once.notna().sum() == 2
    manifest = read_json(results / "tiny_manifest.json")
    assert manifest["again"] == ["pdkit sweep spec.json --record tiny"] and len(manifest["machines"]) == 1
    assert (results / "tiny.png").exists()
    capsys.readouterr()
    monkeypatch.setattr(Local, "start", None)  # nothing may start again
    assert cli.main(["sweep", str(path), "--dry-run"]) == 0 and capsys.readouterr().out.count("finished") == 2
    assert cli.main(["sweep", str(path), "--record", "tiny"]) == 0
    assert "2 jobs, 2 finished, 0 to do" in capsys.readouterr().out and len(pd.read_csv(results / "tiny.csv")) == 2
    # The command of a row, by hand, records the same row, and tells as well what it was run with.
    one, other = sweep_jobs.make_jobs(load_spec(path))
    assert cli.main([*other.words, "--out", str(other.folder / "run"), "--record", "by_hand"]) == 0
    mine, theirs = pd.read_csv(results / "by_hand.csv").iloc[0], table.iloc[1]
    assert mine.decorated_success == theirs.decorated_success and mine.updates == theirs.updates
    told = recorded.settings_of("by_hand", results)[mine.settings]
    assert manifest["settings"][theirs.settings].items() <= told.items() and told["alpha"] == 0.3 and "seed" not in told
    # What ran with another recipe than the profile's of today is not passed off as the same.
    result = read_json(one.result)
    write_json(one.result, result | {"settings": result["settings"] | {"gamma": 0.5, "eval_workers": 9}})
    assert cli.main(["sweep", str(path)]) == 2
    assert "with other values of gamma than" in capsys.readouterr().err


def test_a_training_that_fails_is_told_with_its_own_sentence_and_the_other_is_kept(tmp_path, results, capsys, monkeypatch):
    path = written(tmp_path)
    broken, fine = sweep_jobs.make_jobs(load_spec(path))
    folder = broken.folder / "run" / "Door-alpha=0.1-seed0"
    write_json(folder / "manifest.json", {"kind": "decorated", "parameters": {"alpha": 0.9}})  # another run is in the way

    def run(one):
        return {"row": {}, "curve": []} if one == fine else sweep_run.run_job(one)

    class Here(Local):  # the same job function, in this process
        def start(self, function, one):
            try:
                write_json(one.result, sweep_run.work(run, one))
            except PdkitError as error:
                return str(error)
            return ""

        def ended(self, handles, timeout):
            return list(handles)

        def problem(self, handle, one):
            return handle

        def stop(self, handles):
            assert not handles

    monkeypatch.setattr(sweep, "Local", Here)
    assert cli.main(["sweep", str(path)]) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("FAILED Door alpha=0.1 seed 0: ") and "holds another run" in last and last.endswith("log.txt)")
    assert fine.result.exists() and not broken.result.exists()


def test_ctrl_c_is_told_with_what_is_kept_and_records_it(tmp_path, results, capsys, monkeypatch):
    def interrupted(jobs, *_):
        write_json(jobs[0].result, {"row": {"base_success": 0.5}, "curve": [], "seconds": 1.0})
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "run_jobs", interrupted)
    assert cli.main(["sweep", str(written(tmp_path)), "--record", "tiny"]) == 130
    assert "1 of 2 jobs are finished and kept" in capsys.readouterr().out
    assert list(pd.read_csv(results / "tiny.csv").recipe) == ["alpha=0.1"]


def test_some_of_the_seeds_tasks_and_recipes_alone(tmp_path, capsys):
    path = written(tmp_path, seeds=[0, 1, 2])
    assert cli.main(["sweep", str(path), "--seeds", "1", "2", "--recipes", "alpha=0.3", "--dry-run"]) == 0
    listed = capsys.readouterr().out
    assert listed.count("--recipe alpha=0.3 ") == listed.count("to do") == 2 and "--seeds 0" not in listed
    two = written(tmp_path, grid={"task": ["Door", "Pen"]}, fixed={"profile": "smoke", "episodes": 2})
    assert cli.main(["sweep", str(two), "--tasks", "Pen", "--dry-run"]) == 0
    listed = capsys.readouterr().out
    assert listed.count("train decorated Pen ") == listed.count("to do") == 1
    path = written(tmp_path, seeds=[0, 1, 2])
    for words, said in ((["--seeds", "7"], "Unknown seed of spec.json '7'; choose one of: 0, 1, 2."),
                        (["--tasks", "Door", "Pen"], "Unknown task of spec.json 'Pen'; choose one of: Door."),
                        (["--recipes", "alpha=0.3", "alpha=9"],
                         "Unknown recipe of spec.json 'alpha=9'; choose one of: alpha=0.1, alpha=0.3.")):
        assert cli.main(["sweep", str(path), *words, "--dry-run"]) == 2
        assert said in capsys.readouterr().err


def test_missing_leaves_out_what_is_recorded_by_the_same_command_alone(tmp_path, results, capsys, monkeypatch):
    """On another machine there are no run folders, only the recorded rows."""
    path = written(tmp_path)
    first, second = sweep_jobs.make_jobs(load_spec(path))
    assert sweep_jobs.missing([first, second], "tiny") == [first, second]  # nothing is recorded yet
    rows = pd.DataFrame([first.labels | {"command": first.command}, second.labels | {"command": second.command + " --set utd=1"}])
    recorded.record("tiny", rows, pd.DataFrame())
    assert sweep_jobs.missing([first, second], "tiny") == [second]
    started = []
    monkeypatch.setattr(sweep, "run_jobs", lambda jobs, *_: started.extend(jobs) or {})
    assert cli.main(["sweep", str(path), "--record", "tiny", "--missing"]) == 0
    assert started == [second] and len(pd.read_csv(results / "tiny.csv")) == 2
    recorded.record("tiny", pd.DataFrame([second.labels | {"command": second.command}]), pd.DataFrame())
    capsys.readouterr()
    for words in ([], ["--dry-run"]):
        assert cli.main(["sweep", str(path), "--record", "tiny", "--missing", *words]) == 0
        assert capsys.readouterr().out == "Nothing of it is missing in data/results/tiny.csv.\n" and started == [second]


def test_rows_whose_settings_have_changed_since_are_missing(tmp_path, results):
    """By the fields that both have: one that is newer than the row makes it no older."""
    for values, name in ((BOOK | {"grid": None, "cells": [{"recipe": "a"}], "seeds": [0]}, "alpha"), ({"grid": {"alpha": [0.1]}}, "utd")):
        job = sweep_jobs.make_jobs(load_spec(written(tmp_path, **values)))[0]
        without = {key: value for key, value in job.settings.items() if key != name}
        for settings, gone in ((job.settings, []), (without, []), (without | {name: 0.77}, [job]), (None, [])):
            mark = settings and recorded.mark(settings)
            row = pd.DataFrame([job.labels | {"command": job.command, recorded.SETTINGS: mark}])
            recorded.record("marked", row, pd.DataFrame(), settings and {mark: settings})
            assert sweep_jobs.missing([job], "marked") == gone
            assert recorded.settings_of("marked") == ({mark: settings} if settings else {})
        assert recorded.mark(without)[0] == "s" and len(recorded.mark(without)) == 13  # never a number to pandas


def test_a_base_policy_that_the_sweep_makes_is_told_by_what_makes_it(tmp_path):
    """Its weights are others on each machine, made or not."""
    def settings(**base):
        spec = written(tmp_path, fixed=dict(task="StackCube", profile="smoke", episodes=2, base="runs/none/own"), grid={}, seeds=[0],
                       bases={"runs/none/own": {"task": "StackCube", "policy": "mlp"} | base})
        return sweep_jobs.make_jobs(load_spec(spec))[0].settings

    usual = settings()
    assert usual["base: policy"] == "mlp" and "base" not in usual and "base: demos_checksum" in usual
    assert recorded.unlike(usual, settings(iterations=77)) == ["base: iterations"]
    assert "base: demos_checksum" in recorded.unlike(usual, settings(num_demos=5))


def test_settings_are_those_of_the_profile_and_of_the_notebooks_defaults(tmp_path, monkeypatch):
    """Both decide what a job computes, and neither is among the spec's values."""
    path = written(tmp_path, seeds=[0, 1])
    def marks():
        return [recorded.mark(job.settings) for job in sweep_jobs.make_jobs(load_spec(path))]

    before = marks()
    assert len(set(before)) == 2 and before[:2] == before[2:]  # a recipe's, whatever the seed
    monkeypatch.setitem(profiles._SMOKE, "utd", 0.5)
    assert not set(before) & set(marks())

    book = tmp_path / "own.ipynb"
    cell = 'profile = "smoke"\nout = ""\nlr = {}\nseed = 0\nthreads = {}'
    spec = load_spec(written(tmp_path, **BOOK | {"grid": None, "fixed": {"notebook": str(book)}, "cells": [{"recipe": "a"}], "seeds": [0]}))

    def settings(lr, threads=1):
        source = nbformat.v4.new_code_cell(cell.format(lr, threads), metadata={"tags": ["parameters"]})
        nbformat.write(nbformat.v4.new_notebook(cells=[source]), book)
        job, = sweep_jobs.make_jobs(spec)
        return job, recorded.mark(job.settings)

    job, mark = settings(0.1)
    write_json(job.result, {"settings": job.config, "seconds": 1.0})
    assert sweep_jobs.finished(job) and settings(0.1, threads=2)[1] == mark
    changed, other = settings(0.9)
    assert other != mark
    with pytest.raises(PdkitError, match="other values of lr than"):
        sweep_jobs.finished(changed)


def test_a_notebook_without_a_seed_runs_once(tmp_path):
    book = tmp_path / "own.ipynb"
    cell = nbformat.v4.new_code_cell('profile = "smoke"\nout = ""', metadata={"tags": ["parameters"]})
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), book)
    values = BOOK | {"grid": None, "fixed": {"notebook": str(book)}, "cells": [{"recipe": "a"}]}
    job, = sweep_jobs.make_jobs(load_spec(written(tmp_path, **values | {"seeds": [0]})))
    assert not [word for word in job.words if word.startswith("seed=")]
    with pytest.raises(PdkitError, match="own has no parameter `seed`"):
        sweep_jobs.make_jobs(load_spec(written(tmp_path, **values | {"seeds": [0, 1]})))


def test_rows_of_one_recipe_that_were_made_otherwise_are_told(results, capsys):
    command = "pdkit train decorated Door --method rot --profile lesson --recipe {} --episodes 60 --seeds {} --set total_steps={}"
    rows = pd.DataFrame([{"task": "Door", "recipe": recipe, "seed": seed, "command": command.format(recipe, seed, steps), "settings": mark}
                         for recipe, seed, steps, mark in (("a", 0, 40_000, None), ("a", 1, 80_000, None), ("b", 0, 40_000, "s1"),
                                                           ("b", 1, 40_000, "s2"), ("c", 0, 40_000, "s1"), ("c", 1, 40_000, None),
                                                           ("c", 2, 40_000, "s3"))])
    settings = {"s1": {"utd": 0.1, "alpha": 1}, "s2": {"utd": 0.2}, "s3": {"alpha": 1, "newer": 0}}
    recorded.record("mix", rows, pd.DataFrame(), settings)
    said = capsys.readouterr().out
    assert [f"of Door {recipe} were run with different settings" in said for recipe in "abc"] == [True, True, False]
    problems = report.table_problems("mix", rows, results)
    assert recorded.mixed("mix", rows, settings) == [line for line in problems if "different" in line] != []


@pytest.mark.parametrize("other, same", [
    ("pdkit train decorated Door --seeds 1 --method policy_decorator --threads 1 --set env_workers=0 utd=1 alpha=0.1 --record x", True),
    ("pdkit train decorated Door --seeds 1 --set utd=1 alpha=0.2", False),
    ("pdkit train decorated Door --seeds 2 --set alpha=0.1 utd=1", False),
    ("pdkit train decorated Pen --seeds 1 --set alpha=0.1 utd=1", False), ("pdkit train decorated Door --seeds 1 --set alpha=0.1", False),
    ("pdkit train decorated Door --seeds 1 --pixels --set alpha=0.1 utd=1", False)])
def test_commands_are_the_same_where_what_differs_makes_no_difference(other, same):
    assert (recorded.essence(other) == recorded.essence("pdkit train decorated Door --seeds 1 --set alpha=0.1 utd=1")) == same


def test_the_main_jobs_recorded_rows_are_those_of_its_sweep():
    """They were made one by one, by other words."""
    spec = load_spec(DATA / "sweeps" / "main_job.toml")
    todo = sweep_jobs.missing([job for job in sweep_jobs.make_jobs(spec) if job.labels["seed"] == 0], "main_job")
    assert not todo


def test_the_same_sweep_does_not_run_twice_at_once(tmp_path, results, capsys):
    with sweep._alone("tiny"):
        assert cli.main(["sweep", str(written(tmp_path))]) == 2
    assert "is running already" in capsys.readouterr().err


def test_a_notebook_is_run_with_each_value_and_its_result_becomes_a_row(tmp_path, results, monkeypatch, capsys):
    """One that fails is told with its error, costs the others nothing, and is all that a second go runs."""
    books, mended = ROOT / "notebooks", tmp_path / "mended"
    end = f"import os\nassert word != 'broken' or os.path.exists({str(mended)!r}), 'no, the word is broken'\nfrom pdkit import nb\n" \
          "nb.finish({'seen': word * 2, 'part': {'total': sum(list) + seed}, 'all': list}, out)"
    cells = [nbformat.v4.new_code_cell('profile = "smoke"  # p\nout = ""  # o\nseed = 0  # s\nword = "x"  # w\nlist = [0]  # l'),
             nbformat.v4.new_code_cell(end)]
    cells[0].metadata["tags"] = ["parameters"]
    name = f"tmp_sweep_{os.getpid()}"
    path = books / f"{name}.ipynb"
    try:
        nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
        spec = written(tmp_path, **BOOK | {"fixed": {"notebook": name, "list": [2, 3]}, "grid": {"word": ["a b", "1"]}, "seeds": [4],
                                           "cells": [{"word": "c", "recipe": "c d"}]})
        assert cli.main(["sweep", str(spec)]) == 2  # a blank in a name that was given
        spec = written(tmp_path, **BOOK | {"fixed": {"notebook": name, "list": [2, 3]}, "grid": None, "seeds": [4],
                                           "cells": [{"word": "a b", "recipe": "ab"}, {"word": "broken", "recipe": "bad"},
                                                     {"word": "1", "recipe": "one"}]})
        assert cli.main(["sweep", str(spec), "--record", "book", "--workers", "1"]) == 1
        told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAILED")]
        assert len(told) == 1 and "bad" in told[0] and "no, the word is broken" in told[0]
        assert list(pd.read_csv(results / "book.csv").recipe) == ["ab", "one"]
        mended.touch()
        assert cli.main(["sweep", str(spec), "--record", "book", "--workers", "1"]) == 0
        assert "3 jobs, 2 finished, 1 to do" in capsys.readouterr().out
        cells[1].source += "  # a remark changes nothing"
        nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
        assert cli.main(["sweep", str(spec), "--record", "book", "--workers", "1"]) == 0
        folders = [job.folder for job in sweep_jobs.make_jobs(load_spec(spec))]
        cells[1].source += "\nword = 'another'"
        nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
        assert cli.main(["sweep", str(spec), "--record", "book", "--workers", "1"]) == 2  # what it did is not what it now does
        told = capsys.readouterr().err
        assert "3 jobs were finished with other values than" in told and all(str(f) in told for f in folders)
        for old in folders[1:]:
            shutil.rmtree(old)
        assert cli.main(["sweep", str(spec), "--dry-run"]) == 2
        assert "other values of the notebook's code" in capsys.readouterr().err
        elsewhere = tmp_path / "submitted" / "05_policy_decorator.ipynb"  # not the kit's own of that name
        elsewhere.parent.mkdir()
        path.rename(elsewhere)
        spec = written(tmp_path, **BOOK | {"fixed": {"notebook": str(elsewhere)}, "grid": None, "seeds": [4]})
        given, = sweep_jobs.make_jobs(load_spec(spec))
        assert given.words[:2] == ("nb", str(elsewhere)) and given.labels["task"] == "05_policy_decorator"
    finally:
        path.unlink(missing_ok=True)
    table = pd.read_csv(results / "book.csv", dtype=str)
    assert list(table.seen) == ["a ba b", "brokenbroken", "11"] and set(table["part.total"]) == {"9"} and set(table.seed) == {"4"}
    assert "all" not in table and not (results / "book_curves.csv").exists() and nb.notebooks().get(name) is None


def test_base_policies_are_trained_and_tested_and_what_they_solve_becomes_a_row(tmp_path, results, capsys, monkeypatch):
    path = written(tmp_path, **BASE, seeds=[3])
    assert cli.main(["sweep", str(path), "--record", "bases"]) == 0, capsys.readouterr().out
    table = pd.read_csv(results / "bases.csv").set_index("recipe")
    assert list(table.index) == ["policy=bet,iterations=3", "policy=mlp,iterations=3"] and list(table.policy) == ["bet", "mlp"]
    assert (table[["demos", "iteration", "episodes", "seed"]] == [2, 3, 2, 3]).all(axis=None) and table.base_success.between(0, 1).all()
    assert table.command["policy=mlp,iterations=3"] == ("pdkit train base Door --policy mlp --num-demos 2 --episodes 2 --set "
                                                        "eval_episodes=0 batch=8 iterations=3 seed=3")
    assert not (results / "bases_curves.csv").exists() and not (results / "bases.png").exists()
    one = sweep_jobs.make_jobs(load_spec(path))[0]
    card = read_card(one.folder / "run")
    assert card["info"]["test"]["episodes"] == 2 and card["info"]["imitate"]["seed"] == 3
    capsys.readouterr()
    monkeypatch.setattr(Local, "start", None)  # nothing may start again
    assert cli.main(["sweep", str(path)]) == 0 and "2 jobs, 2 finished, 0 to do" in capsys.readouterr().out
    result = read_json(one.result)
    assert result["row"]["device"] in ("cpu", "cuda") and set(one.config) <= set(result["settings"])
    for name, then in (("lr", 0.5), ("hidden", 7), ("demos_checksum", "another file's")):
        write_json(one.result, result | {"settings": result["settings"] | {name: then}})
        assert cli.main(["sweep", str(path)]) == 2 and f"with other values of {name} than" in capsys.readouterr().err


@pytest.fixture
def own_base():
    """A folder for a base policy where specs may have theirs: below the project's runs/."""
    folder = f"runs/tests/base-{os.getpid()}"
    yield folder
    shutil.rmtree(ROOT / folder, ignore_errors=True)
    for empty in (ROOT / "runs" / "tests", ROOT / "runs"):
        with contextlib.suppress(OSError):
            empty.rmdir()


def test_a_base_policy_that_is_not_there_is_made_first(tmp_path, results, capsys, monkeypatch, own_base):
    made = {"task": "Door", "policy": "mlp", "num_demos": 2, "episodes": 2, "iterations": 3, "batch": 8, "eval_episodes": 0, "seed": 4}
    path = written(tmp_path, grid=None, cells=[{"recipe": "over", "base": own_base}, {"recipe": "shipped"}], bases={own_base: made})
    words, makes = ["sweep", str(path), "--record", "over"], ("pdkit train base Door --policy mlp --num-demos 2 --episodes 2 --set "
                                                              f"iterations=3 batch=8 eval_episodes=0 seed=4 --out {own_base}")
    one = sweep_jobs.make_jobs(load_spec(path))[0]
    assert "base" not in one.config
    assert cli.main([*words, "--dry-run"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert listed[0].endswith(makes) and len(listed) == 3
    assert cli.main([*words, "--dry-run", "--recipes", "shipped"]) == 0 and makes not in capsys.readouterr().out  # nobody needs it
    assert cli.main(words) == 0 and f"base policies first: {own_base}\n" in capsys.readouterr().out
    card = read_card(ROOT / own_base)
    assert card["info"]["imitate"]["seed"] == 4 and card["kind"] == "mlp"
    row = pd.read_csv(results / "over.csv").set_index("recipe").loc["over"]
    assert row.policy == "mlp" and f"--base {own_base} " in row.command
    assert sweep_jobs.make_jobs(load_spec(path))[0].config["base"] == card["weights_sha256"]
    assert cli.main(words) == 0 and "base policies" not in capsys.readouterr().out
    for sha, told in ((card["weights_sha256"], False), ("0" * 64, True)):
        written(tmp_path, grid=None, cells=[{"recipe": "over", "base": own_base}], bases={own_base: made | {"sha256": sha}})
        assert cli.main(words) == 0 and ("its weights are not the same" in capsys.readouterr().out) == told  # and nothing runs anew
    assert sweep_jobs.make_jobs(load_spec(path))[0].name == one.name
    shutil.rmtree(one.folder)
    written(tmp_path, grid=None, cells=[{"recipe": "over", "base": own_base}], bases={own_base: made | {"lr": 0.5, "policy": "cnn"}})
    assert cli.main(words) == 2  # the policy that is there is not the one that the spec describes now
    differing = "hidden, lr, policy, window"
    assert capsys.readouterr().err.startswith(f"{own_base} was made with other values of {differing} than spec.json gives it; delete it")


def test_a_base_policy_that_cannot_be_made_costs_its_own_trainings_alone(tmp_path, results, capsys, monkeypatch, own_base):
    made = {"task": "Door", "policy": "mlp", "num_demos": 2, "iterations": 3}
    cells, ran = [{"recipe": "over", "base": own_base}, {"recipe": "shipped"}], []
    path = written(tmp_path, grid=None, cells=cells, bases={own_base: made}, minutes=9)
    monkeypatch.setattr(sweep, "sweep", lambda jobs, *_: ran.append(list(jobs)) or {one.name: "It broke." for one in jobs if one.out})
    assert cli.main(["sweep", str(path)]) == 1
    (base,), trained = ran
    assert [one.labels["recipe"] for one in trained] == ["shipped"] and base.minutes is None  # the spec's are a training's
    told = f"FAILED Door over seed 0: its base policy could not be made: It broke (log: {base.folder / sweep_run.LOG})"
    assert told in capsys.readouterr().out.splitlines()


def test_a_path_among_the_settings_of_a_base_policy_is_the_projects_wherever_the_sweep_is_started(tmp_path, monkeypatch):
    cell = {"recipe": "x", "policy": "vinn", "representation": "data/checkpoints/Door/bet-sac"}
    path = written(tmp_path, **BASE | {"fixed": {"task": "Door"}, "grid": None, "cells": [cell]})
    monkeypatch.chdir(tmp_path)
    assert sweep_jobs.make_jobs(load_spec(path))[0].config["representation"]["kind"] == "bet-sac"


# ---- Ray -------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("words", [["--ray"], ["--address", "10.0.0.1:6379"]])
def test_a_missing_ray_is_one_clear_sentence(tmp_path, monkeypatch, capsys, words):
    monkeypatch.setattr(sweep_ray, "find_spec", lambda name: None)
    assert cli.main(["sweep", str(written(tmp_path)), *words]) == 2
    assert capsys.readouterr().err == ("Ray is not installed; run `pip install ray`, or leave out --ray and --address to use local "
                                       "workers.\n")


class FakeRay:
    """What sweep_ray.py uses of Ray, so that it is tested where Ray is not installed; the real one: below."""

    class exceptions:  # noqa: N801
        RayError = type("RayError", (Exception,), {})
        RayTaskError = type("RayTaskError", (RayError,), {})

    def __init__(self, cpus=6.0, refuses=None):
        self.cpus, self.refuses, self.calls = cpus, refuses, []

    def init(self, **words):
        self.calls.append(("init", words))
        if self.refuses:
            raise self.refuses

    def cluster_resources(self):
        return {"CPU": self.cpus}

    def remote(self, **words):
        self.calls.append(("remote", words))
        return lambda function: types.SimpleNamespace(remote=lambda *given: (function, given))

    def get(self, handle):
        if isinstance(handle, Exception):
            raise handle
        return handle

    def cancel(self, handle):
        self.calls.append(("cancel", handle))

    def wait(self, handles, **words):
        self.calls.append(("wait", words))
        raise self.exceptions.RayError("the cluster is gone")

    def shutdown(self):
        self.calls.append(("shutdown", None))


@pytest.fixture
def fake_ray(monkeypatch):
    fake = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setattr(sweep_ray, "find_spec", lambda name: True)
    monkeypatch.setenv("RAY_kill_child_processes_on_worker_exit_with_raylet_subreaper", "true")  # put back after the test
    return fake


def test_a_cluster_decides_how_many_jobs_run_and_no_job_is_tried_twice(fake_ray, monkeypatch):
    monkeypatch.setenv("PDKIT_PARTNET", "/objects")
    backend = sweep_ray.Ray("10.0.0.1:6379", None)
    (_, asked), (_, task) = fake_ray.calls
    assert asked["runtime_env"]["env_vars"]["PDKIT_PARTNET"] == "/objects"  # its rows will be called so
    assert backend.limit == 6 and asked["address"] == "10.0.0.1:6379" and "num_cpus" not in asked
    assert asked["runtime_env"]["env_vars"]["PYTHONPATH"].startswith(str(sweep_ray.ROOT)) and task == {"num_cpus": 1, "max_retries": 0}
    assert sweep_ray.Ray("10.0.0.1:6379", 3).limit == 3
    assert sweep_ray.Ray(None, None).limit == 6 and fake_ray.calls[-2][1]["address"] == "local" and fake_ray.calls[-2][1]["num_cpus"] == 2
    assert backend.start(play, "job") == (sweep_ray.on_ray, (play, "job"))


def test_a_cluster_that_is_not_there_is_one_sentence(fake_ray):
    fake_ray.refuses = ConnectionError("no route to host.")
    with pytest.raises(PdkitError, match=r"^Ray does not start at 10.0.0.1:1: .*no route to host\.$"):
        sweep_ray.Ray("10.0.0.1:1", None)


def test_what_became_of_a_job_on_ray(tmp_path, fake_ray):
    backend, one = sweep_ray.Ray(None, 2), job(tmp_path, "a", value=3)
    assert backend.problem({"row": {"value": 3}}, one) == "" and read_json(one.result) == {"row": {"value": 3}}
    failed = FakeRay.exceptions.RayTaskError()
    failed.cause = PdkitError("It broke; mend it.")
    assert backend.problem(failed, one) == "It broke; mend it."
    crashed = type("WorkerCrashedError", (FakeRay.exceptions.RayError,), {})()
    assert backend.problem(crashed, one) == "its worker was lost (WorkerCrashedError)"
    assert "JSON" in backend.problem({"row": object()}, one)


def test_stopping_cancels_every_job_on_ray_and_shuts_it_down_even_if_it_does_not_answer(fake_ray):
    backend = sweep_ray.Ray(None, 2)
    del fake_ray.calls[:]
    backend.stop(["a", "b"])
    assert [name for name, _ in fake_ray.calls] == ["cancel", "cancel", "wait", "shutdown"]
    assert fake_ray.calls[2][1] == {"num_returns": 2, "timeout": 10.0}


def test_the_same_jobs_on_ray_fail_alone_too(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    path = filter(None, (str(Path(__file__).parent), os.environ.get("PYTHONPATH")))  # where Ray's workers find `play`
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    jobs = [job(tmp_path, "a", value=3), job(tmp_path, "b", fail=True), job(tmp_path, "c", die=True), job(tmp_path, "d", value=5),
            job(tmp_path, "e", command=["sh", "-c", "exit 7"])]
    backend = sweep_ray.Ray(None, 2)
    assert backend.limit == 2
    problems = sweep.sweep(jobs, backend, backend.limit, play)
    assert problems["T b seed 0"] == "It broke; mend it." and "worker was lost" in problems["T c seed 0"] and len(problems) == 2
    assert read_json(jobs[3].result)["row"] == {"value": 5}
    assert read_json(jobs[4].result)["row"] == {"code": 7}  # by itself Ray makes 0 of every exit code, in this process too
    assert subprocess.run(["sh", "-c", "exit 7"]).returncode == 7
