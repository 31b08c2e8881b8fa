"""Lanes that share one simulation: the bookkeeping against separate lanes, and ManiSkill's batched step against the fast step.

ManiSkill simulates one lane on a CPU. What takes several of its lanes is tested with an emulated GPU here, and on a real one in
test_cuda.py.
"""
import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from emulated_gpu import emulated_gpu
from mani_skill.utils.structs import Pose
from test_vector import COUNT, CountSim, counting_seeds

from pdkit.decorated import load_decorated
from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.files import DATA
from pdkit.online import Trainer
from pdkit.online_config import OnlineConfig
from pdkit.policies import POLICIES
from pdkit.profiles import flat
from pdkit.rl.sac import SACConfig
from pdkit.runs import Run
from pdkit.seeds import selection_seeds
from pdkit.tasks import batched, get_task
from pdkit.tasks.batched import ManiSkillBatch, Together
from pdkit.tasks.chair_body import chair_start
from pdkit.tasks.faucet_env import faucet_start
from pdkit.tasks.horizon import horizon_spec
from pdkit.tasks.lanes import IDLE
from pdkit.tasks.maniskill import with_base_pose
from pdkit.tasks.peg import peg_start
from pdkit.tasks.vector import SIMULATORS, VectorEnv


class SideBySide:
    """A BatchSim of separate simulators."""

    def __init__(self, spec, num_envs):
        self.sims = [spec.make() for _ in range(num_envs)]

    def reset(self, lanes, seeds):
        return np.stack([self.sims[lane].reset(int(seed)) for lane, seed in zip(lanes, seeds, strict=True)])

    def step(self, actions):
        results = [sim.step(action) for sim, action in zip(self.sims, actions, strict=True)]
        return np.stack([observation for observation, _ in results]), np.array([solved for _, solved in results])

    def close(self):
        for sim in self.sims:
            sim.close()


@pytest.fixture(autouse=True)
def other_simulators(monkeypatch):
    """What tests simulate with: separate simulators, and the one lane that ManiSkill simulates on a CPU."""
    monkeypatch.setitem(SIMULATORS, "side by side", side_by_side)
    monkeypatch.setitem(SIMULATORS, "stock", stock_lanes)
    monkeypatch.setitem(SIMULATORS, "emulated GPU", lambda spec, count, rules: Together(ManiSkillBatch(spec, count), count, rules))


def side_by_side(spec, count, rules):
    return Together(SideBySide(spec, count), count, rules)


def stock_lanes(spec, count, rules):
    return Together(ManiSkillBatch(spec, count, "physx_cpu"), count, rules)


def both(spec, num_envs, queue_of, **rules):
    """The same lanes apart and together."""
    return [VectorEnv(spec, num_envs, queue_of(), simulator=simulator, **rules) for simulator in ("cpu", "side by side")]


def scarce():
    """Four episodes for three lanes, so that lanes become idle."""
    queue = [4, 3, 2, 1]
    return lambda lane: queue.pop() if queue else IDLE


def same(one, other):
    live = one.steps > 0
    return all(np.array_equal(getattr(one, name)[live], getattr(other, name)[live]) for name in
               ("windows", "final_windows", "solved", "terminated", "truncated")) and \
        np.array_equal(one.steps, other.steps) and one.episodes == other.episodes


@pytest.mark.parametrize("rules", [{}, {"chunk": 3}, {"chunk": 3, "terminate_on_success": True}, {"success_tail": 2},
                                   {"chunk": 2, "window": 3, "success_tail": 1}])
@pytest.mark.parametrize("seeds", [counting_seeds, scarce])
def test_lanes_together_report_what_lanes_apart_report(rules, seeds):
    rng, finished = np.random.default_rng(0), 0
    apart, together = both(COUNT, 3, seeds, **rules)
    with apart, together:
        assert np.array_equal(apart.reset(), together.reset())
        for _ in range(30):
            actions = rng.uniform(-1, 0.3, (3, rules.get("chunk", 1), 1))
            one, other = apart.step(actions), together.step(actions)
            assert same(one, other)
            finished += len(one.episodes)
    assert finished >= 4


