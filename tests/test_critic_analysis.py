"""Notebooks 08 and 09: what is measured of critics on a transformer and of Cal-QL's setups, and what their figures show."""
import numpy as np
import pandas as pd
import pytest
import torch
from test_methods import bet_sac  # noqa: F401 (a fixture)
from worlds import reach_trainer

from pdkit import calql_analysis, claims, critic_analysis, plots_critics, recorded
from pdkit.critic_analysis import KINDS
from pdkit.decorator import DecoratorConfig
from pdkit.errors import PdkitError

SETUPS = list(calql_analysis.SETUPS.values())


@pytest.fixture
def tuning(bet_sac):  # noqa: F811
    """Fine-tuning on the reach probe with 200 transitions and no update."""
    trainer = reach_trainer("sac_finetune", bet_sac, total_steps=200, warmup_steps=196, utd=0.0, lora=2, average=0.0)
    trainer.train()
    return trainer


@pytest.fixture
def windows():
    return np.random.default_rng(0).standard_normal((20, 3, 4)).astype(np.float32)


# ---- 08 --------------------------------------------------------------------------------------------------------------

def test_one_seed_gives_all_kinds_the_same_actor_and_the_data_stay(tuning, windows):
    actions, weights = [], []
    for kind in KINDS:
        agent = critic_analysis.learner(tuning, kind, seed=3, critic_lr=0.5)
        actions.append(agent.actor.act(windows))
        weights.append(dict(agent.actor.named_parameters()))
        assert agent.config.critic_lr == 0.5 and tuning.config.sac.critic_lr == 3e-3
    assert all(torch.equal(w[name], weights[0][name]) for w in weights for name in w) and np.array_equal(actions[0], actions[2])
    assert tuning.config.method_config.critic_backbone == "mlp"
    with pytest.raises(PdkitError, match="critic_backbone"):
        critic_analysis.learner(tuning, "both")


def test_critics_alone_move_the_policy_through_a_shared_transformer_only(tuning, windows):
    test, drifts = critic_analysis.returns(tuning, 3), {}
    for kind in KINDS:
        agent = critic_analysis.critics_alone(tuning, kind)
        rows = list(critic_analysis.trail(agent, tuning.replay, 7, windows, test, every=3, batch=16))
        assert [row["update"] for row in rows] == [0, 3, 6, 7] and rows[0]["drift"] == 0
        assert rows[-1]["error"] != rows[0]["error"] and not agent.config.entropy_backup
        drifts[kind] = rows[-1]["drift"]
    assert drifts["mlp"] == drifts["separate"] == 0 < drifts["shared"]
    assert critic_analysis.moved_by_critics(drifts)[0] == "reproduced"
    assert critic_analysis.moved_by_critics(drifts | {"separate": 0.1})[0] == "not"
    verdict, reasons = critic_analysis.moved_by_critics(drifts | {"shared": 0.0})
    assert verdict == "not" and len(reasons) == 3 and "0.0000" in reasons[1]


def test_returns_are_those_of_the_noisy_policy_and_belong_to_their_steps(tuning):
    test = critic_analysis.returns(tuning, 4)
    assert test["obs"].shape[1] == 12 and len(test["mc"]) == len(test["residual"])
    chained = (test["obs"][1:] == test["next_obs"][:-1]).all(dim=1)  # 3-step rows: only an episode's last successor is the next one
    assert not chained[:5].any() and -10 <= test["mc"].min() and test["mc"].max() <= 0
    again = critic_analysis.returns(tuning, 4)
    assert torch.equal(test["mc"], again["mc"]) and torch.equal(test["residual"], again["residual"])
    mean = tuning._start_policy.mean_action(test["obs"]).clamp(-1, 1)
    noise = (test["residual"] - mean).abs().mean()
    assert 0.005 < noise < 0.3


def test_the_error_is_the_distance_of_the_mean_critic_from_the_return(tuning):
    agent, test = critic_analysis.learner(tuning, "shared"), critic_analysis.returns(tuning, 2)
    with torch.no_grad():
        q = agent.critics(torch.cat([test["obs"], test["residual"]], 1)).mean(dim=0)
    assert torch.allclose(critic_analysis.values(agent, test), q, atol=1e-5)
    assert critic_analysis.error(agent, test | {"mc": q + 2}) == pytest.approx(2, abs=1e-4)
    far = torch.where(torch.arange(len(q)) % 2 == 0, q + 3, q - 3)
    assert critic_analysis.error(agent, test | {"mc": far}) == pytest.approx(3, abs=1e-3)


