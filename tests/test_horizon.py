"""Shorter horizons: episodes that start on a guide's way, what is measured on them (notebook 10), and its verdicts."""
import functools
import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from pdkit import horizon_analysis as analysis
from pdkit import plots_horizon
from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.files import DATA
from pdkit.online import Trainer
from pdkit.probes import PROBES, CorridorSim, zero_base
from pdkit.profiles import flat, online_config
from pdkit.sweep_jobs import make_jobs
from pdkit.sweep_spec import load_spec
from pdkit.tasks import get_task, horizon
from pdkit.tasks.horizon import Ways, horizon_spec, shortened, steps_ahead
from pdkit.tasks.vector import VectorEnv

SEED = 2_000_000


class PickySim(CorridorSim):
    """A corridor of four full steps, with a door that odd seeds never open. Remembers how often it was reset."""

    resets = 0

    def reset(self, seed):
        self.shut, type(self).resets = seed % 2 == 1, self.resets + 1
        return super().reset(seed) + np.float32(1e-3 * (seed % 7))

    def step(self, action):
        observation, solved = super().step(action)
        return observation, solved and not self.shut


class Straight:
    """Goes ahead at full speed, drawing from torch on the way as a policy with dropout does."""

    window = 2

    def reset(self, seed):
        torch.manual_seed(seed)

    def act(self, windows):
        assert windows.shape == (1, 2, 1)
        torch.rand(3)
        return np.ones((1, 1, 1))


PICKY = replace(PROBES["corridor"], make=PickySim)


def ways():
    return Ways(Straight(), limit=10)


def test_no_fraction_is_the_task_itself_and_others_are_refused():
    door = get_task("Door")
    assert horizon_spec(door, 0.0) is door
    for fraction in (-0.1, 1.0, float("nan")):
        with pytest.raises(PdkitError, match="start_fraction"):
            horizon_spec(door, fraction)
        with pytest.raises(PdkitError, match="start_fraction"):
            online_config("Door", start_fraction=fraction)
    with pytest.raises(PdkitError, match="nobody knows the way there"):
        horizon_spec(get_task("Pen"), 0.5)


def test_steps_and_limits():
    assert [steps_ahead(4, f) for f in (0.2, 0.25, 0.5, 0.99)] == [0, 1, 2, 3]
    assert [shortened(300, f) for f in (0, 0.25, 0.5, 0.75, 0.999)] == [300, 225, 150, 75, 1]
    assert shortened(0, 0.5) == 0  # no limit stays none
    assert horizon_spec(PICKY, 0.5, ways).max_episode_steps == 10


def test_starts_tell_how_far_each_task_has_come():
    """At nine tenths of the scripted expert's way the red cube is nearly where it belongs; no task without measures is begun."""
    early, late = (analysis.starts(get_task("StackCube"), fraction, [1_000_000]).iloc[0] for fraction in (0.0, 0.9))
    assert early.reach > 0.05 > late.reach and early.apart > 0.05 > late.apart and late.left < early.left
    with pytest.raises(PdkitError, match="Unknown task with starts on the way 'Pen'; choose one of: Door, StackCube"):
        analysis.starts(get_task("Pen"), 0.0, [0])


@pytest.mark.parametrize(("fraction", "x"), [(0.25, 0.25), (0.5, 0.5), (0.75, 0.75)])
def test_an_episode_starts_on_the_way_and_needs_the_rest_of_it(fraction, x):
    sim = horizon_spec(PICKY, fraction, ways).make()
    sim.reset(0)
    assert sim._sim.x == x
    solved = [sim.step(np.ones(1))[1] for _ in range(round(4 * (1 - fraction)))]
    assert solved[-1] and not any(solved[:-1])


def test_the_seed_alone_decides_also_where_the_guide_fails():
    """Odd seeds never succeed: another seed follows from them, always the same one, beyond all seeds in use."""
    shared = ways()
    sim, other = (horizon_spec(PICKY, 0.5, functools.partial(lambda w: w, w)).make() for w in (shared, ways()))
    first = sim.reset(1)
    sim.step(-np.ones(1))
    sim.reset(4)
    np.testing.assert_array_equal(other.reset(1), first)
    actual, actions = shared.way(sim._sim, 1)
    assert actual % 2 == 0 and 2**31 <= actual < 2**32 and len(actions) == 4
    assert shared.way(sim._sim, 4)[0] == 4
    assert len({shared.way(sim._sim, odd)[0] for odd in range(1, 21, 2)}) == 10
    sim.reset(1)
    assert sim.step(np.ones(1))[1] is False and sim.step(np.ones(1))[1] is True  # the start lies on a way that succeeds


