"""`pdkit evaluate`: a saved policy on the test episodes of several tasks, and the recorded gap between source and novel objects."""
import dataclasses
import shlex
import types

import mediapy
import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from pdkit import cli, recorded, transfer
from pdkit.decorated import Decorated, save_decorated
from pdkit.decorator import DecoratorConfig
from pdkit.errors import PdkitError
from pdkit.files import DATA, read_json
from pdkit.policies import DiffusionPolicy, save_policy
from pdkit.policies.mlp import MLP
from pdkit.probes import PROBES, ProbeBase, ReachSim, biased_base
from pdkit.rl.networks import Actor
from pdkit.stats import wilson

NEAR = PROBES["reach"]
FAR = dataclasses.replace(NEAR, name="far", max_episode_steps=4)  # too short for most goals
OTHER = dataclasses.replace(NEAR, name="other", obs_dim=5)


@pytest.fixture(autouse=True)
def probes(monkeypatch):
    monkeypatch.setattr(transfer, "get_task", {spec.name: spec for spec in (NEAR, FAR, OTHER)}.__getitem__)


def straight() -> ProbeBase:
    return ProbeBase(dict(obs_dim=4, act_dim=2, kind="reach", bias=[0.0, 0.0]))


def test_one_row_a_task_on_the_test_seeds(monkeypatch):
    """Two of three episodes solved, one of them lost again; the seeds are those kept for reporting."""
    asked = []

    def told(spec, act, seeds, **options):
        asked.append((spec.name, list(seeds), options["window"], options["chunk"]))
        return pd.DataFrame({"seed": seeds, "success_once": [True, True, False], "success_at_end": [False, True, False]})

    monkeypatch.setattr(transfer, "evaluate", told)
    table = transfer.transfer(straight(), ["reach", "far"], 3)
    assert asked == [(name, [1_000_000, 1_000_001, 1_000_002], 1, 1) for name in ("reach", "far")]
    rate = wilson(2, 3)
    for row in table.itertuples():
        assert (row.episodes, row.success, row.success_at_end, row.low, row.high) == (3, 2 / 3, 1 / 3, rate.low, rate.high)


def test_the_harder_task_is_solved_less_often():
    table = transfer.transfer(straight(), ["reach", "far"], 12)
    assert list(table.task) == ["reach", "far"] and table.success[1] < table.success[0]


def test_a_policy_of_another_shape_is_refused_before_anything_runs(monkeypatch):
    monkeypatch.setattr(transfer, "evaluate", lambda *words, **options: pytest.fail("it ran"))
    with pytest.raises(PdkitError, match="takes 4 numbers and gives 2; other gives 5 and takes 2: choose a task"):
        transfer.transfer(straight(), ["reach", "other"], 1)


def test_the_command_records_a_row_a_task_for_base_and_decorated(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recorded, "DATA", tmp_path)
    torch.manual_seed(0)
    base = MLP({"obs_dim": 4, "act_dim": 2, "hidden": 8, "layers": 1}).eval()
    base.fit_statistics(np.random.default_rng(0).normal(size=(50, 4)), np.zeros((50, 2)))
    save_policy(base, tmp_path / "base", {})
    save_decorated(Decorated(base, Actor(4, 2, 8, 1, False, (-5.0, 2.0)).eval(), DecoratorConfig(alpha=0.1)), tmp_path / "decorated")
    for kind in ("base", "decorated"):
        words = ["evaluate", str(tmp_path / kind), "--tasks", "reach", "far", "--episodes", "3", "--record", "gap"]
        assert cli.main(words) == 0
        assert "far: " in capsys.readouterr().out
        assert isinstance(transfer.load_any(tmp_path / kind)[1], Decorated) == (kind == "decorated")
    table = pd.read_csv(tmp_path / "results" / "gap.csv")
    assert list(table.task + " " + table.recipe) == ["far base", "far decorated", "reach base", "reach decorated"]
    assert table.command[0] == f"pdkit evaluate {tmp_path / 'base'} --tasks reach far --episodes 3 --record gap"
    assert read_json(tmp_path / "results" / "gap_manifest.json")["again"] == sorted(set(table.command))


