"""PushChair: what its numbers mean, repeatability, the stock environment, the success rule, its chairs, and the expert."""
from __future__ import annotations

import json
import platform
import re
from types import SimpleNamespace

import numpy as np
import pytest

from pdkit.demos import save_demos, sources
from pdkit.demos.chair_expert import PushChairExpert
from pdkit.demos.experts import scripted_episodes
from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.tasks import chair_assets, get_task, lanes
from pdkit.tasks.chair import PushChair, PushChairSource, StockPushChairSource, make_chair_env
from pdkit.tasks.chair_assets import Chair, chairs, generated_chair
from pdkit.tasks.chair_body import chair_start, solved
from pdkit.tasks.partnet import UrdfWriter, link_parts
from pdkit.train_base import base_demos
from pdkit.video import try_render

SAME_BITS = platform.machine() in ("x86_64", "AMD64")  # elsewhere a compiler may fuse operations
QPOS, QVEL, BASE, BASE_VEL = slice(0, 19), slice(19, 38), slice(38, 41), slice(41, 44)
PLACE, TURN, MOTION = slice(44, 47), slice(47, 51), slice(51, 57)
CHAIR_QPOS, CHAIR_QVEL, TIPS, FINGERS = slice(57, 82), slice(82, 107), slice(107, 119), slice(119, 131)


@pytest.fixture(scope="module")
def fast():
    sim = PushChairSource()
    yield sim
    sim.close()


@pytest.fixture(scope="module")
def stock():
    sim = StockPushChairSource()
    yield sim
    sim.close()


def play(sim, seed: int, actions) -> tuple[np.ndarray, np.ndarray]:
    """Observations (T + 1, 131) and success flags (T,) of an action sequence."""
    observations, flags = [sim.reset(seed)], []
    for action in actions:
        observation, success = sim.step(action)
        observations.append(observation)
        flags.append(success)
    return np.stack(observations), np.array(flags, bool)


def pushing(sim, seed: int, noise: float = 0.1, steps: int = 200) -> np.ndarray:
    """Actions (T, 20) of the expert until it is done, and some flailing of all joints."""
    expert, rng = PushChairExpert(noise), np.random.default_rng(seed)
    expert.reset(rng)
    actions, observation, success = [], sim.reset(seed), False
    while not success and len(actions) < steps:
        actions.append(expert.act(observation))
        observation, success = sim.step(actions[-1])
    return np.concatenate([actions, rng.uniform(-1.5, 1.5, (15, 20))]).astype(np.float32)


# ---- what the numbers mean ---------------------------------------------------------------------------------------------

@pytest.mark.parametrize("name", ["PushChair", "PushChairSource"])
def test_spec(name):
    task = get_task(name)
    assert (task.obs_dim, task.act_dim, task.max_episode_steps, task.joints, task.rate) == (131, 20, 200, 19, 20)
    observation = task.make().reset(0)
    assert observation.shape == (131,) and observation.dtype == np.float32


def test_every_number_of_a_first_observation(fast):
    for seed in range(4):
        observation, start = fast.reset(seed), chair_start(seed, 5)
        arm = [0, 0, 0, -1.5, 0, 3, 0.78, 0.02, 0.02]
        np.testing.assert_allclose(observation[QPOS], [0.9, *arm, *arm], atol=1e-6)
        np.testing.assert_allclose(observation[BASE], start.base[:3], atol=1e-6)
        np.testing.assert_allclose(observation[PLACE], [*start.place, 0.002], atol=1e-6)
        assert np.linalg.norm(observation[TURN]) == pytest.approx(1, abs=1e-6)
        for part in (QVEL, BASE_VEL, MOTION, CHAIR_QPOS, CHAIR_QVEL, FINGERS):
            assert not observation[part].any()
        right, left = observation[TIPS].reshape(2, 2, 3)
        for hand, side in ((right, -1), (left, 1)):
            assert np.linalg.norm(hand[0] - hand[1]) == pytest.approx(0.04, abs=1e-5)  # each finger is 2 cm from the middle
            aside = hand.mean(axis=0)[:2] - start.base[:2]
            assert side * (np.cos(start.base[2]) * aside[1] - np.sin(start.base[2]) * aside[0]) > 0.3  # on its side of the robot


