"""The fast ManiSkill step against the stock environment, repeatability, and machines without Vulkan."""
from __future__ import annotations

import gc
import hashlib
import itertools
import json
import os
import platform
import subprocess
import sys
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from pdkit.demos.experts import StackCubeExpert
from pdkit.errors import PdkitError
from pdkit.tasks import get_task
from pdkit.tasks.maniskill import BASE_POSE
from pdkit.tasks.maniskill_headless import close_env, render_device
from pdkit.tasks.stack_cube import StackCube, StockStackCube

# The fast step does ManiSkill's arithmetic in ManiSkill's order, so on x86 the two agree to the last bit, through every
# contact. Elsewhere a compiler may fuse operations: then only the steps before the first contact can be compared.
SAME_BITS = platform.machine() in ("x86_64", "AMD64")
BEFORE_CONTACT = 8


@pytest.fixture(scope="module")
def fast():
    sim = StackCube()
    yield sim
    sim.close()


def play(sim, seed: int, actions) -> tuple[np.ndarray, np.ndarray]:
    """Observations (T + 1, 55) and success flags (T,) of an action sequence."""
    observations, flags = [sim.reset(seed)], []
    for action in actions:
        observation, success = sim.step(action)
        observations.append(observation)
        flags.append(success)
    return np.stack(observations), np.array(flags, bool)


def busy_actions(sim, seed: int, noise: float = 0.1) -> np.ndarray:
    """Actions (T, 4) of an episode with grasping and stacking, a pause with the red cube held on the green one, letting
    go, and flailing about."""
    expert, rng = StackCubeExpert(noise), np.random.default_rng(seed)
    expert.reset(rng)
    actions, observation, held, pause = [], sim.reset(seed), 0, 6
    while held < 3 and len(actions) < 80:
        actions.append(expert.act(observation))
        if expert._stage == "release" and pause > 0:
            actions[-1], pause = np.float32([0, 0, 0, -1]), pause - 1
        observation, success = sim.step(actions[-1])
        held += success
    return np.concatenate([actions, rng.uniform(-1.5, 1.5, (25, 4))]).astype(np.float32)


def digging_actions(seed: int) -> np.ndarray:
    """Actions (40, 4) that push the gripper onto the table and among the cubes."""
    return np.random.default_rng(seed).uniform(-1, 1, (40, 4)) * [1, 1, 0.3, 1] - [0, 0, 0.4, 0]


@pytest.mark.parametrize("seed", [0, 3, 11])
def test_fast_step_is_stock_maniskill(fast, seed):
    actions = busy_actions(fast, seed)
    ours, our_flags = play(fast, seed, actions)
    stock, stock_flags = play(StockStackCube(), seed, actions)  # a new one: its results depend on what it did before
    np.testing.assert_allclose(ours[:BEFORE_CONTACT], stock[:BEFORE_CONTACT], rtol=0, atol=1e-5)
    assert stock_flags.any() and not stock_flags.all()
    if SAME_BITS:
        np.testing.assert_array_equal(ours, stock)
        np.testing.assert_array_equal(our_flags, stock_flags)


def test_success_rule_is_stock_maniskills(fast):
    """On ManiSkill's own scene, with the red cube in many places and motions about the one that counts."""
    play(fast, 0, busy_actions(fast, 0)[:-25])
    pose, rng, verdicts = fast._red.entity_pose, np.random.default_rng(0), []
    for spread in (0.0, 1.0):
        for _ in range(60):
            shift = spread * rng.uniform(-1, 1, 3) * [0.035, 0.035, 0.007]
            fast._red.entity_pose = type(pose)(pose.p + shift, pose.q)
            fast._red.linear_velocity = rng.normal(0, 0.006, 3)
            fast._red.angular_velocity = rng.normal(0, 0.3, 3)
            verdicts.append(fast._success())
            assert verdicts[-1] == bool(fast._env.evaluate()["success"])
    assert 0.1 < np.mean(verdicts) < 0.9


def test_a_held_cube_does_not_count(fast):
    """Not even at rest on the other cube. (In play a held cube never is at rest: PhysX says 20 radians a second.)"""
    actions = busy_actions(fast, 0)
    pause = np.flatnonzero((actions == np.float32([0, 0, 0, -1])).all(axis=1))
    play(fast, 0, actions[: pause[3]])
    fast._red.linear_velocity = fast._red.angular_velocity = np.zeros(3)
    stock = {name: bool(value) for name, value in fast._env.evaluate().items()}
    assert stock["is_cubeA_on_cubeB"] and stock["is_cubeA_static"] and stock["is_cubeA_grasped"]
    assert not stock["success"] and not fast._success()


