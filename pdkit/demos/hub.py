"""ManiSkill's hub: motion-planned demonstrations of its environments, made into demonstrations of this kit.

A file of the hub holds actions and states, but no observations: trajectory.h5, and trajectory.json with the seed of every episode.
Its actions are targets of the joints. ManiSkill's own conversion turns them, step by step, into actions of the task's control mode,
which the fast step executes from the same seed: observations and success are what it gives, and an episode that it does not solve is
not a demonstration. Nor is one that starts elsewhere than its seed does here, as those that another version of ManiSkill recorded may.
"""
from __future__ import annotations

import http.client
import shlex
import shutil
import sys
import urllib.error
import urllib.request
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..errors import PdkitError
from ..files import atomic_folder, read_json, runs_root, sha256
from ..tasks import get_task
from ..tasks.maniskill import building
from ..tasks.maniskill_headless import close_env, make_env, quiet
from ..tasks.spec import Sim, TaskSpec
from .format import Demos, from_episodes

HUB = ("StackCube", "PegInsertionSide")
FILES = ("trajectory.h5", "trajectory.json")  # in the hub's archive, under ENVIRONMENT/motionplanning/
TIMEOUT = 30  # seconds without a byte after which the hub counts as out of reach
JOINTS, JOINT_TARGETS = "pd_joint_pos", 8  # ManiSkill's name of the control mode that is converted: 7 joints of the arm and the gripper
MOST = 20e9  # bytes that an archive may have, or unpack to
SAME = 1e-4  # how far apart the numbers of two states may lie, metres and radians; other random numbers put bodies centimetres away
LABELS = {"motionplanning": "scripted", "rl": "agent", "human": "human", "teleoperation": "human"}  # by ManiSkill's `source_type`


@dataclass(frozen=True)
class Recorded:
    """An episode as ManiSkill recorded it."""

    seed: int
    control: str  # ManiSkill's name of the control mode
    actions: np.ndarray  # (T, A) in that mode
    start: dict[str, dict[str, np.ndarray]]  # the first state: numbers by kind ("actors", "articulations") and name of a body


def from_hub(task: str, num: int, file: str | Path | None = None, progress: Callable[[int, int], None] | None = None) -> Demos:
    """The first `num` demonstrations of ManiSkill's hub that are solved in the fast step, or as many as there are.

    `file` is what was downloaded already: the hub's .zip, or a trajectory file of ManiSkill's (.h5) with its .json beside it.
    Otherwise the archive is fetched once and kept in runs/hub. `progress(kept, tried)` is called after every episode.

    Raises PdkitError for a task that the hub does not have, without a network, for a damaged or foreign file, and when no episode
    can be kept.
    """
    if task not in HUB:
        raise PdkitError(f"ManiSkill's hub has no demonstrations of {task}; it has those of: {', '.join(HUB)}.")
    spec = get_task(task)
    path = _trajectory_file(spec, Path(file) if file else None)
    try:
        maker, episodes = read_trajectories(path, spec.make.env_id)
    except PdkitError:
        if path != Path(file or ""):  # what was unpacked here, never a user's own file
            shutil.rmtree(path.parent)  # so that the next call unpacks, or fetches, it anew
        raise
    kept, elsewhere, tried = [], 0, 0
    for executed in _executed(spec, path, episodes):
        tried += 1
        if executed is None:
            elsewhere += 1
        elif executed["success"].any():
            kept.append(executed)
        if progress:
            progress(len(kept), tried)
        if len(kept) == num:
            break
    failed = (f"{elsewhere} start elsewhere than their seeds do in this version of ManiSkill and {tried - elsewhere - len(kept)} are not "
              "solved in the fast step")
    if not kept:
        raise PdkitError(f"None of the {tried} episodes of {task} in {path} can be kept: {failed}; use the scripted expert's, "
                         f"`pdkit demos {task}`.")
    command = f"pdkit demos {task} --source hub --num {num}" + (f" --from {shlex.quote(str(file))}" if file else "")
    how = (f"{maker} episodes in the form of ManiSkill's hub, {episodes[0].control} as {spec.make.control}, executed in the fast step, "
           f"each ending at its success; of {tried} read {len(kept)} are kept, {failed}")
    return from_episodes(task, kept, label=LABELS.get(maker, "scripted"), how=how, command=command)


