"""Comparisons say what their rows say: tables of methods, one change at a time, the figures of both, and a run of one's own."""
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from pdkit import ablations, claims, compare, plots_compare, recorded
from pdkit import runs as runs_module
from pdkit.claims import TooLittle
from pdkit.errors import PdkitError
from pdkit.files import DATA
from pdkit.methods import METHODS, Method
from pdkit.policies import load_policy
from pdkit.seeds import reported_seeds
from pdkit.sweep_spec import load_spec


def runs(recipe, ends, task="Door", base=0.5, **columns):
    """Rows of a recipe with these final successes, a seed each."""
    rows = {"task": task, "policy": "bet", "recipe": recipe, "seed": range(len(ends)), "decorated_success": ends, "base_success": base,
            "decorated_success_at_end": np.array(ends) / 2, "train_minutes": 4.0, "env_steps": 40_000, "updates": 8_500, "episodes": 60,
            "base_jerk": 50.0, "decorated_jerk": 100.0, "base_action_change": 0.1, "decorated_action_change": 0.1}
    return pd.DataFrame(rows | columns)


@pytest.fixture
def table():
    return pd.concat([runs("residual_rl", [0.1, 0.0, 0.2]), runs("policy_decorator", [0.9, 1.0, 0.8]),
                      runs("sac_from_scratch", [0.0, 0.0, 0.0])], ignore_index=True)


# ---- recorded rows ---------------------------------------------------------------------------------------------------

def test_what_is_not_recorded_is_told_and_empty(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recorded, "DATA", tmp_path)
    for path in ("results", "sweeps"):
        (tmp_path / path).mkdir()
    (tmp_path / "sweeps" / "ablations.toml").touch()
    rows, curves = compare.available("ablations")
    assert rows.empty and curves.empty and "pdkit sweep data/sweeps/ablations.toml" in capsys.readouterr().out
    runs("a", [0.5]).to_csv(tmp_path / "results" / "ablations.csv", index=False)
    assert len(compare.available("ablations")[0]) == 1 and not capsys.readouterr().out


def test_every_method_has_one_family_and_a_place():
    members = [name for family in compare.FAMILIES.values() for name in family]
    assert sorted(members) == sorted(METHODS)
    names = compare.titles(["rlpd", "sac_finetune,actor_lr=1e-4", "jsrl", "sac_finetune", "jsrl"])
    assert list(names) == ["jsrl", "sac_finetune,actor_lr=1e-4", "sac_finetune", "rlpd"]
    assert names["sac_finetune,actor_lr=1e-4"] == "SAC fine-tuning, actor_lr=1e-4" and names["jsrl"] == METHODS["jsrl"].title
    assert compare.families(["rlpd", "sac_finetune,actor_lr=1e-4"]) == {
        "fine-tuning the policy itself": ["sac_finetune,actor_lr=1e-4"], "from scratch": ["rlpd"]}
    assert compare.from_scratch("rlpd,n_step=1") and not compare.from_scratch("jsrl")
    with pytest.raises(PdkitError, match="jslr.*Did you mean 'jsrl'"):
        compare.titles(["jslr"])


def test_a_method_of_the_readers_own_comes_last(monkeypatch):
    own = {"mine": Method("Mine", "me"), "blank": Method("Blank", "me", trainer="pdkit.methods.scratch:Scratch")}
    for name, method in own.items():
        monkeypatch.setitem(METHODS, name, method)
    assert list(compare.titles(["mine", "rlpd", "mine,alpha=1"])) == ["rlpd", "mine", "mine,alpha=1"]
    assert compare.families(["mine", "rlpd"]) == {"from scratch": ["rlpd"], "others": ["mine"]}
    assert compare.from_scratch("blank") and not compare.from_scratch("mine")