def test_fingers_come_in_maniskill_2s_order(fast):
    observation = play(fast, 0, np.random.default_rng(0).uniform(-1, 1, (5, 20)))[0][-1]
    links = {name: link._objs[0] for name, link in fast._env.agent.robot.links_map.items()}
    for index, name in enumerate(("right_panda_right", "right_panda_left", "left_panda_right", "left_panda_left")):
        pose = links[f"{name}finger"].entity_pose
        tip = pose.p + 0.035 * pose.to_transformation_matrix()[:3, 2]  # 3.5 cm along the finger
        np.testing.assert_allclose(observation[TIPS].reshape(4, 3)[index], tip, atol=1e-5)
    for index, name in enumerate(("right_panda_left", "right_panda_right", "left_panda_left", "left_panda_right")):
        np.testing.assert_array_equal(observation[FINGERS].reshape(4, 3)[index], links[f"{name}finger"].linear_velocity)


@pytest.mark.parametrize(("index", "velocity"), [
    (2, BASE_VEL.start + 2), (3, QVEL.start), *((4 + i, QVEL.start + 10 + i) for i in range(7)),  # turning, height, left arm
    *((12 + i, QVEL.start + 1 + i) for i in range(7)), (11, QVEL.start + 17), (19, QVEL.start + 8),  # right arm; fingers
])
def test_each_action_moves_its_joint(fast, index, velocity):
    action = np.zeros(20)
    action[[11, 19]] = 0.2  # keeps the fingers where they are: 0.015 + 0.025 * 0.2 = 2 cm
    action[index] = -0.8
    velocities = play(fast, 0, [action] * 3)[0][-1, [*range(19, 38), 41, 42, 43]]
    expected = [*range(19, 38), 41, 42, 43].index(velocity)
    assert velocities[expected] < -0.02
    others = np.delete(velocities, [expected, expected + 1] if index in (11, 19) else [expected])  # fingers move in pairs
    assert np.abs(others).max() < 0.5 * abs(velocities[expected])  # the arms shake a little


def test_base_rolls_in_its_own_frame_and_actions_are_clipped(fast):
    heading = chair_start(0, 5).base[2]
    forwards = play(fast, 0, [np.eye(20)[0] * 7] * 4)[0]
    leftwards = play(fast, 0, [np.eye(20)[1]] * 4)[0]
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    np.testing.assert_allclose(forwards[-1, 41:43], 0.5 * ahead, atol=0.03)
    np.testing.assert_allclose(leftwards[-1, 41:43], 0.5 * left, atol=0.03)
    np.testing.assert_array_equal(forwards, play(fast, 0, [np.eye(20)[0]] * 4)[0])


def test_chairs_velocities_are_its_motion(fast):
    observations = play(fast, 1, pushing(fast, 1)[:-15])[0]
    moved = np.diff(observations[:, 44:46], axis=0) * 20
    fastest = np.argsort(np.linalg.norm(moved, axis=1))[-40:]
    mean = (observations[fastest, 51:53] + observations[fastest + 1, 51:53]) / 2
    assert np.corrcoef(moved[fastest].ravel(), mean.ravel())[0, 1] > 0.9
    count = len(fast._env.built[0].active_joints)
    assert observations[:, 82 : 82 + count].any(axis=0).all() and not observations[:, 82 + count : 107].any()


# ---- the stock environment, and repeatability --------------------------------------------------------------------------

@pytest.mark.parametrize("seed", [0, 3, 4])
def test_fast_step_is_the_stock_environments(fast, stock, seed):
    actions = pushing(fast, seed)
    ours, flags = play(fast, seed, actions)
    theirs, verdicts = play(stock, seed, actions)
    np.testing.assert_allclose(ours[:8], theirs[:8], rtol=0, atol=1e-5)
    assert np.abs(np.diff(ours[:, 44:46], axis=0)).max() > 0.01 and any(verdicts)  # the chair was pushed, and home
    if SAME_BITS:
        np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(flags, verdicts)


def test_same_seed_and_actions_repeat_whatever_came_before(fast):
    episodes = {seed: pushing(fast, seed, steps=40 + 20 * (seed % 4)) for seed in range(8)}
    alone = {seed: play(PushChairSource(), seed, actions)[0] for seed, actions in episodes.items()}
    rng = np.random.default_rng(0)
    for seed in rng.integers(8, size=14):
        stop = rng.integers(1, len(episodes[seed]) + 1)
        np.testing.assert_array_equal(play(fast, seed, episodes[seed][:stop])[0], alone[seed][: stop + 1], err_msg=f"seed {seed}")


