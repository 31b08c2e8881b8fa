"""Lanes: a simulator with its episode, and where they run, in this process or in workers (see vector.py)."""
from __future__ import annotations

import atexit
import multiprocessing
import signal
import sys
from collections.abc import Callable
from multiprocessing import shared_memory

import numpy as np

from ..errors import PdkitError
from .spec import Sim, TaskSpec, behind

IDLE = -1  # instead of a seed: this lane has nothing more to do
DIED = "A simulator process died; run `pdkit doctor`, or set env_workers=0 to see its error."


SPARES = 50  # at most so many are kept of a kind: the lanes of the largest evaluations

_spare: dict[Callable[..., Sim], list[Sim]] = {}  # simulations of closed lanes that take long to build, by what makes them


def _simulation(spec: TaskSpec) -> Sim:
    """A simulation that was kept, or a new one. Which it is makes no difference: `reset` alone decides what follows (see `Sim`)."""
    kept = _spare.get(spec.make) if _spare else None
    return kept.pop() if kept else spec.make()


def _keep(spec: TaskSpec, sim: Sim) -> None:
    """Keep a simulation for the next lanes where that is worth it, or close it."""
    kept = _spare.setdefault(spec.make, []) if getattr(sim, "slow_to_build", False) else None
    if kept is None or len(kept) >= SPARES:
        sim.close()
    else:
        kept.append(sim)


@atexit.register
def close_spares() -> None:
    """Close all simulations that are kept."""
    while _spare:
        for sim in _spare.popitem()[1]:
            sim.close()


class EpisodeCount:
    """The bookkeeping of one lane's episode."""

    def __init__(self, limit: int, terminate_on_success: bool, success_tail: int):
        self._full_limit, self._terminate_on_success, self._success_tail = limit, terminate_on_success, success_tail
        self.begin(IDLE)

    def begin(self, seed: int) -> None:
        self.seed, self.length, self.once, self._limit = int(seed), 0, False, self._full_limit

    def took(self, success: bool) -> tuple[bool, bool]:
        """Count a primitive step, solved or not; whether with it the episode (terminated, was truncated)."""
        self.length += 1
        if success and not self.once:
            self.once = True
            if self._success_tail:
                self._limit = min(self._limit, self.length + self._success_tail)
        terminated = self._terminate_on_success and success
        # Solving the task on the very last step is a termination, not a time-out.
        return terminated, self.length >= self._limit and not terminated


class _Lane:
    """One simulator with its episode; runs in the main process or in a worker."""

    def __init__(self, sim: Sim, *rules):
        self.sim, self.episode = sim, EpisodeCount(*rules)

    def reset(self, seed: int) -> np.ndarray:
        self.episode.begin(seed)
        return self.sim.reset(self.episode.seed)

    def step(self, chunk: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool, bool]:
        """(observations after each primitive step taken, success at each, terminated, truncated)."""
        observations, successes = [], []
        for action in chunk:
            observation, success = self.sim.step(action)
            observations.append(observation)
            successes.append(success)
            terminated, truncated = self.episode.took(success)
            if terminated or truncated:
                break
        return np.stack(observations), np.array(successes), terminated, truncated


class Lanes:
    """A group of lanes stepped one after the other, writing into shared arrays. `rules` are those of `EpisodeCount`."""

    def __init__(self, spec: TaskSpec, count: int, rules: tuple):
        self._spec = spec
        self.lanes = [_Lane(_simulation(spec), *rules) for _ in range(count)]

    def step(self, arrays: dict[str, np.ndarray]) -> None:
        for i, lane in enumerate(self.lanes):
            arrays["steps"][i] = 0
            if lane.episode.seed == IDLE:
                continue
            observations, successes, terminated, truncated = lane.step(arrays["actions"][i])
            taken = len(observations)
            arrays["observations"][i, :taken] = observations
            arrays["solved"][i, :taken], arrays["steps"][i] = successes, taken
            arrays["ended"][i] = (terminated, truncated)
            if terminated or truncated:
                arrays["episode"][i] = (lane.episode.seed, lane.episode.length, lane.episode.once, successes[-1])
                self._start(lane, arrays, i, int(arrays["seeds"][i]))

    def reset(self, arrays: dict[str, np.ndarray]) -> None:
        for i, lane in enumerate(self.lanes):
            self._start(lane, arrays, i, int(arrays["seeds"][i]))

    def _start(self, lane: _Lane, arrays: dict[str, np.ndarray], i: int, seed: int) -> None:
        if seed == IDLE:
            lane.episode.begin(IDLE)
        else:
            arrays["first"][i] = lane.reset(seed)

    def replay(self, histories: list[tuple[int, np.ndarray]]) -> list[np.ndarray]:
        """Bring every lane into the episode (seed, primitive actions (T, act_dim)); the observations (T+1, obs_dim)."""
        out = []
        for lane, (seed, actions) in zip(self.lanes, histories, strict=True):
            if seed == IDLE:
                lane.episode.begin(IDLE)
                out.append(np.zeros((0,), np.float32))
                continue
            observations = [lane.reset(seed)]
            for action in actions:
                observations.append(lane.step(action[None])[0][0])
            out.append(np.stack(observations))
        return out

    def close(self, keep: bool) -> None:
        """Give up the simulations; `keep` them for other lanes, unless something went wrong in them. A second time nothing is left."""
        lanes, self.lanes = self.lanes, []
        for lane in lanes:
            _keep(self._spec, lane.sim) if keep else lane.sim.close()


