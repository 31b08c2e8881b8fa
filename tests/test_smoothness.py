"""How smooth a motion is: the definitions on curves whose derivatives are known, and what an evaluation collects."""
import dataclasses

import numpy as np
import pytest
from test_vector import COUNT

from pdkit.evaluate import evaluate
from pdkit.smoothness import Motions, action_change, jerk
from pdkit.tasks import get_task


def test_action_change_is_the_root_mean_square_of_differences():
    assert action_change(np.array([[0.0, 0.0], [0.3, 0.0], [0.3, -0.4]])) == pytest.approx(np.sqrt((0.09 + 0.16) / 4))
    assert action_change(np.full((9, 2), 0.7)) == 0 == action_change(np.zeros((1, 2)))


@pytest.mark.parametrize("rate", [20.0, 100.0])
def test_jerk_is_the_third_derivative_in_seconds(rate):
    t = np.arange(200) / rate
    cubic, parabola = np.stack([2 * t**3, 0 * t], 1), np.stack([t**2, 3 * t], 1)
    assert jerk(cubic, rate) == pytest.approx(12, rel=1e-6) and jerk(parabola, rate) == pytest.approx(0, abs=1e-4)
    assert jerk(np.stack([2 * t**3, 2 * t**3], 1), rate) == pytest.approx(12 * np.sqrt(2), rel=1e-6)
    assert np.isnan(jerk(cubic[:3], rate)) and np.isnan(jerk(cubic[:, :0], rate))


def test_each_episode_is_measured_by_itself():
    """COUNT's observation is (seed, steps so far), so both the action and what it should amount to are known."""
    def wave(observation):
        return 2 * np.sin(observation[..., :1] * (1 + observation[..., 1:2]))  # beyond 1: executed, and counted, as 1

    def act(windows):
        return wave(windows[:, -1:]).astype(np.float32)

    tables = [evaluate(COUNT, act, [3, 1, 2, 5], num_envs=lanes) for lanes in (1, 3)]
    for table in tables:
        for row in table.itertuples():
            taken = np.clip(wave(np.array([[row.seed, t] for t in range(4)], float)), -1, 1)
            assert row.action_change == pytest.approx(action_change(taken), rel=1e-5)
        assert table.jerk.isna().all()  # no joints


def test_chunks_count_step_by_step_and_need_windows_as_long():
    spec = dataclasses.replace(COUNT, joints=2, rate=1.0)
    rng = np.random.default_rng(0)
    actions, places = rng.uniform(-1, 1, (6, 1)), rng.normal(size=(7, 2))
    one, two, short = (Motions(spec, places[None, :1]) for _ in range(3))
    for t in range(6):
        one.add(actions[None, t: t + 1], np.array([1]), places[None, t + 1: t + 2])
    for t in (0, 2, 4):
        two.add(actions[None, t: t + 2], np.array([2]), places[None, t + 1: t + 3])
        short.add(actions[None, t: t + 2], np.array([2]), places[None, t + 2: t + 3])
    ends = [motions.end(0, places[:1]) for motions in (one, two, short)]
    assert ends[0] == ends[1] == {"action_change": pytest.approx(action_change(actions)), "jerk": pytest.approx(jerk(places, 1.0))}
    assert ends[2]["action_change"] == ends[0]["action_change"] and np.isnan(ends[2]["jerk"])
    assert one.actions == [[]] and len(one.joints[0]) == 1


def test_the_tasks_joints_move_and_what_follows_is_no_joint():
    """Door: 27 angles, then the latch. A still hand has no jerk; a trembling one much."""
    spec = get_task("Door")

    def still(windows):
        return np.zeros((len(windows), 1, spec.act_dim), np.float32)

    rng = np.random.default_rng(0)

    def trembling(windows):
        return rng.uniform(-1, 1, (len(windows), 1, spec.act_dim)).astype(np.float32)

    calm, wild = (evaluate(spec, act, [1, 2], max_episode_steps=60) for act in (still, trembling))
    assert (calm.action_change == 0).all() and (wild.action_change > 0.5).all() and (wild.jerk > 10 * calm.jerk).all()