def test_a_guide_that_never_succeeds_is_an_error():
    never = replace(PROBES["wait"], make=PROBES["wait"].make)
    with pytest.raises(PdkitError, match="20 seeds in a row"):
        horizon_spec(never, 0.5, ways).make().reset(0)


def test_ways_are_remembered_but_not_without_bound(monkeypatch):
    monkeypatch.setattr(horizon, "REMEMBERED", 2)
    kept, sim = ways(), PickySim()
    kept.way(sim, 0)
    before = PickySim.resets
    kept.way(sim, 0)
    assert PickySim.resets == before
    for seed in (2, 0, 4):  # 0 was used last, so 2 goes
        kept.way(sim, seed)
    assert list(kept._kept) == [0, 4]


def test_torch_is_left_as_it_was():
    torch.manual_seed(5)
    expected, threads = torch.rand(2), torch.get_num_threads()
    torch.manual_seed(5)
    horizon_spec(PICKY, 0.5, ways).make().reset(1)
    assert torch.equal(torch.rand(2), expected) and torch.get_num_threads() == threads


@pytest.mark.parametrize("task", ["Door", "StackCube"])
def test_start_states_are_exact_and_rare_to_fail(task):
    """In a fresh simulator the way's first actions lead to the very start, after other episodes as well as before."""
    spec = get_task(task)
    variant = pickle.loads(pickle.dumps(horizon_spec(spec, 0.6)))
    sim, plain = variant.make(), spec.make()
    try:
        sim.reset(SEED + 1)
        start = sim.reset(SEED)
        actual, actions = horizon.ways_of(task).way(plain, SEED)
        observation = plain.reset(actual)
        ahead = steps_ahead(len(actions), 0.6)
        assert 0 < ahead < len(actions)
        for action in actions[:ahead]:
            observation, solved = plain.step(action)
            assert not solved
        np.testing.assert_array_equal(observation, start)
        for action in actions[ahead:]:
            here, there = sim.step(action), plain.step(action)
            np.testing.assert_array_equal(here[0], there[0])
        assert here[1] and there[1]
        assert hasattr(sim._env, "reset")  # what pdkit/video.py aims the camera of
    finally:
        sim.close()
        plain.close()


# ---- in the loop -----------------------------------------------------------------------------------------------------

def trainer(monkeypatch, **changes):
    monkeypatch.setitem(horizon.GUIDES, "corridor", None)
    monkeypatch.setattr(horizon, "ways_of", lambda task: ways())
    values = dict(total_steps=300, warmup_steps=100, num_envs=2, env_workers=0, eval_workers=0, eval_every=150, eval_episodes=4,
                  log_every=0, checkpoint_every=0, demo_fraction=0.0, hidden=16, batch=16, H=100, train_limit=12,
                  on_success="terminate", bf16=False,
                  select="last")
    return Trainer(online_config("Door", "lesson", 0, **(values | changes)), zero_base(PROBES["corridor"]), None, PROBES["corridor"])


def test_training_and_evaluation_use_the_variant(monkeypatch):
    one = trainer(monkeypatch, start_fraction=0.75)
    assert one.spec.max_episode_steps == 5 and flat(one.config)["start_fraction"] == 0.75
    one.train()
    lengths = [row["train_length"] for row in one.rows if "train_length" in row]
    assert max(lengths) <= 3  # of 12
    table = evaluate(one.spec, lambda w: np.ones((len(w), 1, 1)), [1, 2], num_envs=2, max_episode_steps=1)
    assert table.success_once.all()


def test_without_a_fraction_the_task_is_untouched(monkeypatch):
    one = trainer(monkeypatch)
    assert one.spec is PROBES["corridor"] and one.config.start_fraction == 0


def test_a_vector_environment_goes_on_from_a_snapshot_in_workers():
    """The make of a variant is picklable, and a restored episode starts where it started."""
    spec = horizon_spec(get_task("StackCube"), 0.75)
    with VectorEnv(spec, 1, lambda lane: SEED) as envs:
        envs.reset()
        envs.step(np.full((1, 1, 4), 0.3, np.float32))
        snapshot, expected = envs.snapshot(), envs.step(np.zeros((1, 1, 4), np.float32)).windows
    with VectorEnv(spec, 1, lambda lane: SEED, workers=1) as envs:
        envs.restore(snapshot)
        np.testing.assert_array_equal(envs.step(np.zeros((1, 1, 4), np.float32)).windows, expected)


# ---- measurements ----------------------------------------------------------------------------------------------------