def test_a_later_evaluation_builds_no_scene_and_gives_the_same(monkeypatch):
    """In what the first left behind, with other pushes in between."""
    spec, built, moved = get_task("PushChairSource"), [], []
    monkeypatch.setattr("pdkit.tasks.chair.make_chair_env", lambda *words: built.append(words) or make_chair_env(*words))
    actions = pushing(PushChairSource(), 1, steps=60)

    def pushed(order):
        step = iter(actions[order])

        def act(windows):
            moved.append(windows[:, -1, 44:46])  # where the chair stands
            return np.repeat(next(step)[None, None], len(windows), axis=0)

        return evaluate(spec, act, [1, 2], num_envs=2, max_episode_steps=len(actions))

    lanes.close_spares()
    built.clear()
    first = pushed(slice(None))
    pushed(slice(None, None, -1))
    scenes = len(built)  # whichever lane meets whichever chair: both have both at most
    again = pushed(slice(None))
    assert len(built) == scenes <= 4 and first.equals(again)
    assert np.abs(moved[len(actions) - 1][0] - moved[0][0]).max() > 0.05  # the expert did reach its own chair
    lanes.close_spares()


def test_simulations_in_one_process_do_not_disturb_each_other():
    kinds = (PushChairSource, PushChairSource, PushChair)
    sims, actions = [kind() for kind in kinds], np.random.default_rng(0).uniform(-1, 1, (25, 20))
    together = [[sim.reset(seed)] for seed, sim in enumerate(sims)]
    for action in actions:
        for sim, history in zip(sims, together, strict=True):
            history.append(sim.step(action)[0])
    for seed, (kind, history) in enumerate(zip(kinds, together, strict=True)):
        np.testing.assert_array_equal(np.stack(history), play(kind(), seed, actions)[0])


def test_other_tasks_do_not_disturb(fast):
    actions = pushing(fast, 1, steps=30)
    alone = play(fast, 1, actions)[0]
    cube = get_task("StackCube").make()  # sets PhysX's global configuration to its own
    cube.reset(0)
    history = [fast.reset(1)]
    for action in actions:
        cube.step(action[:4])
        history.append(fast.step(action)[0])
    np.testing.assert_array_equal(np.stack(history), alone)


# ---- success -----------------------------------------------------------------------------------------------------------

def turned(axis: str, degrees: float) -> np.ndarray:
    half = np.radians(degrees) / 2
    return np.array([np.cos(half), *(np.sin(half) * (np.array(list("xyz")) == axis))])


@pytest.mark.parametrize(("place", "turn", "moved", "spun", "verdict"), [
    ((0.149, 0), ("z", 0), 0, 0, True), ((0, -0.151), ("z", 0), 0, 0, False), ((0.11, 0.11), ("z", 0), 0, 0, False),
    ((0, 0), ("x", 8.9), 0, 0, True), ((0, 0), ("x", 9.1), 0, 0, False), ((0, 0), ("y", -9.1), 0, 0, False),
    ((0, 0), ("z", 150), 0, 0, True),
    ((0, 0), ("z", 30), 0.0049, 0, True), ((0, 0), ("z", 30), 0.0051, 0, False),  # 0.1 m/s in a twentieth of a second
    ((0, 0), ("z", 30), 0, 1.79, True), ((0, 0), ("z", 30), 0, 1.81, False), ((0, 0), ("z", 30), 0, -1.81, False),  # 36 degrees a second
])
def test_success_rule_at_its_edges(place, turn, moved, spun, verdict):
    now = np.array([*place, 0.3]), turned(*turn)
    before = now[0] - [0, 0, moved], turned(turn[0], turn[1] - spun)
    assert solved(before, now) is verdict
    assert solved((before[0], -before[1]), now) is verdict  # the same turn, written the other way


def test_success_rule_is_the_stock_environments(stock):
    import sapien

    stock.reset(seed=0)
    env = stock._env
    body, rng, verdicts = env.chair._objs[0], np.random.default_rng(0), []
    for _ in range(150):
        poses = []
        place, tilt = rng.uniform(-0.12, 0.12, 2), rng.normal(0, 4)
        for step in range(2):
            shift = step * rng.uniform(-0.005, 0.005, 2)
            turn = sapien.Pose(q=turned("z", 40 + step * rng.uniform(-2.5, 2.5))) * sapien.Pose(q=turned("x", tilt))
            body.set_root_pose(sapien.Pose([*(place + shift), 0.01], turn.q))
            poses.append((body.root_pose.p, body.root_pose.q))
            info = env.evaluate()
        verdicts.append(solved(*poses))
        assert verdicts[-1] == bool(info["success"])
    assert 0.2 < np.mean(verdicts) < 0.8


