"""All tasks in one table and one figure, beside the paper's averages."""
import numpy as np
import pandas as pd
import pytest

from pdkit import plots_diffusion, plots_range, task_range
from pdkit.files import DATA
from pdkit.stats import wilson


@pytest.fixture
def tasks():
    rows = [dict(task="Door", policy="bet", seed=seed, episodes=200, env_steps=1000 + seed, base_success=0.5, decorated_success=end,
                 decorated_success_at_end=end - 0.1, command="pdkit train decorated Door --num-demos 5")
            for seed, end in enumerate((0.9, 0.95, 1.0))]
    rows.append(dict(task="StackCube", policy="mlp", seed=0, episodes=100, env_steps=60, base_success=0.4, decorated_success=0.8,
                     decorated_success_at_end=0.3))
    return task_range.by_task(pd.DataFrame(rows))


def test_every_task_of_the_paper_has_a_row(tasks):
    assert list(tasks.suite) == ["maniskill"] * 4 + ["adroit"] * 4 and tasks.task.nunique() == 8
    known = tasks.set_index("task")
    assert known.loc["Door", "decorated"] == pytest.approx(0.95) and known.loc["Door", "env_steps"] == 1002
    half = 4.302653 * 0.05 / np.sqrt(3)  # Student's t over three seeds
    assert known.loc["Door", "low"] == pytest.approx(0.95 - half, abs=1e-6) and known.loc["Door", "high"] == 1.0
    one = wilson(80, 100)
    assert (known.loc["StackCube", "low"], known.loc["StackCube", "high"]) == (one.low, one.high)  # one seed: its test episodes' alone
    assert known.loc["Pen", "seeds"] == 0 and np.isnan(known.loc["Pen", "decorated"]) and known.loc["Pen", "demos"] == 25
    assert known.loc["Door", "demos"] == 5  # of 25: what the base policy of these runs learned from
    assert known.loc["TurnFaucet", "label"] == "scripted, other objects" and known.loc["Pen", "label"] == "agent"


def test_a_decorated_bet_stands_for_a_task_whose_main_job_has_another_base():
    jobs = pd.DataFrame([dict(task=task, policy="mlp", seed=seed) for task in ("Pen", "StackCube") for seed in range(3)])
    bets = pd.DataFrame([dict(task="StackCube", policy="bet-sac", seed=seed) for seed in range(3)])
    shown = task_range.over_bets(jobs, bets)
    assert shown.task.tolist() == ["Pen"] * 3 + ["StackCube"] * 3 and shown.policy.tolist() == ["mlp"] * 3 + ["bet-sac"] * 3
    assert task_range.over_bets(jobs, bets[:2]).policy.tolist() == ["mlp"] * 6  # two seeds are too few to replace three
    assert task_range.over_bets(jobs, pd.DataFrame()) is jobs


def test_averages_are_over_what_is_recorded(tasks):
    means = task_range.averages(tasks).set_index("over")
    assert means.loc["all", "tasks"] == "2 of 8" and means.loc["all", "decorated"] == pytest.approx(0.875)
    assert means.loc["maniskill", "base"] == pytest.approx(0.4) and means.loc["maniskill", "paper_base"] == 0.3625
    assert means.loc["adroit", "tasks"] == "1 of 4" and means.loc["adroit", "paper_decorated"] == 0.99575


def test_the_figure_names_what_is_not_recorded(tasks):
    (ax,) = plots_range.range_figure(tasks, task_range.averages(tasks)).axes
    labels = [label.get_text() for label in ax.get_yticklabels()]
    assert labels[:2] == ["StackCube (1 seed)", "PegInsertionSide (not recorded)"] and labels[4] == "mean, 1 of 4 ManiSkill tasks"
    assert labels[5] == "Door (3 seeds)" and len(labels) == 10
    squares = [line for line in ax.lines if line.get_marker() == "s"]
    assert [float(np.ravel(line.get_xdata())[0]) for line in squares] == pytest.approx([0.3625, 0.98325, 0.4675, 0.99575])


def test_what_is_recorded_over_a_diffusion_policy(results):
    """The cell chosen for each task counts; a record that is not there is left out."""
    assert task_range.over_diffusion().empty
    rows = pd.DataFrame([dict(task="StackCube", recipe=recipe, policy="diffusion", seed=0, episodes=60, env_steps=16_000, base_success=0.7,
                              decorated_success=end, decorated_success_at_end=0.1)
                         for recipe, end in (("policy_decorator", 0.1), ("policy_decorator,alpha=0.03", 0.6), ("dppo", 0.9))])
    rows.to_csv(results / "diffusion_finetuning.csv", index=False)
    (row,) = task_range.over_diffusion().to_dict("records")
    assert (row["task"], row["suite"], row["policy"], row["seeds"], row["demos"]) == ("StackCube", "maniskill", "diffusion", 1, 300)
    assert row["base"] == pytest.approx(0.7) and row["decorated"] == pytest.approx(0.6) and row["at_end"] == pytest.approx(0.1)
    drawn = pd.concat([rows, rows.assign(seed=1, base_success=0.6)])  # a start that samples has a test of its own in each run
    drawn.to_csv(results / "diffusion_finetuning.csv", index=False)
    (two,) = task_range.over_diffusion().to_dict("records")
    assert two["base"] == pytest.approx(0.65) and two["base_high"] - two["base_low"] < row["base_high"] - row["base_low"]
    figure = plots_range.over_diffusion_figure(pd.DataFrame([two]))
    (ax,) = figure.axes
    assert figure.legends[0].get_texts()[-1].get_text() == "the paper's mean, what seem to be six tasks, not named"
    assert [label.get_text() for label in ax.get_yticklabels()] == ["StackCube (2 seeds)", "mean, 1 of 1 tasks"]
    assert [float(np.ravel(line.get_xdata())[0]) for line in ax.lines if line.get_marker() == "s"] == pytest.approx([0.5255, 0.999])


