"""Demonstrations of ManiSkill's hub: real trajectory files, recorded by ManiSkill's own wrapper, and what can be wrong with one."""
import contextlib
import dataclasses
import io
import json
import shutil
import urllib.error
import urllib.request
import zipfile

import h5py
import numpy as np
import pytest

from pdkit import cli
from pdkit.demos import hub, load_demos
from pdkit.demos.experts import EXPERTS
from pdkit.errors import PdkitError
from pdkit.tasks import get_task
from pdkit.tasks.maniskill import building
from pdkit.tasks.maniskill_headless import make_env, quiet

SEED = 3


def joint_targets(sim, action):
    """What `pd_joint_pos` is told for the targets that the fast step has just set: 7 joint positions and the gripper."""
    return np.array([*(np.ravel(joint.drive_target)[0] for joint in sim._panda._arm), action[-1]], np.float32)


def wrapped(folder, env_id, control):
    """A stock environment in ManiSkill's recorder, as the program that made the hub's files sets it up."""
    with quiet():
        from mani_skill.utils.wrappers.record import RecordEpisode
    return RecordEpisode(make_env(env_id, control, obs_mode="none"), str(folder), trajectory_name="trajectory", save_video=False,
                         record_reward=False, save_on_reset=False, source_type="motionplanning")


def record(folder, task, control):
    """A trajectory file of one episode of the scripted expert, recorded in a control mode; its .h5."""
    spec, expert = get_task(task), EXPERTS[task]()
    sim, env = spec.make(), wrapped(folder, spec.make.env_id, control)
    with building(False):
        env.reset(seed=SEED)
    observation, success = sim.reset(SEED), False
    expert.reset(np.random.default_rng(SEED))
    while not success:
        action = expert.act(observation)
        observation, success = sim.step(action)
        env.step(joint_targets(sim, action) if control == hub.JOINTS else action)
    env.flush_trajectory()
    env.close()
    sim.close()
    return folder / "trajectory.h5"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return record(tmp_path_factory.mktemp("hub"), "StackCube", hub.JOINTS)


@pytest.fixture
def copied(recorded, tmp_path, monkeypatch):
    """A copy of the recorded file to damage; what is fetched or unpacked goes beside it."""
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path / "runs"))
    for name in hub.FILES:
        shutil.copy(recorded.with_name(name), tmp_path)
    return tmp_path / recorded.name


def changed_card(path, change):
    card = json.loads(path.with_suffix(".json").read_text())
    change(card)
    path.with_suffix(".json").write_text(json.dumps(card))


def zipped(path, names=None):
    """The hub's archive of a trajectory file, or one with other names in it."""
    archive = path.with_name("hub.zip")
    with zipfile.ZipFile(archive, "w") as opened:
        for member in hub.FILES:
            opened.write(path.with_name(member), f"StackCube-v1/motionplanning/{member}")
        for name in names or ():
            opened.writestr(name, b"evil")
    return archive


def assert_repeats(demos):
    sim = get_task(demos.task).make()
    for seed, episode in zip(demos.seeds, demos.episodes(), strict=True):
        seen = [sim.reset(int(seed))]
        solved = []
        for action in episode["actions"]:
            observation, success = sim.step(action)
            seen.append(observation)
            solved.append(success)
        np.testing.assert_array_equal(seen, episode["observations"])
        assert solved == episode["success"].tolist() == [False] * (len(solved) - 1) + [True]
    sim.close()


def test_what_is_solved_here_from_the_same_start_is_kept_and_the_rest_is_counted(copied, tmp_path, capsys):
    """Three episodes: one that starts elsewhere than its seed does, one that is broken off, and one as it should be."""
    with h5py.File(copied, "a") as file:
        for name in ("traj_1", "traj_2"):
            file.copy("traj_0", name)
        broken_off = file["traj_1/actions"][:5]
        del file["traj_1/actions"]
        file["traj_1/actions"] = broken_off

    def three(card):
        first = card["episodes"][0]
        card["episodes"] = [first | {"episode_id": i, "reset_kwargs": {"seed": [SEED + (i == 0)]}} for i in range(3)]

    changed_card(copied, three)
    out = tmp_path / "d.safetensors"
    assert cli.main(["demos", "StackCube", "--source", "hub", "--num", "2", "--from", str(copied), "--out", str(out)]) == 0
    told = capsys.readouterr()
    assert "1/2 kept of 3 tried" in told.err and "1 demonstrations instead of 2" in told.err
    demos = load_demos(out)
    assert demos.label == "scripted" and demos.seeds.tolist() == [SEED] and str(copied) in demos.command
    assert "of 3 read 1 are kept, 1 start elsewhere than their seeds" in demos.how and "1 are not solved" in demos.how
    assert_repeats(demos)

    changed_card(copied, lambda card: card["episodes"].pop())
    with pytest.raises(PdkitError, match="None of the 2 episodes of StackCube.*1 start elsewhere.*1 are not solved"):
        hub.from_hub("StackCube", 2, copied)