def test_runs_from_one_start_have_plain_names_and_stand_apart():
    plain, tuned = runs("policy_decorator", [0.9]), runs("sac_finetune", [0.0], policy="bet-sac")
    given = runs("policy_decorator,base=bet-sac", [0.8], policy="bet-sac")
    table = pd.concat([plain, tuned, given], ignore_index=True)
    assert compare.own_starts(table).recipe.tolist() == ["policy_decorator", "sac_finetune"]
    same = compare.one_start(table)
    assert same.recipe.tolist() == ["sac_finetune", "policy_decorator"] and same.decorated_success.tolist() == [0.0, 0.8]
    assert compare.one_start(pd.DataFrame(columns=["task", "recipe", "seed"])).empty  # as `available` gives it where nothing is recorded


def test_scores_take_the_seeds_that_all_tasks_have():
    table = pd.concat([runs("a", [0.1, 0.2, 0.3]), runs("a", [0.5, 0.6], task="Pen").iloc[::-1], runs("b", [0.9])], ignore_index=True)
    assert compare.scores(table, "a", "decorated_success").tolist() == [[0.1, 0.5], [0.2, 0.6]]
    assert set(compare.shared(table).recipe) == {"a"} and len(compare.shared(table)) == 5
    with pytest.raises(PdkitError, match="No seed of b .* all of Door, Pen"):
        compare.scores(table, "b", "decorated_success")
    own = pd.concat([runs("policy_decorator", [0.5]), runs("rot", [0.1]), runs("ppo_decorator", [0.2], task="Pen")])
    assert set(compare.shared(own).recipe) == {"policy_decorator", "rot"}  # Pen, without the decorator, is another comparison


def test_both_forms_are_compared_on_the_seeds_that_they_share():
    """An interrupted sweep: the original has two seeds more, better ones."""
    table = pd.concat([runs("bet,short", [0] * 5, base=[0.5, 0.6, 0.4, 0.9, 0.9]), runs("bet-sac,short", [0] * 3, base=[0.6, 0.7, 0.5]),
                       runs("bet-sac,arm,short", [0] * 3, base=[0.7, 0.8, 0.6])]).assign(demos=5, iteration=1_400)
    alone = runs("bet", [0] * 3).assign(demos=5, iteration=80)  # of another number of steps one form only
    paper, ours = compare.forms(pd.concat([table, alone])).to_dict("records")
    assert paper == {"task": "Door", "demonstrations": 5, "gradient steps": "1,400", "seeds": 3, "original, %": "50",
                     "form": compare.FORMS["bet-sac"], "modified, %": "60", "modified less original, points": "+10 (+10 to +10)"}
    assert (ours["form"], ours["modified, %"]) == (compare.FORMS["bet-sac,arm"], "70")
    with pytest.raises(PdkitError, match="bet_forms.toml"):
        compare.forms(alone)


# ---- comparisons -----------------------------------------------------------------------------------------------------

def test_the_final_table(table):
    standing = compare.league(table).set_index("recipe")
    assert list(standing.index) == ["policy_decorator", "residual_rl", "sac_from_scratch"]
    best, worst, scratch = (standing.loc[name] for name in standing.index)
    assert (best.iqm, best.seeds, best.start, best.at_end, best.minutes) == pytest.approx((0.9, 3, 0.5, 0.45, 4.0))
    assert best.gain == pytest.approx(0.4) and best.low == pytest.approx(0.8) and best.high == 1.0 and np.isnan(best.p)
    assert (best.gain_low, best.gain_high) == pytest.approx((0.3, 0.5))
    assert (worst.p, worst.p_low, worst.p_high) == (0, 0, 0) and worst.gain == pytest.approx(-0.4)
    assert np.isnan(scratch.start) and np.isnan(scratch.gain) and scratch.iqm == 0
    text = compare.formatted(compare.league(table)).set_index("method")
    assert text.loc["residual_rl", "final success, IQM, %"] == "10 (0 to 20)" and text.loc["residual_rl", "starts at, %"] == "50"
    assert text.loc["policy_decorator", "gain over its start, points"] == "+40 (+30 to +50)"
    assert text.loc["sac_from_scratch", "gain over its start, points"] == "-" == text.loc["policy_decorator", "P(above Policy Decorator)"]


