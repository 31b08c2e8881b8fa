"""`pdkit train`, `pdkit demos` and the sources of demonstrations."""
import shlex
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import minari
import numpy as np
import pandas as pd
import pytest
import torch
from worlds import reach_demos

import pdkit.demos.sources as sources
import pdkit.recorded as recorded
from pdkit import cli, imitate, report, train, train_base, train_decorated
from pdkit.decorated import load_decorated
from pdkit.demos import load_demos, save_demos
from pdkit.demos.cli import main as demos_cli
from pdkit.errors import PdkitError
from pdkit.files import DATA, locked, read_json, write_json
from pdkit.imitate import Saved
from pdkit.policies import POLICIES, BeT, load_policy
from pdkit.policies.base import read_card
from pdkit.policies.diffusion import DiffusionPolicy
from pdkit.probes import PROBES, ProbeBase
from pdkit.profiles import online_config
from pdkit.runs import Run
from pdkit.seeds import reported_seeds
from pdkit.tasks import TASKS, get_task
from pdkit.tensorboard import Board


def call(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["pdkit", *words])
    return cli.main(list(words))


def test_settings_are_literals_or_words():
    assert cli.parse_settings(["alpha=0.2", "H=3", "warmup=base", "log_std_range=(-5.0, 1.0)"]) == {
        "alpha": 0.2, "H": 3, "warmup": "base", "log_std_range": (-5.0, 1.0)}
    with pytest.raises(PdkitError, match="NAME=VALUE"):
        cli.parse_settings(["alpha"])


def test_demonstrations_from_the_command_line(monkeypatch, tmp_path, capsys):
    path = tmp_path / "d.safetensors"
    assert call(monkeypatch, "demos", "StackCube", "--num", "2", "--out", str(path)) == 0
    demos = load_demos(path)
    assert demos.num == 2 and demos.label == "scripted" and demos.success[demos.lengths.cumsum() - 1].all()
    assert np.array_equal(demos.actions, load_demos(DATA / "demos" / "StackCube.safetensors").first(2).actions)  # again, the same
    assert call(monkeypatch, "demos", "--show", str(path)) == 0
    assert "2 scripted demonstrations of StackCube" in capsys.readouterr().out


@pytest.mark.parametrize("words", [
    ("demos", "Stackcube"), ("demos",), ("demos", "StackCube", "--num", "0"),
    ("demos", "StackCube", "--first-seed", "-5"), ("demos", "Door", "--first-seed", "1000000"), ("demos", "Door", "--first-seed", "999999"),
    ("demos", "StackCube", "--first-seed", "99999999999"), ("demos", "Door", "--noise", "-1"),
    ("demos", "Door", "--tail", "-200"), ("demos", "--show", "none.safetensors"),
    ("demos", "StackCube", "--source", "human"), ("train", "base", "Door", "--policy", "gan"), ("train", "base", "Pens"),
    ("train", "base", "Door", "--num-demos", "99"), ("train", "base", "Door", "--set", "iterrations=3"),
    ("train", "decorated", "Door", "--set", "alpha=7.0"), ("train", "decorated", "Door", "--profile", "x"),
    ("train", "decorated", "Door", "--set", "seed=3"), ("train", "decorated", "Door", "--seeds", "-1"),
    ("train", "decorated", "Door", "--episodes", "0"), ("train", "decorated", "Door", "--set", "device=gpu"),
    ("train", "decorated", "Door", "--set", "log_std_range=(1.0,)"), ("train", "base", "Door", "--set", "eval_every=0"),
    ("train", "base", "Door", "--set", "lr=fast"), ("train", "decorated", "Door", "--set", "batch=100000"),
    ("train", "decorated", "Door", "--base", "nowhere"), ("train", "base", "Door", "--device", "gpu"),
    ("train", "base", "Door", "--episodes", "-1"), ("train", "base", "Door", "--out", str(DATA)), ("train", "base", "Door", "--out", "/"),
    ("train", "decorated", "Door", "--record", "a/b"), ("train", "decorated", "Door", "--recipe", "../x"),
    ("train", "decorated", "Door", "--set", "init_temperature=0.0"), ("train", "decorated", "Door", "--set", "actor_every=0"),
    ("train", "decorated", "Door", "--set", "layers=0"), ("train", "decorated", "Door", "--set", "train_limit=-1"),
    ("train", "decorated", "Door", "--set", "log_std_range=(2.0,-5.0)"),
    ("evaluate", str(DATA / "checkpoints" / "Door" / "base"), "--tasks", "Door", "--record", ".."),
])
def test_bad_input_is_one_sentence_and_exit_code_2(monkeypatch, capsys, words):
    assert call(monkeypatch, *words) == 2
    out, err = capsys.readouterr()
    assert len(err.strip().splitlines()) == 1 and "Traceback" not in err