def test_together_a_real_task_is_the_same_to_the_last_bit():
    rng = np.random.default_rng(0)
    apart, together = both(get_task("StackCube"), 2, counting_seeds, chunk=2, window=2, max_episode_steps=5)
    with apart, together:
        assert np.array_equal(apart.reset(), together.reset())
        for _ in range(8):
            actions = rng.uniform(-1, 1, (2, 2, 4))
            assert same(apart.step(actions), together.step(actions))


class AccountSim(CountSim):
    """As CountSim, but its observation sums up the actions, so that a replay that mixes lanes or steps up is seen."""

    def reset(self, seed):
        self.sum = np.float32(seed)
        return np.array([super().reset(seed)[0], self.sum], np.float32)

    def step(self, action):
        _, solved = super().step(action)
        self.sum = self.sum * np.float32(0.5) + action[0]
        return np.array([self.seed, self.sum], np.float32), solved


def test_a_snapshot_brings_lanes_of_different_ages_back():
    spec = dataclasses.replace(COUNT, make=AccountSim, max_episode_steps=5)
    rng, ages = np.random.default_rng(1), set()
    for steps in range(1, 8):
        first = VectorEnv(spec, 3, counting_seeds(), terminate_on_success=True, window=3, simulator="side by side")
        with first, VectorEnv(spec, 3, counting_seeds(), terminate_on_success=True, window=3, simulator="side by side") as second:
            first.reset()
            for _ in range(steps):
                first.step(rng.uniform(-1, 0.7, (3, 1, 1)))
            snapshot = first.snapshot()
            ages.add(tuple(snapshot["lengths"] == snapshot["lengths"].max()))
            assert np.array_equal(second.restore(snapshot), first._windows)
            first._next_seed = second._next_seed = lambda lane: 7 + lane
            for _ in range(6):
                actions = rng.uniform(-1, 0.7, (3, 1, 1))
                assert same(first.step(actions), second.step(actions))
    assert len(ages) > 2  # of which some began later than others


def arm(stock):
    """The kinematics of a batch's arm, by which actions become joint positions."""
    return stock._env.agent.controller.controllers["arm"].kinematics


@pytest.mark.parametrize("task, tolerance", [("StackCube", 1e-4), ("PegInsertionSide", 5e-3), ("TurnFaucet", 1e-4), ("PushChair", 5e-3)])
def test_maniskills_batched_step_starts_and_moves_as_the_fast_step(task, tolerance):
    spec, rng = get_task(task), np.random.default_rng(0)
    stock, fast = ManiSkillBatch(spec, 1, "physx_cpu"), spec.make()
    try:
        for _ in range(2):  # the second time without building the scene anew
            np.testing.assert_allclose(stock.reset(np.array([0]), np.array([7]))[0], fast.reset(7), atol=1e-6)
            for _ in range(30):
                action = rng.uniform(-1, 1, spec.act_dim).astype(np.float32)
                (observations, solved), (expected, success) = stock.step(action[None]), fast.step(action)
                np.testing.assert_allclose(observations[0], expected, atol=tolerance)
                assert bool(solved[0]) == success
    finally:
        stock.close()
        fast.close()


@pytest.mark.parametrize("task", ["StackCube", "PegInsertionSide"])
def test_the_arm_control_of_a_gpu_moves_as_the_fast_step_where_actions_are_small(task):
    """ManiSkill's inverse kinematics for GPUs, which runs on a CPU too; where actions are large it falls short (see batched.py)."""
    spec, apart = get_task(task), []
    stock, fast = ManiSkillBatch(spec, 1, "physx_cpu"), spec.make()
    try:
        stock.reset(np.array([0]), np.array([7]))
        arm(stock)._setup_gpu()
        for size in (0.1, 1.0):
            rng = np.random.default_rng(0)
            stock.reset(np.array([0]), np.array([7]))
            fast.reset(7)
            for _ in range(5):
                action = (size * rng.uniform(-1, 1, spec.act_dim)).astype(np.float32)
                observation, expected = stock.step(action[None])[0][0], fast.step(action)[0]
            apart.append(np.abs(observation - expected)[:9].max())  # of the joints' positions, radians
    finally:
        stock.close()
        fast.close()
    assert apart[0] < 5e-3 and apart[1] > 3 * apart[0]