def test_two_seeds_have_no_interval_and_one_lucky_run_no_rank():
    few = compare.league(pd.concat([runs("policy_decorator", [0.9, 0.7]), runs("jsrl", [0.8, 0.8])])).set_index("recipe")
    assert few.iqm.tolist() == pytest.approx([0.8, 0.8]) and few[["low", "high", "gain_low", "p_high"]].isna().all().all()
    assert few.p["jsrl"] == 0.5 and few.gain["jsrl"] == pytest.approx(0.3)
    lucky = compare.league(pd.concat([runs("jsrl", [0.0, 0.0, 0.0, 0.1, 1.0]), runs("fish", [0.15] * 5)]), reference="rot")
    assert list(lucky.recipe) == ["fish", "jsrl"] and lucky.p.isna().all()


def test_a_league_over_two_tasks_needs_both():
    table = pd.concat([runs("policy_decorator", [0.9, 1.0, 0.8]), runs("policy_decorator", [0.1, 0.2, 0.0], task="Pen"),
                       runs("rot", [1, 1, 1])])
    with pytest.raises(PdkitError, match="compare on fewer tasks"):
        compare.league(table)
    only = compare.league(compare.shared(table))
    assert len(only) == 1 and only.iqm[0] == pytest.approx(0.5)  # of 0.1, 0.2, 0.8 and 0.9


def test_pairs(table):
    pairs = compare.pairwise(table, {"policy_decorator": "D", "residual_rl": "R", "sac_from_scratch": "S", "rot": "absent"})
    assert pairs.columns.tolist() == ["D", "R", "S"] == pairs.index.tolist()
    assert pairs.loc["D", "R"] == 1 and pairs.loc["R", "D"] == 0 and np.isnan(pairs.loc["R", "R"])
    assert pairs.loc["R", "S"] == pytest.approx((6 + 3 * 0.5) / 9)  # two of three runs above all, one equal to all


def test_smoothness_is_a_ratio_to_the_given_policy():
    rows = pd.concat([runs("jsrl", [1, 1, 1], decorated_jerk=[50.0, 100.0, 200.0], decorated_action_change=0.0),
                      runs("fish", [1, 1], decorated_jerk=25.0)])
    smooth = compare.smoothness(rows).set_index("recipe")
    assert smooth.jerk["jsrl"] == pytest.approx(2) and smooth.jerk_low["jsrl"] == pytest.approx(1) and smooth.jerk["fish"] == 0.5
    assert smooth.change["jsrl"] == pytest.approx(compare.LEAST_RATIO)  # standing still, and still a number
    assert np.isnan(smooth.jerk_low["fish"]) and smooth.seeds["fish"] == 2


def test_budgets_tell_what_is_not_equal():
    table = pd.concat([runs(name, [0.5]) for name in ("policy_decorator", "sac_finetune", "ppo_decorator", "fish", "rlpd")])
    rows = compare.budgets(table, compare.titles(list(table.recipe))).set_index("method")
    assert rows.loc["SAC fine-tuning", "transitions an update"] == "64" != rows.loc["Policy Decorator", "transitions an update"]
    assert rows.loc["Policy Decorator (PPO)", ["demonstrations", "transitions an update"]].tolist() == ["none", "64"]
    assert rows.loc["FISH", ["starts from", "demonstrations"]].tolist() == ["nearest neighbours (VINN)", "yes, not in batches"]
    assert rows.loc["RLPD, the original", ["starts from", "demonstrations"]].tolist() == ["nothing", "50% of a batch"]
    assert set(rows.updates) == {"8,500"} and rows.loc["Policy Decorator", "demonstrations"] == "25% of a batch"


def test_figures_give_no_interval_below_three_seeds():
    table = pd.concat([runs("one", [0.5]), runs("two", [0.2, 0.6]), runs("three", [0.1, 0.2, 0.6])])
    rows = plots_compare.summary(table).set_index("recipe")
    assert rows.low.isna().tolist() == rows.high.isna().tolist() == [True, True, False]
    assert rows.iqm.tolist() == pytest.approx([0.5, 0.4, 0.3]) and rows.low["three"] < 0.3 < rows.high["three"]
    assert plots_compare.finals_figure(table).png()[:4] == b"\x89PNG"