def test_costs_tell_apart_what_is_shared(tuning):
    found = {kind: critic_analysis.costs(critic_analysis.learner(tuning, kind), tuning.replay, 2, 16) for kind in KINDS}
    gpt = sum(p.numel() for p in critic_analysis.learner(tuning, "shared").actor.gpt.parameters())
    heads = {kind: sum(p.numel() for p in critic_analysis.learner(tuning, kind).critics.members.parameters()) for kind in KINDS}
    assert [found[k]["parameters"] - heads[k] for k in KINDS] == [0, gpt, gpt] and [found[k]["own"] for k in KINDS] == [
        heads["mlp"], heads["shared"], heads["separate"] + gpt]
    assert heads["separate"] < found["separate"]["trained"] < found["separate"]["parameters"] and found["mlp"]["seconds"] > 0


def test_ppos_value_pulls_at_the_actor_only_if_shared():
    from pdkit.policies import BeTForSAC

    torch.manual_seed(0)
    config = dict(window=2, bins=2, layers=1, heads=1, embed=8, features=8, dropout=0.0, act_dropout=False)
    start = BeTForSAC({"obs_dim": 39, "act_dim": 28, **config, "scale": [0.5] * 28}).eval()
    test = {"obs": torch.randn(12, 78), "base": torch.zeros(12, 28), "residual": torch.rand(12, 28) - 0.5, "mc": -30 * torch.rand(12)}
    pulls = {kind: critic_analysis.ppo_pulls(start, kind, test, 3) for kind in KINDS}
    assert all(pull["policy"] > 0 for pull in pulls.values())
    assert pulls["mlp"]["value"] == pulls["separate"]["value"] == 0 < pulls["shared"]["value"]


def architectures(gain, seeds=3):
    return pd.concat([pd.DataFrame({"task": "Door", "recipe": critic_analysis.recipe(m, k), "seed": range(seeds), "base_success": 0.5,
                                    "decorated_success": 0.5 + gain[k] + 0.01 * np.arange(seeds)}) for m in ("sac_finetune", "ppo_finetune")
                      for k in gain])


def test_gains_are_over_the_start_and_without_an_interval_below_three_seeds():
    rows = critic_analysis.gains(architectures({"separate": -0.2, "mlp": 0.1}))
    assert list(rows.recipe[:2]) == ["sac_finetune,critic_backbone=mlp", "sac_finetune,critic_backbone=separate"] and len(rows) == 4
    assert list(rows.value.round(2)) == [0.11, -0.19, 0.11, -0.19] and (rows.low < rows.value).all() and (rows.value < rows.high).all()
    assert rows.label[2] == "PPO, MLP" and set(rows.seeds) == {3}
    few = critic_analysis.gains(architectures({"mlp": 0.1}, seeds=2))
    assert few.low.isna().all() and list(few.seeds) == [2, 2]
    assert critic_analysis.gains(pd.DataFrame(columns=["task", "recipe", "seed"])).empty  # nothing is recorded


# ---- 09 --------------------------------------------------------------------------------------------------------------

def test_the_table_of_setups_changes_one_thing_of_the_papers_list_at_a_time():
    table = calql_analysis.setups().set_index("setup")
    changed = {a + b: [c for c in ("actor", "offline data", "online") if table.loc[a, c] != table.loc[b, c]] for a, b in
               zip("ABCD", "BCDE", strict=True)}
    assert changed == {"AB": ["offline data"], "BC": ["online"], "CD": ["actor"], "DE": ["actor"]}
    assert "50 rollouts" in table.loc["A", "offline data"] and list(table.online) == ["Cal-QL", "Cal-QL", "SAC", "SAC", "SAC"]
    with pytest.raises(PdkitError, match="no setup 'F'"):
        calql_analysis.trainer_of_setup("F")


def test_the_losses_differ_in_the_term_and_its_max_alone():
    small = dict(hidden=16, layers=1, batch=32, bf16=False, critic_lr=0.3, tau=0.5)  # values fall below returns within a few updates
    rows = pd.DataFrame(calql_analysis.losses("B", 6, 3, weight=50.0, **small))
    start = rows[rows["update"] == 0].drop(columns="loss").drop_duplicates()
    assert len(start) == 1 and list(rows["update"]) == [0, 3, 6] * 3 and list(dict.fromkeys(rows.loss)) == list(calql_analysis.LOSSES)
    last = rows[rows["update"] == 6].set_index("loss")[["data", "policy", "random"]]
    assert not np.allclose(last.loc["TD alone"], last.loc["CQL"], atol=1e-5)
    assert not np.allclose(last.loc["CQL"], last.loc["Cal-QL"], atol=1e-3) and last.policy["CQL"] < last.policy["Cal-QL"]
    assert rows.lifted.between(0, 1).all() and rows.lifted.max() > 0