# ---- chairs and starts -------------------------------------------------------------------------------------------------

def test_source_and_novel_chairs_are_disjoint_and_all_differ():
    source, novel = chairs("source"), chairs("novel")
    assert (len(source), len(novel)) == (5, 3)
    assert len({chair.model.urdf.split(">", 1)[1] for chair in source + novel}) == 8  # beside the name
    assert not set(chair_assets.PARTNET["source"]) & set(chair_assets.PARTNET["novel"])
    assert generated_chair(3) == generated_chair(3)
    with pytest.raises(PdkitError, match="Did you mean 'novel'"):
        chairs("novell")


@pytest.mark.parametrize("kind", [PushChairSource, PushChair])
def test_every_chair_stands_by_itself_on_its_wheels(kind):
    sim, count, seen, seed = kind(), len(chairs(kind.kind)), set(), 0
    while len(seen) < count:
        chair, seed = chair_start(seed, count).chair, seed + 1
        if chair in seen:
            continue
        seen.add(chair)
        observations, _ = play(sim, seed - 1, np.zeros((20, 20)))
        assert np.abs(observations[-1, PLACE] - observations[0, PLACE]).max() < 0.01
        assert np.abs(observations[-1, 48:50]).max() < 0.02 and np.abs(observations[-1, MOTION]).max() < 0.01


def test_wheels_grip_and_seats_do_not_touch_their_feet(fast):
    fast.reset(0)
    links = {name: link._objs[0] for name, link in fast._env.built[0].links_map.items()}
    for name, link in links.items():
        for shape in link.collision_shapes:
            assert shape.physical_material.dynamic_friction == pytest.approx(1.0 if name.startswith("wheel") else 0.1)
            assert bool(shape.collision_groups[2] & 1 << 31) == (name in ("seat", "support"))
            assert shape.density == pytest.approx(200)  # kilograms a cubic metre: ManiSkill 2's


def test_starts_are_maniskill_2s():
    starts = [chair_start(seed, 5) for seed in range(400)]
    far = [np.linalg.norm(start.place) for start in starts]
    assert 0.8 <= min(far) < 0.81 and 1.19 < max(far) <= 1.2
    off = [wrapped(start.facing - np.arctan2(*-start.place[::-1])) for start in starts]  # how far it looks past the target
    assert np.radians(70) < np.abs(off).max() <= np.radians(72)
    away = np.array([start.base[:2] - start.place for start in starts])
    apart = np.linalg.norm(away, axis=1)
    assert 0.8 <= apart.min() < 0.81 and 1.19 < apart.max() <= 1.2
    behind = [wrapped(np.arctan2(*gap[::-1]) - start.facing - np.pi) for gap, start in zip(away, starts, strict=True)]
    assert np.radians(35) < np.abs(behind).max() <= np.radians(36)
    askew = [wrapped(start.base[2] - np.arctan2(*-gap[::-1])) for gap, start in zip(away, starts, strict=True)]
    assert np.radians(8.7) < np.abs(askew).max() <= np.radians(9)
    assert {start.base[3] for start in starts} == {0.9} and np.bincount([start.chair for start in starts]).min() > 50


