"""Recorded results: what is read back from data/results."""
import numpy as np
import pandas as pd
import pytest

from pdkit import recorded, report
from pdkit.errors import PdkitError
from pdkit.files import read_json, write_json
from pdkit.plots_recorded import figure
from pdkit.sweep_spec import check_names


def test_rows_and_curves_of_one_task_are_loaded(results):
    rows = pd.DataFrame({"task": ["Door", "Door", "Pen"], "recipe": "a", "seed": [0, 1, 0], "decorated_success": [0.5, 0.7, 0.1]})
    rows.to_csv(results / "x.csv", index=False)
    assert recorded.load("x")[1].empty
    rows.drop(columns="decorated_success").assign(step=10).to_csv(results / "x_curves.csv", index=False)
    table, curves = recorded.load("x", "Door")
    assert table.seed.tolist() == [0, 1] == curves.seed.tolist() and len(recorded.load("x")[1]) == 3


def test_what_is_not_recorded_is_said_with_the_command_that_makes_it(results):
    with pytest.raises(PdkitError, match="No results 'x' are recorded.*no sweep in data/sweeps makes them"):
        recorded.load("x")
    (results.parent / "sweeps").mkdir()
    (results.parent / "sweeps" / "x.toml").touch()
    with pytest.raises(PdkitError, match="No results 'x' are recorded.*pdkit sweep data/sweeps/x.toml"):
        recorded.load("x")
    pd.DataFrame({"task": ["Pen"], "recipe": "a", "seed": 0}).to_csv(results / "x.csv", index=False)
    with pytest.raises(PdkitError, match="No results 'x' of Door"):
        recorded.load("x", "Door")


def test_a_notebooks_columns_become_rows_by_arm():
    table = pd.DataFrame({"seed": [0, 1], "success.before.value": [0.9, 0.8], "success.random critic, 2.value": [0.1, None],
                          "success.before.low": 0.0, "successes.x.value": 1.0})
    rows = recorded.by_arm(table, "success", "value", "success")
    assert rows.to_dict("records") == [{"recipe": "before", "seed": 0, "success": 0.9},
                                       {"recipe": "random critic, 2", "seed": 0, "success": 0.1},
                                       {"recipe": "before", "seed": 1, "success": 0.8}]
    with pytest.raises(PdkitError, match="no columns drift.ARM.value"):
        recorded.by_arm(table, "drift", "value", "drift")
    rows = recorded.by_arm(pd.DataFrame({"seed": [1], "heading.critic": [0.5], "cosine": [0.1]}), "heading", "", "at")
    assert rows.to_dict("records") == [{"recipe": "critic", "seed": 1, "at": 0.5}]


def test_a_notebooks_numbered_columns_become_rows():
    table = pd.DataFrame({"seed": [0, 1], "met.random actions.0.25": [0.5, None], "met.random actions.0": [0.0, 0.1], "metal.x.1": 9.0})
    rows = recorded.by_number(table, "met", "who", "start_fraction", "share")
    assert rows.to_dict("records") == [{"who": "random actions", "start_fraction": where, "seed": seed, "share": share}
                                       for where, seed, share in ((0.25, 0, 0.5), (0.0, 0, 0.0), (0.0, 1, 0.1))]
    with pytest.raises(PdkitError, match="no columns x.ARM.NUMBER"):
        recorded.by_number(table, "x", "who", "start_fraction", "share")


def test_the_picture_shows_every_policy_that_methods_start_from():
    """A comparison of methods has several: the first row's alone would stand for all."""
    rows = pd.DataFrame({"task": "Door", "recipe": ["a", "a", "b", "b", "c"], "policy": ["bet", "bet", "vinn", "vinn", "bet"],
                         "seed": [0, 1, 0, 1, 0], "episodes": 60, "base_success": [0.5, 0.5, 0.9, 0.9, 0.5],
                         "decorated_success": [0.7, 0.8, 0.1, 0.2, 0.0]})
    curves = rows[["task", "recipe", "seed"]].assign(step=1_000, success_once=0.6)
    for table, expected in ((rows, {"base (bet)": 0.5, "base (vinn)": 0.9, "a": 0.75, "b": 0.15}),
                            (rows[rows.recipe == "a"].assign(recipe=["x", "y"]), {"base": 0.5})):
        left, right = figure(table, curves[curves.recipe.isin(table.recipe)]).axes
        names = [label.get_text() for label in right.get_yticklabels()]
        widths = {names[round(bar.get_y() + bar.get_height() / 2)]: bar.get_width() / 100 for bar in right.patches}
        assert {name: widths[name] for name in expected} == pytest.approx(expected)
        dashes = sorted(line.get_ydata()[0] / 100 for line in left.lines if line.get_linestyle() == "--")
        assert dashes == sorted(value for name, value in expected.items() if name.startswith("base"))