def test_a_task_without_bundled_demonstrations_is_said_with_those_that_have_some(monkeypatch, tmp_path):
    (tmp_path / "demos").mkdir()
    (tmp_path / "demos" / "Door.safetensors").touch()
    monkeypatch.setattr(sources, "DATA", tmp_path)
    with pytest.raises(PdkitError, match="No demonstrations of Pen are bundled .there are: Door.*pdkit demos"):
        sources.bundled("Pen")


@pytest.mark.parametrize("error", [ConnectionError, KeyboardInterrupt])
def test_no_network_is_said_clearly_and_leaves_no_half_of_a_download(monkeypatch, tmp_path, error):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def offline(name):
        (tmp_path / name / "data").mkdir(parents=True)
        raise error("no route")

    monkeypatch.setattr(minari, "download_dataset", offline)
    with pytest.raises(PdkitError if error is ConnectionError else error, match="need a network|no route"):
        sources.human("Door")
    assert not (tmp_path / sources.MINARI["Door"]).exists()


def test_damaged_human_demonstrations_are_said_with_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    (tmp_path / sources.MINARI["Door"] / "data").mkdir(parents=True)  # what an interrupted download of another program leaves
    with pytest.raises(PdkitError, match="human-v2 cannot be read .*delete that folder"):
        sources.human("Door")


