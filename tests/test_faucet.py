"""TurnFaucet: the faucets, the fast step against a stock environment, what a seed decides, the success rule, the expert."""
from __future__ import annotations

import pickle
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from test_maniskill import BEFORE_CONTACT, SAME_BITS, play

from pdkit import recorded, train_decorated
from pdkit.demos import save_demos, sources
from pdkit.demos.experts import scripted_episodes
from pdkit.demos.faucet_expert import TurnFaucetExpert
from pdkit.demos.format import from_episodes
from pdkit.errors import PdkitError
from pdkit.files import DATA
from pdkit.policies import load_policy
from pdkit.profiles import online_config
from pdkit.runs import origin
from pdkit.sweep_jobs import make_jobs
from pdkit.sweep_spec import load_spec
from pdkit.tasks import faucet_assets, get_task
from pdkit.tasks.faucet import StockTurnFaucetSource, TurnFaucet, TurnFaucetSource, _corners
from pdkit.tasks.faucet_assets import PARTNET_NOVEL, PARTNET_SOURCE, faucets, with_metadata
from pdkit.tasks.partnet import VARIABLE, Model, object_set
from pdkit.train_base import base_demos

SPAN, AXIS, PLACE, LEFT = 32, slice(33, 36), slice(36, 39), 39


@pytest.fixture(scope="module", autouse=True)
def ours():
    """The generated faucets, whatever the user has set."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(VARIABLE, raising=False)
        yield


@pytest.fixture(scope="module")
def fast():
    sim = TurnFaucetSource()
    yield sim
    sim.close()


def expert_actions(sim, seed: int, steps: int = 130) -> tuple[np.ndarray, bool]:
    """Actions (T, 7) of an episode up to two steps after its success, and whether it got there."""
    expert, actions, observation, solved = TurnFaucetExpert(), [], sim.reset(seed), 0
    expert.watch(sim)
    expert.reset(np.random.default_rng(seed))
    while solved < 2 and len(actions) < steps:
        actions.append(expert.act(observation))
        observation, success = sim.step(actions[-1])
        solved += success
    return np.stack(actions), bool(solved)


def pushing_actions(seed: int, steps: int = 50) -> np.ndarray:
    """Actions (steps, 7) that turn the hand about and push it forwards and down, into the faucet."""
    return np.random.default_rng(seed).uniform(-1.3, 1.3, (steps, 7)) + [0.2, 0, -0.4, 0, 0, 0, 0]


def seed_of(sim, model: int) -> int:
    """A seed whose episode has that faucet."""
    from pdkit.tasks.faucet_env import faucet_start

    return next(seed for seed in range(1000) if faucet_start(seed, sim.models).model == model)


def test_starts_are_maniskill_2s():
    from pdkit.tasks.faucet_env import faucet_start

    models = faucets(novel=False)
    starts = [faucet_start(seed, models) for seed in range(400)]
    yaws, places = np.array([start.yaw for start in starts]), np.array([start.place for start in starts])
    assert np.radians(14.5) < np.abs(yaws).max() <= np.radians(15) and 0.048 < np.abs(places).max() <= 0.05
    assert {start.model for start in starts} == set(range(len(models)))
    start = starts[0]
    assert start.pose(models[start.model]).p == pytest.approx([*start.place, models[start.model].height + 0.01])


def test_a_handle_without_a_limit_is_turned_a_quarter_round():
    for limit, first, target in (((-np.inf, np.inf), 0, np.pi / 2), ((-1.0, 1.0), -1, 0.8)):
        sim = TurnFaucet.__new__(TurnFaucet)
        sim._joint = SimpleNamespace(limit=np.array([limit], np.float32))
        sim._aim()
        assert (sim._first_angle, sim._target_angle) == (pytest.approx(first), pytest.approx(target))


# ---- the faucets -----------------------------------------------------------------------------------------------------

def test_source_and_novel_faucets_differ():
    source, novel = faucets(novel=False), faucets(novel=True)
    assert (len(source), len(novel)) == (10, 3)
    assert len({f.model.urdf.split(">", 1)[1] for f in source + novel}) == 13  # beside the name
    assert len({f.model.name for f in source + novel}) == 13
    assert not set(PARTNET_SOURCE) & set(PARTNET_NOVEL) and (len(PARTNET_SOURCE), len(PARTNET_NOVEL)) == (10, 4)


def test_faucets_come_in_several_styles_and_repeat():
    source = faucets(novel=False)
    assert source == faucets(novel=False)
    assert {len(f.switches) for f in source} == {1, 2}
    boxes = [len(ElementTree.fromstring(f.model.urdf).findall("link[@name='link_0']/collision")) for f in source]
    assert set(boxes) == {3, 4}  # a round post of two boxes with a lever or fin, or with a cross


def test_faucets_have_the_layout_of_partnet():
    for faucet in (*faucets(novel=False), *faucets(novel=True)):
        robot = ElementTree.fromstring(faucet.model.urdf)
        joints = {joint.find("child").get("link"): joint for joint in robot.findall("joint")}
        assert set(faucet.switches) | {"link_base"} == set(joints)
        for name in faucet.switches:
            limit = joints[name].find("limit")
            assert joints[name].get("type") == "revolute" and float(limit.get("lower")) == 0 and 1.1 < float(limit.get("upper")) < 2.3
        assert not robot.findall(".//mesh")


def partnet(folder, ids) -> None:
    """A folder as PartNet-Mobility's, filled with faucets of ours under its numbers."""
    for number, name in enumerate(ids):
        faucet = faucet_assets.generated_faucet(4 + 6 * (number % 2))  # two levers, as most of the paper's have two links
        (folder / str(name)).mkdir()
        (folder / str(name) / "mobility_cvx.urdf").write_text(faucet.model.urdf)