def wrapped(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def test_the_seat_faces_where_the_start_says(fast):
    for seed in range(5):
        fast.reset(seed)
        seat = fast._env.built[0].links_map["seat"]._objs[0].entity_pose.to_transformation_matrix()
        facing = chair_start(seed, 5).facing
        np.testing.assert_allclose(-seat[:2, 1], [np.cos(facing), np.sin(facing)], atol=1e-5)


def joints(sim, seed: int) -> np.ndarray:
    """Friction and damping (N, 2) of the chair's joints, the swivel's last."""
    sim.reset(seed)
    return np.array([(joint.friction, joint.damping) for joint in sim._env.chair._objs[0].active_joints])


def test_frictions_are_drawn_for_every_episode_and_repeat(fast):
    seeds = [seed for seed in range(40) if chair_start(seed, 5).chair == chair_start(0, 5).chair]
    values = np.array([joints(fast, seed) for seed in seeds])
    assert len(np.unique(values.reshape(len(seeds), -1), axis=0)) == len(seeds) and len(np.unique(values)) > values.size // 2
    low, high = values.min(axis=0), values.max(axis=0)
    assert (low[:-1] >= 0).all() and (high[:-1] <= [0.1, 0.5]).all() and high[:-1].max(axis=0)[1] > 0.4
    assert (low[-1] >= [0.05, 5]).all() and (high[-1] <= [0.15, 15]).all()
    np.testing.assert_array_equal(joints(fast, seeds[0]), values[0])


def test_plans_show_chair_robot_and_target(fast):
    with pytest.raises(PdkitError, match="render=True"):
        fast.render()
    sim = PushChairSource(render=True)
    observation = sim.reset(0)
    picture = sim.render()
    assert picture.shape == (256, 256, 3) and picture.dtype == np.uint8
    assert try_render(get_task("PushChair")) is None  # wherever there is matplotlib

    def colour(place, along=0.0, angle=0.0):
        """The colour of the plan's pixel at a place on the floor, or so many metres from it."""
        x, y = place + along * np.array([np.cos(angle), np.sin(angle)])
        return picture[round(128 - y * 256 / 4.8), round(128 + x * 256 / 4.8)].astype(int)

    red, blue, grey = colour((0, 0)), colour(observation[44:46]), colour(observation[38:40])
    assert red[0] > red[2] + 50 and blue[2] > blue[0] + 50 and np.ptp(grey) < 10 and grey[0] < 130
    facing = chair_start(0, 5).facing
    assert colour(observation[44:46], -0.18, facing).sum() < colour(observation[44:46], 0.12, facing).sum()  # the dark back is behind
    before = picture
    sim.step(np.eye(20)[0])
    assert np.abs(sim.render().astype(int) - before).max() > 50


# ---- the user's own PartNet-Mobility -----------------------------------------------------------------------------------

@pytest.fixture
def partnet(tmp_path, monkeypatch):
    """A folder as PartNet-Mobility's, with generated chairs under the paper's names, turned and moved at rest."""
    rest = {}
    for index, name in enumerate(str(one) for kind in ("source", "novel") for one in chair_assets.PARTNET[kind]):
        model = generated_chair(20 + index)
        (tmp_path / name).mkdir()
        (tmp_path / name / "mobility.urdf").write_text(model.urdf)
        count = model.urdf.count('type="continuous"')
        rest[name] = dict(position=[0.3, 0.1, 0.004], rotation=turned("z", 35).tolist(), initial_qpos=[0.1] * count)
    monkeypatch.setenv("PDKIT_PARTNET", str(tmp_path))
    monkeypatch.setattr(chair_assets, "_recorded_rest", lambda: rest)
    return tmp_path, rest


def test_partnet_chairs_take_the_place_of_generated_ones(partnet):
    folder, _ = partnet
    assert [chair.model.name for chair in chairs("source")] == ["3022", "3027", "3030", "3070", "3076"]
    assert [chair.model.path for chair in chairs("novel")] == [folder / name / "mobility.urdf" for name in ("3003", "3013", "3020")]
    (folder / "3013" / "mobility_cvx.urdf").write_text((folder / "3013" / "mobility.urdf").read_text())
    assert chairs("novel")[1].model.path.name == "mobility_cvx.urdf"  # ManiSkill 2's corrected file is preferred
    sim = PushChair()
    for seed in range(3):
        observation, start = sim.reset(seed), chair_start(seed, 3)
        np.testing.assert_allclose(observation[PLACE], [*start.place, 0.004], atol=1e-6)
        assert observation[57] == np.float32(0.1)
        seat = sim._env.built[0].links_map["seat"]._objs[0].entity_pose.to_transformation_matrix()
        faces = np.arctan2(seat[1, 0], seat[0, 0]) - np.pi / 2
        assert wrapped(faces - start.facing) == pytest.approx(0, abs=1e-5)


CUBE = "\n".join([*(f"v {x} {y} {z}" for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)), "f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2",
                  "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4", ""])


def test_partnet_meshes_take_part(partnet):
    """A box of the seat written as PartNet writes shapes, as a mesh beside the description, weighs and collides as the box does."""
    folder, _ = partnet
    path = folder / "3003" / "mobility.urdf"
    boxes = path.read_text()
    size = re.search(r'"seat-\d+"><origin[^>]*/><geometry><box size="([^"]*)"', boxes)[1]
    half = " ".join(str(float(edge) / 2) for edge in size.split())
    (path.parent / "textured_objs").mkdir()
    (path.parent / "textured_objs" / "original-1.obj").write_text(CUBE)
    path.write_text(boxes.replace(f'<box size="{size}" />', f'<mesh filename="textured_objs/original-1.obj" scale="{half}" />'))
    mesh = chairs("novel")[0]
    assert "original-1.obj" in mesh.model.urdf and "original-1.obj" not in boxes
    seats = []
    for chair in (mesh, Chair(generated_chair(25))):
        env = make_chair_env([chair])
        seats.append(env.built[0].links_map["seat"]._objs[0])
        assert len(seats[-1].collision_shapes) == boxes.count('<collision name="seat-')
    assert seats[0].mass == pytest.approx(seats[1].mass, rel=1e-3) and seats[0].mass > 1
    np.testing.assert_allclose(seats[0].compute_global_aabb_tight()[1][2], seats[1].compute_global_aabb_tight()[1][2] + 0.002, atol=1e-3)


