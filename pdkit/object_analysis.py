"""What lesson 14 measures: the same task with objects that no demonstration shows (appendix A, Fig. 12).

Objects, not episodes, are what "novel" is about: three novel objects are a sample of three, however many episodes are run with each.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from scipy import spatial
from scipy import stats as scipy_stats

from .claims import FLOOR, jointly, judged
from .decorated import Decorated
from .demos import Demos
from .errors import PdkitError
from .evaluate import evaluate
from .policies import Policy
from .seeds import reported_seeds
from .stats import Interval, paired, wilson
from .tasks import TASKS, TaskSpec, get_task
from .tasks.chair_assets import chairs
from .tasks.chair_body import chair_start
from .tasks.faucet_assets import faucets
from .tasks.partnet import Model

NOVEL = tuple(name for name, spec in TASKS.items() if spec.demo_task)  # tasks whose objects no demonstration shows
OF_THE_OBJECT = {"TurnFaucet": slice(32, 40), "PushChair": slice(44, 57)}  # what an observation says of it; of a chair, its root link
WHAT_IS_LEFT = {"TurnFaucet": "turn still to go (share)", "PushChair": "chair to the middle (m)"}


def both(task: str) -> tuple[TaskSpec, TaskSpec]:
    """The task with the source objects, and with the novel ones. Raises PdkitError for a task without novel objects."""
    if task not in NOVEL:
        raise PdkitError(f"{task} has no novel objects; choose {' or '.join(NOVEL)}.")
    return get_task(get_task(task).demo_task), get_task(task)


def objects(task: str) -> list[Model]:
    """The objects of a task, source or novel, in the order that `object_of` numbers them."""
    novel = task in NOVEL
    if task.startswith("TurnFaucet"):
        return [faucet.model for faucet in faucets(novel)]
    return [chair.model for chair in chairs("novel" if novel else "source")]


def object_of(task: str, seed: int) -> int:
    """Which of `objects(task)` the episode of `seed` has."""
    if task.startswith("TurnFaucet"):
        from .tasks.faucet_env import faucet_start  # imports the simulator

        return int(faucet_start(seed, faucets(task in NOVEL)).model)
    return chair_start(seed, len(objects(task))).chair


def starts(spec: TaskSpec, seeds: Sequence[int]) -> np.ndarray:
    """First observations (len(seeds), obs_dim) of the episodes of `seeds`."""
    sim = spec.make()
    try:
        return np.stack([sim.reset(seed) for seed in seeds])
    finally:
        sim.close()


def strangeness(demos: Demos, observations: np.ndarray, task: str) -> np.ndarray:
    """How far starts (N, obs_dim) lie from the nearest demonstrated start, in what they say of the object: (N,).

    In standard deviations of the demonstrated starts, as root mean square over the numbers that vary among them or between them
    and `observations`; a number that never varies among the demonstrations counts by its spread over both.
    """
    part = OF_THE_OBJECT[task]
    shown = np.stack([episode["observations"][0] for episode in demos.episodes()])[:, part].astype(np.float64)
    asked = np.asarray(observations, np.float64)[:, part]
    spread = shown.std(axis=0)
    spread = np.where(spread > 1e-4, spread, np.concatenate([shown, asked]).std(axis=0))
    used = spread > 1e-4
    distance, _ = spatial.KDTree(shown[:, used] / spread[used]).query(asked[:, used] / spread[used])
    return distance / np.sqrt(used.sum())


def by_object(policies: Mapping[str, Policy | Decorated], task: str, episodes: int, limit: int | None = None) -> pd.DataFrame:
    """Whole episodes of each policy on the first `episodes` test seeds of the source and of the novel task, a row an episode.

    Columns: policy, objects ("source" or "novel"), object (its name), and those of `evaluate`.
    """
    rows = []
    for kind, spec in zip(("source", "novel"), both(task), strict=True):
        names = [model.name for model in objects(spec.name)]
        for name, policy in policies.items():
            policy.reset(0)
            table = evaluate(spec, policy.act, reported_seeds(episodes), window=policy.window, chunk=policy.chunk, num_envs=25,
                             max_episode_steps=limit)
            which = [names[object_of(spec.name, seed)] for seed in table.seed]
            rows.append(table.assign(policy=name, objects=kind, object=which))
    return pd.concat(rows, ignore_index=True)


def summary(episodes: pd.DataFrame) -> pd.DataFrame:
    """`by_object`'s episodes as a row a policy and object: policy, objects, object, episodes, success, low, high (Wilson, 95 %)."""
    rows = []
    for (policy, kind, name), part in episodes.groupby(["policy", "objects", "object"], sort=False):
        rate = wilson(int(part.success_once.sum()), len(part))
        rows.append(dict(policy=policy, objects=kind, object=name, episodes=rate.n, success=rate.value, low=rate.low, high=rate.high))
    return pd.DataFrame(rows)