def test_partnet_is_used_where_it_lies(tmp_path, monkeypatch):
    partnet(tmp_path, PARTNET_NOVEL)
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert [faucet.model.name for faucet in faucets(novel=True)] == [str(name) for name in PARTNET_NOVEL]
    sim = TurnFaucet()
    assert {sim.reset(seed)[SPAN] > 1 for seed in range(8)} == {True}
    scale = sim.models[sim._model].scale
    assert 0.05 < scale < 0.5  # PartNet's faucets are made this much smaller, and ManiSkill knows by how much
    assert np.ptp(sim.handle().corners, axis=0).max() < 0.2 * scale  # our levers, 0.11 m at most, to that scale
    with pytest.raises(PdkitError, match="lacks 5002/mobility.urdf, PartNet-Mobility object 5002; put the whole object there, or unset"):
        TurnFaucetSource()
    with pytest.raises(PdkitError, match="ManiSkill does not describe faucet 7; reinstall"):
        with_metadata([Model("7", "<robot/>")])


def test_results_on_ones_own_objects_are_not_mixed_with_those_on_generated_ones(tmp_path, monkeypatch, results):
    """Not in a record, not in a run that goes on, not in the kept episodes of the base policy; demonstrations say whose they show."""
    started = {name: origin({"weights_sha256": "x"}, None, objects=name) for name in ("", "PartNet-Mobility")}
    assert started[""] != started["PartNet-Mobility"] and "objects" not in started[""]
    row = pd.DataFrame({"task": ["TurnFaucet", "Door"], "recipe": "lesson", "seed": 0, "success": 0.5, "command": "x"})
    recorded.record("x", row, pd.DataFrame())
    partnet(tmp_path, PARTNET_SOURCE)
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert [object_set(get_task(name)) for name in ("TurnFaucet", "PushChairSource", "Door")] == ["PartNet-Mobility"] * 2 + [""]
    recorded.record("x", row.assign(success=0.9), pd.DataFrame())
    written = pd.read_csv(results / "x.csv").set_index(["task", "recipe"]).success
    assert written.to_dict() == {("TurnFaucet", "lesson"): 0.5, ("TurnFaucet", "lesson,partnet"): 0.9, ("Door", "lesson"): 0.9}
    assert recorded.load("x")[0].set_index(["task", "recipe"]).success.to_dict() == dict.fromkeys(
        [("Door", "lesson"), ("TurnFaucet", "lesson")], 0.9)
    with pytest.warns(UserWarning, match="TurnFaucetSource show generated objects, and the task now has PartNet-Mobility ones"):
        sources.bundled("TurnFaucet")
    shown = [{"observations": np.zeros((3, 40)), "actions": np.zeros((2, 7)), "success": np.array([False, True]), "seed": 0}]
    monkeypatch.setattr(sources, "scripted_episodes", lambda task, *rest: shown)
    assert sources.scripted("TurnFaucetSource", 1).extra == {"objects": "PartNet-Mobility"}
    spec = tmp_path / "s.toml"
    spec.write_text('kind = "train"\n[fixed]\ntask = "TurnFaucet"')
    with pytest.warns(UserWarning):
        theirs, = make_jobs(load_spec(spec))
    monkeypatch.delenv(VARIABLE)
    assert sources.scripted("TurnFaucetSource", 1).extra == {} and object_set(get_task("TurnFaucet")) == ""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "typo"))
    with pytest.raises(PdkitError, match="which is not a folder"):  # at once, not when a training first simulates
        sources.bundled("TurnFaucet")
    assert object_set(get_task("Door")) == ""
    monkeypatch.delenv(VARIABLE)
    assert recorded.load("x")[0].set_index(["task", "recipe"]).success.to_dict() == {
        ("TurnFaucet", "lesson"): 0.5, ("Door", "lesson"): 0.9}
    ours, = make_jobs(load_spec(spec))
    assert (ours.name, ours.words) == (theirs.name, theirs.words) and ours.folder != theirs.folder