def test_incomplete_partnet_folders_are_told(partnet, monkeypatch):
    folder, _ = partnet
    path = folder / "3013" / "mobility.urdf"
    text = path.read_text()
    mesh = '<visual><geometry><mesh filename="textured_objs/one.obj"/></geometry></visual>'
    path.write_text(f'<robot name="x"><link name="a">{mesh}</link></robot>')
    with pytest.raises(PdkitError, match="uses textured_objs/one.obj"):
        chairs("novel")
    path.write_text(text[:500])
    with pytest.raises(PdkitError, match="not a readable URDF"):
        chairs("novel")
    path.unlink()
    with pytest.raises(PdkitError, match="lacks 3013/mobility.urdf"):
        chairs("novel")
    chairs("source")  # complete
    monkeypatch.setenv("PDKIT_PARTNET", str(folder / "nowhere"))
    with pytest.raises(PdkitError, match="not a folder"):
        chairs("source")


def test_foreign_descriptions_are_told(partnet):
    good = chairs("novel")[0]
    with pytest.raises(PdkitError, match="joints where 3 are expected"):
        make_chair_env([Chair(good.model, joints=(0.0,) * 3)])
    seatless = type(good.model)("x", good.model.urdf.replace('name="seat-', 'name="plank-'))
    with pytest.raises(PdkitError, match="no part called seat"):
        make_chair_env([Chair(seatless)])
    with pytest.raises(PdkitError, match="how chair 3003 stands"):
        chair_assets.with_rest([good.model], {})


def test_rest_of_the_papers_chairs_is_known():
    from mani_skill import PACKAGE_ASSET_DIR

    table = json.loads((PACKAGE_ASSET_DIR / "partnet_mobility/meta/info_chair_train.json").read_text())
    assert chair_assets._recorded_rest() == table
    for name in (*chair_assets.PARTNET["source"], *chair_assets.PARTNET["novel"]):
        entry = table[str(name)]
        assert len(entry["position"]) == 3 and len(entry["rotation"]) == 4 and 5 < len(entry["initial_qpos"]) <= 25


def test_parts_are_read_from_a_description():
    urdf = UrdfWriter("thing")
    urdf.link("a")
    urdf.box("seat", (1, 1, 1), (0, 0, 0))
    urdf.sphere("wheel", 0.1)
    urdf.link("b")
    urdf.joint("j", "revolute", "a", "b", limits=(0, 1))
    assert link_parts(urdf.text()) == {"a": "seat-1 wheel-2", "b": ""}
    assert 'lower="0.00000" upper="1.00000"' in urdf.text()


# ---- the expert --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("name", "noise"), [("PushChairSource", 0.0), ("PushChair", 0.1)])
def test_expert_pushes_chairs_home(name, noise):
    episodes = list(scripted_episodes(name, 4, first_seed=100, noise=noise))
    assert episodes[-1]["seed"] <= 104  # at most one of five failed
    for episode in episodes:
        assert 60 < len(episode["actions"]) < 200 and np.abs(episode["actions"]).max() <= 1
        assert np.linalg.norm(episode["observations"][-1][44:46]) < 0.15 < np.linalg.norm(episode["observations"][-20][44:46])
        assert episode["actions"][:, :3].std(axis=0).min() > 0.01 and not episode["actions"][:, 3:].any()


def test_novel_chairs_are_learned_from_demonstrations_of_the_source_ones(tmp_path):
    def arguments(task):
        return SimpleNamespace(task=task, demos=str(tmp_path / "demos.safetensors"), num_demos=None)

    save_demos(sources.scripted("PushChairSource", 2), arguments("").demos)
    assert base_demos(arguments("PushChair")).num == base_demos(arguments("PushChairSource")).num == 2
    with pytest.raises(PdkitError, match="demonstrations of PushChairSource, not of StackCube"):
        base_demos(arguments("StackCube"))