def test_grasp_rule_is_stock_maniskills(fast, monkeypatch):
    """With made-up contacts of many strengths and directions, in both orders of the bodies."""
    fast.reset(0)
    rng, verdicts = np.random.default_rng(0), []
    for _ in range(200):
        contacts = []
        for finger, sign in zip(fast._panda.fingers, (1, -1), strict=True):
            closing = sign * finger.entity_pose.to_transformation_matrix()[:3, 1]
            direction = closing + rng.normal(0, 1.5, 3) * rng.integers(2)
            order = int(rng.choice([1, -1]))
            impulse = order * direction / np.linalg.norm(direction) * rng.choice([0.003, 0.1])
            points = [SimpleNamespace(impulse=impulse / 2)] * 2
            contacts.append(SimpleNamespace(bodies=[finger, fast._red][::order], points=points))
        contacts.append(SimpleNamespace(bodies=[fast._green, fast._red], points=[SimpleNamespace(impulse=np.ones(3))]))
        physics = SimpleNamespace(get_contacts=lambda contacts=contacts: contacts, timestep=0.01)
        monkeypatch.setattr(fast._env.scene, "px", physics)
        verdicts.append(fast._panda.holds(physics, fast._red))
        assert verdicts[-1] == bool(fast._env.agent.is_grasping(fast._env.cubeA))
    assert 0.1 < np.mean(verdicts) < 0.9


def test_out_of_reach_is_stock_maniskill(fast):
    """Where the inverse kinematics fails the arm's targets stay where the arm is."""
    actions = np.tile([1.0, 1.0, 1.0, -1.0], (30, 1))
    ours, _ = play(fast, 5, actions)
    stock, _ = play(StockStackCube(), 5, actions)
    assert np.linalg.norm(ours[-1, 25:28] - ours[-5, 25:28]) < 0.05  # it has stopped at the edge of its reach
    np.testing.assert_allclose(ours, stock, rtol=0, atol=0 if SAME_BITS else 1e-3)


def test_starts_are_stock_maniskill(fast):
    stock = StockStackCube()
    for seed in [*range(40), 2**31 - 1]:
        np.testing.assert_allclose(fast.reset(seed), stock.reset(seed), rtol=0, atol=0 if SAME_BITS else 1e-6)


def test_observation_is_maniskills_with_the_base_pose(fast):
    observation = fast.reset(0)
    assert observation.shape == (get_task("StackCube").obs_dim,) == (55,) and observation.dtype == np.float32
    np.testing.assert_allclose(observation[BASE_POSE], [-0.615, 0, 0, 1, 0, 0, 0], atol=1e-6)
    stock = StockStackCube()._env.reset(seed=0)[0][0].numpy()
    assert stock.shape == (48,)  # ManiSkill 3 dropped it
    np.testing.assert_allclose(np.delete(observation, np.r_[BASE_POSE]), stock, rtol=0, atol=1e-6)


def test_same_seed_and_actions_repeat_whatever_came_before(fast):
    episodes = {seed: busy_actions(fast, seed, 0.2) for seed in range(6)} | {
        seed: digging_actions(seed) for seed in range(6, 12)
    }
    alone = {seed: play(StackCube(), seed, actions)[0] for seed, actions in episodes.items()}
    rng = np.random.default_rng(0)
    seeds = rng.integers(12, size=40)
    parts = [(seed, rng.integers(1, len(episodes[seed]) + 1)) for seed in seeds]  # also left with the cube in the air
    parts += [(10, 9), (6, 12), (9, 11), (4, 12), (9, 14), (5, 12)]  # left just before a cube would have fallen asleep
    for seed, stop in parts:
        observations, _ = play(fast, seed, episodes[seed][:stop])
        np.testing.assert_array_equal(observations, alone[seed][: stop + 1], err_msg=f"seed {seed}")


def test_simulations_in_one_process_do_not_disturb_each_other():
    sims = [StackCube() for _ in range(3)]
    actions = [digging_actions(seed) for seed in range(3)]
    together = [[sim.reset(seed)] for seed, sim in enumerate(sims)]
    for step in range(len(actions[0])):
        for sim, mine, history in zip(sims, actions, together, strict=True):
            history.append(sim.step(mine[step])[0])
    for seed, history in enumerate(together):
        np.testing.assert_array_equal(np.stack(history), play(StackCube(), seed, actions[seed])[0])


WITHOUT_VULKAN = """
import hashlib, json, sys
import pdkit.tasks.stack_cube as stack_cube
from pdkit.errors import PdkitError
lazy = not {"sapien", "mani_skill", "gymnasium"} & set(sys.modules)
from tests.test_maniskill import digest
result = dict(lazy=lazy, digest=digest(stack_cube.StackCube()))
try:
    stack_cube.StackCube(render=True)
except PdkitError as error:
    result["error"] = str(error)
print(json.dumps(result))
"""