def test_recipes_that_start_from_different_successes_show_each_its_own():
    """As over several horizons: the first one's would stand for all."""
    rows = pd.DataFrame({"task": "Door", "recipe": ["a", "a", "b", "b"], "policy": "bet", "seed": [0, 1, 0, 1], "episodes": 60,
                         "base_success": [0.5, 0.5, 0.9, 0.9], "decorated_success": [0.7, 0.8, 0.1, 0.2]})
    left, right = figure(rows, rows[["task", "recipe", "seed"]].assign(step=1_000, success_once=0.6)).axes
    names = [label.get_text() for label in right.get_yticklabels()]
    ticks = {names[round(sum(line.get_ydata()) / 2)]: line.get_xdata()[0] / 100 for line in right.lines if line.get_color() == "0.4"}
    assert ticks == {"a": 0.5, "b": 0.9} and names == ["b", "a"]  # from below: the better one is on top
    assert not [line for line in left.lines if line.get_linestyle() == "--"]
    starts = {line.get_color(): line.get_ydata()[0] / 100 for line in left.lines if line.get_marker() == "s"}
    assert starts == {line.get_color(): 0.5 if line.get_label() == "a" else 0.9 for line in left.lines if line.get_label() in "ab"}
    own = rows.assign(policy=["mlp", "mlp", "rnn", "rnn"])  # each over a kind of policy of its own
    assert [label.get_text() for label in figure(own, pd.DataFrame(columns=["task", "recipe", "seed"])).axes[1].get_yticklabels()] == names


def test_only_recipes_whose_kind_of_policy_has_several_starts_have_ticks():
    """A method from scratch has the row of the base that it was given: a tick there would call that its start."""
    rows = pd.DataFrame({"task": "Door", "recipe": ["a", "b", "c", "sac_from_scratch"] * 2, "policy": ["vinn", "vinn", "bet", "bet"] * 2,
                         "seed": [0] * 4 + [1] * 4, "episodes": 60, "base_success": [0.9, 0.8, 0.5, 0.5] * 2, "decorated_success": 0.7})
    right = figure(rows, rows[["task", "recipe", "seed"]].assign(step=1_000, success_once=0.6)).axes[1]
    names = [label.get_text() for label in right.get_yticklabels()]
    ticks = {names[round(sum(line.get_ydata()) / 2)]: line.get_xdata()[0] / 100 for line in right.lines if line.get_color() == "0.4"}
    assert ticks == {"a": 0.9, "b": 0.8} and "base (bet)" in names and "base (vinn)" not in names


def test_the_manifest_names_every_machine_that_recorded(results, monkeypatch):
    """Of one machine the newest commit; results of another stay labelled with theirs."""
    row = pd.DataFrame({"task": ["Door"], "recipe": ["a"], "seed": [0], "command": ["pdkit x"]})
    for number, (cores, commit) in enumerate([(2, "one"), (16, "two"), (2, "three")]):
        machine = {"cores": cores, "torch_threads": len(commit), "git": commit}
        monkeypatch.setattr(recorded, "describe_machine", lambda machine=machine: machine)
        recorded.record("x", row.assign(seed=number), pd.DataFrame())
    manifest = read_json(results / "x_manifest.json")
    assert [(machine["cores"], machine["git"]) for machine in manifest["machines"]] == [(16, "two"), (2, "three")]
    assert manifest["again"] == ["pdkit x"]
    assert len(recorded.load("x")[0]) == 3


def test_a_manifest_of_one_machine_is_taken_over(results, monkeypatch):
    write_json(results / "x_manifest.json", {"machine": {"cores": 4, "git": "old"}})
    monkeypatch.setattr(recorded, "describe_machine", lambda: {"cores": 2, "torch_threads": 1, "git": "new"})
    recorded.record("x", pd.DataFrame({"task": ["Door"], "recipe": ["a"], "seed": [0], "command": ["pdkit x"]}), pd.DataFrame())
    assert [machine["cores"] for machine in read_json(results / "x_manifest.json")["machines"]] == [4, 2]