def test_another_policys_row_is_not_replaced(tmp_path, monkeypatch, capsys):
    """Neither by an evaluation nor by a corrected one, and before anything is evaluated; the same folder, however written, may."""
    monkeypatch.setattr(recorded, "DATA", tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    for name in ("the one", "two"):
        save_policy(MLP(dict(obs_dim=4, act_dim=2)), tmp_path / name)
    monkeypatch.setattr(transfer, "by_bound", lambda spec, policy, alphas, seeds, progress: pd.DataFrame(
        {"task": spec.name, "alpha": alphas, "episodes": len(seeds), "success": 1.0}))
    for more, row in ([], "base"), (["--oracle", "0"], "mlp,alpha=0"):
        words = ["--tasks", "reach", "--episodes", "2", "--record", "r", *more]
        assert cli.main(["evaluate", "the one", *words]) == cli.main(["evaluate", str(tmp_path / "the one"), *words]) == 0
        table = (tmp_path / "data" / "results" / "r.csv").read_bytes()
        capsys.readouterr()
        assert cli.main(["evaluate", "two", *words]) == 2
        told = capsys.readouterr()
        assert f"holds reach's '{row}' of {tmp_path / 'the one'}" in told.err and "another name" in told.err and "reach:" not in told.out
        assert (tmp_path / "data" / "results" / "r.csv").read_bytes() == table
    named = ["evaluate", "two", "--tasks", "reach", "--episodes", "2", "--record", "r", "--recipe", "the other"]
    assert cli.main(named) == 0
    rows = pd.read_csv(tmp_path / "data" / "results" / "r.csv").set_index("recipe")
    assert set(rows.index) == {"base", "mlp,alpha=0", "the other"} and rows.command["the other"] == shlex.join(["pdkit", *named])
    capsys.readouterr()
    assert cli.main([*named[:2], *named[2:6], "--recipe", "x"]) == 2 and "add --record" in capsys.readouterr().err


@pytest.mark.parametrize(("words", "message"), [
    (["nowhere", "--tasks", "reach"], "nowhere"), (["nowhere", "--tasks", "reach", "--episodes", "0"], "at least 1, not 0"),
    (["nowhere"], "--tasks")])
def test_bad_words_are_told_in_one_sentence(words, message, capsys):
    assert cli.main(["evaluate", *words]) == 2
    assert message in capsys.readouterr().err


class Drawn(ReachSim):
    """A probe that can be drawn, in grey."""

    def __init__(self, render=False): ...

    def render(self):
        return np.full((40, 60, 3), 128, np.uint8)


@pytest.mark.parametrize("name", ["it.webp", "it.mp4"])
def test_a_film_shows_a_decorated_policy_beside_its_base(tmp_path, monkeypatch, name):
    spec = dataclasses.replace(PROBES["reach"], make=Drawn, suite="adroit", rate=40.0)
    monkeypatch.setattr(transfer.video, "try_render", lambda spec: None)
    lost, solves = biased_base(), straight()
    decorated = types.SimpleNamespace(base=lost, act=solves.act, window=1, reset=lambda seed: None)
    monkeypatch.setattr(transfer, "Decorated", types.SimpleNamespace)
    path = transfer.film(decorated, spec, tmp_path / "films" / name, 20)
    if name.endswith("webp"):
        frames = Image.open(path)
        frames.load()
        assert frames.n_frames > 3 and frames.size == (60, 20) and frames.info["duration"] == 50  # side by side, half the size; 20 a second
    else:
        assert mediapy.read_video(path).shape[2] == 120
    alone = transfer.film(solves, spec, tmp_path / f"alone-{name}", 1)
    assert alone.stat().st_size > 0


def test_films_that_cannot_be_made_are_refused_in_a_sentence(tmp_path, capsys, monkeypatch):
    folder = str(DATA / "checkpoints" / "Door" / "base")
    assert cli.main(["evaluate", folder, "--tasks", "reach", "far", "--film", str(tmp_path / "x.mp4")]) == 2
    assert "name one task" in capsys.readouterr().err
    assert cli.main(["evaluate", folder, "--tasks", "reach", "--film", str(tmp_path / "x.gif")]) == 2
    assert "writes .mp4 or .webp, not" in capsys.readouterr().err
    monkeypatch.setenv("PDKIT_RENDER", "off")
    assert cli.main(["evaluate", folder, "--tasks", "reach", "--film", str(tmp_path / "x.mp4")]) == 2
    assert "turned off" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_diffusion_policy_samples_as_asked_and_others_do_not(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recorded, "DATA", tmp_path / "data")
    kept = DiffusionPolicy(dict(obs_dim=4, act_dim=2, horizon=4, chunk=2, dims=[16], groups=4, embed=16))
    save_policy(kept, tmp_path / "base")
    seen, evaluated = [], transfer.evaluate
    monkeypatch.setattr(transfer, "evaluate", lambda spec, act, seeds, **options: seen.append((act.__self__.config, options["chunk"]))
                        or evaluated(spec, act, seeds, **options))
    words = ["evaluate", str(tmp_path / "base"), "--tasks", "reach", "--episodes", "3"]
    assert cli.main([*words, "--record", "s"]) == 0
    other = ["--sampling", "temperature=0", "chunk=1", "--record", "s"]
    assert cli.main([*words, *other]) == 0
    assert [(config["temperature"], chunk) for config, chunk in seen] == [(1.0, 2), (0, 1)]
    table = pd.read_csv(tmp_path / "data" / "results" / "s.csv").set_index("recipe")
    assert table.command["base,temperature=0.0,chunk=1"] == " ".join(["pdkit", *words, *other])
    named = [*words, "--record", "s", "--recipe", "mine", "--sampling", "chunk=1"]
    assert cli.main([*named, "temperature=0"]) == cli.main([*named, "temperature=0.0"]) == 0
    capsys.readouterr()
    assert cli.main([*named, "temperature=0.5"]) == 2 and "holds reach's 'mine'" in capsys.readouterr().err
    assert "base" in table.index
    capsys.readouterr()
    for asked, told in (("horizon=8", "Unknown sampling"), ("temperature", "--sampling takes NAME=VALUE"), ("chunk=9", "must be 1 to"),
                        ("chunk=1 --oracle 0", "leave --sampling out")):
        assert cli.main([*words, "--sampling", *asked.split()]) == 2
        assert told in capsys.readouterr().err
    save_policy(kept.with_late(2), tmp_path / "late")
    for asked, rc in (("sampler_steps=2", 2), ("temperature=0.5", 0)):
        assert cli.main(["evaluate", str(tmp_path / "late"), "--tasks", "reach", "--episodes", "3", "--sampling", asked]) == rc
    assert "sampler_steps would change which these are" in capsys.readouterr().err
    save_policy(MLP(dict(obs_dim=4, act_dim=2)), tmp_path / "mlp")
    assert cli.main(["evaluate", str(tmp_path / "mlp"), "--tasks", "reach", "--sampling", "chunk=1"]) == 2
    assert "a Diffusion Policy; this is a MLP" in capsys.readouterr().err