def digest(sim) -> str:
    """A checksum over an episode with contacts."""
    return hashlib.sha256(play(sim, 1, busy_actions(sim, 1))[0].tobytes()).hexdigest()


def test_building_and_closing_search_recent_objects_alone_for_garbage(monkeypatch):
    """A search through all that torch and its like have loaded takes 0.3 s, and ManiSkill calls for one at each."""
    from mani_skill.envs import sapien_env  # not above: another process imports this file and must be silent

    searched, search = [], gc.collect
    monkeypatch.setattr("pdkit.tasks.maniskill_headless._closings", itertools.count(1))
    with monkeypatch.context() as patch:
        patch.setattr(gc, "collect", lambda generation=2: searched.append(generation) or search(generation))
        sims = [StackCube() for _ in range(2)]
        scenes = [weakref.ref(sim._env.scene) for sim in sims]
        for sim in sims:
            sim.close()
    assert len(searched) == 4 and set(searched) == {1} and sapien_env.gc is gc
    del sim, sims
    for _ in range(25):
        close_env(SimpleNamespace(render_mode=None, close=lambda: None))
    assert [scene() for scene in scenes] == [None, None]


def test_without_vulkan_in_another_process(fast):
    """No driver: the same trajectory to the bit, a clear error for pictures, and not a word on stderr."""
    masked = {"VK_DRIVER_FILES": "/nonexistent", "VK_ICD_FILENAMES": "/nonexistent"}
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_VULKAN], cwd=root, env=os.environ | masked, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["lazy"], "importing the tasks must not import the simulator"
    assert result["digest"] == digest(fast)
    assert "Vulkan" in result["error"] and "bookworm-backports" in result["error"]
    assert done.stderr == ""


def test_pictures_have_to_be_asked_for(fast):
    with pytest.raises(PdkitError, match="render=True"):
        fast.render()


def test_pictures_follow_the_same_trajectory(fast):
    if render_device() is None:
        pytest.skip("no Vulkan driver that SAPIEN can draw with")
    drawn = StackCube(render=True)
    actions = busy_actions(fast, 2)
    drawn.reset(2)
    before = drawn.render()
    observations, _ = play(drawn, 2, actions)
    after = drawn.render()
    np.testing.assert_array_equal(observations, play(fast, 2, actions)[0])
    assert before.shape == after.shape == (256, 256, 3) and before.dtype == np.uint8
    assert 20 < before.mean() < 235 and np.abs(after.astype(int) - before).max() > 100  # lit, and something moved
    drawn.close()


@pytest.mark.parametrize("task", ["PegInsertionSide", "TurnFaucetSource"])
def test_pictures_show_each_episodes_own_objects(task):
    """Bodies that are built for an episode are seen, the last episode's no more, and the trajectory is the same as without."""
    if render_device() is None:
        pytest.skip("no Vulkan driver that SAPIEN can draw with")
    drawn, plain = get_task(task).make(render=True), get_task(task).make()
    pictures, actions = [], digging_actions(0)
    actions = np.concatenate([actions[:, :3], np.zeros((40, 3)), actions[:, 3:]], axis=1)
    for seed in (0, 3, 0):
        np.testing.assert_array_equal(play(drawn, seed, actions)[0], play(plain, seed, actions)[0])
        drawn.reset(seed)
        pictures.append(drawn.render().astype(int))
    assert np.abs(pictures[0] - pictures[1]).max() > 100
    np.testing.assert_array_equal(pictures[0], pictures[2])
    drawn.close()


# What ManiSkill does and lessons rely on.


def test_action_is_a_clipped_displacement_in_the_robots_frame(fast):
    def moved(action):
        observations, _ = play(fast, 0, [action])
        return observations[-1] - observations[0]

    forward = moved([0.5, 0, 0, 1])[25:28]
    assert forward[0] > 0.01 and np.abs(forward[1:]).max() < 0.01
    np.testing.assert_array_equal(moved([7, 0, 0, 9]), moved([1, 0, 0, 1]))
    assert moved([0, 0, 0, -1])[7] < -0.005  # a finger closes


def test_success_needs_letting_go_and_can_be_lost(fast):
    expert = StackCubeExpert()
    expert.reset(np.random.default_rng(0))
    observation, success, on_top = fast.reset(0), False, []
    while not success:
        observation, success = fast.step(expert.act(observation))
        on_top.append(np.abs(observation[52:55] - [0, 0, -0.04]).max() < 0.005)
    assert sum(on_top) >= 2 and on_top[-1]  # some steps on top did not count: the gripper was still closed
    flags = [fast.step([0, 0, 0, -1])[1] for _ in range(5)]
    assert not flags[-1]  # held again: success is judged at every step and does not last by itself