def test_who_made_a_file_is_its_label_and_the_task_s_limit_holds(copied, monkeypatch):
    changed_card(copied, lambda card: card.update(source_type="rl"))
    assert hub.from_hub("StackCube", 1, copied).label == "agent"
    short = dataclasses.replace(get_task("StackCube"), max_episode_steps=5)
    monkeypatch.setattr(hub, "get_task", lambda name: short)
    with pytest.raises(PdkitError, match="None of the 1 episodes.*0 start elsewhere.*1 are not solved"):
        hub.from_hub("StackCube", 1, copied)


def test_a_start_two_millimetres_off_is_elsewhere(copied):
    with h5py.File(copied, "a") as file:
        file["traj_0/env_states/actors/cubeA"][0, 0] += 0.002
    with pytest.raises(PdkitError, match="None of the 1 episodes.*1 start elsewhere"):
        hub.from_hub("StackCube", 1, copied)


def test_actions_in_the_task_s_own_control_mode_are_executed_as_they_are(tmp_path):
    path = record(tmp_path, "PegInsertionSide", "pd_ee_delta_pose")
    demos = hub.from_hub("PegInsertionSide", 1, path)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(demos.actions, file["traj_0/actions"])
    assert demos.seeds.tolist() == [SEED]
    assert_repeats(demos)


@pytest.mark.slow
@pytest.mark.parametrize("task, seed", [("StackCube", 0), ("PegInsertionSide", 2)])
def test_what_maniskill_s_motion_planner_does_is_solved_after_the_conversion(tmp_path, task, seed):
    """The program that made the hub's files, on a seed that it solves."""
    pytest.importorskip("mplib")
    with quiet():
        from mani_skill.examples.motionplanning.panda import solutions
    env = wrapped(tmp_path, get_task(task).make.env_id, hub.JOINTS)
    with building(False):
        getattr(solutions, f"solve{task}")(env, seed=seed)
    env.flush_trajectory()
    env.close()
    assert_repeats(hub.from_hub(task, 1, tmp_path / "trajectory.h5"))


def test_a_file_of_the_user_s_is_never_deleted(tmp_path, monkeypatch):
    """Not even where it lies in the folder in which unpacked archives are kept."""
    monkeypatch.setenv("PDKIT_RUNS", str(tmp_path))
    mine = tmp_path / "hub" / "mine.h5"
    mine.parent.mkdir()
    mine.write_text("no trajectory")
    with pytest.raises(PdkitError):
        hub.from_hub("StackCube", 1, mine)
    assert mine.read_text() == "no trajectory"
    with pytest.raises(PdkitError, match="mine.txt is neither a .zip nor an .h5; --from takes"):
        hub.from_hub("StackCube", 1, mine.rename(mine.with_suffix(".txt")))


def test_the_archive_is_fetched_once(copied, tmp_path, monkeypatch):
    answers = [io.BytesIO(zipped(copied).read_bytes())]
    monkeypatch.setattr(urllib.request, "urlopen", lambda url, timeout: answers.pop())
    for _ in range(2):
        path = hub._trajectory_file(get_task("StackCube"), None)
        assert path.read_bytes() == copied.read_bytes()
    assert sorted(p.name for p in (tmp_path / "runs").rglob("*") if p.is_file()) == sorted(hub.FILES)
    given = hub._trajectory_file(get_task("StackCube"), tmp_path / "hub.zip")
    assert given != path and given.read_bytes() == path.read_bytes()  # one that is given does not take the place of the hub's own
    maker, (episode,) = hub.read_trajectories(path, "StackCube-v1")
    assert (maker, episode.seed, episode.control) == ("motionplanning", SEED, hub.JOINTS) and episode.actions.shape[1] == 8


