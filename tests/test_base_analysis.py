"""What lesson 04 measures and draws: choices in demonstrations, the flattery of selection, curves, gains; and the exercise."""
import itertools
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.patches import Rectangle
from scipy.stats import binom
from worlds import reach_demos

from pdkit import base_analysis as analysis
from pdkit import check, imitate, plots_bases, stats
from pdkit.demos import Demos
from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.files import DATA
from pdkit.policies import POLICIES
from pdkit.probes import PROBES
from pdkit.seeds import selection_seeds
from pdkit.sweep_jobs import make_jobs
from pdkit.sweep_spec import load_spec

SMALL = {"MLP": analysis.Family("mlp", 60, dict(hidden=16)), "chunked": analysis.Family(
    "diffusion", 60, dict(horizon=4, chunk=2, dims=[8, 16], groups=4, embed=8), dict(lr=3e-3, lr_warmup=0, batch=32))}


def demos_of(*episodes):
    """Demonstrations whose episodes are lists of (observation, action), each ended by an observation far away."""
    observations = [[*(o for o, _ in episode), [1e3, 1e3]] for episode in episodes]
    actions = [[a for _, a in episode] for episode in episodes]
    return Demos("reach", "scripted", "test", "-", np.concatenate(observations).astype(np.float32),
                 np.concatenate(actions).astype(np.float32), np.zeros(sum(map(len, actions)), bool),
                 np.array([len(a) for a in actions]), np.arange(len(episodes)))


# ---- demonstrations --------------------------------------------------------------------------------------------------

def test_neighbours_are_the_closest_steps_of_other_episodes_one_of_each():
    """The first number is large in every episode and must be put in standard units; own steps and last observations do not count."""
    first = [([0, 0.00], [0.0]), ([0, 0.01], [0.1])]
    second = [([900, 0.00], [0.2]), ([0, 0.02], [0.3]), ([0, 0.03], [0.4])]
    third = [([100, 0.00], [0.5])]
    found = analysis.neighbours(demos_of(first, second, third), 2, queries=99)
    assert found.shape == (6, 2, 1)
    by_query = dict(zip(np.random.default_rng(0).permutation(6).tolist(), found[..., 0].astype(float).round(3).tolist(), strict=True))
    assert by_query[1] == [0.3, 0.5]  # from (0, 0.01): the second episode's (0, 0.02) comes closest, then the third's only one
    assert by_query[5] == [0.0, 0.3] and by_query[3] == [0.1, 0.5]
    assert analysis.neighbours(demos_of(first, second, third), 1, queries=4).shape == (4, 1, 1)
    with pytest.raises(PdkitError, match="more than 3 demonstrations"):
        analysis.neighbours(demos_of(first, second, third), 3)


def test_doubt_is_none_where_all_agree_and_one_where_the_observation_tells_nothing():
    rng = np.random.default_rng(0)
    everything = rng.normal(size=(5_000, 3)) * [1, 2, 3]
    assert analysis.doubt(np.repeat(everything[:4, None], 7, axis=1), everything) == pytest.approx([0, 0, 0, 0])
    assert analysis.doubt(everything[None], everything) == pytest.approx([1])
    assert analysis.doubt(np.array([[[0.0], [2.0]]]), np.array([[-1.0], [3.0]])) == pytest.approx([0.25])  # variances 1 and 4


def test_along_first_finds_the_direction_and_standard_units():
    along = np.array([-2.0, -1.0, 0.0, 3.0])
    actions = np.array([[3.0, 4.0]]) / 5 * along[:, None] + [7, 7]
    found = analysis.along_first(actions[None])[0]
    assert np.allclose(np.abs(found), np.abs(along / along.std())) and np.allclose(found / found[3], along / 3)


def test_split_is_the_best_division_into_two():
    values = np.random.default_rng(0).normal(size=9)

    def explained(group):  # by hand, over all divisions
        a, b = values[list(group)], np.delete(values, list(group))
        return (len(a) * (a.mean() - values.mean()) ** 2 + len(b) * (b.mean() - values.mean()) ** 2) / len(values) / values.var()

    best = max(explained(g) for size in range(1, 9) for g in itertools.combinations(range(9), size))
    assert analysis.split(values) == pytest.approx(best)
    assert analysis.split([0, 0, 1, 1, 1]) == pytest.approx(1) and analysis.split([2, 2]) == 0
    assert analysis.split(np.random.default_rng(1).normal(size=40_000)) == pytest.approx(2 / np.pi, abs=0.01)  # what the module says


# ---- checkpoints -----------------------------------------------------------------------------------------------------

def test_best_of_by_hand_and_by_simulation():
    assert analysis.best_of(0.5, 1, 2) == pytest.approx(0.75) and analysis.best_of(0.37, 50, 1) == pytest.approx(0.37)
    assert analysis.best_of(0.0, 9, 9) == 0 and analysis.best_of(1.0, 9, 9) == 1
    drawn = np.random.default_rng(0).binomial(50, 0.3, (20_000, 10)).max(axis=1).mean() / 50
    assert analysis.best_of(0.3, 50, 10) == pytest.approx(drawn, abs=0.002)
    for bad in ((1.2, 5, 5), (0.5, 0, 5), (0.5, 5, 0)):
        with pytest.raises(PdkitError, match="best_of needs"):
            analysis.best_of(*bad)