@pytest.mark.parametrize("cql, cal, verdict", [(2.0, 0.9, "calibrated"), (0.4, 0.0, "no gap"), (2.0, 1.1, "not"), (2.0, 1.0, "calibrated")])
def test_the_verdict_on_the_max(cql, cal, verdict):
    rows = pd.DataFrame({"loss": ["CQL", "CQL", "Cal-QL"], "update": [0, 9, 9], "short": [9.0, cql, cal]})
    found, reasons = calql_analysis.calibration_verdict(rows)
    assert found == verdict and f"by {cql:.2f}" in reasons[0] and f"by {cal:.2f}" in reasons[1]


def test_values_are_measured_at_the_same_states_without_disturbing_anything():
    class Learner:
        """Q = -10 for the data's action (0), -4 for others."""

        def __init__(self):
            self.decorator, self.critic_view = DecoratorConfig(alpha=1.0, H=0), lambda x: x

        def normalize(self, obs):
            return obs

        def critics(self, x):
            return torch.where(x[:, 1] == 0, -10.0, -4.0)[None]

        def _sampled(self, rows, generator):
            return {"here": torch.ones(2, 4, 1), "random": torch.ones(2, 4, 1)}

        def _values(self, critics, obs, base, actions):
            return torch.stack([critics(torch.cat([obs, a], 1)) for a in actions], dim=1)

    rows = {"obs": torch.ones(4, 1), "base": torch.zeros(4, 1), "residual": torch.zeros(4, 1), "mc": torch.tensor([-9.0, -3.0, -2.0, -4.0])}
    assert calql_analysis._values(Learner(), rows) == {"data": -10, "policy": -4, "random": -4, "lifted": 0.5, "short": 0.75}


def run_rows(recipes, steps=40_000, **columns):
    return pd.concat([pd.DataFrame({"task": "Door", "recipe": r, "seed": range(3), "env_steps": steps, "episodes": 60,
                                    "decorated_success": 0.5} | columns) for r in recipes])


def curve_rows(recipes, successes=(0.2, 0.6, 0.4), seeds=3):
    return pd.concat([pd.DataFrame({"task": "Door", "recipe": r, "seed": s, "step": [0, *range(8_000, 8_000 * len(successes) + 1, 8_000)],
                                    "success_once": [0.9, *successes]}) for r in recipes for s in range(seeds)])