def test_kept_episodes_of_a_base_policy_are_those_of_the_same_objects(monkeypatch, tmp_path):
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path))
    played = []
    monkeypatch.setattr(train_decorated, "reported", lambda *given: played.append(1) or pd.DataFrame({"success_once": [len(played)]}))
    spec, config = get_task("TurnFaucet"), online_config("TurnFaucet")
    base = load_policy(DATA / "checkpoints" / "TurnFaucet" / "base")
    for objects, first in (("", 1), ("PartNet-Mobility", 2), ("", 1)):
        table = train_decorated._base_episodes(base, spec, 4, config, origin({"weights_sha256": "x"}, None, objects=objects))
        assert table.success_once.tolist() == [first]


def test_a_folder_that_is_not_there_is_told_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
    with pytest.raises(PdkitError, match="PDKIT_PARTNET names .*none, which is not a folder; .*unset it"):
        TurnFaucet()
    monkeypatch.setenv(VARIABLE, "")
    assert len(faucets(novel=True)) == 3


# ---- the task --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("name", ["TurnFaucet", "TurnFaucetSource"])
def test_the_task(name):
    spec = get_task(name)
    assert (spec.obs_dim, spec.act_dim, spec.max_episode_steps, spec.suite) == (40, 7, 200, "maniskill")
    assert not spec.absolute_actions and "negative sense" in spec.control
    assert pickle.loads(pickle.dumps(spec)) == spec  # worker processes are given it


def test_the_novel_task_is_learned_from_demonstrations_of_the_source_task(tmp_path):
    arguments = SimpleNamespace(task="TurnFaucet", num_demos=None)
    for task in ("TurnFaucetSource", "TurnFaucet"):
        episode = dict(observations=np.zeros((3, 40)), actions=np.zeros((2, 7)), success=np.array([False, True]), seed=0)
        save_demos(from_episodes(task, [episode], label="scripted", how="made for a test", command="pytest"), tmp_path / task)
    arguments.demos = tmp_path / "TurnFaucetSource"
    assert base_demos(arguments).task == "TurnFaucetSource"
    arguments.demos = tmp_path / "TurnFaucet"
    with pytest.raises(PdkitError, match="holds demonstrations of TurnFaucet, not of TurnFaucetSource"):
        base_demos(arguments)
    arguments.demos = None
    assert base_demos(arguments).task == "TurnFaucetSource"  # those that come with the kit