# ---- one change at a time --------------------------------------------------------------------------------------------

def test_differences_are_paired_by_seed():
    table = pd.concat([runs("a", [0.5, 0.7, 0.9, 0.1]), runs("b", [0.4, 0.5, 0.8], base=0.2), runs("c", [0.6, 0.6])])
    rows = ablations.differences(table, {"a": "A", "b": "B", "c": "C", "d": "not recorded"}, "a").set_index("recipe")
    assert list(rows.index) == ["b", "c"] and rows.seeds.tolist() == [3, 2]
    assert rows.value.tolist() == pytest.approx([-0.4 / 3, 0.0])
    assert (rows.low["b"], rows.high["b"]) == pytest.approx((-0.27676, 0.01009), abs=1e-5)  # Student's t, 2 degrees of freedom
    assert np.isnan(rows.low["c"])
    gains = ablations.differences(table, {"b": "B"})
    assert gains.value[0] == pytest.approx(1.7 / 3 - 0.2)
    assert ablations.lines(rows.reset_index()) == ["B: -13.3 points (-27.7 to +1.0), 3 pairs",
                                                   "C: +0.0 points over 2 seeds, too few for an interval"]


def test_own_runs_find_their_recorded_cell():
    cells = {cell["recipe"] for cell in load_spec(DATA.parent / "data" / "sweeps" / "ablations.toml").cells}
    named = {ablations.cell_of(0.1, 8_000, 16_000), ablations.cell_of(1, 0, 600), ablations.cell_of(0.1, 40_000, 40_000),
             ablations.cell_of(0.1, 300, 600, "residual"), ablations.cell_of(0.1, 300, 600, "residual", units="bound"),
             ablations.cell_of(0.1, 300, 600, "sum", "obs+base", "bound")}
    assert named <= cells and ablations.GRID in named and len(named) == 6
    assert ablations.cell_of(0.3, 0, 10, "concat") == "alpha=0.3,H=0,critic_input=concat"


def test_the_grid():
    table = pd.concat([runs("alpha=0.1,H=0", [0.2, 0.4]), runs("alpha=1.0,H=20000", [0.1]), runs("critic_input=concat", [0.9])])
    grid = ablations.grid(table)
    assert grid.loc[0.1, 0] == pytest.approx(0.3) and np.isnan(grid.loc[0.1, 20_000]) and grid.shape == (2, 2)
    with pytest.raises(PdkitError, match="no grid"):
        ablations.grid(runs("critic_input=concat", [0.9]))


def test_a_gate_is_held_against_that_of_its_own_bound():
    cells = {"alpha=0.1,H=0": [0.1, 0.2, 0.3], "alpha=1.0,H=0": [0.5, 0.6], "alpha=0.1,H=20000": [0.3, 0.3, 0.3],
             "alpha=1.0,H=20000": [0.4, 0.4], "alpha=0.1,H=40000": [0.4, 0.4, 0.4], "alpha=0.3,H=0": [0.9], "critic_input=concat": [0.9]}
    table = pd.concat([runs(name, values) for name, values in cells.items()])
    rows = ablations.gate_effects(table)
    assert rows.label.tolist() == ["alpha 0.1, H 0", "alpha 0.1, H 40,000", "alpha 1, H 0"]  # 0.3 has nothing to be held against
    assert rows.value.tolist() == pytest.approx([-0.1, 0.1, 0.15]) and rows.seeds.tolist() == [3, 3, 2] and np.isnan(rows.low[2])
    assert ablations.gate_effects(runs("critic_input=concat", [0.9])).empty