def test_exploration_counts_episodes_steps_and_rewards():
    met = analysis.exploration(PROBES["corridor"], lambda w: np.ones((len(w), 1, 1), np.float32), [1, 2, 3], 6, lanes=2)
    assert met == {"episodes": 3, "solved": 3, "steps": 12, "steps_per_reward": 4.0}
    met = analysis.exploration(PROBES["corridor"], lambda w: np.zeros((len(w), 1, 1), np.float32), [1, 2, 3], 6, lanes=2)
    assert met == {"episodes": 3, "solved": 0, "steps": 18, "steps_per_reward": np.inf}
    first, again = (analysis.uniform_actions(3, 0)(np.zeros((5, 2, 4))) for _ in range(2))
    assert first.shape == (5, 1, 3) and np.abs(first).max() <= 1 and np.array_equal(first, again)


def test_corridor_rows_are_the_exact_returns():
    rows = np.stack(analysis.corridor_rows(4, 2, 0.9))  # columns: 5 cells, residual, base, reward, 5 cells, base, discount
    assert rows.shape == (4, 15)
    np.testing.assert_array_equal(rows[:, :5].argmax(1), [0, 1, 2, 3])
    np.testing.assert_allclose(rows[:, 7], [0, 0, 0.9, 1])
    np.testing.assert_array_equal(rows[:2, 8:13].argmax(1), [2, 3])
    np.testing.assert_allclose(rows[:, 14], [0.81, 0.81, 0, 0])


def test_a_value_needs_longer_for_a_longer_way_and_waits_for_the_target():
    options = dict(lr=3e-3, hidden=16, batch=16, tau=0.05)
    short, long = (analysis.propagation(length, **options) for length in (4, 8))
    assert 1.5 < long / short < 3
    assert analysis.propagation(8, 4, **options) < long / 2
    assert analysis.propagation(8, **(options | {"tau": 0.02})) > 1.5 * long
    assert analysis.propagation(8, **options, most=20) is None


def sweep_table(gains, base=0.5, seeds=3):
    """Rows as data/results/horizon.csv has them: `gains` of the method by fraction, spread by a hundredth over the seeds."""
    return pd.DataFrame([{"task": "Door", "recipe": f"{method},start_fraction={f}", "seed": s, "base_success": base, "env_steps": 20_000,
                          "decorated_success": base + gain + 0.01 * (s - 1), "first_reward_step": np.nan if s else 100.0 + s}
                         for method in ("sac_finetune", "policy_decorator") for f, gain in gains.items() for s in range(seeds)])


def test_rows_of_the_sweep_are_read_by_their_recipe():
    table = analysis.by_fraction(sweep_table({0.0: -0.3, 0.5: 0.1}))
    assert set(table.method) == {"sac_finetune", "policy_decorator"} and set(table.start_fraction) == {0.0, 0.5}
    np.testing.assert_allclose(table.gain.iloc[:3], [-0.31, -0.3, -0.29])
    with pytest.raises(PdkitError, match="horizon.toml"):
        analysis.by_fraction(sweep_table({0.0: 0.1}).assign(recipe="lesson"))


def test_the_sweep_varies_the_horizon_alone():
    jobs = make_jobs(load_spec(DATA / "sweeps" / "horizon.toml"))
    table = analysis.by_fraction(pd.DataFrame([dict(j.labels, decorated_success=0, base_success=0) for j in jobs]))
    assert len(jobs) == 30 and set(table.groupby("method").start_fraction.nunique()) == {3}
    for job, fraction, method in zip(jobs, table.start_fraction, table.method, strict=True):
        assert job.config["start_fraction"] == fraction and job.config["method"] == method and job.config["select"] == "last"


# ---- verdicts --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("solved", "verdict"), [
    ([0, 0, 30], "reproduced"), ([0, 30, 15], "partly"), ([3, 4, 5], "partly"), ([5, 4, 5], "not"), ([30, 10, 0], "not"), ([5], "untested"),
    ([0, 0, 1], "untested"), ([1, 30, 1], "not")])
def test_exploration_verdict(solved, verdict):
    table = pd.DataFrame({"start_fraction": [0.0, 0.5, 0.9][: len(solved)], "episodes": 40, "solved": solved})
    found, reasons = analysis.exploration_verdict(table.iloc[::-1])
    assert found == verdict and len(reasons) == len(solved)


@pytest.mark.parametrize(("updates", "verdict"), [
    ([[10, 12], [20, 22], [40, 44]], "reproduced"), ([[10, 12], [20, None], [40, 44]], "partly"), ([[10, 30], [20, 42], [30, 60]],
                                                                                                                    "partly"),
    ([[40, 44], [20, 22], [10, 12]], "not"), ([[10, 12]], "untested")])