def test_observation(fast):
    for seed in range(6):
        observation = fast.reset(seed)
        assert observation.shape == (40,) and observation.dtype == np.float32
        np.testing.assert_allclose(observation[18:25], [-0.56, 0, 0, 1, 0, 0, 0], atol=1e-6)  # the base pose, put back
        handle = fast.handle()
        np.testing.assert_allclose(observation[AXIS], handle.axis, atol=1e-6)
        assert np.linalg.norm(observation[PLACE] - handle.corners.mean(axis=0)) < 0.05 and observation[LEFT] == observation[SPAN]
        assert handle.corners[:, 2].min() > 0.03  # over the table


def test_fast_step_is_stock_maniskill(fast):
    stock = StockTurnFaucetSource()  # builds its scene anew at every reset
    for model in (0, 1, 2, 5):  # levers on top and at the side, crosses
        seed = seed_of(fast, model)
        actions, solved = expert_actions(fast, seed)
        assert solved
        compare(fast, stock, seed, np.concatenate([actions, pushing_actions(seed, 10)]))
    for seed in (9, 10):
        compare(fast, stock, seed, pushing_actions(seed))


def compare(fast, stock, seed: int, actions: np.ndarray) -> None:
    ours, our_flags = play(fast, seed, actions)
    theirs, their_flags = play(stock, seed, actions)
    np.testing.assert_allclose(ours[:BEFORE_CONTACT], theirs[:BEFORE_CONTACT], rtol=0, atol=1e-5)
    if SAME_BITS:
        np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(our_flags, their_flags)


def test_same_seed_and_actions_repeat_whatever_came_before(fast):
    episodes = {seed: expert_actions(fast, seed)[0] for seed in range(3)} | {seed: pushing_actions(seed) for seed in range(3, 7)}
    alone = {seed: play(TurnFaucetSource(), seed, actions)[0] for seed, actions in episodes.items()}
    rng = np.random.default_rng(0)
    for seed in rng.integers(7, size=24):
        stop = rng.integers(1, len(episodes[seed]) + 1)  # also left with a handle half turned
        observations, _ = play(fast, seed, episodes[seed][:stop])
        np.testing.assert_array_equal(observations, alone[seed][: stop + 1], err_msg=f"seed {seed}")


def test_one_faucet_is_in_the_scene_at_a_time(fast):
    robot_and_table = len(fast._env.agent.robot._objs[0].links) + 2
    for model in (0, 4, 0, 9):
        fast.reset(seed_of(fast, model))
        assert len(fast._env.scene.sub_scenes[0].entities) == robot_and_table + len(fast._faucet.links)


def test_faucet_handle_and_place_come_from_the_seed(fast):
    observations, models, handles = [], set(), set()
    for seed in range(120):
        observations.append(fast.reset(seed))
        models.add(fast._model)
        handles.add((fast._model, fast._link.name))
    assert models == set(range(10)) and len(handles) == sum(len(f.switches) for f in fast.models)
    observations = np.stack(observations)
    assert len({o[PLACE].tobytes() for o in observations}) == 120
    one_type = observations[np.isclose(observations[:, SPAN], observations[0, SPAN])]
    assert len(one_type) > 3 and (np.ptp(one_type[:, PLACE][:, :2], axis=0) > 0.03).all()
    assert observations[:, :7].std(axis=0).max() < 0.03  # the arm starts at one place, give or take


def test_success_rule_at_its_edge(fast):
    """Nine tenths of the range, in the stock environment's words too."""
    stock = StockTurnFaucetSource()
    fast.reset(3)
    stock.reset(3)
    limit = float(fast._joint.limit[0][1])
    for part, expected in ((0.0, False), (0.8999, False), (0.9001, True), (1.0, True)):
        joints = np.zeros(fast._faucet.dof, np.float32)
        joints[fast._index] = part * limit
        fast._faucet.set_qpos(joints)
        stock._env.faucet._objs[0].set_qpos(joints)
        assert fast._success() == bool(stock._env.evaluate()["success"][0]) == expected
        assert fast._observe()[LEFT] == pytest.approx((0.9 - part) * limit, abs=1e-5)


