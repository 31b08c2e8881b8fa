"""What a bound allows: a base policy that a demonstrator corrects, within the bound."""
import numpy as np
import pandas as pd
import pytest
from worlds import TwoAtOnce

from pdkit import cli, oracle, transfer
from pdkit.demos.experts import TurnFaucetExpert
from pdkit.errors import PdkitError
from pdkit.files import DATA
from pdkit.policies import save_policy
from pdkit.policies.mlp import MLP
from pdkit.probes import PROBES, ProbeBase, biased_base
from pdkit.seeds import reported_seeds
from pdkit.tasks import get_task

REACH = PROBES["reach"]


class Straight:
    """Goes straight to the goal of the reach probe; wants windows of two, and what it is told is noted."""

    window = 2

    def __init__(self):
        self.starts, self.seen = [], []

    def reset(self, seed):
        self.starts.append(seed)

    def act(self, windows):
        self.seen.append(windows)
        last = windows[0, -1]
        return np.clip((last[2:] - last[:2]) * 2.5, -1, 1)[None, None].astype(np.float32)


@pytest.fixture
def straight(monkeypatch):
    guide = Straight()
    monkeypatch.setattr(oracle, "demonstrator", lambda task, sim: guide)
    monkeypatch.setattr(oracle, "online_config", lambda task, profile: type("C", (), {"decorator": type("D", (), {"alpha_scale": ()})})())
    monkeypatch.setattr(transfer, "get_task", {"reach": REACH}.__getitem__)
    return guide


def test_a_wide_bound_solves_what_a_narrow_one_does_not(straight):
    """The base is off by a constant: a correction that reaches it brings it to the goal, half of it does not."""
    base = biased_base()
    bias = float(np.abs(base.config["bias"]).max())
    rows = oracle.by_bound(REACH, base, [0, bias / 4, min(1.0, 2 * bias)], reported_seeds(10)).set_index("alpha").success
    assert rows.iloc[0] <= rows.iloc[1] < 0.5 and rows.iloc[2] == 1.0
    assert straight.starts[:10] == reported_seeds(10)
    assert straight.seen[0].shape == (1, 2, 4) and (straight.seen[0][0, 0] == straight.seen[0][0, 1]).all()


def test_the_bound_of_a_dimension_follows_the_lessons_scale():
    assert oracle.bound("StackCube", 0.1) == pytest.approx([0.1, 0.1, 0.1, 1.0]) and oracle.bound("Door", 0.1) == 0.1


def test_who_shows_the_way():
    """An expert that looks at the simulation is given it; where no expert is scripted, the agent that made the demonstrations acts."""
    sim = object()
    guide = oracle.demonstrator("TurnFaucet", sim)
    assert isinstance(guide.expert, TurnFaucetExpert) and guide.expert._sim is sim
    assert oracle.demonstrator("Pen", sim).base.config["act_dim"] == 24


def test_what_cannot_be_corrected_is_refused(straight):
    plain = dict(obs_dim=4, act_dim=2, kind="reach", bias=[0.0, 0.0])
    with pytest.raises(PdkitError, match="one action at a time"):
        oracle.by_bound(REACH, TwoAtOnce(plain), [0.1], [0])
    with pytest.raises(PdkitError, match="name one of the task"):
        oracle.by_bound(get_task("Door"), ProbeBase(plain), [0.1], [0])
    for alphas, said in (([0.1, 1.5], "and 1; 1.5 does not"), ([], "nothing does not")):
        with pytest.raises(PdkitError, match=said):
            oracle.by_bound(REACH, ProbeBase(plain), alphas, [0])


def test_the_command_prints_and_records_a_row_a_bound(straight, results, tmp_path, capsys):
    folder = tmp_path / "mlp"
    save_policy(MLP(dict(obs_dim=4, act_dim=2, hidden=8)), folder, {})
    words = ["evaluate", str(folder), "--tasks", "reach", "--episodes", "4"]
    assert cli.main([*words, "--oracle", "0", "1", "--record", "oracle"]) == 0
    assert "corrected by at most 1: 100" in capsys.readouterr().out
    table = pd.read_csv(results / "oracle.csv")
    assert table.recipe.tolist() == ["mlp,alpha=0", "mlp,alpha=1"] and table.episodes.tolist() == [4, 4] and table.success[1] == 1.0
    assert table.command[1] == f"pdkit {' '.join(words)} --oracle 1 --record oracle"
    assert cli.main([*words, "--oracle", "0.1", "--film", "x.webp"]) == 2 and "leave --oracle" in capsys.readouterr().err
    assert cli.main(["evaluate", str(DATA / "checkpoints/Door/decorated"), "--tasks", "Door", "--oracle", "0.1"]) == 2
    assert "name the folder of one" in capsys.readouterr().err