def test_human_demonstrations_are_clipped_and_judged(monkeypatch, tmp_path):
    """A data set as Minari gives it: raw actions beyond 1, no success recorded, the hinge at index 28. Where observations do not tell, a
    reward decides nothing."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.setattr(minari, "download_dataset", lambda name: None)

    class Recorded:
        observations = np.zeros((5, 39))
        actions = np.full((4, 28), 1.3)
        rewards = np.zeros(4)
        infos: dict = {}

    Recorded.observations[3:, 28] = 1.4

    class Dataset:
        def iterate_episodes(self):
            return [Recorded]

    monkeypatch.setattr(minari, "load_dataset", lambda *a, **k: Dataset())
    demos = sources.human("Door")
    assert demos.label == "human" and demos.actions.max() == 1.0
    assert demos.success.tolist() == [False, False, True, True]
    monkeypatch.setattr(Dataset, "iterate_episodes", lambda self: [Recorded] * 3)
    for given, kept in (((), 3), (("--num", "2"), 2)):
        assert demos_cli(["Door", "--source", "human", *given, "--out", str(tmp_path / "human.safetensors")]) == 0
        assert load_demos(tmp_path / "human.safetensors").num == kept
    with pytest.raises(PdkitError, match="leave them out with --source human"):
        demos_cli(["Door", "--source", "human", "--noise", "0.1"])
    Recorded.rewards = np.full(4, 20.0)
    with pytest.raises(PdkitError, match="do not say at which steps they were solved"):
        sources.human("Hammer")
    Recorded.infos = {"success": np.array([False, False, False, True, True])}  # of the reset, then of each step
    assert sources._recorded_success("Hammer", Recorded).tolist() == [False, False, True, True]


@pytest.mark.parametrize("task", ["Door", "Pen", "Relocate"])
def test_observations_tell_success_as_the_simulator_does(task):
    demos = load_demos(DATA / "demos" / f"{task}.safetensors")
    for e in demos.episodes():
        told = sources._recorded_success(task, SimpleNamespace(infos={}, actions=e["actions"], observations=e["observations"]))
        assert np.array_equal(told, e["success"])


def test_agent_episodes_are_what_the_simulator_did(monkeypatch):
    from pdkit.probes import PROBES

    monkeypatch.setattr(sources, "get_task", lambda name: PROBES[name])
    base = ProbeBase(dict(obs_dim=4, act_dim=2, kind="reach", bias=[0.0, 0.0]))
    started = []
    monkeypatch.setattr(base, "reset", started.append)
    episodes = sources.agent_episodes(base, "reach", 6, 100, 0.1, 3)
    assert started == [100]  # so that one that samples makes the same again
    assert len(episodes) == 6 and all(e["success"].any() for e in episodes)
    limit = PROBES["reach"].max_episode_steps
    for e in episodes:
        assert len(e["observations"]) == len(e["actions"]) + 1
        assert len(e["actions"]) == len(e["success"]) == min(np.argmax(e["success"]) + 1 + 3, limit)
        moved = np.clip(e["observations"][:-1, :2] + 0.2 * e["actions"], -1.5, 1.5)
        assert np.allclose(moved, e["observations"][1:, :2], atol=1e-5)
    noises = [e["actions"][0] - base.act(e["observations"][:1][None])[0, 0] for seed in (100, 100, 200)
              for e in sources.agent_episodes(base, "reach", 1, seed, 0.001, 3)[:1]]
    assert np.allclose(noises[0], noises[1]) and not np.allclose(noises[0], noises[2], atol=1e-4)


def test_training_from_the_command_line_records_a_row_a_seed(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(recorded, "DATA", tmp_path)
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path / "runs"))
    refused = []
    for owner, name, work in ((train_decorated.Trainer, "train", train_decorated.Trainer.train),
                              (train_decorated, "reported", train_decorated.reported)):  # each writes files
        def watched(*given, work=work):
            with pytest.raises(PdkitError, match="Another process is at work in .*Door-smoke-seed0"):
                with Run.alone(SimpleNamespace(folder=tmp_path / "runs" / "train" / "Door-smoke-seed0")):
                    pass
            refused.append(1)
            return work(*given)

        monkeypatch.setattr(owner, name, watched)
    words = ["train", "decorated", "Door", "--profile", "smoke", "--seeds", "0", "--episodes", "2", "--record", "t",
             "--set", "eval_episodes=1"]
    assert call(monkeypatch, *words) == 0 and len(refused) == 3  # while it trains, and while base and decorated are tested
    capsys.readouterr()
    assert call(monkeypatch, *words) == 0  # finished already: the same row, not a second one
    assert "Trained already" in capsys.readouterr().out
    path = tmp_path / "runs" / "train" / "Door-smoke-seed0" / "manifest.json"
    older = read_json(path)
    del older["parameters"]["success_tail"]  # a field that is newer than the run
    write_json(path, older)
    assert call(monkeypatch, *words) == 0 and "Trained already" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "results" / "t.csv")
    assert len(table) == 1 and table.env_steps[0] >= 600 and table.command[0].startswith("pdkit train decorated Door --profile smoke")
    assert (tmp_path / "results" / "t.png").stat().st_size > 1000
    kept, = (tmp_path / "runs" / "base_episodes").iterdir()  # the base policy's episodes, run once for all that start from it
    episodes = pd.read_csv(kept)
    assert list(episodes.seed) == reported_seeds(2) and episodes.success_once.mean() == table.base_success[0]
    episodes.assign(success_once=0.25).to_csv(kept, index=False)
    assert call(monkeypatch, *words) == 0 and pd.read_csv(tmp_path / "results" / "t.csv").base_success[0] == 0.25
    assert call(monkeypatch, *words, "--episodes", "3") == 0  # of other episodes there are others
    assert pd.read_csv(tmp_path / "results" / "t.csv").base_success[0] != 0.25
    monkeypatch.setattr(train_decorated, "code_checksum", lambda: "edited")  # another task, perhaps: its base policy is tested anew
    assert call(monkeypatch, *words) == 0 and pd.read_csv(tmp_path / "results" / "t.csv").base_success[0] == table.base_success[0]
    policy = load_decorated(tmp_path / "runs" / "train" / "Door-smoke-seed0" / "decorated")
    base = load_policy(DATA / "checkpoints" / "Door" / "base")
    assert policy.base.state_dict().keys() == base.state_dict().keys()
    with pytest.raises(PdkitError, match="differing: demos, num_demos"):  # the same folder with other demonstrations is another run
        train.main([*words[1:], "--num-demos", "2"])


def test_an_interrupted_training_tells_what_is_kept_and_how_to_go_on(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path))

    def stop(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(train_decorated, "decorate", stop)
    words = ["train", "decorated", "Door", "--profile", "smoke", "--method", "residual_rl"]
    assert call(monkeypatch, *words) == 130 and "Nothing had been saved yet; start again with: the same command." in capsys.readouterr().err
    folder = tmp_path / "train" / "Door-residual_rl,profile=smoke-seed0" / "checkpoint"  # not where the lesson's run is
    folder.mkdir(parents=True)
    (folder / "state.json").write_text('{"step": 1200}')
    assert call(monkeypatch, *words) == 130 and "saved up to step 1,200; go on with: the same command." in capsys.readouterr().err


def test_a_base_policy_of_another_task_is_told_before_anything_else(monkeypatch, capsys):
    other = str(DATA / "checkpoints" / "Door" / "base")
    assert call(monkeypatch, "train", "decorated", "StackCube", "--base", other) == 2
    assert "is for 39 observations and 28 actions; StackCube has 55 and 4: start from one of this task." in capsys.readouterr().err
    for name, told in (("nowhere", "nowhere/policy.json does not exist (looked for in "), (f"{other}/policy.json", "is a file; name the")):
        assert call(monkeypatch, "train", "decorated", "Door", "--base", name) == 2 and told in capsys.readouterr().err


def test_without_a_number_there_are_as_many_demonstrations_as_the_base_policy_saw():
    demos = reach_demos(4)
    assert sources.learned_from(demos, {"info": {"demos": 3}}).num == 3 and sources.learned_from(demos, {"info": {"demos": 3}}, 2).num == 2
    assert sources.learned_from(demos, {"info": {"demos": 5}}).num == sources.learned_from(demos, {"info": {}}).num == 4  # a smaller file
    with pytest.raises(PdkitError, match="num_demos must be 1 to 4, not 5"):
        sources.learned_from(demos, {"info": {}}, 5)


def test_a_base_policy_that_samples_is_tested_on_random_numbers_of_each_run(monkeypatch, tmp_path):
    """One draw for all runs would take a lucky start for what each of them lost."""
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path))
    drawn = []
    monkeypatch.setattr("pdkit.evaluate.evaluate",
                        lambda *_, **__: drawn.append(torch.initial_seed()) or pd.DataFrame({"success_once": [0]}))
    for kind, wanted in (("diffusion", [0, 1, 2]), ("base", [0])):
        drawn.clear()
        policy = load_policy(DATA / "checkpoints" / "StackCube" / kind)
        assert policy.samples == (kind == "diffusion")
        for seed in (0, 1, 2, 1):
            config = online_config("StackCube", "lesson", seed)
            train_decorated._base_episodes(policy, get_task("StackCube"), 2, config, {"base": kind})
        assert drawn == wanted
    shape = dict(obs_dim=3, act_dim=2, dims=[8])
    assert not DiffusionPolicy(shape | dict(temperature=0.0)).samples and DiffusionPolicy(shape | dict(sampler="ddpm")).samples
    assert BeT(dict(obs_dim=3, act_dim=2, act_dropout=True)).samples and not BeT(dict(obs_dim=3, act_dim=2)).samples


def test_episodes_of_code_from_elsewhere_are_not_kept(monkeypatch, tmp_path):
    """It may be another one the next time, by the same name and weights."""
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path))
    tested = []
    monkeypatch.setattr("pdkit.evaluate.evaluate", lambda *_, **__: tested.append(1) or pd.DataFrame({"success_once": [0]}))
    door, base = get_task("Door"), load_policy(DATA / "checkpoints" / "Door" / "base")
    foreign = type("Mine", (ProbeBase,), {"__module__": "elsewhere"})(base.config | {"kind": "zero"})
    sim = type("Sim", (), {"__module__": "elsewhere"})
    for spec, policy, wanted in ((door, base, 1), (door, base, 0), (replace(door, max_episode_steps=9), base, 1), (door, foreign, 1),
                                 (door, foreign, 1), (replace(door, make=sim), base, 1), (replace(door, make=sim), base, 1)):
        tested.clear()
        train_decorated._base_episodes(policy, spec, 2, online_config("Door", "lesson", 0), {"base": "x"})
        assert len(tested) == wanted


def test_the_command_of_a_row_can_be_pasted_into_a_shell():
    args = SimpleNamespace(task="Door", method="policy_decorator", profile="lesson", recipe="wide", episodes=60, threads=1, base="my base",
                           pixels=False, demos=None, num_demos=None, set=["alpha_scale=(1.0, 1.0)"], record="x")
    words = shlex.split(train_decorated.command_of(args, 3))
    assert words[:3] == ["pdkit", "train", "decorated"] and words[words.index("--base") + 1] == "my base"
    assert words[words.index("--set") + 1] == "alpha_scale=(1.0, 1.0)" and words[words.index("--seeds") + 1] == "3"


def test_a_record_of_another_task_alone_can_be_drawn(monkeypatch, tmp_path):
    monkeypatch.setattr(recorded, "DATA", tmp_path)
    row = dict(task="StackCube", recipe="lesson", seed=0, episodes=10, base_success=0.5, decorated_success=0.9, command="x")
    curve = dict(task="StackCube", recipe="lesson", seed=0, step=[10, 20], success_once=[0.5, 0.9])
    recorded.record("s", pd.DataFrame([row]), pd.DataFrame(curve))
    assert (tmp_path / "results" / "s.png").stat().st_size > 1000
    for task, names in (("Pen", ("s", "s-StackCube")), ("Door", ("s", "s-Pen", "s-StackCube"))):  # each task has its own, Door the first
        recorded.record("s", pd.DataFrame([row | {"task": task}]), pd.DataFrame(curve | {"task": task}))
        assert sorted(path.stem for path in (tmp_path / "results").glob("*.png")) == sorted(names)
    shown = [part for part in report.sections(pd.DataFrame(columns=["verdict", "claim", "section", "tasks"]),
                                              {"s": recorded.load("s")[0]}, tmp_path / "results") if part.title == "Recorded: s"]
    assert [str(shown).count(f"<figcaption>s.csv, {task}<") for task in ("Door", "Pen", "StackCube")] == [1, 1, 1]


def test_tensorboard_gets_every_number_at_its_step(tmp_path):
    event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    board = Board(tmp_path)
    rows = [{"step": 100, "updates": 5, "seconds": 1.0, "q_mean": -2.0}, {"step": 200, "updates": 9, "seconds": 2.0, "q_mean": -1.5}]
    board.update(rows)
    rows[0]["success_once"] = 0.5  # an evaluation that came back late
    board.update(rows)
    board.close()
    events = event_accumulator.EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert sorted(events.Tags()["scalars"]) == ["q_mean", "success_once"]
    assert [(e.step, e.value) for e in events.Scalars("q_mean")] == [(100, -2.0), (200, -1.5)]
    assert [(e.step, e.value) for e in events.Scalars("success_once")] == [(100, 0.5)]


def test_an_interrupted_imitation_is_told_and_goes_on(tmp_path, monkeypatch, capsys):
    """What was saved stays until the policy is written; where nothing was, nothing is left."""
    out, row = tmp_path / "base", imitate._checkpoint_row
    words = ["train", "base", "Door", "--policy", "mlp", "--num-demos", "2", "--out", str(out), "--set", "iterations=30", "eval_every=25",
             "eval_episodes=0", "batch=8"]

    def until(iteration):
        def told(now, *others):
            if now >= iteration:
                raise KeyboardInterrupt
            return row(now, *others)

        monkeypatch.setattr(imitate, "_checkpoint_row", told)
        return cli.main(words)

    assert until(1) == 130 and "Nothing had been saved yet" in capsys.readouterr().err and not list(tmp_path.iterdir())
    assert until(30) == 130 and "saved up to step 25; go on with: the same command" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["base.training"]
    assert cli.main([*words, "lr=0.5"]) == 2 and "holds another run (differing: lr)" in capsys.readouterr().err
    assert until(99) == 0
    said = capsys.readouterr().out
    assert "saved up to step 25; it goes on from there" in said and "iteration 30" in said
    assert [path.name for path in tmp_path.iterdir()] == ["base"]
    assert cli.main([str(tmp_path / "whole") if word == str(out) else word for word in words]) == 0
    assert "seconds a gradient step: less than a minute left" in capsys.readouterr().out
    assert read_card(out)["weights_sha256"] == read_card(tmp_path / "whole")["weights_sha256"]


def _words(out, *settings, num=2):
    return ["train", "base", "Door", "--policy", "mlp", "--num-demos", str(num), "--out", str(out), "--set", "iterations=4", "eval_every=2",
            "eval_episodes=0", "batch=8", *settings]


def test_a_training_of_imitation_is_gone_on_with_by_the_same_command_alone(tmp_path, monkeypatch, capsys):
    """Not with other demonstrations, nor from pictures, nor while another process is at it; and what lies beside is nobody's to remove."""
    saves, folder = Saved.save, tmp_path / "base.training"

    def interrupt(self, *what):
        saves(self, *what)
        raise KeyboardInterrupt

    monkeypatch.setattr(Saved, "save", interrupt)
    monkeypatch.setattr(train_base, "pictures_of", lambda *_: object())
    assert cli.main(_words(tmp_path / "base")) == 130
    monkeypatch.undo()
    monkeypatch.setattr(train_base, "pictures_of", lambda *_: object())
    for words, said in ((_words(tmp_path / "base", num=3), "(differing: demos, num_demos)"),
                        ([*_words(tmp_path / "base"), "--pixels"], "(differing: pixels)")):
        capsys.readouterr()
        assert cli.main(words) == 2 and said in capsys.readouterr().err
    with locked(folder / "lock", ""):
        assert cli.main(_words(tmp_path / "base")) == 2 and "Another process is at work" in capsys.readouterr().err
        shutil.rmtree(folder / "checkpoint")
        assert cli.main(_words(tmp_path / "base")) == 2 and "Another process is at work" in capsys.readouterr().err
    assert (folder / "manifest.json").exists()
    assert cli.main(_words(tmp_path / "base", "lr=0.01")) == 0  # what a killed process left, and nothing to go on from
    (tmp_path / "mine.training").mkdir()
    (tmp_path / "mine.training" / "notes.txt").touch()
    assert cli.main(_words(tmp_path / "mine")) == 2 and "holds something else" in capsys.readouterr().err
    assert (tmp_path / "mine.training" / "notes.txt").exists() and not (tmp_path / "mine").exists()


