"""Lanes that share one simulation: `physx_cuda`, where ManiSkill steps all lanes of a task together on an NVIDIA GPU.

Here it is stock ManiSkill that steps, not the fast step of maniskill.py. What differs for a user:

- A Panda's arm is controlled otherwise. On a CPU inverse kinematics is solved until the gripper's target is reached; on a GPU ManiSkill
  takes one step along the Jacobian, which falls the shorter the further an action goes.
- Physics on a GPU does not repeat bit for bit, so neither does a training run, and a restored checkpoint puts lanes only nearly
  where they were.
- Only training is simulated so. Every evaluation is made by the fast step on the CPU, in the world in which all policies of this
  kit are compared. With a GPU's arm control StackCube's, TurnFaucet's and PushChair's shipped decorated policies solve about as much
  on a CPU, the last two over an emulated GPU (slow tests); on a real one that is not known.
- An episode starts where the fast step starts it for the same seed, but bodies cannot be built while the GPU simulates: a lane keeps
  the peg and the box, the faucet and the handle that is to be turned, or the chair and its joints' friction, of its first episode, and
  only where they are changes.
- PhysX for CUDA changes how its process simulates on the CPU as well, so the lanes have a process of their own (see VectorEnv).
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from zipfile import BadZipFile

import numpy as np

from ..errors import PdkitError
from .chair import PushChair, PushChairSource, standing
from .chair_body import chair_start
from .faucet import TurnFaucet, TurnFaucetSource
from .lanes import IDLE, EpisodeCount
from .maniskill import FastSim, building, with_base_pose
from .maniskill_headless import quiet
from .mobile_panda import first_joints
from .peg import PegInsertionSide, peg_start
from .spec import TaskSpec
from .stack_cube import StackCube, stack_cube_start


class Start(NamedTuple):
    """Where an episode starts; poses (7,) by ManiSkill's names of what is there."""

    joints: np.ndarray  # of the robot, in PhysX's order
    bodies: dict[str, np.ndarray] = {}
    articulated: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # of the root link, and joint positions