def test_a_row_keeps_the_commit_of_its_own_run_and_older_ones_have_none(results):
    row = {"task": "Door", "recipe": "x", "command": "pdkit"}
    for seed, brought in ((0, {}), (1, {"commit": "one"}), (2, {"commit": "two"}), (3, {})):
        recorded.record("x", pd.DataFrame([row | {"seed": seed} | brought]), pd.DataFrame())
    assert recorded.load("x")[0].commit.fillna("").tolist() == ["", "one", "two", ""]


def test_counts_are_kept_to_the_last_digit_where_some_rows_lack_them(results):
    row = {"task": "Door", "recipe": "x", "command": "pdkit"}
    recorded.record("counts", pd.DataFrame([row | {"seed": 0, "steps": 1_234_567, "rate": 0.123456789}, row | {"seed": 1}]), pd.DataFrame())
    written = (results / "counts.csv").read_text()
    assert "1234567" in written and "0.123457" in written and "0.1234567" not in written


def test_the_pictures_of_a_record_are_drawn_again_from_its_tables(results):
    """A picture a task, the first under the record's name; none of what has no trainings."""
    rows = pd.DataFrame({"task": ["Pen", "Hammer"], "recipe": "7", "seed": 0, "episodes": 60, "base_success": 0.5, "decorated_success": 0.6,
                         "command": "pdkit x"})
    recorded.record("x", rows, rows[["task", "recipe", "seed"]].assign(step=1_000, success_once=0.6))
    recorded.record("y", rows.drop(columns="base_success"), pd.DataFrame())
    for path in results.glob("*.png"):
        path.unlink()
    for name in ("x", "y", "absent"):
        recorded.draw(name)
    assert {path.name for path in results.glob("*.png")} == {"x.png", "x-Pen.png"}


def test_runs_without_evaluations_can_be_drawn():
    table = pd.DataFrame([{"task": "Door", "recipe": "x", "seed": s, "base_success": 0.5, "decorated_success": 0.6, "episodes": n}
                          for s, n in ((0, 1_000), (1, 20))])
    left, right = figure(table, table[["task", "recipe", "seed"]].assign(step=10)).axes
    assert "20 to 1000 test episodes" in right.get_title() and not any(len(line.get_xdata()) > 2 for line in left.lines)
    widths = {round(float(np.ptp(segment[:, 0])), 1) for bars in right.collections for segment in bars.get_segments()}
    assert {6.1, 39.5} <= widths  # Wilson's of 600 of 1,000 and of 12 of 20


@pytest.mark.parametrize("name", ["mine/door", "..", "", ".x"])
def test_a_record_s_name_is_a_word(name):
    with pytest.raises(PdkitError, match="--record takes a name"):
        check_names(name)
    with pytest.raises(PdkitError, match="--recipe"):
        check_names(None, name)
    check_names("my-record.2", "fish,features=GPT")


@pytest.mark.parametrize("recipe", ["7", "None", "1e3", "true"])
def test_a_recipe_is_a_word_whatever_it_looks_like(results, recipe):
    """A table of whole numbers, or of nothing, could not be merged with one of words."""
    row = {"task": "Door", "seed": 0, "command": "pdkit", "base_success": 0.5}
    for name in (recipe, recipe, "other"):
        rows = pd.DataFrame([row | {"recipe": name}])
        recorded.record("x", rows, rows[recorded.KEYS].assign(step=10))
        assert recipe in recorded.load("x")[0].recipe.tolist()
    assert all(sorted(table.recipe) == sorted(["other", recipe]) for table in recorded.load("x"))
    assert report.table_problems("x", report.recorded_tables(results)["x"], results) == []


def test_only_tables_of_runs_can_be_recorded_in(results):
    for name, columns in (("claims", ["claim", "verdict"]), ("runs", recorded.KEYS)):
        pd.DataFrame(columns=columns).to_csv(results / f"{name}.csv", index=False)
    check_names("runs")
    check_names("new")
    (results / "empty.csv").touch()
    for name in ("claims", "runs_curves", "empty"):
        with pytest.raises(PdkitError, match=f"{name}.csv is no table of runs"):
            check_names(name)