def test_an_imitation_is_not_repeated_for_its_test_nor_after_a_loss_that_is_no_number(tmp_path, monkeypatch, capsys):
    words = [*_words(tmp_path / "base"), "--episodes", "1"]

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(train_base, "reported", interrupt)
    assert cli.main(words) == 130 and (tmp_path / "base" / "policy.json").exists()
    monkeypatch.undo()
    monkeypatch.setattr(POLICIES["mlp"], "loss", interrupt)
    assert cli.main(words) == 0 and read_card(tmp_path / "base")["info"]["test"]["episodes"] == 1
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["base"]
    capsys.readouterr()
    assert cli.main(_words(tmp_path / "wild", "lr=1e30", "eval_every=1")) == 2 and "lower lr" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["base"]


def test_a_task_of_ones_own_takes_one_entry_in_the_registry(monkeypatch, tmp_path, capsys):
    """What the README tells: imitated and decorated from the command line, with the defaults of the profile."""
    monkeypatch.setitem(TASKS, "Mine", replace(PROBES["reach"], name="Mine"))
    file, base, out = tmp_path / "mine.safetensors", tmp_path / "base", tmp_path / "runs"
    save_demos(replace(reach_demos(), task="Mine"), file)
    assert call(monkeypatch, "train", "base", "Mine", "--policy", "mlp", "--demos", str(file), "--out", str(base), "--set", "iterations=20",
                "eval_episodes=0") == 0
    assert call(monkeypatch, "train", "decorated", "Mine", "--base", str(base), "--demos", str(file), "--profile", "smoke",
                "--episodes", "2", "--out", str(out)) == 0
    assert "task Mine, method policy_decorator" in capsys.readouterr().out
    assert load_decorated(out / "Mine-smoke-seed0" / "decorated").base.kind == "mlp"


