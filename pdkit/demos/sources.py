"""Where demonstrations come from: bundled in data/demos, scripted experts, the project's agents, human ones through Minari."""
from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ..errors import PdkitError
from ..files import DATA
from ..policies import Policy
from ..tasks import get_task
from ..tasks.lanes import IDLE
from ..tasks.partnet import VARIABLE, object_set
from ..tasks.spec import TaskSpec
from ..tasks.vector import VectorEnv
from .experts import scripted_episodes
from .format import Demos, from_episodes, load_demos

MINARI = {"Door": "D4RL/door/human-v2", "Pen": "D4RL/pen/human-v2", "Hammer": "D4RL/hammer/human-v2", "Relocate": "D4RL/relocate/human-v2"}
JUDGED: dict[str, Callable[[np.ndarray], np.ndarray]] = {  # the rules of the tasks, on observations (M, obs_dim): solved or not, (M,)
    "Door": lambda o: o[:, 28] >= 1.35,  # the hinge
    "Pen": lambda o: (np.linalg.norm(o[:, 39:42], axis=1) < 0.075) & ((o[:, 33:36] * o[:, 36:39]).sum(axis=1) > 0.95),
    "Relocate": lambda o: np.linalg.norm(o[:, 36:39], axis=1) < 0.1}


def bundled(task: str) -> Demos:
    """The demonstrations that come with the kit and from which this task is learned: of a novel task those of its source task.

    Raises PdkitError when there are none.
    """
    shown = get_task(task).demo_task or task
    path = DATA / "demos" / f"{shown}.safetensors"
    if not path.exists():
        have = ", ".join(sorted(p.stem for p in path.parent.glob("*.safetensors"))) or "none"
        raise PdkitError(f"No demonstrations of {shown} are bundled (there are: {have}); make some with `pdkit demos {shown}`, or name a "
                         "file of your own (--demos; pdkit.demos.from_episodes and save_demos make one).")
    return _warned_of_objects(load_demos(path))


def _warned_of_objects(demos: Demos) -> Demos:
    """The demonstrations; with a warning where they were made with other objects than the task has now (PDKIT_PARTNET)."""
    shown, now = demos.extra.get("objects", ""), object_set(get_task(demos.task))
    if shown != now:
        warnings.warn(f"These demonstrations of {demos.task} show {shown or 'generated'} objects, and the task now has "
                      f"{now or 'generated'} ones; make others with `pdkit demos {demos.task}`, or change {VARIABLE}.", stacklevel=3)
    return demos


def given(task: str, path: str | Path | None) -> Demos:
    """The demonstrations in a file, to learn this task from, or without one those of the kit. Raises PdkitError when they are of another
    task."""
    if not path:
        return bundled(task)
    demos, wanted = load_demos(path), get_task(task).demo_task or task
    if demos.task != wanted:
        raise PdkitError(f"{path} holds demonstrations of {demos.task}, not of {wanted}.")
    return _warned_of_objects(demos)


def learned_from(demos: Demos, card: dict, num: int | None = None) -> Demos:
    """The first `num` demonstrations; without a number as many as the policy of this card learned from, or all where there are fewer."""
    return demos.first(min(card["info"].get("demos", demos.num), demos.num) if num is None else num)


def scripted(task: str, num: int, first_seed: int = 0, noise: float = 0.0, progress: Callable[[int, int], None] | None = None) -> Demos:
    """`num` successful episodes of the task's scripted expert."""
    command = f"pdkit demos {task} --num {num} --first-seed {first_seed} --noise {noise}"
    return from_episodes(task, list(scripted_episodes(task, num, first_seed, noise, progress)), label="scripted",
                         how=f"closed-loop scripted expert, action noise {noise}, successful episodes, each ending at its success",
                         command=command)


def _play(policy: Policy, spec: TaskSpec, seeds: Sequence[int], lanes: int, noise: float = 0.0,
          limit: int | None = None) -> Iterator[list[dict]]:
    """One whole episode for each seed, in lists of those that end together: observations, actions as executed, success and seed."""
    queue = list(seeds)[::-1]
    rng = np.random.default_rng(seeds[0])
    with VectorEnv(spec, lanes, lambda lane: queue.pop() if queue else IDLE, window=max(policy.window, policy.chunk),
                   chunk=policy.chunk, max_episode_steps=limit) as envs:
        windows = envs.reset()
        open_episodes = [[] for _ in range(lanes)]
        playing = len(seeds)
        while playing:
            actions = policy.act(windows[:, -policy.window:])
            actions = np.clip(actions + noise * rng.standard_normal(actions.shape), -1, 1).astype(np.float32)
            result = envs.step(actions)
            for i in range(lanes):
                seen = np.concatenate([windows[i, -1:], result.final_windows[i, -policy.chunk:]])[-result.steps[i] - 1:]
                open_episodes[i] += [(seen[k], actions[i, k], result.solved[i, k], seen[k + 1]) for k in range(result.steps[i])]
            ended = []
            for e in result.episodes:
                steps, open_episodes[e.lane] = open_episodes[e.lane], []
                ended.append(dict(observations=np.stack([s[0] for s in steps] + [steps[-1][3]]), actions=np.stack([s[1] for s in steps]),
                                  success=np.array([s[2] for s in steps]), seed=e.seed))
            playing -= len(ended)
            windows = result.windows
            yield ended