def test_the_table_of_diffusion_policies_is_what_is_recorded():
    told, rows = (DATA / "RESULTS.md").read_text().splitlines(), task_range.over_diffusion()
    for r in rows.itertuples():
        start, end = (f"{100 * value:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
                      for value, low, high in ((r.base, r.base_low, r.base_high), (r.decorated, r.low, r.high)))
        (line,) = (line for line in told if line.startswith(f"| {r.task}") and f" | {start} | {end} | " in line)
        assert f"| {r.demos}, {r.label.replace('other objects', 'of other')}" in line
        assert line.endswith(f" | {100 * r.at_end:.0f} % | {round(r.env_steps, -3):,} |")
    assert sum(f"| {100 * rows.base.mean():.1f} % | {100 * rows.decorated.mean():.1f} % |" in line for line in told) == 1


def test_longer_imitation_beside_decoration(tasks):
    """Only tasks that both records have; intervals over the seeds of each."""
    jobs = pd.DataFrame([dict(task=task, policy="bet", seed=seed, episodes=200, env_steps=10, base_success=0.5, decorated_success=end,
                              decorated_success_at_end=0) for task in ("Door", "Pen") for seed, end in enumerate((0.9, 0.95, 1.0))])
    longer = pd.DataFrame([dict(task=task, seed=seed, base_success=end)
                           for task in ("Pen", "Hammer") for seed, end in enumerate((0.6, 0.7, 0.8))])
    over = pd.DataFrame([dict(task="Pen", recipe=recipe, seed=seed, base_success=0.6, decorated_success=end)
                         for recipe, ends in (("lesson", (0.8, 0.9, 1.0)), ("alpha=0.03", (0.1, 0.2, 0.3)))
                         for seed, end in enumerate(ends)])
    (row,) = task_range.beside_imitation(jobs, longer, over).to_dict("records")
    half = 4.302653 * 0.1 / np.sqrt(3)  # Student's t over three seeds
    assert (row["task"], row["base"], row["imitated_seeds"]) == ("Pen", 0.5, 3) and row["imitated"] == pytest.approx(0.7)
    assert (row["imitated_low"], row["imitated_high"]) == pytest.approx((0.7 - half, 0.7 + half), abs=1e-6)
    assert row["decorated"] == pytest.approx(0.95) and row["high"] == 1.0 and row["over"] == pytest.approx(0.9) and row["over_high"] == 1.0
    figure = plots_range.beside_imitation_figure(pd.DataFrame([row]))
    assert [float(line.get_xdata()[0]) for line in figure.axes[0].lines] == pytest.approx([0.5, 0.95, 0.7, 0.9])
    assert [text.get_text() for text in figure.legends[0].get_texts()][2:4] == ["longer imitation (3 seeds)", "that, decorated (3 seeds)"]
    (without,) = task_range.beside_imitation(jobs, longer, over[:2]).to_dict("records")  # two seeds are too few
    assert np.isnan(without["over"]) and plots_range.beside_imitation_figure(pd.DataFrame([without])).axes
    assert task_range.beside_imitation(jobs, pd.DataFrame(columns=["task"]), over).empty


def test_rates_by_temperature_the_task_that_gains_most_first(results):
    assert task_range.by_temperature().empty
    rates = {"Pen": (0.5, 0.6, 0.4), "Door": (0.3, 0.8, 0.9)}
    rows = [dict(task=task, recipe=f"base,temperature={t}", seed=0, episodes=100, success=rate, low=rate - 0.1, high=rate + 0.1,
                 success_at_end=0.2) for task, three in rates.items() for t, rate in zip((1.0, 0.5, 0.0), three, strict=True)]
    rows.append(rows[0] | dict(recipe="base,chunk=1", success=1.0))
    pd.DataFrame(rows).to_csv(results / "sampling.csv", index=False)
    table = task_range.by_temperature()
    assert table.task.tolist() == ["Door"] * 3 + ["Pen"] * 3 and table.temperature.tolist() == [1, 0.5, 0] * 2
    assert table.success.tolist() == [0.3, 0.8, 0.9, 0.5, 0.6, 0.4]
    door, pen = plots_diffusion.temperature_figure(table).axes
    assert (door.get_title(loc="left"), pen.get_title(loc="left")) == ("Door", "Pen")
    assert sorted(map(tuple, np.round(pen.lines[0].get_xydata(), 3).tolist())) == [(0, 0.4), (0.5, 0.6), (1, 0.5)]


def test_the_figure_of_bounds_has_a_panel_a_task_and_a_diamond_where_something_was_learned():
    table = pd.DataFrame([dict(task=task, alpha=alpha, success=alpha, low=0.0, high=1.0)
                          for task in ("Door", "Pen") for alpha in (0, 0.1, 0.3)])
    figure = plots_range.bounds_figure(table, pd.DataFrame([dict(task="Pen", alpha=0.4, success=0.7)]))
    door, pen = figure.axes
    assert [ax.get_title(loc="left") or ax.get_title() for ax in (door, pen)] == ["Door", "Pen"] and len(door.lines) == 1
    diamond = pen.lines[1]
    assert (diamond.get_marker(), *map(float, (*diamond.get_xdata(), *diamond.get_ydata()))) == ("D", 0.4, 0.7) and pen.get_xlim()[1] > 0.4
    assert len(plots_range.bounds_figure(table).legends[0].get_texts()) == 1