def test_a_field_that_is_newer_than_a_run_had_its_default(tmp_path):
    Run(tmp_path / "x", "decorated", {"alpha": 0.1})
    assert not Run(tmp_path / "x", "decorated", {"alpha": 0.1, "mine": 0.5}, {"alpha": 0.3, "mine": 0.5}).finished
    for asked, differing in (({"alpha": 0.1, "mine": 0.7}, "mine"), ({"alpha": 0.3, "mine": 0.5}, "alpha"), ({"mine": 0.5}, "alpha"),
                             ({"alpha": 0.1, "mine": 0.5, "encoder": "e"}, "encoder")):
        with pytest.raises(PdkitError, match=rf"another run \(differing: {differing}\)"):
            Run(tmp_path / "x", "decorated", asked, {"alpha": 0.3, "mine": 0.5})


def test_a_task_that_nobody_here_can_demonstrate_is_said_with_what_to_do(monkeypatch, capsys):
    monkeypatch.setitem(TASKS, "Mine", replace(get_task("Door"), name="Mine"))
    assert call(monkeypatch, "demos", "Mine") == 2 and "from_episodes and save_demos" in capsys.readouterr().err
    assert call(monkeypatch, "train", "base", "Mine") == 2
    said = capsys.readouterr().err
    assert "No demonstrations of Mine are bundled" in said and "--demos" in said and "from_episodes" in said
