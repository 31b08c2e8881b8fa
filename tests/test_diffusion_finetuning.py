"""Notebook 12: DPPO's inner steps, actions that climb DIPO's critics, what trains and what it costs, and how runs are judged."""
import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.colors import to_hex
from test_dipo import ONE_LEVEL, SMALL, Formula, policy
from test_dppo import agent as dppo_agent
from worlds import TwoAtOnce, reach_trainer

from pdkit import check, plots, plots_diffusion_finetuning, stats
from pdkit import diffusion_finetuning as analysis
from pdkit.errors import PdkitError

WINDOW = np.array([[0, 0, 0.1, 0.1]], np.float32)


def test_inner_steps_are_the_learners_own():
    rows = analysis.inner_steps(dppo_agent(late=2, dppo_sample_std=0.3, dppo_gamma=0.5))
    assert rows.step.tolist() == [75, 50, 25, 0] and rows.tuned.tolist() == [False, False, True, True]
    learner = dppo_agent(late=2)
    assert np.allclose(rows.sigma, learner.steps.sigma) and np.allclose(rows.noise, np.maximum(rows.sigma, 0.3))
    assert rows.sigma.iloc[-1] == 0 and rows.discount.tolist()[2:] == [0.5, 1.0] and rows.discount.isna().tolist()[:2] == [True, True]
    assert np.allclose(rows["clip"][2:], [0.001, 0.01])


def test_the_drawn_problem_is_one_decision_that_pushes_blur():
    actions = np.array([[0.5, 0.5], [0.5, 0.95], [0.5, -0.05], [1.4, 1.4]])
    assert analysis.solves(actions).tolist() == [True, True, False, False]  # a circle of 0.5 around (0.5, 0.5); the last is clipped
    for push, rate in ((0.0, (0, 0)), (0.5, (0.1, 0.5))):
        sim, solved = analysis.one_reach(push).make(), []
        for seed in range(200):
            assert np.allclose(sim.reset(seed), WINDOW[0])
            solved.append(sim.step(np.array([0.5, -0.05]))[1])
        assert rate[0] <= np.mean(solved) <= rate[1]


@pytest.fixture(scope="module")
def aside():
    return analysis.aims_beside(300)


def test_actions_climb_and_the_policy_follows_where_success_has_a_slope(aside):
    """The clouds move into the circle with pushes; the sequence's other actions stay at rest."""
    before = analysis.draws(aside, WINDOW, 100)
    assert before.shape == (100, 4, 2) and analysis.solves(before[:, 0].numpy()).mean() < 0.3
    assert (before[:, 0].mean(0) - torch.tensor(analysis.AIM, dtype=torch.float32)).abs().max() < 0.1 and before[:, 1:].abs().mean() < 0.1
    trainer = analysis.probe_trainer(aside, 1_800, push=0.5)
    trainer.train()
    after = analysis.draws(trainer.agent.actor.eval(), WINDOW, 100)
    assert analysis.solves(after[:, 0].numpy()).mean() > 0.7 and after[:, 1:].abs().mean() < 0.25
    path = analysis.ascent(trainer.agent, WINDOW, before)
    assert path.shape == (11, 100, 4, 2) and np.array_equal(path[0], before) and trainer.agent.rule.steps == 10
    assert np.array_equal(path[-1], trainer.agent.improved(torch.from_numpy(WINDOW).repeat(100, 1), before))
    worth = [analysis.values(trainer.agent, WINDOW, at[:, 0]).mean() for at in path]
    assert worth[-1] > worth[5] > worth[0]


def test_values_are_those_of_the_lesser_critic():
    trainer = analysis.probe_trainer(policy(ONE_LEVEL | dict(window=1, chunk=1)), 300, push=0.0)
    trainer.agent.critics = Formula(lambda o, a: a.sum(1) + o[:, 3], lambda o, a: 3 * a.sum(1))
    actions = np.array([[0.1, 0.2], [-0.1, -0.2]])
    assert np.allclose(analysis.values(trainer.agent, WINDOW, actions), [0.4, -0.9], atol=1e-5)


def test_adapters_are_counted():
    """Rank r on a layer of n inputs (times its kernel) and m outputs: r * (n + m) numbers."""
    start = policy(SMALL)
    rows = analysis.adapters(start, (0, 2))
    expected = 0
    for module in start.unet.modules():
        if isinstance(module, torch.nn.Linear | torch.nn.Conv1d):
            expected += 2 * (module.weight[0].numel() + len(module.weight))
    whole = sum(p.numel() for p in start.unet.parameters())
    assert rows.trained.tolist() == [whole, expected] and rows.share.tolist() == pytest.approx([1, expected / whole])


def test_updates_are_timed_and_passes_counted():
    """DIPO: 2 steps of sampling for each target, and a pass with the loss every second update. DPPO: one for each row."""
    start = policy(ONE_LEVEL)
    trainers = {
        "decorator": reach_trainer("residual_rl", TwoAtOnce(dict(obs_dim=4, act_dim=2, kind="zero")), batch=32),
        "DIPO": reach_trainer("dipo", start, batch=16, actor_every=2, utd=0.25, lora=2),
        "DPPO": reach_trainer("dppo", start, warmup_steps=0, lr_decay_from=0.0, dppo_steps=2, ppo_rollout=8, ppo_epochs=2,
                              ppo_minibatches=4)}
    ticks = iter(range(1000))
    rows = analysis.update_costs(trainers, 3, clock=lambda: float(next(ticks))).set_index("method")
    assert rows.ms.tolist() == [500, 500, 125]  # a tick a measurement: of two updates, or of a rollout's eight
    assert rows.rows.tolist() == [32, 16, 16] and rows.passes.tolist() == [0, 2.5, 1]
    assert rows.per_step.tolist() == [0.5, 0.25, 8 / (8 * 4 * 2)]
    assert all(trainer.replay.size == 0 for trainer in trainers.values())