def test_a_family_trains_in_its_own_way_where_it_says_so():
    usual = analysis.FAMILIES["MLP"].settings(5, 50)
    assert (usual.batch, usual.lr, usual.ema_power) == (256, 1e-3, 0.0)
    assert (usual.iterations, usual.eval_every, usual.eval_episodes) == (300, 60, 50)
    chunked = analysis.FAMILIES["Diffusion Policy"].settings(3, 20, steps=90, seed=4)
    assert (chunked.batch, chunked.schedule, chunked.ema_power, chunked.iterations, chunked.eval_every, chunked.seed) == (
        128, "cosine", 0.75, 90, 30, 4)
    assert {family.kind for family in analysis.FAMILIES.values()} <= set(POLICIES)


def test_the_selected_checkpoint_is_the_one_that_is_tested(monkeypatch):
    demos, spec, tested = reach_demos(10), PROBES["reach"], list(range(500, 520))
    spec = replace(spec, max_episode_steps=25)
    config = SMALL["MLP"].settings(3, 8, seed=1)
    scores, kept = iter([0.25, 0.75, 0.5]), {}

    def told(spec, policy, episodes, seed):
        kept[len(kept)] = {k: v.clone() for k, v in policy.state_dict().items()}
        return {"success_once": next(scores), "success_at_end": 0.0}

    monkeypatch.setattr(imitate, "selection_scores", told)
    curve, chosen = analysis.learned(SMALL["MLP"], demos, spec, replace(config, bf16=False, lr=1e-2), tested)
    assert curve.step.tolist() == [20, 40, 60] and curve.success.tolist() == [0.25, 0.75, 0.5]
    policy, tables = analysis.fresh(SMALL["MLP"], demos, spec).eval(), []
    for weights in kept.values():
        policy.load_state_dict(weights)
        tables.append(evaluate(spec, policy.act, tested, num_envs=25))
    once = [table.success_once.mean() for table in tables]
    expected = tables[1]
    assert once[1] not in (once[0], once[2])  # so that the test tells them apart
    assert (chosen["step"], chosen["selected"], chosen["episodes"]) == (40, 0.75, 20)
    assert chosen["test"] == expected.success_once.mean() and chosen["test_at_end"] == expected.success_at_end.mean()
    assert not set(tested) & set(selection_seeds(8))


def test_costs_count_what_is_there():
    table = analysis.costs(SMALL, reach_demos(10), PROBES["reach"], lanes=4, repeats=1).set_index("family")
    assert table.parameters["MLP"] == 5 * 16 + 17 * 16 + 17 * 16 + 17 * 2
    assert table.chunk.to_dict() == {"MLP": 1, "chunked": 2} and table.batch.to_dict() == {"MLP": 256, "chunked": 32}
    assert (table[["ms_gradient_step", "ms_step"]] > 0).all(axis=None)


def test_acting_is_counted_by_primitive_step_and_environment(monkeypatch):
    times = []
    monkeypatch.setattr(analysis, "_milliseconds", lambda run, repeats: times.append(run) or 80.0)
    table = analysis.costs(SMALL, reach_demos(10), PROBES["reach"], lanes=4).set_index("family")
    assert table.ms_step.to_dict() == {"MLP": 20.0, "chunked": 10.0} and table.ms_gradient_step.tolist() == [80.0, 80.0] and len(times) == 4


def test_recorded_rows_of_the_notebook_become_curves_and_pairs():
    table = pd.DataFrame({"seed": [0, 1], "curves.MLP.40": [0.2, 0.4], "curves.MLP.8": [0.1, np.nan], "chosen.MLP.selected": [0.2, 0.4],
                          "chosen.MLP.test": [0.1, 0.5], "chosen.MLP.step": [40, 40]})
    assert analysis.recorded_curves(table).to_dict("list") == {"family": ["MLP"] * 3, "seed": [0, 0, 1], "step": [8, 40, 40],
                                                              "success": [0.1, 0.2, 0.4]}
    assert analysis.optimism(table).to_dict("list") == {"family": ["MLP"] * 2, "seed": [0, 1], "selected": [0.2, 0.4], "test": [0.1, 0.5]}
    assert analysis.recorded_curves(pd.DataFrame({"seed": []})).empty and analysis.optimism(pd.DataFrame({"seed": []})).empty


def test_the_sweeps():
    jobs = make_jobs(load_spec(DATA / "sweeps" / "base_policies.toml"))
    bases = {job.labels["recipe"]: job.words[job.words.index("--base") + 1] for job in jobs}
    assert set(bases) == {"mlp", "rnn", "cnn", "diffusion"}
    assert len({(job.config["total_steps"], job.config["H"], job.config["eval_every"]) for job in jobs}) == 1
    assert {job.labels["recipe"] for job in make_jobs(load_spec(DATA / "sweeps" / "imitation.toml"))} == {"imitation"}


# ---- figures ---------------------------------------------------------------------------------------------------------