def test_corners_of_boxes_and_meshes():
    """A mesh with a box's corners, at half its size and scaled by two, is that box."""
    import sapien

    pose = sapien.Pose([0.1, 0, 0], [0.5**0.5, 0, 0, 0.5**0.5])  # a quarter turn about z
    box = SimpleNamespace(half_size=np.array([0.3, 0.2, 0.1]), local_pose=pose)
    corners = {tuple(np.round(corner, 4)) for corner in _corners(box)}
    assert len(corners) == 8 and (0.3, 0.3, 0.1) in corners and (-0.1, -0.3, -0.1) in corners
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    mesh = SimpleNamespace(vertices=signs * [0.15, 0.1, 0.05], scale=np.array([2.0, 2.0, 2.0]), local_pose=pose)
    assert {tuple(np.round(corner, 4)) for corner in _corners(mesh)} == corners


def test_joints_turn_as_hard_as_in_maniskill_2(fast):
    """And the faucet stays where it is: its root is fixed."""
    fast.reset(0)
    assert all(joint.friction == pytest.approx(0.1) and joint.damping == pytest.approx(2.0) for joint in fast._faucet.active_joints)
    assert fast._faucet.links[0].joint.type == "fixed"
    shape = fast._link.collision_shapes[0]
    assert shape.density == pytest.approx(2000) and shape.physical_material.dynamic_friction == pytest.approx(1)


def test_the_other_handle_does_not_count(fast):
    fast.reset(seed_of(fast, 4))
    joints = np.full(2, fast._joint.limit[0][1], np.float32)
    joints[fast._index] = 0
    fast._faucet.set_qpos(joints)
    assert not fast._success()


@pytest.mark.parametrize("model", range(10))
def test_expert_goes_behind_the_bar_and_pushes_the_right_way_round(fast, model):
    expert = TurnFaucetExpert()
    expert.watch(fast)
    expert.reset(np.random.default_rng(0))
    expert.act(fast.reset(seed_of(fast, model)))
    contact, onwards = expert._contact()
    bar = fast.handle().corners[expert._bar]
    assert len(bar) in (2, 4) or np.ptp(bar, axis=0).max() < 0.06  # one end of one bar
    assert 0 < ((bar - contact) @ onwards).min() < 0.03
    joints = fast._faucet.qpos
    joints[fast._index] += 0.05
    fast._faucet.set_qpos(joints)
    moved = fast.handle().corners[expert._bar].mean(axis=0) - bar.mean(axis=0)
    assert moved @ onwards > 0.99 * np.linalg.norm(moved) > 0.001


def test_expert_succeeds():
    episodes = list(scripted_episodes("TurnFaucetSource", 12, first_seed=100))
    assert episodes[-1]["seed"] <= 112  # at most 1 of 13 failed
    assert 20 <= np.median([len(episode["actions"]) for episode in episodes]) <= 80


def test_expert_succeeds_with_noise_that_comes_from_the_seed():
    noisy, again = (list(scripted_episodes("TurnFaucetSource", 4, noise=0.1)) for _ in range(2))
    assert noisy[-1]["seed"] <= 4
    np.testing.assert_array_equal(noisy[3]["actions"], again[3]["actions"])
    clean = next(scripted_episodes("TurnFaucetSource", 1))
    difference = (noisy[0]["actions"][:5] - clean["actions"][:5])[:, :6]
    assert 0.03 < difference.std() < 0.3 and (np.abs(difference).max(axis=0) > 0.01).all()


def test_expert_turns_novel_faucets():
    assert [episode["seed"] for episode in scripted_episodes("TurnFaucet", 3)] == [0, 1, 2]