def _trajectory_file(spec: TaskSpec, given: Path | None) -> Path:
    """The .h5 file to read: the one given, or that of the hub's archive, which is unpacked into runs/hub unless it is there already."""
    takes = "--from takes the hub's .zip, or a trajectory.h5 with its trajectory.json beside it."
    if given and not given.is_file():
        raise PdkitError(f"{given} does not exist; {takes}")
    if given and given.suffix not in (".zip", ".h5"):
        raise PdkitError(f"{given} is neither a .zip nor an .h5; {takes}")
    if given and given.suffix == ".h5":
        return given
    # An archive that was given is kept apart from the hub's own: what it holds is anybody's.
    folder = runs_root() / "hub" / (f"{spec.make.env_id}-{sha256(given)[:12]}" if given else spec.make.env_id)
    if not all((folder / name).is_file() for name in FILES):
        with atomic_folder(folder) as fresh:
            archive = given or _fetched(spec, fresh / f"{spec.make.env_id}.zip")
            _unpack(archive, spec.make.env_id, fresh)
            if not given:
                archive.unlink()
    return folder / FILES[0]


def _fetched(spec: TaskSpec, path: Path) -> Path:
    """`path`, into which the hub's archive was downloaded. Raises PdkitError where it cannot be."""
    with quiet():
        from mani_skill.utils.download_demo import DATASET_SOURCES
    url = DATASET_SOURCES[spec.make.env_id].raw_dataset_url
    print(f"fetching {url}", file=sys.stderr, flush=True)
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT) as answer, open(path, "wb") as file:
            while block := answer.read(1 << 20):
                file.write(block)
                if file.tell() > MOST:
                    raise PdkitError(f"{url} gives more than {MOST / 1e9:.0f} GB, more than the hub has, so it is not the archive "
                                     f"that was meant: use the scripted expert's, `pdkit demos {spec.name}`, or name a file that you "
                                     "have with --from.")
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
        raise PdkitError(f"ManiSkill's demonstrations of {spec.name} could not be fetched ({getattr(error, 'reason', error)}); they need a "
                         f"network the first time: use the scripted expert's, `pdkit demos {spec.name}`, or download {url} where there is "
                         f"one and name the file with --from.") from error
    return path


def _unpack(archive: Path, env_id: str, folder: Path) -> None:
    """Put the two trajectory files of the hub's archive into `folder`, and nothing else of it. Raises PdkitError where it is not one."""
    try:
        with zipfile.ZipFile(archive) as opened:
            for name in map(PurePosixPath, opened.namelist()):
                if name.is_absolute() or ".." in name.parts:
                    raise PdkitError(f"{archive.name} is not safe to use: it wants to write outside its own folder ({str(name)!r}).")
            members = [opened.getinfo(f"{env_id}/motionplanning/{name}") for name in FILES]
            if (size := sum(member.file_size for member in members)) > MOST:
                raise PdkitError(f"{archive.name} would unpack to {size / 1e9:.0f} GB, more than the hub has; check where it is from.")
            for name, info in zip(FILES, members, strict=True):
                with opened.open(info) as member, open(folder / name, "wb") as file:
                    shutil.copyfileobj(member, file)
    except KeyError as error:
        raise PdkitError(f"{archive.name} is not the hub's archive of {env_id}: {error.args[0]}.") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:  # RuntimeError: encrypted, or an unknown compression
        raise PdkitError(f"{archive.name} is not a readable .zip (truncated or another format); download it again.") from error