def test_propagation_verdict(updates, verdict):
    rows = [{"length": 5 * (i + 1), "seed": s, "updates": u} for i, each in enumerate(updates) for s, u in enumerate(each)]
    assert analysis.propagation_verdict(pd.DataFrame(rows))[0] == verdict


@pytest.mark.parametrize(("gains", "verdict"), [
    ({0.0: -0.3, 0.75: 0.1}, "reproduced"), ({0.0: -0.3, 0.5: -0.4, 0.75: 0.1}, "reproduced"),
    ({0.0: -0.3, 0.75: -0.1}, "partly"), ({0.0: 0.1, 0.75: 0.3}, "partly"),
    ({0.0: -0.3, 0.75: -0.3}, "not"), ({0.0: -0.1, 0.75: -0.4}, "not"), ({0.0: -0.3}, "untested")])
def test_failure_verdict(gains, verdict):
    found, reasons = analysis.failure_verdict(analysis.by_fraction(sweep_table(gains)))
    assert found == verdict and f"{100 * gains[0.0]:+.0f} points" in reasons[0]
    assert analysis.failure_verdict(analysis.by_fraction(sweep_table(gains, seeds=1)))[0] == "untested"


# ---- figures ---------------------------------------------------------------------------------------------------------

def test_figures_draw_what_they_are_given():
    done = analysis.by_fraction(sweep_table({0.0: -0.3, 0.5: 0.1}))
    labels = {"sac_finetune": "tuned", "policy_decorator": "decorated", "jsrl": "absent"}
    own = pd.DataFrame({"who": ["base"] * 2, "start_fraction": [0.0, 0.5], "success": [0.4, 0.6]})
    figure = plots_horizon.sweep_figure(done, "decorated_success", labels, own=own)
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["tuned", "decorated", "base, your run"]
    line = next(x for x in figure.axes[0].lines if x.get_label() == "tuned")
    np.testing.assert_allclose(line.get_ydata(), [0.2, 0.6])
    mine = analysis.by_fraction(pd.DataFrame({"recipe": ["policy_decorator,start_fraction=0.9"], "base_success": 0.5, "env_steps": 600,
                                              "episodes": 2, "decorated_success": 0.75, "first_reward_step": np.nan}))
    star = [x for x in plots_horizon.sweep_figure(done, "gain", labels, trained=mine).axes[0].lines if x.get_marker() == "*"]
    said = "your run, decorated, 600 steps, 2 episodes"
    assert [(*x.get_xdata(), *x.get_ydata(), x.get_label()) for x in star] == [(pytest.approx(0.1), 0.25, said)]
    never = plots_horizon.sweep_figure(done, "first_reward_step", labels, trained=mine, budget=20_000).axes[0].lines
    never, = (x for x in never if "your run" in x.get_label())
    assert never.get_marker() == "^" and list(never.get_ydata()) == [600]
    alone = plots_horizon.sweep_figure(done[done.method == "sac_finetune"], "gain", labels, trained=mine).axes[0]
    assert [x.get_marker() for x in alone.lines if "your run" in x.get_label()] == ["*"]
    first = plots_horizon.sweep_figure(done, "first_reward_step", labels, budget=20_000)
    assert sum(list(x.get_ydata()) == [20_000] * 2 for x in first.axes[0].lines) == 4  # two runs of each method and start: no reward
    met = pd.DataFrame({"who": "a", "start_fraction": [0.0, 0.9], "episodes": 10, "solved": [0, 5], "steps": [900, 100],
                        "steps_per_reward": [np.inf, 20.0]})
    right = plots_horizon.exploration_figure(met).axes[1]
    other = pd.DataFrame({"who": met.who.iloc[0], "start_fraction": [met.start_fraction.iloc[0], 0.123], "seed": [3, 3], "met": 0.37})
    left = plots_horizon.exploration_figure(met, recorded=other).axes[0]
    assert [line.get_ydata().tolist() for line in left.lines].count([0.37]) == 1  # where this run has no start, nothing of others either
    assert [list(x.get_ydata()) for x in right.lines[:2]] == [[20.0], [900]]
    starts = pd.DataFrame({"start_fraction": [0.0, 0.5], "hinge": [0, 0.2], "reach": [0.4, 0.1]})
    corridor = pd.DataFrame({"length": [5, 10], "n_step": 1, "updates": [10, None]})
    door = analysis.PROGRESS["Door"]
    for picture in (plots_horizon.starts_figure(starts, door), plots_horizon.propagation_figure(corridor)):
        assert picture.png()[:4] == b"\x89PNG"
    with pytest.raises(PdkitError, match="first_reward"):
        plots_horizon.sweep_figure(done.drop(columns="first_reward_step"), "first_reward_step", labels)