def test_a_download_without_an_end_is_cut(copied, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(hub, "MOST", 2e6)
    monkeypatch.setattr(urllib.request, "urlopen", lambda url, timeout: contextlib.closing(open("/dev/zero", "rb")))
    assert cli.main(["demos", "StackCube", "--source", "hub"]) == 2
    assert "more than the hub has" in capsys.readouterr().err
    assert not [p for p in (tmp_path / "runs").rglob("*") if p.is_file()]


def test_no_network_is_said_with_what_to_do(copied, tmp_path, monkeypatch, capsys):
    def offline(url, timeout):
        raise urllib.error.URLError("no route to host")

    monkeypatch.setattr(urllib.request, "urlopen", offline)
    assert cli.main(["demos", "StackCube", "--source", "hub"]) == 2
    fetching, told = capsys.readouterr().err.splitlines()
    assert "StackCube-v1.zip" in fetching
    for part in ("no route to host", "need a network", "`pdkit demos StackCube`", "StackCube-v1.zip", "--from"):
        assert part in told
    assert not [p for p in (tmp_path / "runs").rglob("*") if p.is_file()]


def truncated(path):
    path.write_bytes(path.read_bytes()[:-3000])
    return path


def alien(path):
    with h5py.File(path, "w") as file:
        file["x"] = np.zeros(3)
    return path


def text(path):
    path.write_text("traj_0")
    return path


def without_card(path):
    path.with_suffix(".json").unlink()
    return path


def card_of_something_else(path):
    path.with_suffix(".json").write_text("[1, 2]")
    return path


def of_another_environment(path):
    changed_card(path, lambda card: card["env_info"].update(env_id="PickCube-v1"))
    return path


def in_another_control_mode(path):
    changed_card(path, lambda card: card["episodes"][0].update(control_mode="pd_joint_vel"))
    return path


def not_a_number(path):
    with h5py.File(path, "a") as file:
        file["traj_0/actions"][3, 2] = np.nan
    return path


def without_seed(path):
    changed_card(path, lambda card: card["episodes"][0].update(reset_kwargs={}, episode_seed=None))
    return path


def truncated_archive(path):
    return truncated(zipped(path))


def damaged_archive(path):
    archive = zipped(path)
    content = bytearray(archive.read_bytes())
    content[5000] ^= 1
    archive.write_bytes(content)
    return archive


def archive_of_something_else(path):
    archive = path.with_name("hub.zip")
    with zipfile.ZipFile(archive, "w") as opened:
        opened.writestr("PickCube-v1/motionplanning/trajectory.h5", b"")
    return archive


def archive_that_climbs(path):
    return zipped(path, ["StackCube-v1/../../../evil"])


def archive_with_a_root(path):
    return zipped(path, [str(path.with_name("evil"))])


def nowhere(path):
    return path.with_name("none.zip")


@pytest.mark.parametrize("damage, says", [
    (truncated, "truncated"), (alien, "another format"), (text, "another format"), (without_card, "does not exist"),
    (card_of_something_else, "another format"), (of_another_environment, "of PickCube-v1"), (in_another_control_mode, "pd_joint_vel"),
    (not_a_number, "another format"), (without_seed, "another format"), (truncated_archive, "truncated"),
    (damaged_archive, "truncated"), (archive_of_something_else, "no item named"), (archive_that_climbs, "not safe"),
    (archive_with_a_root, "not safe"), (nowhere, "does not exist"),
], ids=lambda value: getattr(value, "__name__", ""))
def test_what_cannot_be_used_is_one_sentence_and_nothing_is_written(copied, tmp_path, capsys, damage, says):
    path = damage(copied)
    before = sorted(p for p in tmp_path.rglob("*") if p.is_file())
    out = tmp_path / "runs" / "d.safetensors"
    assert cli.main(["demos", "StackCube", "--source", "hub", "--from", str(path), "--out", str(out)]) == 2
    told, = capsys.readouterr().err.splitlines()
    assert says in told and "Traceback" not in told
    assert sorted(p for p in tmp_path.rglob("*") if p.is_file()) == before


@pytest.mark.parametrize("words, says", [
    (["Door", "--source", "hub"], "no demonstrations of Door; it has those of: StackCube, PegInsertionSide"),
    (["StackCube", "--from", "x.zip"], "--source hub"),
])
def test_asking_for_what_the_hub_does_not_have(capsys, words, says):
    assert cli.main(["demos", *words]) == 2
    told, = capsys.readouterr().err.splitlines()
    assert says in told