class LikeAGPU:
    """StackCube as ManiSkill steps it on a CPU, with the arm control of a GPU."""

    def __init__(self):
        self._stock = ManiSkillBatch(get_task("StackCube"), 1, "physx_cpu")
        self._stock.reset(np.array([0]), np.array([0]))
        arm(self._stock)._setup_gpu()

    def reset(self, seed):
        return self._stock.reset(np.array([0]), np.array([seed]))[0]

    def step(self, action):
        observations, solved = self._stock.step(action[None])
        return observations[0], bool(solved[0])

    def close(self):
        self._stock.close()


@pytest.mark.slow
def test_a_policy_solves_as_much_with_the_arm_control_of_a_gpu():
    """So policies trained in one world can be judged in the other: of 10 episodes of the shipped decorated policy, at most 2 differ."""
    policy, spec = load_decorated(DATA / "checkpoints" / "StackCube" / "decorated"), get_task("StackCube")
    rates = []
    for world in (spec, dataclasses.replace(spec, make=LikeAGPU)):
        policy.reset(0)
        table = evaluate(world, policy.act, selection_seeds(10), window=policy.window, chunk=policy.chunk, num_envs=4)
        rates.append(table.success_once.sum())
    assert min(rates) >= 7 and abs(rates[0] - rates[1]) <= 2


def test_a_lane_keeps_the_peg_that_it_was_built_with_where_another_episode_lies():
    spec = get_task("PegInsertionSide")
    stock, fast = ManiSkillBatch(spec, 1, "physx_cpu"), spec.make()
    try:
        stock.reset(np.array([0]), np.array([7]))
        observation, expected = stock.reset(np.array([0]), np.array([11]))[0], fast.reset(11)
    finally:
        stock.close()
        fast.close()
    built = peg_start(7)
    np.testing.assert_allclose(observation[:34], expected[:34], atol=1e-6)  # the arm, and where the peg lies on the table
    np.testing.assert_allclose(observation[34], built.radius, atol=1e-6)  # on the table, neither in nor above it
    np.testing.assert_allclose(observation[39:42], [built.half_length, built.radius, built.radius], atol=1e-6)


def test_a_restored_lane_has_the_peg_that_it_was_built_with():
    spec, seeds = dataclasses.replace(get_task("PegInsertionSide"), max_episode_steps=3), iter([7, 11, 12, 13])
    with VectorEnv(spec, 1, lambda lane: next(seeds), simulator="stock") as first:
        first.reset()
        for _ in range(4):
            first.step(np.zeros((1, 1, 7)))
        snapshot, seen = first.snapshot(), first._windows[0, 0]
    with VectorEnv(spec, 1, lambda lane: 99, simulator="stock") as second:
        again = second.restore(snapshot)[0, 0]
        assert second.snapshot()["built"].tolist() == [7]
    built = peg_start(7)
    assert snapshot["seeds"].tolist() == [11] and len(snapshot["actions"]) == 1
    np.testing.assert_allclose(again[39:42], [built.half_length, built.radius, built.radius], atol=1e-6)
    np.testing.assert_allclose(again, seen, atol=1e-3)


@pytest.mark.parametrize("task, simulator, lanes, limit", [("StackCube", "stock", 1, 30), ("TurnFaucet", "emulated GPU", 4, 9),
                                                         ("PushChair", "emulated GPU", 4, 9)])
