"""Variants of a task with a shorter horizon: episodes that start part of the way to success (appendix F.1, F.4).

    way    the actions of a guide from reset(seed) to its first success, T steps
    start  the state after floor(fraction * T) of them; the time limit shrinks to (1 - fraction) of the task's

What is left of the task is about (1 - fraction) of its length; the text and numbers of F.4 are not known, so this is our way to vary it.
The guide is the policy that made the demonstrations (Door), or the task's scripted expert (StackCube). Every seed gives another
start, the same for all methods. Where the guide fails, the start is drawn from another seed that follows from the first: starts always
lie on a way that succeeds. These further seeds are from 2^31 on, which no other use of seeds reaches (pdkit/seeds.py).
A policy's window begins with the first observation repeated, as in every episode: it does not see the way to the start.
"""
from __future__ import annotations

import functools
import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from ..errors import PdkitError
from ..seeds import own_random_numbers
from .spec import Sim, TaskSpec

PATIENCE = 2.0  # a guide has failed at this multiple of the longest way among the demonstrations
TRIES = 20  # seeds that are tried before a guide is given up
REMEMBERED = 1_000  # ways that a process remembers: evaluations ask for the same seeds again and again
FURTHER = 2**31  # where the seeds of further tries begin


class Guide(Protocol):
    """Who goes ahead: a Policy, a Decorated, or an expert behind the same two methods."""

    window: int

    def reset(self, seed: int) -> None:
        """Start an episode."""

    def act(self, windows: np.ndarray) -> np.ndarray:
        """Action chunks (1, 1, act_dim) for windows (1, window, obs_dim)."""


def walk(sim: Sim, guide: Guide, seed: int, limit: int) -> np.ndarray | None:
    """The guide's actions (T, act_dim) from reset(seed) until its first success, None where it does not get there in `limit` steps.

    Leaves torch as it was: a base policy may draw from its global generator, and a guide in a worker must round as one in this process.
    """
    from ..torch_setup import one_thread

    with one_thread(), own_random_numbers():
        guide.reset(seed)
        window, actions = np.repeat(sim.reset(seed)[None], guide.window, axis=0), []
        while len(actions) < limit:
            actions.append(np.clip(guide.act(window[None])[0, 0], -1, 1).astype(np.float32))
            observation, solved = sim.step(actions[-1])
            if solved:
                return np.stack(actions)
            window = np.concatenate([window[1:], observation[None]])
    return None


class Ways:
    """The ways of a guide, by seed; the last REMEMBERED of them are kept."""

    def __init__(self, guide: Guide, limit: int):
        self.guide, self.limit = guide, limit
        self._kept: OrderedDict[int, tuple[int, np.ndarray]] = OrderedDict()

    def way(self, sim: Sim, seed: int) -> tuple[int, np.ndarray]:
        """The simulator's seed and the actions (T, act_dim) that lead from there to the first success, for an episode's seed.

        Raises PdkitError when the guide fails from TRIES seeds in a row.
        """
        if seed in self._kept:
            self._kept.move_to_end(seed)
            return self._kept[seed]
        for attempt in range(TRIES):
            actual = seed if attempt == 0 else FURTHER + int(np.random.SeedSequence([seed, attempt]).generate_state(1)[0]) % FURTHER
            actions = walk(sim, self.guide, actual, self.limit)
            if actions is not None:
                break
        else:
            raise PdkitError(f"The guide failed from {TRIES} seeds in a row within {self.limit} steps, so there is no way to start on; "
                             "use a better guide.")
        self._kept[seed] = actual, actions
        if len(self._kept) > REMEMBERED:
            self._kept.popitem(last=False)
        return actual, actions


class HorizonSim:
    """A simulator whose episodes start on a guide's way; decided by seed and actions, as the one inside is. See `Sim`."""

    def __init__(self, make: Callable[..., Sim], ways: Callable[[], Ways], fraction: float, render: bool = False):
        self._sim, self._ways, self._fraction = make(render=render) if render else make(), ways(), fraction
        self._env = getattr(self._sim, "_env", None)  # where pdkit/video.py finds the camera

    def reset(self, seed: int) -> np.ndarray:
        actual, actions = self._ways.way(self._sim, int(seed))
        observation = self._sim.reset(actual)
        for action in actions[: steps_ahead(len(actions), self._fraction)]:
            observation, _ = self._sim.step(action)
        return observation

    def step(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        return self._sim.step(action)

    def render(self) -> np.ndarray:
        return self._sim.render()

    def close(self) -> None:
        self._sim.close()


def steps_ahead(length: int, fraction: float) -> int:
    """How many steps of a way of `length` lie before the start; at least one is left."""
    return math.floor(length * fraction)


def shortened(limit: int, fraction: float) -> int:
    """A time limit in primitive steps for what is left of the task, at least 1; 0 (none) stays 0."""
    return math.ceil(limit * (1 - fraction))


def horizon_spec(spec: TaskSpec, fraction: float, ways: Callable[[], Ways] | None = None) -> TaskSpec:
    """`spec` with episodes that start `fraction` of the way to success; 0 gives `spec` itself.

    `ways` is for worlds outside the registry: a picklable function that gives the guide's ways. Raises PdkitError for a fraction outside
    [0, 1) and for a task without a guide.
    """
    if not 0 <= fraction < 1:
        raise PdkitError(f"start_fraction must be at least 0 and below 1, not {fraction}.")
    if fraction == 0:
        return spec
    if ways is None:
        if spec.name not in GUIDES:
            raise PdkitError(f"Episodes of {spec.name} cannot start part of the way, as nobody knows the way there (guides: "
                             f"{', '.join(GUIDES)}); set start_fraction=0.")
        ways = functools.partial(ways_of, spec.name)
    make = functools.partial(HorizonSim, spec.make, ways, fraction)
    return replace(spec, make=make, max_episode_steps=shortened(spec.max_episode_steps, fraction))


# ---- who knows the way -----------------------------------------------------------------------------------------------

class Scripted:
    """A scripted expert as a guide."""

    window = 1

    def __init__(self, expert: Any):
        self.expert = expert

    def reset(self, seed: int) -> None:
        self.expert.reset(np.random.default_rng(seed))

    def act(self, windows: np.ndarray) -> np.ndarray:
        return self.expert.act(windows[0, -1])[None, None]


def demonstrator(task: str) -> Guide:
    """The agent that made the demonstrations of a task."""
    from ..decorated import load_decorated
    from ..files import DATA

    return load_decorated(DATA / "checkpoints" / task / "demonstrator")


def scripted(task: str) -> Scripted:
    """The scripted expert of a task."""
    from ..demos.experts import EXPERTS

    return Scripted(EXPERTS[task]())


GUIDES: dict[str, Callable[[str], Guide]] = {"Door": demonstrator, "StackCube": scripted}


@functools.cache
def ways_of(task: str) -> Ways:
    """The ways of a task's guide, once a process: all simulators and all fractions share what it has walked."""
    from ..demos import sources

    longest = max(int(np.argmax(e["success"])) + 1 for e in sources.bundled(task).episodes())
    return Ways(GUIDES[task](task), math.ceil(PATIENCE * longest))