def read_trajectories(path: Path, env_id: str) -> tuple[str, list[Recorded]]:
    """What made the episodes of a ManiSkill trajectory file (its `source_type`), and the episodes, as the .json beside it lists them.

    Raises PdkitError where one of the two files is missing, damaged, of something else, or of another environment.
    """
    import h5py

    with quiet():
        from mani_skill.trajectory.utils import index_dict

    def recorded(group: Any, entry: dict) -> Recorded:
        seed = int(np.ravel(entry["reset_kwargs"].get("seed", entry.get("episode_seed"))).item())  # also written as a list of one
        actions = np.asarray(group["actions"], np.float32)
        if actions.ndim != 2 or not np.isfinite(actions).all() or not 0 <= seed < 2**32:
            raise ValueError("no episode")
        return Recorded(seed, entry["control_mode"], actions, index_dict(group["env_states"], 0))

    card = read_json(path.with_suffix(".json"))
    try:
        of, entries = card["env_info"]["env_id"], card["episodes"]
        with h5py.File(path) as file:
            episodes = [recorded(file[f"traj_{entry['episode_id']}"], entry) for entry in entries] if of == env_id else []
    except (OSError, LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise PdkitError(f"{path} and its .json are not a readable trajectory file of ManiSkill (truncated or another format); download "
                         "it again.") from error
    if not episodes:
        raise PdkitError(f"{path} holds no episode of {env_id}: it is of {of}, with {len(entries)} episodes.")
    return str(card.get("source_type", "motionplanning")), episodes


def _executed(spec: TaskSpec, path: Path, episodes: list[Recorded]) -> Iterator[dict[str, Any] | None]:
    """Each episode as the fast step executes it, cut at its first success or at the task's limit: observations (T + 1, obs_dim), actions
    (T, act_dim), success (T,) and seed; None where it does not start as its seed does here."""
    with quiet():
        from mani_skill.trajectory.utils.actions.conversion import from_pd_joint_pos_to_ee
    widths = {JOINTS: JOINT_TARGETS, spec.make.control: spec.act_dim}
    for episode in episodes:
        if episode.actions.shape[1] != widths.get(episode.control):
            known = " and ".join(f"{control} ({width})" for control, width in widths.items())
            raise PdkitError(f"{path} holds actions of {episode.control} ({episode.actions.shape[1]} numbers); what can be used for "
                             f"{spec.name} is {known}.")
    original, sim = make_env(spec.make.env_id, JOINTS), spec.make()
    try:
        for episode in episodes:
            with building(False):
                original.reset(seed=episode.seed)
            if not _same(original.get_state_dict(), episode.start):
                yield None
                continue
            followed = _Followed(sim, episode.seed)
            if episode.control == JOINTS:
                from_pd_joint_pos_to_ee(spec.make.control, episode.actions, original, followed)
            else:
                for action in episode.actions:
                    followed.step(action)
            yield followed.episode(spec.max_episode_steps)
    finally:
        close_env(original)
        sim.close()


def _same(here: dict, recorded: dict) -> bool:
    """Whether everything in the scene `here` is recorded at the same place."""
    for kind, bodies in here.items():
        for name, state in bodies.items():
            there = recorded.get(kind, {}).get(name)
            if np.shape(there) != state.shape[1:] or not np.allclose(state[0].cpu().numpy(), there, rtol=0, atol=SAME):
                return False
    return True


class _Followed:
    """The fast step in the form in which ManiSkill's conversion steps an environment; keeps what was done and what came of it."""

    def __init__(self, sim: Sim, seed: int):
        import torch

        self._sim, self._seed = sim, seed
        self.unwrapped, self.agent, self.device = self, sim._env.agent, torch.device("cpu")
        self._observations, self._actions, self._success = [sim.reset(seed)], [], []

    def step(self, action: Any) -> tuple[None, float, bool, bool, dict]:
        self._actions.append(np.clip(np.asarray(action, np.float32).ravel(), -1, 1))
        observation, success = self._sim.step(self._actions[-1])
        self._observations.append(observation)
        self._success.append(success)
        return None, 0.0, False, False, {}

    def episode(self, limit: int) -> dict[str, Any]:
        """The steps to the first success, at most `limit`."""
        success = np.array(self._success[:limit], bool)
        length = int(np.argmax(success)) + 1 if success.any() else len(success)
        return {"observations": np.stack(self._observations[: length + 1]), "actions": np.stack(self._actions[:length]),
                "success": success[:length], "seed": self._seed}
