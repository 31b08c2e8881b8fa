"""The vectorised environment: everything that corrupts results silently when it is wrong."""
import dataclasses
import functools
import sys

import numpy as np
import pytest

from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.probes import PROBES
from pdkit.tasks import TASKS, get_task, lanes
from pdkit.tasks.lanes import IDLE
from pdkit.tasks.spec import TaskSpec
from pdkit.tasks.vector import VectorEnv


class CountSim:
    """Observation (seed, steps so far); solved while the action's first entry is positive."""

    def reset(self, seed):
        self.seed, self.t = seed, 0
        return np.array([seed, 0], np.float32)

    def step(self, action):
        self.t += 1
        return np.array([self.seed, self.t], np.float32), bool(action[0] > 0)

    def close(self): ...


COUNT = TaskSpec("count", "probe", 2, 1, 4, "-", "-", False, CountSim)
NO, YES = np.float32(-1), np.float32(1)


def counting_seeds():
    counts = [0, 0, 0]

    def next_seed(lane):
        counts[lane] += 1
        return 10 * lane + counts[lane]

    return next_seed


def make(**kw):
    return VectorEnv(COUNT, 2, counting_seeds(), **kw)


def act(*values, chunk=1):
    return np.repeat(np.array(values, np.float32)[:, None, None], chunk, axis=1)


def test_time_limit_truncates_and_returns_the_true_final_observation():
    env = make(window=2)
    windows = env.reset()
    assert windows[:, :, 0].tolist() == [[1, 1], [11, 11]]  # the first observation is repeated
    for t in range(1, 5):
        r = env.step(act(NO, NO))
        assert r.final_windows[:, :, 1].tolist() == [[max(0, t - 1), t]] * 2
    assert r.truncated.all() and not r.terminated.any()
    assert r.final_windows[0].tolist() == [[1, 3], [1, 4]]  # the old episode's end, not the new one's start
    assert r.windows[0].tolist() == [[2, 0], [2, 0]]  # the next episode, its window filled with its first observation
    assert [e.length for e in r.episodes] == [4, 4] and not any(e.success_once for e in r.episodes)


def test_success_terminates_only_when_asked_and_a_solved_last_step_is_a_termination():
    env = make(terminate_on_success=True)
    env.reset()
    r = env.step(act(YES, NO))
    assert r.terminated.tolist() == [True, False] and r.reward.tolist() == [1, 0] and not r.truncated.any()
    for _ in range(2):
        env.step(act(NO, NO))
    r = env.step(act(NO, YES))  # lane 1's fourth and last step
    assert r.terminated.tolist() == [False, True] and r.truncated.tolist() == [False, False]
    env = make()
    env.reset()
    assert not env.step(act(YES, YES)).done.any()


def test_a_tail_cuts_an_episode_after_its_first_success_as_a_time_limit():
    env = make(success_tail=2)
    env.reset()
    assert not env.step(act(YES, NO)).done.any()
    assert not env.step(act(YES, NO)).done.any()  # counted from the first success
    r = env.step(act(NO, NO))
    assert r.truncated.tolist() == [True, False] and not r.terminated.any()
    assert [(e.length, e.success_once, e.success_at_end) for e in r.episodes] == [(3, True, False)]


def test_success_once_and_at_end_differ():
    env = make()
    env.reset()
    env.step(act(YES, NO))
    for _ in range(2):
        env.step(act(NO, NO))
    episodes = env.step(act(NO, YES)).episodes
    assert [(e.success_once, e.success_at_end) for e in episodes] == [(True, False), (True, True)]


def test_chunks_sum_rewards_stop_at_the_end_and_count_primitive_steps():
    env = make(chunk=3, window=2)
    env.reset()
    r = env.step(act(YES, NO, chunk=3))
    assert r.steps.tolist() == [3, 3] and r.reward.tolist() == [3, 0]
    assert r.windows[0, :, 1].tolist() == [2, 3]
    r = env.step(act(NO, NO, chunk=3))
    assert r.steps.tolist() == [1, 1] and r.truncated.all() and r.final_windows[0, :, 1].tolist() == [3, 4]
    assert r.reward.tolist() == [0, 0] and not r.solved.any()  # what the last chunk solved is not paid again