def test_joined_takes_e_from_the_leaderboard_and_only_there(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recorded, "DATA", tmp_path)
    for folder in ("results", "sweeps"):
        (tmp_path / folder).mkdir()
    for name in ("calql", "leaderboard", "calql_stackcube"):
        (tmp_path / "sweeps" / f"{name}.toml").touch()
    table, curves = calql_analysis.joined()
    assert table.empty and curves.empty and capsys.readouterr().out.count("pdkit sweep") == 2

    def write(name, recipes, offline=1_500, **columns):
        run_rows(recipes, **columns).to_csv(tmp_path / "results" / f"{name}.csv", index=False)
        curves = curve_rows(recipes).assign(updates=lambda t: offline + t.step // 4)
        curves.to_csv(tmp_path / "results" / f"{name}_curves.csv", index=False)

    write("calql", SETUPS[:4])
    assert set(calql_analysis.joined()[0].recipe) == set(SETUPS[:4]) and "leaderboard" in capsys.readouterr().out
    write("leaderboard", ["calql", "calql_a", "rot"], steps=40_004)
    table, curves = calql_analysis.joined()
    assert set(table.recipe) == set(curves.recipe) == set(SETUPS) and len(table) == 15 and (table.recipe == "calql_a").sum() == 3
    assert calql_analysis.joined("StackCube")[0].empty and "pdkit sweep data/sweeps/calql_stackcube.toml" in capsys.readouterr().out
    run_rows(SETUPS, task="StackCube").to_csv(tmp_path / "results" / "calql_stackcube.csv", index=False)
    assert set(calql_analysis.joined("StackCube")[0].recipe) == set(SETUPS)
    for other in (dict(steps=20_000), dict(episodes=200), dict(offline=3_000)):
        write("leaderboard", ["calql"], **other)
        with pytest.raises(PdkitError, match="another budget"):
            calql_analysis.joined()


def test_efficiency_leaves_the_offline_evaluation_out_and_late_falls_are_within_a_run():
    curves = curve_rows(["calql_a"])
    assert claims.efficiency(curves, "calql_a").to_list() == pytest.approx([0.4] * 3)
    with pytest.raises(claims.TooLittle):
        claims.efficiency(curves, "calql_b")
    with pytest.raises(claims.TooLittle):
        claims.efficiency(curve_rows(["calql_a"], seeds=2), "calql_a")
    found = calql_analysis.late(pd.concat([curves, curve_rows(["calql_c"], (0.1, 0.2, 0.3))]))
    assert found.to_dict("records") == [{"recipe": "calql_a", "seeds": 3, "best": pytest.approx(0.6), "last": pytest.approx(0.4),
                                         "largest fall": pytest.approx(0.2)},
                                        {"recipe": "calql_c", "seeds": 3, "best": pytest.approx(0.3), "last": pytest.approx(0.3),
                                         "largest fall": 0.0}]


# ---- figures ---------------------------------------------------------------------------------------------------------

def test_figures_of_08_draw_what_they_are_given():
    rows = pd.DataFrame([{"stage": s, "kind": k, "update": u, "drift": 0.1 * u * (k == "shared"), "error": 9.0 - u} for s in ("one", "two")
                         for k in KINDS for u in (0, 2, 4)])
    figure = plots_critics.drifts_figure(rows, KINDS)
    left, right = figure.axes
    assert [len(ax.lines) for ax in (left, right)] == [3, 3] and left.lines[1].get_ydata()[-1] == pytest.approx(0.4)
    assert left.get_title(loc="left") == "one" and left.lines[0].get_markersize() > left.lines[2].get_markersize()
    returns = np.array([-3.0, -1.0])
    figure = plots_critics.values_figure(rows[rows.stage == "one"], {k: returns + 1 for k in KINDS}, returns, KINDS)
    assert figure.axes[0].lines[3].get_ydata()[0] == 1.0 and len(figure.axes) == 4  # spread of -3 and -1
    assert list(figure.axes[2].lines[0].get_ydata()) == [-2.0, 0.0] and figure.axes[2].get_title(loc="left") == "shared transformer"
    prices = pd.DataFrame({"kind": list(KINDS), "parameters": [10, 30, 30], "own": [10, 12, 30], "seconds": [0.001, 0.002, 0.003]})
    figure = plots_critics.costs_figure(prices, KINDS)
    widths = [patch.get_width() for patch in figure.axes[0].patches]
    assert widths == [10, 12, 30, 0, 18, 0] and [p.get_width() for p in figure.axes[1].patches] == pytest.approx([1, 2, 3])
    assert "30" in figure.axes[0].texts[1].get_text() and len(figure.legends) == 1
    with pytest.raises(PdkitError, match="drift"):
        plots_critics.drifts_figure(rows.drop(columns="drift"), KINDS)


def test_figures_of_09_draw_what_they_are_given():
    steps = pd.DataFrame({"source": ["demonstrations"] * 3 + ["rollouts"], "mc": [-10.0, -5.0, 0.0, -33.3]})
    figure = plots_critics.returns_figure(steps, -33.3)
    assert sum(p.get_height() for p in figure.axes[0].patches) == 4 and "3 rows" in figure.legends[0].get_texts()[0].get_text()
    values = dict(data=-1.0, random=-3.0)
    rows = pd.DataFrame([{"loss": loss, "update": u, "policy": -2.0 * u} | values for loss in ("x", "y") for u in (0, 1)])
    figure = plots_critics.calibration_figure(rows, -7.0)
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["x", "y"] and list(figure.axes[1].lines[1].get_ydata()) == [0.0, -2.0]
    assert list(figure.axes[0].lines[3].get_ydata()) == [-7.0, -7.0]
    curves = curve_rows(["calql_a"]).assign(updates=lambda t: 300 + t.step, q_mean=-5.0, conservative=2.0, calibrated=0.25)
    labels = calql_analysis.labels()
    figure = plots_critics.offline_figure(curves, labels, own=curves[curves.seed == 0].assign(recipe="calql_b", q_mean=-9.0))
    lines = figure.axes[0].lines
    assert [list(line.get_xdata()) for line in lines] == [[300], [300]] and [line.get_ydata()[0] for line in lines] == [-5, -9]
    assert [text.get_text() for text in figure.legends[0].texts] == ["A: the original (3)", "B: no rollouts, your run"]
    times = pd.DataFrame({"label": ["a", "b"], "online": ["SAC", "Cal-QL"], "seconds": [0.01, 0.04]})
    ax = plots_critics.times_figure(times).axes[0]
    assert [p.get_width() for p in ax.patches] == pytest.approx([10, 40]) and ax.patches[0].get_facecolor() != ax.patches[1].get_facecolor()
    assert ax.get_xscale() == "log" and ax.texts[1].get_text().strip() == "40"