def over_objects(rates: Sequence[float]) -> Interval:
    """Mean success over objects, each counted once, with Student's t over objects (95 %), clipped to [0, 1].

    The interval is about *other objects of the same kind*. Raises PdkitError for fewer than two objects, which say nothing of others.
    """
    values = np.asarray(rates, np.float64)
    if len(values) < 2:
        raise PdkitError("One object says nothing of other objects: an interval over objects needs at least two.")
    half = scipy_stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return Interval(float(values.mean()), float(max(values.mean() - half, 0)), float(min(values.mean() + half, 1)))


def paths(policy: Policy | Decorated, spec: TaskSpec, seeds: Sequence[int], task: str, limit: int | None = None) -> np.ndarray:
    """What is left to do (len(seeds), decisions) before each decision of an episode, as WHAT_IS_LEFT[task] says; 0 is the goal.

    Of a faucet, the share of the handle's turn that is still to go; of a chair, its distance from the middle of the room, metres.
    """
    seen: list[np.ndarray] = []

    def watched(windows: np.ndarray) -> np.ndarray:
        seen.append(_left(windows[:, -1], task))
        return policy.act(windows)

    policy.reset(0)
    evaluate(spec, watched, seeds, window=policy.window, chunk=policy.chunk, num_envs=len(seeds), max_episode_steps=limit)
    return np.stack(seen, axis=1)


def _left(observations: np.ndarray, task: str) -> np.ndarray:
    if task == "TurnFaucet":
        return np.maximum(observations[:, 39], 0) / observations[:, 32]
    return np.hypot(observations[:, 44], observations[:, 45])


def verdict(episodes: pd.DataFrame, base: str, decorated: str) -> tuple[str, list[str]]:
    """Whether Fig. 12's point shows in `by_object`'s episodes: "reproduced", "partly", "not" or "untested", and the reasons.

    Two statements: the base policy does worse on novel objects than on source ones, clearly where the two Wilson intervals do not
    overlap; on novel objects the decorated policy does better than the base policy, clearly where the paired interval lies above 0.
    A statement that is clear counts as reproduced, one that does not even point that way as not, and both together by
    `claims.jointly`. Where nothing reaches FLOOR, it is no test.
    """
    def part(policy: str, kind: str) -> pd.DataFrame:
        return episodes[(episodes.policy == policy) & (episodes.objects == kind)]

    source, novel = (wilson(int(rows.success_once.sum()), len(rows)) for rows in (part(base, "source"), part(base, "novel")))
    gain = paired(part(base, "novel"), part(decorated, "novel"))
    apart = novel.high < source.low
    gap = "reproduced" if apart else "partly" if novel.value < source.value else "not"
    reasons = [f"{base}, novel against source objects: {100 * (novel.value - source.value):+.0f} points, "
               f"intervals {'apart' if apart else 'overlap'}",
               f"novel objects, {decorated} against {base}: {100 * gain.difference:+.0f} points "
               f"({100 * gain.low:+.0f} to {100 * gain.high:+.0f})"]
    if max(source.value, novel.value, gain.other.value) < FLOOR:
        return "untested", ["hardly any episode was solved"]
    return jointly(gap, judged(Interval(gain.difference, gain.low, gain.high))), reasons