def test_actions_are_clipped_and_wrong_shapes_refused():
    seen = []

    class Spy(CountSim):
        def step(self, action):
            seen.append(float(action[0]))
            return super().step(action)

    env = VectorEnv(dataclasses.replace(COUNT, make=Spy), 1, lambda lane: 1)
    env.reset()
    env.step(np.full((1, 1, 1), 7.0))
    assert seen == [1.0]
    with pytest.raises(PdkitError, match="shape"):
        env.step(np.zeros((1, 2, 1)))


@pytest.mark.parametrize("workers", [0, 2])
def test_snapshot_restores_the_exact_episode(workers):
    spec = PROBES["reach"]
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (30, 3, 1, 2)).astype(np.float32)

    def seeds(start):
        counts = [start] * 3

        def next_seed(lane):
            counts[lane] += 1
            return 100 * lane + counts[lane]
        return next_seed

    with VectorEnv(spec, 3, seeds(0), window=4) as first, VectorEnv(spec, 3, seeds(2), window=4, workers=workers) as second:
        first.reset()
        for a in actions[:12]:
            first.step(a)
        windows = second.restore(first.snapshot())
        assert np.array_equal(windows, first._windows)
        for a in actions[12:]:
            one, other = first.step(a), second.step(a)
            assert np.array_equal(one.final_windows, other.final_windows) and np.array_equal(one.windows, other.windows)
            assert one.episodes == other.episodes


def test_a_snapshot_of_a_young_episode_repeats_its_first_observation():
    spec, actions = PROBES["reach"], np.full((3, 2, 1, 2), 0.3, np.float32)
    for steps in range(4):  # windows of 4 are not yet full of what was seen
        with VectorEnv(spec, 2, lambda lane: 5 + lane, window=4) as first, VectorEnv(spec, 2, lambda lane: 9 + lane, window=4) as second:
            first.reset()
            for a in actions[:steps]:
                first.step(a)
            assert np.array_equal(second.restore(first.snapshot()), first._windows)


def test_workers_change_nothing_on_a_real_task():
    spec, results = get_task("Door"), []
    for workers in (0, 2):
        with VectorEnv(spec, 3, lambda lane: 5 + lane, window=2, workers=workers, max_episode_steps=6) as env:
            env.reset()
            rng = np.random.default_rng(0)
            results.append([env.step(rng.uniform(-1, 1, (3, 1, 28))) for _ in range(8)])
    for one, other in zip(*results, strict=True):
        assert np.array_equal(one.windows, other.windows) and one.episodes == other.episodes


def test_a_simulator_from_a_notebook_is_refused_by_other_processes_alone(monkeypatch):
    spec = dataclasses.replace(COUNT, make=type("Mine", (CountSim,), {"__module__": "__main__"}))
    env = VectorEnv(spec, 2, counting_seeds())
    env.close()
    monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)  # as in a kernel
    wrapped = dataclasses.replace(COUNT, make=functools.partial(CountSim, functools.partial(spec.make)))
    for one in (spec, wrapped):  # or hidden among the arguments
        with pytest.raises(PdkitError, match="Mine is defined in a notebook, .* or set env_workers=0"):
            VectorEnv(one, 2, counting_seeds(), workers=1)


def test_idle_lanes_stay_idle():
    queue = [3, 2, 1]
    with VectorEnv(COUNT, 2, lambda lane: queue.pop() if queue else IDLE) as env:
        env.reset()
        finished = [e for _ in range(12) for e in env.step(act(YES, YES)).episodes]
    assert sorted(e.seed for e in finished) == [1, 2, 3]