def test_action_scales_stay_inside_an_episode():
    parts = [np.array([[0.5], [-2.0]]), np.array([[1.0], [0.0]])]
    demos = SimpleNamespace(task="Door", actions=np.concatenate(parts), episodes=lambda: [{"actions": part} for part in parts])
    assert ablations.action_scales(demos) == pytest.approx({"mean |a|": 2.5 / 4, "mean |a_t - a_(t-1)|": 1.25})  # -2 counts as -1
    wide = [np.hstack([np.repeat(part, 3, axis=1), -np.ones_like(part)]) for part in parts]  # a gripper, which alpha does not bound
    cube = SimpleNamespace(task="StackCube", actions=np.concatenate(wide), episodes=lambda: [{"actions": part} for part in wide])
    assert ablations.action_scales(cube) == pytest.approx(ablations.action_scales(demos))


@pytest.mark.parametrize("near, best, base, verdict", [
    ([0.9, 0.92, 0.94], [0.7, 0.7, 0.7], 0.5, "reproduced"),  # is the best itself
    ([0.9, 0.92, 0.94], [0.95, 0.95, 0.95], 0.5, "reproduced"),
    ([0.9, 0.95, 0.80], [0.95, 0.95, 0.95], 0.5, "partly"),
    ([0.6, 0.7, 0.65], [0.95, 0.95, 0.95], 0.5, "not"),
    ([0.9, 0.92, 0.94], [0.95, 0.95, 0.95], 0.93, "not"),  # close to the best, which is worth nothing
])
def test_a_bound_works_where_it_helps_and_hardly_any_is_better(near, best, base, verdict):
    table = pd.concat([runs("alpha=0.1,H=20000", near, base=base), runs("alpha=0.3,H=20000", best, base=base),
                       runs("alpha=1.0,H=0", [1, 1, 1], base=base)])
    found, behind, recipe = ablations.alpha_works(table, 0.15)  # 0.1 is closer in ratio
    assert (found, recipe) == (verdict, "alpha=0.1,H=20000") and behind.value == pytest.approx(min(np.mean(near) - np.mean(best), 0))
    assert ablations.alpha_works(table, 0.5)[2] == "alpha=0.3,H=20000"
    with pytest.raises(TooLittle, match="two bounds"):
        ablations.alpha_works(table[table.recipe != "alpha=0.3,H=20000"], 0.15)


# ---- a run of one's own ----------------------------------------------------------------------------------------------

def test_what_learns_from_scratch_is_measured_against_the_base_policy():
    """As its recorded runs are (data/sweeps/leaderboard_stackcube.toml)."""
    assert compare.start_of("sac_from_scratch", "StackCube").name == "base"


def test_comparisons_start_from_a_behavior_transformer():
    folders = {(method, task): compare.start_of(method, task).relative_to(DATA / "checkpoints").as_posix() for method, task in (
        ("policy_decorator", "Door"), ("policy_decorator", "StackCube"), ("sac_finetune", "StackCube"), ("calql_a", "StackCube"),
        ("fish", "Door"))}
    assert list(folders.values()) == ["Door/base", "StackCube/bet-sac", "StackCube/bet-sac", "StackCube/bet-sac", "Door/vinn"]
    assert all(load_policy(DATA / "checkpoints" / f).kind in (*claims.BETS, "vinn") for f in folders.values())


def test_an_own_run_is_a_recorded_row_and_is_made_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path / "runs"))
    settings = dict(total_steps=260, warmup_steps=100, eval_every=0, log_every=100, batch=32)
    row, curve = compare.own_run("residual_rl", "Door", "smoke", 3, tmp_path, 1, **settings)
    assert row.loc[0, ["task", "recipe", "seed", "episodes", "policy"]].tolist() == ["Door", "residual_rl", 3, 1, "bet"]
    assert {"base_jerk", "decorated_success", "updates", "env_steps"} <= set(row) and set(curve.recipe) == {"residual_rl"}
    assert curve.gate.eq(1).all() and row.env_steps[0] >= 260
    before, after, episode = compare.before_and_after(row)
    assert before.kind == "bet" and after.config.alpha == 1.0 and episode == reported_seeds(1)[0]
    monkeypatch.setattr(compare, "decorate", lambda *a: pytest.fail("it trained again"))
    capsys.readouterr()
    again, _ = compare.own_run("residual_rl", "Door", "smoke", 3, tmp_path, 1, "mine", **settings)
    said = capsys.readouterr().out
    assert said.startswith("Trained already (20") and "code has changed" not in said and f"delete {row.folder[0]}" in said
    monkeypatch.setattr(runs_module, "code_checksum", lambda: "edited")
    compare.own_run("residual_rl", "Door", "smoke", 3, tmp_path, 1, **settings)
    assert "and the kit's code has changed since" in capsys.readouterr().out
    assert again.recipe[0] == "mine" and again.updates[0] == row.updates[0]
    for name, task, message in (("residal_rl", "Door", "Did you mean"), ("fish", "StackCube", "FISH starts from a policy .* StackCube")):
        with pytest.raises(PdkitError, match=message):
            compare.own_run(name, task, "smoke", 0, tmp_path, 1)