def test_a_run_trains_on_the_batched_step_and_resumes(tmp_path, task, simulator, lanes, limit):
    """The whole loop: on the one lane that ManiSkill simulates on a CPU, and on several."""
    spec = get_task(task)
    torch.manual_seed(0)
    base = POLICIES["mlp"](dict(obs_dim=spec.obs_dim, act_dim=spec.act_dim, hidden=8))
    config = OnlineConfig(task=task, simulator=simulator, num_envs=lanes, env_workers=int(lanes == 1), eval_workers=0,
                          total_steps=120, warmup_steps=40, batch=16, utd=0.1, demo_fraction=0.0, eval_every=0, log_every=40,
                          train_limit=limit, checkpoint_every=50, sac=SACConfig(hidden=16, layers=2, bf16=False))

    def killed(trainer):
        if trainer.step >= 80:
            raise KeyboardInterrupt

    with emulated_gpu() if lanes > 1 else nullcontext():
        with pytest.raises(KeyboardInterrupt):
            Trainer(config, base).train(Run(tmp_path, "online", flat(config)), killed)
        trainer = Trainer(config, base)
        trainer.train(Run(tmp_path, "online", flat(config)))
    assert [row["step"] for row in trainer.rows] == [40, 80, 120] and trainer.agent.updates >= 7
    assert all(row["train_length"] == limit for row in trainer.rows)


SEEDS = np.array([3, 8, 5, 6])  # of episodes with different objects


@pytest.fixture
def several():
    """Makes a task's batch of four lanes on an emulated GPU, and a fast step for each."""
    made = []

    def make(task):
        spec = get_task(task)
        made.extend([ManiSkillBatch(spec, 4), *(spec.make() for _ in range(4))])
        return made[-5], made[-4:]

    with emulated_gpu():
        yield make
        for sim in made:
            sim.close()


@pytest.mark.parametrize("task", ["StackCube", "PegInsertionSide", "TurnFaucet", "TurnFaucetSource", "PushChair", "PushChairSource"])
def test_several_lanes_start_and_move_as_the_fast_step(several, task):
    """Each with its own objects, of which some have more joints than others; and so do lanes that begin again while others go on."""
    lanes, fast = several(task)
    rng = np.random.default_rng(0)

    def compare(observations, expected):
        np.testing.assert_allclose(observations[:, :9], expected[:, :9], atol=5e-3)  # the arm control of a GPU, and of a CPU
        rest = np.ones(observations.shape[1], bool)
        rest[82:107] = not task.startswith("PushChair")  # how castors turn in place depends on the last digits
        np.testing.assert_allclose(observations[:, rest], expected[:, rest], atol=0.05)

    np.testing.assert_allclose(lanes.reset(np.arange(4), SEEDS), [sim.reset(int(seed)) for sim, seed in zip(fast, SEEDS, strict=True)],
                               atol=1e-6)
    if task.startswith("PushChair"):
        assert len({built.max_dof for built in lanes._env.built}) > 1
    for begin in ((), (1, 3), (0,)):
        if begin:
            again = lanes.reset(np.array(begin), SEEDS[list(begin)])
            np.testing.assert_allclose(again, [fast[lane].reset(int(SEEDS[lane])) for lane in begin], atol=1e-6)
        for _ in range(4):
            actions = rng.uniform(-0.1, 0.1, (4, lanes._env.single_action_space.shape[0])).astype(np.float32)
            observations, solved = lanes.step(actions)
            results = [sim.step(action) for sim, action in zip(fast, actions, strict=True)]
            compare(observations, np.stack([seen for seen, _ in results]))
            assert solved.tolist() == [success for _, success in results]