def test_evaluation_counts_every_seed_once_in_order():
    table = evaluate(COUNT, lambda windows: np.where(windows[:, -1, :1] > 6, YES, NO)[:, None], [9, 3, 8, 1, 7], num_envs=2)
    assert table.seed.tolist() == [9, 3, 8, 1, 7]
    assert table.success_once.tolist() == [True, False, True, False, True]
    with pytest.raises(PdkitError):
        evaluate(COUNT, lambda w: w, [])


def test_simulations_that_take_long_to_build_are_kept_but_not_after_an_error():
    built, closed = [], []

    class Slow(CountSim):
        slow_to_build = True

        def __init__(self):
            built.append(self)

        def close(self):
            closed.append(self)

    spec = dataclasses.replace(COUNT, make=Slow)
    for _ in range(2):
        with VectorEnv(spec, 2, counting_seeds()) as env:
            env.reset()
            env.step(act(NO, NO))
    assert len(built) == 2 and not closed
    with pytest.raises(PdkitError), VectorEnv(spec, 3, counting_seeds()) as env:
        env.reset()
        env.step(act(NO))  # of the wrong shape
    assert len(built) == 3 == len(closed)
    with VectorEnv(spec, 1, counting_seeds()) as env:
        env.reset()
    assert len(built) == 4
    lanes.close_spares()
    assert len(closed) == 4
    with VectorEnv(spec, 1, counting_seeds()) as env:
        env.reset()
        env.close()  # and once more at the end: it must not be kept twice
    assert len(lanes._spare[Slow]) == 1
    lanes.close_spares()
    with VectorEnv(COUNT, 1, counting_seeds()) as env:  # what is quickly built is not kept
        env.reset()
    assert CountSim not in lanes._spare


@pytest.mark.parametrize("task", ["StackCube", "PegInsertionSide", "TurnFaucet"])
def test_an_evaluation_in_kept_simulations_repeats_to_the_last_bit(task):
    """As in new ones: whatever was simulated before, contacts above all and another task, a reset leaves nothing of it."""
    spec, rng = get_task(task), np.random.default_rng(0)
    pushes = rng.uniform(-1, 1, (30, 1, spec.act_dim)).astype(np.float32)
    pushes[:, :, 2] = -0.5  # down, into the table and what lies there

    def pushed(seeds):
        step = iter(pushes)
        return evaluate(spec, lambda windows: np.repeat(next(step)[None], len(windows), axis=0), seeds, num_envs=2, max_episode_steps=30)

    lanes.close_spares()
    first, _ = pushed([1, 2]), pushed([3, 4])
    get_task("PushChair").make().reset(0)  # its friction is another, and what bodies are made of is global
    again = pushed([1, 2])
    assert len(lanes._spare[spec.make]) == 2 and first.equals(again)


@pytest.mark.parametrize("name", ["Door", "Pen", "Hammer", "Relocate"])
def test_adroit_tasks_are_what_the_registry_says(name):
    spec = get_task(name)
    sim = spec.make()
    observation = sim.reset(0)
    assert observation.shape == (spec.obs_dim,) and observation.dtype == np.float32
    actions = np.random.default_rng(0).uniform(-1, 1, (20, spec.act_dim))
    first = [sim.step(a)[0] for a in actions]
    sim.reset(1)
    sim.step(actions[0])
    assert np.array_equal(sim.reset(0), observation)  # the seed alone decides, whatever came before
    assert np.array_equal(first, [sim.step(a)[0] for a in actions])
    assert not np.array_equal(sim.reset(1), observation)


def test_episode_limits_are_the_papers():
    maniskill = ("StackCube", "PegInsertionSide", "TurnFaucet", "TurnFaucetSource", "PushChair", "PushChairSource")
    limits = {n: TASKS[n].max_episode_steps for n in TASKS}
    assert limits == dict.fromkeys(maniskill, 200) | dict(Door=300, Pen=200, Hammer=400, Relocate=400)


def test_unknown_task_names_the_known_ones():
    with pytest.raises(PdkitError, match="Door.*Did you mean 'Door'"):
        get_task("Dor")