def test_a_run_is_judged_by_the_interval_of_its_difference():
    table = pd.DataFrame({"recipe": ["a", "b", "c"], "seed": 0, "episodes": 60, "base_success": 0.5, "decorated_success": [0.8, 0.55, 0.2],
                          "base_success_at_end": 0.25, "decorated_success_at_end": [0.25, 0.0, 0.9]})
    rows = analysis.outcomes(table)
    assert rows.verdict.tolist() == ["above", "not told apart", "below"] and rows.after[0].successes == 48
    assert analysis.outcomes(table, "success_at_end").verdict.tolist() == ["not told apart", "below", "above"]
    change = stats.newcombe(stats.wilson(48, 70), stats.wilson(56, 70))  # Newcombe's own example (1998, Table II a): 0.0524 to 0.3339
    assert change.value == pytest.approx(8 / 70) and analysis.outcomes(table.iloc[:0]).empty
    turned = stats.newcombe(stats.wilson(48, 80), stats.wilson(56, 70))
    assert (turned.low, turned.high) == pytest.approx((0.0524, 0.3339), abs=5e-4)


def test_the_families_of_the_appendix_are_complete():
    rows = analysis.taxonomy()
    assert [name in " ".join(rows.methods) for name in ("DIPO", "IDQL", "QSM", "Diffusion QL", "Consistency AC", "DPPO")] == [True] * 6
    assert rows.isna().sum().sum() == 0 and rows.set_index("methods").loc["DPPO", "on-policy data"] == "yes"


def test_figures_show_what_they_are_given():
    draw = plots_diffusion_finetuning
    boxes = draw.two_layers_figure(4, 2, decisions=2).axes[0].patches
    blue = [box for box in boxes if to_hex(box.get_facecolor()) == plots.COLORS["decorated"] and hasattr(box, "get_width")]
    assert len(blue) == 4  # two fine-tuned steps in each of two decisions
    rows = analysis.inner_steps(dppo_agent(late=2))
    heights = [[bar.get_height() for bar in ax.patches] for ax in draw.inner_figure(rows).axes]
    assert np.allclose(heights[0], [*rows.sigma, *rows.noise]) and np.allclose(heights[1], [0, 0, 0.001, 0.01])
    axis, path = np.linspace(-1, 1, 5), np.random.default_rng(0).uniform(-1, 1, (3, 4, 2))
    grid = np.stack(np.meshgrid(axis, axis), -1)
    figure = draw.ascent_figure(axis, grid.sum(-1), np.hypot(*grid.transpose(2, 0, 1)) < 0.6, path, {"a": path[0], "b": path[-1]})
    left, right = figure.axes[:2]
    assert np.array_equal(left.lines[0].get_xydata(), path[:, 0]) and np.array_equal(right.lines[1].get_xydata(), path[-1])
    costs = pd.DataFrame({"method": ["a", "b"], "ms": [10.0, 40.0], "rows": [100, 10], "passes": [0, 3], "per_step": [0.5, 0.1]})
    bars = [[bar.get_width() for bar in ax.patches] for ax in draw.costs_figure(costs).axes]
    assert np.allclose(bars, [[10, 40], [0.1, 4], [5, 4]])
    with pytest.raises(PdkitError, match="per_step"):
        draw.costs_figure(costs.drop(columns="per_step"))
    table = pd.DataFrame({"recipe": ["x"], "seed": [3], "episodes": 10, "base_success": 0.5, "decorated_success": 0.9})
    ax = draw.outcomes_figure({"once": analysis.outcomes(table)}, {"x": "X"}).axes[0]
    assert [line.get_xdata()[0] for line in ax.lines[1::2]] == [0.5, 0.9] and ax.get_yticklabels()[0].get_text() == "X, seed 3"


def test_the_exercise_names_the_likely_mistakes(capsys):
    def climb(value, sequence, executed, steps, lr, sign=1.0, clamp=True, copy=True, whole=False):
        moved = sequence.clone() if copy else sequence
        part = slice(None) if whole else executed
        for _ in range(steps):
            actions = moved[executed].clone().requires_grad_()
            gradient = torch.autograd.grad(value(actions), actions)[0]
            moved[part] = moved[part] + sign * lr * (gradient.repeat(3, 1)[: len(moved)] if whole else gradient)
            moved = moved.clamp(-1, 1) if clamp is True else moved
        return moved.clamp(-1, 1) if clamp == "last" else moved

    assert check.action_ascent(climb)
    for wrong, words in ((lambda *a: climb(*a, sign=-1.0), "add the gradient"), (lambda *a: climb(*a, clamp=False), "clamp them"),
                         (lambda *a: climb(*a, clamp="last"), "at the end alone"),
                         (lambda *a: climb(*a, copy=False), "work on a copy"), (lambda *a: climb(*a, whole=True), "outside the executed"),
                         (lambda v, s, e, n, lr: climb(v, s, e, 1, lr), "that is one step"), (lambda v, s, *_: s.clone(), "nothing moves"),
                         (lambda *a: climb(*a)[a[2]], "the whole sequence"), (lambda *a: 0.9 * climb(*a), "outside the executed")):
        assert not check.action_ascent(wrong)
        assert words in capsys.readouterr().out, words
    with pytest.raises(PdkitError, match="action_ascent"):
        check.action_ascent(lambda *a: climb(*a)[a[2]], strict=True)