def test_costs_figure_has_a_bar_a_family_from_one_edge():
    table = pd.DataFrame({"family": ["a", "b"], "parameters": [10, 1000], "ms_gradient_step": [1.0, 9.0], "ms_step": [0.1, 0.2]})
    axes = plots_bases.costs_figure(table).axes
    ends = [[bar.get_x() + bar.get_width() for bar in ax.patches if isinstance(bar, Rectangle)] for ax in axes]
    assert np.allclose(ends, [[10, 1000], [1, 9], [0.1, 0.2]])
    with pytest.raises(PdkitError, match="ms_step"):
        plots_bases.costs_figure(table.drop(columns="ms_step"))


def test_doubts_figure_has_a_line_and_a_histogram_each():
    left, *panels = plots_bases.doubts_figure({"x": np.array([0.5, 0.0]), "y": np.array([0.1])},
                                              {"x": np.array([[1.0, -1.0]]), "y": np.array([[0.0, 0.0]])}).axes
    assert [list(line.get_xdata()) for line in left.lines] == [[0.0, 0.5], [0.1]] and list(left.lines[0].get_ydata()) == [0.5, 1.0]
    assert [panel.get_title(loc="left") for panel in panels] == ["x", "y"]


def test_imitation_figure_joins_selection_and_test():
    curves = {"a": pd.DataFrame({"step": [10, 20], "success": [0.2, 0.6]})}
    told = pd.DataFrame({"family": ["a", "a", "b"], "seed": [1, 1, 1], "step": [10, 20, 20], "success": [0.0, 0.1, 0.9]})
    ax = plots_bases.imitation_figure(curves, {"a": {"step": 20, "selected": 0.6, "test": 0.5}}, recorded=told).axes[0]
    drawn = [(list(line.get_xdata()), list(line.get_ydata())) for line in ax.lines if len(line.get_xdata())]
    assert drawn == [([10, 20], [0.0, 0.1]), ([10, 20], [0.2, 0.6]), ([20, 20], [0.6, 0.5]), ([20], [0.6]), ([20], [0.5])]


def test_optimism_figure():
    seen = pd.DataFrame({"family": ["a", "b"], "selected": [0.5, 0.8], "test": [0.4, 0.9]})
    left, right = plots_bases.optimism_figure([1, 50], [1, 2], 0.5, seen).axes
    assert np.allclose(left.lines[0].get_ydata(), [0.5, 0.75])
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in right.lines[1:]] == [(0.5, 0.4), (0.8, 0.9)]


def test_gains_figure_points_from_base_to_decorated():
    table = pd.DataFrame({"recipe": ["rnn", "mlp"], "seed": [0, 0], "base_success": [0.5, 0.4], "decorated_success": [0.3, 0.9],
                          "base_success_at_end": [0.0, 0.1], "decorated_success_at_end": [0.1, 0.2]})
    ax = plots_bases.gains_figure(table, {"mlp": "MLP", "rnn": "BC-RNN", "cnn": "CNN"}).axes[0]
    arrows = [(text.xyann[0], text.xy[0]) for text in ax.texts if hasattr(text, "xyann")]
    assert arrows == [(0.4, 0.9), (0.1, 0.2), (0.5, 0.3), (0.0, 0.1)]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["MLP, seed 0", "BC-RNN, seed 0"]
    assert [text.get_text() for text in ax.texts if text.get_text()] == ["90", "20", "30", "10"]


def test_neighbours_figure():
    rates = {"Door": {1: stats.wilson(5, 10), 30: stats.wilson(1, 10)}, "Cube": {5: stats.wilson(0, 10)}}
    figure = plots_bases.neighbours_figure(rates, {"Door": ("the BeT", 0.5)})
    ax = figure.axes[0]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["1", "5", "30"]
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["Door: the BeT", "Door: VINN", "Cube: VINN"]


# ---- the exercise ----------------------------------------------------------------------------------------------------

def test_the_exercise_accepts_formula_and_simulation_and_names_mistakes(capsys):
    rng = np.random.default_rng(0)

    def simulated(p, n, m):
        return rng.binomial(n, p, (20_000, m)).max(axis=1).mean() / n

    assert check.best_of(analysis.best_of) and check.best_of(simulated)
    for wrong, words in ((lambda p, n, m: p, "truth itself"), (lambda p, n, m: n * analysis.best_of(p, n, m), "divide by n"),
                         (lambda p, n, m: 1 - (1 - p) ** m, "one of m episodes"),
                         (lambda p, n, m: (binom.pmf(np.arange(n + 1), n, p) ** m) @ np.arange(n + 1) / n, "after the power"),
                         (lambda p, n, m: analysis.best_of(p, n, 1) ** (1 / m), "not 0.75")):
        assert not check.best_of(wrong)
        assert words in capsys.readouterr().out, words
    assert not check.best_of(lambda p, n, m: sys.exit("enough"))  # whatever a student's code does
    assert "it raised SystemExit: enough" in capsys.readouterr().out
    with pytest.raises(PdkitError, match="best_of"):
        check.best_of(lambda p, n, m: p, strict=True)
