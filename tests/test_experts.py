"""The scripted experts and the episodes they leave."""
from __future__ import annotations

import numpy as np
import pytest

from pdkit.demos import experts, peg_expert
from pdkit.demos.chair_expert import PushChairExpert
from pdkit.demos.experts import EXPERTS, StackCubeExpert, scripted_episodes
from pdkit.errors import PdkitError
from pdkit.tasks import get_task


@pytest.fixture(scope="module")
def episodes():
    return list(scripted_episodes("StackCube", 20))


def test_stack_cube_expert_succeeds_quickly(episodes):
    assert episodes[-1]["seed"] <= 21  # at most 2 of 22 failed
    lengths = [len(episode["actions"]) for episode in episodes]
    assert 30 <= np.median(lengths) <= 40 and max(lengths) <= 100


def test_episodes_end_at_their_first_success(episodes):
    task = get_task("StackCube")
    for episode in episodes:
        steps = len(episode["actions"])
        assert episode["observations"].shape == (steps + 1, task.obs_dim)
        assert episode["actions"].shape == (steps, task.act_dim)
        assert episode["observations"].dtype == episode["actions"].dtype == np.float32
        assert np.abs(episode["actions"]).max() <= 1
        assert episode["success"].dtype == bool and episode["success"].nonzero()[0].tolist() == [steps - 1]


def test_episodes_replay_from_their_seed(episodes):
    sim = get_task("StackCube").make()
    for episode in episodes[:3]:
        np.testing.assert_array_equal(sim.reset(episode["seed"]), episode["observations"][0])
        for action, after in zip(episode["actions"], episode["observations"][1:], strict=True):
            np.testing.assert_array_equal(sim.step(action)[0], after)


def test_noise_is_in_the_actions_and_comes_from_the_seed(episodes):
    noisy, again = (list(scripted_episodes("StackCube", 3, first_seed=5, noise=0.2)) for _ in range(2))
    for one, two in zip(noisy, again, strict=True):
        np.testing.assert_array_equal(one["actions"], two["actions"])
    clean = next(episode for episode in episodes if episode["seed"] == noisy[0]["seed"])
    difference = (noisy[0]["actions"][:5] - clean["actions"][:5])[:, :3]  # before the paths part too far
    assert 0.05 < difference.std() < 0.5
    np.testing.assert_array_equal(noisy[0]["actions"][:5, 3], clean["actions"][:5, 3])


class Sometimes(StackCubeExpert):
    """Fails every second episode, or always."""

    always = False
    episodes = 0

    def reset(self, rng):
        super().reset(rng)
        Sometimes.episodes += 1

    def act(self, observation):
        if self.always or Sometimes.episodes % 2:
            return np.zeros(4, np.float32)
        return super().act(observation)


def test_each_episode_has_noise_of_its_own(monkeypatch):
    drawn = []

    class Drawing(StackCubeExpert):
        def reset(self, rng):
            super().reset(rng)
            drawn.append(rng.random())

    monkeypatch.setitem(EXPERTS, "StackCube", Drawing)
    for first in (0, 0, 1):
        list(scripted_episodes("StackCube", 1, first))
    assert len(drawn) == 3 and drawn[0] == drawn[1] != drawn[2]


def test_near_the_hole_and_there_alone_the_noise_is_small(monkeypatch):
    told, expert = [], peg_expert.PegInsertionSideExpert(0.5)
    monkeypatch.setattr(peg_expert, "pose_action", lambda move, turning, gripper, noise, rng: told.append(noise))
    sim = get_task("PegInsertionSide").make()
    observation = sim.reset(0)
    sim.close()
    expert.reset(np.random.default_rng(0))
    expert.act(observation)
    expert._stage = "insert"
    monkeypatch.setattr(expert, "_advance", lambda scene: None)
    expert.act(observation)
    assert told == [0.5, pytest.approx(0.05)]


def test_the_chairs_expert_turns_with_noise_too():
    sim, expert = get_task("PushChairSource").make(), PushChairExpert(0.1)
    observation = sim.reset(0)
    sim.close()
    expert.reset(np.random.default_rng(0))
    actions = np.stack([expert.act(observation) for _ in range(50)])
    inside = np.abs(actions[:, :3]).max(axis=0) < 1
    assert inside[2] and actions[:, :3].std(axis=0)[inside].min() > 0.05 and not actions[:, 3:].std(axis=0).any()


def test_failures_are_skipped_and_counted(monkeypatch):
    monkeypatch.setitem(EXPERTS, "StackCube", Sometimes)
    calls = []
    kept = list(scripted_episodes("StackCube", 2, first_seed=7, progress=lambda *counts: calls.append(counts)))
    assert [episode["seed"] for episode in kept] == [8, 10]
    assert calls == [(0, 1), (1, 2), (1, 3), (2, 4)]


def test_an_expert_that_always_fails_is_given_up(monkeypatch):
    monkeypatch.setitem(EXPERTS, "StackCube", Sometimes)
    monkeypatch.setattr(Sometimes, "always", True)
    monkeypatch.setattr(experts, "GIVE_UP", 3)
    with pytest.raises(PdkitError, match="lower the noise"):
        list(scripted_episodes("StackCube", 1))


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("StackCub", 1), "Did you mean 'StackCube'"),
        (("StackCube", 0), "at least 1"),
        (("StackCube", 1, 0, -0.1), "noise"),
    ],
)
def test_bad_arguments_are_told_at_once(arguments, message):
    with pytest.raises(PdkitError, match=message):
        scripted_episodes(*arguments)


def test_stack_cube_expert_picks_up_a_dropped_cube():
    sim, expert = get_task("StackCube").make(), StackCubeExpert()
    expert.reset(np.random.default_rng(0))
    observation, success, drop, steps = sim.reset(0), False, 6, 0
    while not success and steps < 120:
        action = expert.act(observation)
        if observation[34] > 0.09 and drop > 0:  # in the air: open the gripper
            action, drop = np.float32([0, 0, 0, 1]), drop - 1
        observation, success = sim.step(action)
        steps += 1
    assert drop < 6 and success