class InProcess:
    """All lanes in this process; the work is done when the result is asked for. `make(count)` makes lanes."""

    def __init__(self, shapes, num_envs: int, make: Callable[[int], Lanes]):
        self.arrays = {name: np.zeros(shape, dtype) for name, (shape, dtype) in shapes.items()}
        self._lanes = make(num_envs)
        self._pending = ""

    def send(self, command: str) -> None:
        self._pending = command

    def receive(self) -> None:
        getattr(self._lanes, self._pending)(self.arrays)

    def call(self, command: str) -> None:
        self.send(command)
        self.receive()

    def replay(self, histories):
        return self._lanes.replay(histories)

    def close(self, keep: bool) -> None:
        self._lanes.close(keep)


def must_be_importable(*code: Callable) -> None:
    """Raises PdkitError for a simulator or policy class that other processes cannot have: it is defined in a notebook. (A script's they
    import again.)"""
    for one in (one for each in code for one in behind(each)[0]):
        if getattr(one, "__module__", "") == "__main__" and not hasattr(sys.modules["__main__"], "__file__"):
            raise PdkitError(f"{one.__qualname__} is defined in a notebook, from where other processes cannot import it: move it into a "
                             "module of its own, or set env_workers=0 and eval_workers=0.")


class Workers:
    """Lanes spread over spawned processes; arrays in shared memory, one byte string a command. `make(count)` makes lanes there."""

    def __init__(self, shapes, num_envs: int, workers: int, make: Callable[[int], Lanes]):
        context = multiprocessing.get_context("spawn")  # fork is unsafe once torch has threads
        self._memory, self.arrays = _share(shapes)
        bounds = np.linspace(0, num_envs, workers + 1).astype(int)
        self._slices = [slice(int(a), int(b)) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
        self._pipes, self._processes = [], []
        names = {name: block.name for name, block in self._memory.items()}
        for part in self._slices:
            ours, theirs = context.Pipe()
            process = context.Process(target=_worker, args=(theirs, names, shapes, part, make), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)
        for pipe in self._pipes:
            self._expect(pipe)

    def _expect(self, pipe):
        try:
            answer = pipe.recv()
        except (EOFError, ConnectionResetError):
            self.close()
            raise PdkitError(DIED) from None
        if isinstance(answer, BaseException):
            self.close()
            raise answer
        return answer

    def send(self, command: str) -> None:
        for pipe in self._pipes:
            self._tell(pipe, (command, None))

    def _tell(self, pipe, message) -> None:
        try:
            pipe.send(message)
        except OSError:
            self.close()
            raise PdkitError(DIED) from None

    def receive(self) -> None:
        for pipe in self._pipes:
            self._expect(pipe)

    def call(self, command: str) -> None:
        self.send(command)
        self.receive()

    def replay(self, histories):
        for pipe, part in zip(self._pipes, self._slices, strict=True):
            self._tell(pipe, ("replay", histories[part]))
        return [item for pipe in self._pipes for item in self._expect(pipe)]

    def close(self, keep: bool = False) -> None:
        """End the processes; nothing of theirs can be kept."""
        for pipe in self._pipes:
            try:
                pipe.send(("close", None))
            except OSError:
                pass
        for process in self._processes:
            process.join(timeout=2)
            if process.is_alive():
                process.terminate()
        self.arrays.clear()  # a shared block cannot be closed while arrays look into it
        for block in self._memory.values():
            block.close()
            try:
                block.unlink()
            except FileNotFoundError:
                pass
        self._memory = {}


def _share(shapes) -> tuple[dict[str, shared_memory.SharedMemory], dict[str, np.ndarray]]:
    blocks, arrays = {}, {}
    for name, (shape, dtype) in shapes.items():
        blocks[name] = shared_memory.SharedMemory(create=True, size=max(1, int(np.prod(shape)) * np.dtype(dtype).itemsize))
        arrays[name] = np.ndarray(shape, dtype, buffer=blocks[name].buf)
        arrays[name][...] = 0
    return blocks, arrays


def _worker(pipe, names, shapes, part: slice, make: Callable[[int], Lanes]) -> None:
    """The process of one worker: build the lanes, then obey commands until told to close or the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    blocks = {name: shared_memory.SharedMemory(name=block) for name, block in names.items()}
    arrays = {name: np.ndarray(*shapes[name], buffer=block.buf)[part] for name, block in blocks.items()}
    lanes = None
    try:
        lanes = make(part.stop - part.start)
        pipe.send("ready")
        while True:
            command, payload = pipe.recv()
            if command == "close":
                break
            pipe.send(lanes.replay(payload) if command == "replay" else getattr(lanes, command)(arrays))
    except (EOFError, KeyboardInterrupt, BrokenPipeError):
        pass
    except PdkitError as error:
        pipe.send(error)
    except Exception as error:
        pipe.send(PdkitError(f"A simulator process failed: {type(error).__name__}: {error}"))
    finally:
        if lanes is not None:
            lanes.close(keep=False)
        arrays.clear()