class BatchSim(Protocol):
    """N simulated worlds that take every step together; without time limit, reward or autoreset, as `Sim`."""

    def reset(self, lanes: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Start the episodes that `seeds` (k,) name in `lanes` (k,), which ascend; observations (k, obs_dim)."""

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One primitive step of all lanes with actions (N, act_dim); (observations (N, obs_dim), success at this step (N,))."""

    def close(self) -> None: ...


def _stack_cube(env: Any, lane: int, seed: int, built: int) -> Start:
    joints, red, green = stack_cube_start(seed)
    return Start(joints, {"cubeA": red, "cubeB": green})


def _peg(env: Any, lane: int, seed: int, built: int) -> Start:
    start, bodies = peg_start(seed), peg_start(built)
    peg, box = start.peg.copy(), start.box.copy()
    peg[2], box[2] = bodies.radius, bodies.half_length  # both lie on the table
    return Start(start.joints, {"peg": peg, "box_with_hole": box})


def _faucet(env: Any, lane: int, seed: int, built: int) -> Start:
    from .faucet_env import faucet_start

    start = faucet_start(seed, env.models)
    pose = start.pose(env.models[env.starts[lane].model])
    return Start(start.joints, articulated={"faucet": (np.concatenate([pose.p, pose.q]), env.first_angles[lane].cpu().numpy())})


def _chair(env: Any, lane: int, seed: int, built: int) -> Start:
    start, chair = chair_start(seed, len(env.chairs)), env.chairs[env.starts[lane].chair]
    pose, joints = standing(chair).start(start)
    return Start(first_joints(start.base, env.order), articulated={"chair": (np.concatenate([pose.p, pose.q]), joints)})


# Where the episode of a seed starts in a lane that was built for another seed.
STARTS: dict[Callable[..., Any], Callable[[Any, int, int, int], Start]] = {
    StackCube: _stack_cube, PegInsertionSide: _peg, TurnFaucet: _faucet, TurnFaucetSource: _faucet, PushChair: _chair,
    PushChairSource: _chair}


class ManiSkillBatch:
    """A task through ManiSkill's own step, all lanes in one scene; a `BatchSim`.

    Args:
        spec: a task of ManiSkill as it is in the registry.
        num_envs: N.
        backend: ManiSkill's name of what simulates. "physx_cpu" takes one lane: so the tests compare it with the fast step.
    """

    def __init__(self, spec: TaskSpec, num_envs: int, backend: str = "physx_cuda"):
        self._start, self._base_pose = STARTS[spec.make], issubclass(spec.make, FastSim)
        self._env = spec.make.build(render=False, sim_backend=backend, num_envs=num_envs, reconfiguration_freq=0)
        self._built: list[int] = []  # the seed that each lane was built for

    def reset(self, lanes: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        import torch

        if not self._built:
            known = dict(zip(lanes.tolist(), seeds.tolist(), strict=True))
            self._built = [known.get(lane, 0) for lane in range(self._env.num_envs)]
            with building(False):
                self._env.reset(seed=self._built, options={"reconfigure": True})
        # Starts are given as states, because ManiSkill draws those of all lanes from the first one's seed.
        starts = [self._start(self._env, lane, int(seed), self._built[lane]) for lane, seed in zip(lanes, seeds, strict=True)]
        robot = self._env.agent.robot
        poses = robot.pose.raw_pose.cpu().numpy()[lanes]
        articulated = {robot.name: [(pose, start.joints) for pose, start in zip(poses, starts, strict=True)]}
        articulated |= {name: [start.articulated[name] for start in starts] for name in starts[0].articulated}
        states = dict(
            actors={name: self._states([(start.bodies[name], ()) for start in starts], 0) for name in starts[0].bodies},
            articulations={name: self._states(placed, self._env.scene.state_dict_registry.articulations[name].max_dof)
                           for name, placed in articulated.items()})
        options = {"env_idx": torch.as_tensor(lanes, device=self._env.device), "reset_to_env_states": {"env_states": states}}
        return self._seen(self._env.reset(options=options)[0])[lanes]

    def _states(self, placed: list[tuple[np.ndarray, Any]], dof: int) -> Any:
        """ManiSkill's states (k, 13 + 2 dof) of bodies at rest at poses (7,), with joint positions that are padded to `dof`."""
        states = np.zeros((len(placed), 13 + 2 * dof), np.float32)
        for state, (pose, joints) in zip(states, placed, strict=True):
            state[:7], state[13 : 13 + len(joints)] = pose, joints
        return self._tensor(states)

    def _tensor(self, values: np.ndarray) -> Any:
        import torch

        return torch.from_numpy(np.asarray(values, np.float32)).to(self._env.device)

    def _seen(self, observations: Any) -> np.ndarray:
        return with_base_pose(self._env, observations) if self._base_pose else observations.cpu().numpy()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        observations, _, _, _, info = self._env.step(self._tensor(actions))
        return self._seen(observations), info["success"].cpu().numpy()

    def close(self) -> None:
        self._env.close()


def require_batched(spec: TaskSpec) -> None:
    """Raises PdkitError without a GPU, and for a task that is not a stock one of ManiSkill, or that was changed."""
    import torch

    if spec.make not in STARTS:
        raise PdkitError(f"physx_cuda simulates {', '.join(task.__name__ for task in STARTS)}, whole episodes with states as "
                         f"observations, and not {spec.name} as it is set up here; set simulator=cpu.")
    if not torch.cuda.is_available():
        raise PdkitError("physx_cuda needs a CUDA device, and none was found; set simulator=cpu, or check the driver with `pdkit doctor`.")


def load_physx_cuda() -> None:
    """Load SAPIEN's PhysX library for CUDA, which SAPIEN fetches when it is first needed. Raises PdkitError where that fails."""
    with quiet():
        from sapien import physx

    try:
        physx.enable_gpu()
    except (OSError, BadZipFile, RuntimeError) as error:  # no network is an OSError too
        release = physx.version()
        fix = "make the driver's libcuda.so known to the loader" if "libcuda" in str(error) else (
            f"unzip the one for this system from GitHub, sapien-sim/physx-precompiled, release {release}, into "
            f"{Path.home() / '.sapien' / 'physx' / release}")
        raise PdkitError(f"SAPIEN's PhysX library for CUDA could not be loaded ({error}): {fix}, or set simulator=cpu.") from None


def gpu_lanes(spec: TaskSpec, count: int, rules: tuple) -> Together:
    """Lanes on the GPU, in a process that has simulated nothing yet. Raises PdkitError where they cannot be had."""
    require_batched(spec)
    load_physx_cuda()
    return Together(ManiSkillBatch(spec, count), count, rules)


class Together:
    """The lanes of one `BatchSim`; used as Lanes (lanes.py) are.

    Every primitive step is all lanes' at once: a lane without an episode, or one whose episode ended before its chunk did, is
    stepped along and not looked at.
    """

    def __init__(self, sim: BatchSim, count: int, rules: tuple):
        self._sim, self._episodes = sim, [EpisodeCount(*rules) for _ in range(count)]

    def reset(self, arrays: dict[str, np.ndarray]) -> None:
        self._begin(np.arange(len(self._episodes)), arrays)

    def step(self, arrays: dict[str, np.ndarray]) -> None:
        going = np.array([episode.seed != IDLE for episode in self._episodes])
        arrays["steps"][:] = 0
        for k in range(arrays["actions"].shape[1]):
            if not going.any():
                break
            observations, solved = self._sim.step(arrays["actions"][:, k])
            for i in np.flatnonzero(going):
                episode = self._episodes[i]
                arrays["observations"][i, k], arrays["solved"][i, k], arrays["steps"][i] = observations[i], solved[i], k + 1
                arrays["ended"][i] = episode.took(bool(solved[i]))
                if arrays["ended"][i].any():
                    arrays["episode"][i] = (episode.seed, episode.length, episode.once, solved[i])
                    going[i] = False
        self._begin(np.flatnonzero(arrays["ended"].any(axis=1) & (arrays["steps"] > 0)), arrays)

    def _begin(self, lanes: np.ndarray, arrays: dict[str, np.ndarray]) -> None:
        for lane, first in self._started(lanes, arrays["seeds"][lanes]):
            arrays["first"][lane] = first

    def _started(self, lanes: np.ndarray, seeds: np.ndarray) -> Iterable[tuple[int, np.ndarray]]:
        """Start the episodes that `seeds` (k,) name in `lanes` (k,), or leave a lane idle; those that began, with what they see first."""
        for lane, seed in zip(lanes, seeds, strict=True):
            self._episodes[lane].begin(seed)
        live = seeds != IDLE
        return zip(lanes[live], self._sim.reset(lanes[live], seeds[live]), strict=True) if live.any() else ()

    def replay(self, histories: list[tuple[int, np.ndarray]]) -> list[np.ndarray]:
        """As `Lanes.replay`. All lanes arrive at the same step, so one with a shorter history starts later."""
        seeds = np.array([seed for seed, _ in histories], np.int64)
        lengths = np.array([len(actions) for _, actions in histories])
        longest, out = lengths.max(), [[] for _ in histories]
        for step in range(longest + 1):
            begin = np.flatnonzero(lengths == longest - step)
            for i, first in self._started(begin, seeds[begin]):
                out[i].append(first)
            if step == longest:
                break
            at = step - (longest - lengths)  # where each lane stands in its history; below 0: not yet begun
            going = np.flatnonzero((at >= 0) & (seeds != IDLE))
            actions = np.zeros((len(histories), histories[0][1].shape[1]), np.float32)
            actions[going] = [histories[i][1][at[i]] for i in going]
            observations, solved = self._sim.step(actions)
            for i in going:
                self._episodes[i].took(bool(solved[i]))
                out[i].append(observations[i])
        return [np.stack(observations) if observations else np.zeros((0,), np.float32) for observations in out]

    def close(self, keep: bool) -> None:
        """End the simulation; it is not kept."""
        self._sim.close()