def test_a_lane_keeps_its_faucet_where_the_next_episode_has_another(several):
    lanes, (fast, *_) = several("TurnFaucet")
    other = next(seed for seed in range(40) if faucet_start(seed, fast.models).model != faucet_start(8, fast.models).model)
    first = lanes.reset(np.arange(4), SEEDS)
    moved, expected = lanes.reset(np.array([1]), np.array([other]))[0], fast.reset(other)
    np.testing.assert_allclose(moved[:32], expected[:32], atol=1e-6)  # the arm
    assert moved[32] == first[1, 32] != expected[32]  # how far its handle turns
    assert 0.005 < np.abs(moved[36:39] - first[1, 36:39]).max() < 0.15  # where it stands


def test_a_lane_keeps_its_chair_where_the_next_episode_has_another(several):
    lanes, (fast, *_) = several("PushChair")
    other = next(seed for seed in range(40) if chair_start(seed, 3).chair != chair_start(8, 3).chair)
    lanes.reset(np.arange(4), SEEDS)
    moved, expected = lanes.reset(np.array([1]), np.array([other]))[0], fast.reset(other)
    np.testing.assert_allclose(moved[:57], expected[:57], atol=1e-6)  # the robot, and the chair's root link
    assert lanes._env.built[1].max_dof != len(fast._chair._rest)


def test_success_of_one_lane_is_that_lanes(several):
    """A handle turned to just short of, and just past, nine tenths of its range; a chair that stands at the origin."""
    lanes, _ = several("TurnFaucet")
    lanes.reset(np.arange(4), SEEDS)
    env = lanes._env
    joints, handle = env.first_angles.clone(), env.target_switch_link.joint
    limits = handle.get_limits()[:, 1]
    joints[torch.arange(4), handle.active_index] = limits * torch.tensor([0.0, 0.8999, 0.9001, 0.5])
    env.faucet.set_qpos(joints)
    fetched(env)
    verdict = env.evaluate()
    assert verdict["success"].tolist() == [False, False, True, False]
    seen = env.get_obs(verdict)
    np.testing.assert_allclose(seen[:, -1], limits * torch.tensor([0.9, 0.0001, -0.0001, 0.4]), atol=1e-5)
    lanes.reset(np.array([0]), SEEDS[:1])
    np.testing.assert_array_equal(env.get_obs(env.evaluate())[:, 25:32], seen[:, 25:32])  # where handles were at the start

    lanes, _ = several("PushChair")
    lanes.reset(np.arange(4), SEEDS)
    env = lanes._env
    poses = env.chair.pose.raw_pose.clone()
    poses[[0, 2], :2] = torch.tensor([[0.1, 0.1], [0.1, 0.12]])  # 0.141 and 0.156 m from the origin
    env.chair.set_pose(Pose.create(poses))
    fetched(env)
    assert env.evaluate()["success"].tolist() == [False] * 4  # it moved there just now
    assert env.evaluate()["success"].tolist() == [True, False, False, False]


def test_nothing_touches_the_robot_when_a_scene_is_set_up(several):
    """A GPU simulates a step then, with bodies where they were built."""
    lanes, _ = several("PushChair")
    lanes._env.reset(seed=SEEDS.tolist(), options={"reconfigure": True})
    for world in lanes._env.scene.px.worlds:
        world.step()
        pairs = [sorted(body.name.split("_")[0].split("-")[2] for body in contact.bodies if "_" in body.name)
                 for contact in world.get_contacts() if any(point.separation < 0 for point in contact.points)]
        assert ["chair", "pdkit"] not in pairs
        assert all(abs(joint) < 50 for one in world.articulation_link_components for joint in one.articulation.qvel)


def test_a_plain_reset_starts_faucets_where_the_fast_step_does(several):
    lanes, fast = several("TurnFaucet")
    observations, _ = lanes._env.reset(seed=SEEDS.tolist(), options={"reconfigure": True})
    expected = [sim.reset(int(seed)) for sim, seed in zip(fast, SEEDS, strict=True)]
    np.testing.assert_allclose(with_base_pose(lanes._env, observations), expected, atol=1e-6)


def fetched(env):
    """What was set, simulated and seen."""
    env.scene._gpu_apply_all()
    env.scene.px.gpu_update_articulation_kinematics()
    env.scene._gpu_fetch_all()