def agent_episodes(policy, task: str, num: int, first_seed: int, noise: float, tail: int,
                   progress: Callable[[int, int], None] | None = None) -> list[dict]:
    """`num` successful episodes of a policy acting with Gaussian action noise, cut `tail` steps after their first success.

    The noise makes the recorded actions, which are the ones executed, vary as a demonstrator's would; episodes that the
    task's limit ends unsolved are dropped.
    """
    policy.reset(first_seed)
    kept, finished = {}, 0
    for ended in _play(policy, get_task(task), range(first_seed, first_seed + 4 * num), min(num, 10), noise):
        for e in ended:
            finished += 1
            if e["success"].any():
                length = 1 + int(np.argmax(e["success"])) + tail
                kept[e["seed"]] = e | {"observations": e["observations"][: length + 1], "actions": e["actions"][:length],
                                       "success": e["success"][:length]}
            if progress and len(kept) <= num:
                progress(min(len(kept), num), finished)
        if len(kept) >= num:
            break
    if len(kept) < num:
        raise PdkitError(f"Only {len(kept)} of {finished} episodes succeeded, {num} were asked for; use a better policy or less noise.")
    return [kept[seed] for seed in sorted(kept)[:num]]


def from_agent(policy: Policy, task: str, num: int, *, first_seed: int, noise: float, tail: int, how: str, command: str,
               progress: Callable[[int, int], None] | None = None) -> Demos:
    """Demonstrations made by an agent of this project."""
    return from_episodes(task, agent_episodes(policy, task, num, first_seed, noise, tail, progress), label="agent", how=how,
                         command=command, noise=noise, tail=tail)


def rollouts(policy: Policy, spec: TaskSpec, seeds: Sequence[int], limit: int | None = None) -> Demos:
    """Whole episodes of a policy, one a seed, successes and failures alike: what a learner must not only imitate.

    They run to the time limit (`limit`, or the task's), so they end in the order of the seeds.
    """
    policy.reset(seeds[0])
    episodes = [e for ended in _play(policy, spec, seeds, min(len(seeds), 10), limit=limit) for e in ended]
    return from_episodes(spec.name, episodes, label="agent", how=f"{type(policy).__name__} without action noise, failures kept",
                         command="pdkit.demos.sources.rollouts", spec=spec)


def human(task: str) -> Demos:
    """The 25 human demonstrations of an Adroit task, through Minari. Raises PdkitError without a network or for another task.

    Actions outside [-1, 1] (5.6 % of Door's, facts.md 5.2) are clipped, as the environment does. Success is judged from
    what was recorded; only about a third of the Door episodes pass the threshold.
    """
    if task not in MINARI:
        raise PdkitError(f"There are no human demonstrations of {task}; Minari has: {', '.join(MINARI)}.")
    import minari
    from minari.storage import get_dataset_path

    folder = Path(get_dataset_path(MINARI[task]))
    if not folder.exists():
        try:
            minari.download_dataset(MINARI[task])
        except BaseException as error:  # an interrupted one, too, would leave a part that passes for the whole
            shutil.rmtree(folder, ignore_errors=True)
            if not isinstance(error, Exception):
                raise
            raise PdkitError(f"The human demonstrations of {task} could not be fetched ({type(error).__name__}); they need a network the "
                             f"first time: use the bundled ones, or run `pdkit demos {task} --source human` where there is one.") from error
    try:
        recorded = list(minari.load_dataset(MINARI[task]).iterate_episodes())
    except Exception as error:  # whatever a damaged file makes of itself
        raise PdkitError(f"Minari's files of {task} in {folder} cannot be read ({type(error).__name__}); delete that folder, and the same "
                         "command fetches them anew.") from error
    episodes = [dict(observations=e.observations, actions=np.clip(e.actions, -1, 1), success=_recorded_success(task, e), seed=-1)
                for e in recorded]
    return from_episodes(task, episodes, label="human", how="human teleoperation (Rajeswaran et al., 2018), through Minari "
                         f"({MINARI[task]}), actions clipped to [-1, 1]", command=f"pdkit demos {task} --source human")


def _recorded_success(task: str, episode) -> np.ndarray:
    """Success after each step: the environment's own flag where it was recorded, else the rule on the observation. Raises PdkitError where
    neither tells."""
    length = len(episode.actions)
    infos = getattr(episode, "infos", None) or {}
    if "success" in infos:
        return np.asarray(infos["success"], bool).ravel()[-length:]
    if task not in JUDGED:  # the bonuses in the dense reward are given for less than the task asks for
        raise PdkitError(f"Minari's episodes of {task} do not say at which steps they were solved, and their observations do not tell it; "
                         "use the bundled demonstrations.")
    return JUDGED[task](np.asarray(episode.observations)[1: length + 1])