def test_expected_minutes_follow_the_recorded_runs(table):
    assert compare.expected_minutes(table, "residual_rl", 10_000) == pytest.approx(1.0)
    assert compare.expected_minutes(table, "rot", 10_000) is None


# ---- figures ---------------------------------------------------------------------------------------------------------

def curve(recipe, values, seeds=3):
    return pd.concat([pd.DataFrame({"task": "Door", "recipe": recipe, "seed": s, "step": [8_000 + s, 16_000 + s],
                                    "success_once": np.array(values) + 0.1 * s}) for s in range(seeds)])


def legend(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_panels_show_each_family_and_the_reference_everywhere():
    curves = pd.concat([curve("policy_decorator", [0.5, 0.7]), curve("residual_rl", [0.0, 0.1], 1), curve("rot", [0.2, 0.3])])
    own = curve("rot", [0.9, 0.8], 1)
    names = compare.titles(list(curves.recipe))
    figure = plots_compare.panels_figure(curves, compare.families(list(names)), labels=names, reference="policy_decorator", base=0.55,
                                         starts={"rot": 0.5}, own=own, title="x")
    first, second = figure.axes[:2]
    assert [ax.get_title(loc="left") for ax in (first, second)] == list(compare.FAMILIES)[:2]
    assert legend(first) == ["Policy Decorator (3)", "Residual RL (1)"]
    assert legend(second) == ["Policy Decorator (3)", "ROT (3)", "ROT, your run"]
    lines = {line.get_label(): line for line in second.lines}
    assert to_hex(lines["Policy Decorator (3)"].get_color()) == "#9a9a9a" != to_hex(first.lines[0].get_color())
    assert lines["ROT (3)"].get_ydata() == pytest.approx([0.3, 0.4]) and lines["ROT (3)"].get_xdata().tolist() == [8_001, 16_001]
    assert lines["ROT, your run"].get_ydata().tolist() == [0.9, 0.8]
    squares = [line for line in second.lines if line.get_marker() == "s"]
    assert len(squares) == 1 and squares[0].get_ydata()[0] == 0.5 and not [line for line in first.lines if line.get_marker() == "s"]
    band = second.collections[-1].get_paths()[0].vertices[:, 1]
    assert 0.2 <= band.min() < 0.3 and 0.4 < band.max() <= 0.5  # a bootstrap of the mean stays inside the seeds
    with pytest.raises(PdkitError, match="success_once"):
        plots_compare.panels_figure(curves.drop(columns="success_once"), {"a": ["rot"]})


def test_a_matrix_writes_its_numbers():
    values = pd.DataFrame([[np.nan, 0.97], [0.03, np.nan]], index=["a", "b"], columns=["a", "b"])
    ax = plots_compare.matrix_figure(values, middle=0.5, xlabel="H").axes[0]
    assert {text.get_position(): text.get_text() for text in ax.texts} == {(1, 0): "97%", (0, 1): "3%"}
    assert [text.get_color() for text in ax.texts] == ["white", "white"] and ax.get_xlabel() == "H"
    assert [t.get_text() for t in ax.get_yticklabels()] == ["a", "b"]
    with pytest.raises(PdkitError, match="at least one row"):
        plots_compare.matrix_figure(pd.DataFrame())


def test_the_trade_draws_runs_means_and_starts(table):
    table = table[table.recipe != "sac_from_scratch"].assign(decorated_jerk=[100, 200, 300, 40, 50, 60])
    own = runs("residual_rl", [0.3], decorated_jerk=500.0)
    labels = {"residual_rl": "R", "policy_decorator": "D"}
    ax = plots_compare.trade_figure(table, labels=labels, own=own, starts=[("a BeT", 50.0, 0.5)]).axes[0]
    lines = {line.get_label(): line for line in ax.lines}
    assert lines["R"].get_xdata()[0] == pytest.approx(200) and lines["D"].get_ydata()[0] == pytest.approx(0.9)
    assert lines["R, your run"].get_xdata()[0] == 500 and ax.get_xscale() == "log"
    assert [line.get_xydata().tolist() for line in ax.lines if line.get_marker() == "X"] == [[[50.0, 0.5]]]
    assert [text.get_text() for text in ax.texts] == ["start: a BeT"]
    with pytest.raises(PdkitError, match="both jerk and success"):
        plots_compare.trade_figure(table.assign(decorated_jerk=np.nan))


def test_curves_that_coincide_are_both_seen_and_begin_at_their_starts():
    curves = pd.DataFrame({"recipe": ["a", "a", "b", "b", "c", "c"], "seed": 0, "step": 3 * [10, 20], "success_once": [0, 0, 0, 0, 0, 0.5]})
    ax = plots_compare.curves_figure(curves, starts={"b": 0.4}).axes[0]
    assert [line.get_linestyle() for line in ax.lines if len(line.get_xdata()) == 2] == ["-", "--", "-"]
    assert [line.get_xydata().tolist() for line in ax.lines if line.get_marker() == "s"] == [[[0, 0.4]]]
    panels = plots_compare.panels_figure(curves, {"one": ["a", "b", "c"]}, starts={"a": 0.5, "b": 0.5}).axes[0]
    assert [line.get_linestyle() for line in panels.lines if len(line.get_xdata()) == 2] == ["-", "--", "-"]
    sizes = [line.get_markersize() for line in panels.lines if line.get_marker() == "s"]
    assert len(sizes) == 2 and sizes[0] > sizes[1]  # a square in the other


def test_starting_points_are_those_of_methods_that_start_from_a_policy(table):
    """One cross for a policy that several share, one for each of two lookups, and none for the yardstick of a method from scratch."""
    table = pd.concat([table.assign(base_jerk=[50.0, 50.1, 49.9] * 2 + [9.0] * 3), runs("fish", [0.9], policy="vinn", base=0.93),
                       runs("fish,features=GPT", [0.9], policy="vinn", base=0.88)])
    points = compare.starting_points(table, {"fish": "FISH"})
    assert points == [("the base policy", pytest.approx(50.0), 0.5), ("that of fish,features=GPT", 50.0, 0.88),
                      ("that of FISH", 50.0, 0.93)]


def test_differences_are_drawn_in_points_with_the_side_as_colour():
    rows = pd.DataFrame({"recipe": ["a", "b", "c"], "label": ["A", "B", "C"], "seeds": [3, 5, 2], "value": [0.2, -0.3, 0.05],
                         "low": [0.1, -0.4, np.nan], "high": [0.3, -0.2, np.nan]})
    single = pd.DataFrame({"recipe": ["b", "x"], "value": [-0.5, 0.9]})
    ax = plots_compare.differences_figure(rows, others=single).axes[0]
    assert [t.get_text() for t in ax.get_yticklabels()] == ["C (2)", "B (5)", "A (3)"]
    dots = {line.get_ydata()[0]: line for line in ax.lines if line.get_marker() == "o"}
    assert [dots[y].get_xdata()[0] for y in range(3)] == pytest.approx([5, -30, 20])
    assert len({to_hex(dots[y].get_color()) for y in range(3)}) == 3  # undecided, lost, gained
    diamonds = [line.get_xydata().tolist() for line in ax.lines if line.get_marker() == "D"]
    assert diamonds == [[[-50.0, 1.0]]]