def test_lanes_have_the_friction_and_damping_of_the_episode_that_they_were_built_for(several):
    lanes, _ = several("PushChair")
    lanes.reset(np.arange(4), SEEDS)
    for built, seed in zip(lanes._env.built, SEEDS, strict=True):
        start, joints = chair_start(int(seed), 3), built._objs[0].active_joints
        values = np.array([[joint.friction, joint.damping] for joint in joints])
        swivel = ["helper" in joint.parent_link.name for joint in joints]
        np.testing.assert_allclose(values[swivel], [start.swivel], rtol=1e-5)
        np.testing.assert_allclose(values[:2], start.frictions[:2], rtol=1e-5)
        for name, link in built.links_map.items():  # wheels grip, and a seat does not collide with its foot, in every lane
            for shape in link._objs[0].collision_shapes:
                assert shape.physical_material.dynamic_friction == pytest.approx(1.0 if name.startswith("wheel") else 0.1)
                assert bool(shape.collision_groups[2] & 1 << 31) == (name in ("seat", "support"))
    lanes, _ = several("TurnFaucet")
    lanes.reset(np.arange(4), SEEDS)
    assert lanes._env.target_switch_link.joint.friction.numpy() == pytest.approx(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["TurnFaucet", "PushChair"])
def test_a_policy_solves_as_much_on_several_lanes(task):
    """Of 18 episodes of the shipped decorated policy, at most 3 more or less."""
    policy, spec = load_decorated(DATA / "checkpoints" / task / "decorated"), get_task(task)
    solved = []
    for simulator in ("cpu", "emulated GPU"):
        policy.reset(0)
        queue, episodes = list(selection_seeds(18)), []
        with emulated_gpu(), VectorEnv(spec, 6, lambda lane, queue=queue: queue.pop(0) if queue else IDLE, terminate_on_success=True,
                                       window=policy.window, chunk=policy.chunk, simulator=simulator) as env:
            windows = env.reset()
            while len(episodes) < 18:
                result = env.step(policy.act(windows))
                windows = result.windows
                episodes += result.episodes
        solved.append(sum(episode.success_once for episode in episodes))
    assert min(solved) >= 9 and abs(solved[0] - solved[1]) <= 3


def test_what_cannot_be_simulated_together_is_refused_with_what_to_do(monkeypatch):
    base = POLICIES["mlp"](dict(obs_dim=39, act_dim=28, hidden=8))
    for spec in (get_task("Door"), horizon_spec(get_task("StackCube"), 0.5)):
        with pytest.raises(PdkitError, match="^physx_cuda simulates StackCube, PegInsertionSide, .*PushChair.*set simulator=cpu"):
            VectorEnv(spec, 2, counting_seeds(), simulator="physx_cuda")  # from the process that simulates
    with pytest.raises(PdkitError, match="^physx_cuda simulates"):
        Trainer(OnlineConfig(task="Door", simulator="physx_cuda"), base)  # before anything is made
    for make in (OnlineConfig, lambda simulator: VectorEnv(COUNT, 1, counting_seeds(), simulator=simulator)):
        with pytest.raises(PdkitError, match="Unknown simulator 'physx'"):
            make(simulator="physx")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(PdkitError, match="needs a CUDA device.*set simulator=cpu"):
        batched.require_batched(get_task("PegInsertionSide"))


@pytest.mark.parametrize("what, fix", [("no network", "sapien-sim/physx-precompiled"), ("libcuda.so: cannot open", "libcuda.so known")])
def test_a_missing_library_is_one_sentence(monkeypatch, what, fix):
    from sapien import physx

    def fails():
        raise OSError(what)

    monkeypatch.setattr(physx, "enable_gpu", fails)
    with pytest.raises(PdkitError, match=f"{what}.*{fix}.*set simulator=cpu"):
        batched.load_physx_cuda()
