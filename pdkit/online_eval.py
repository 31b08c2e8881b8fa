"""Evaluations during training, in a process of their own: on two cores they cost the learner next to nothing.

An evaluation depends only on the actor it is given, so when it comes back changes neither the curve nor the policy selected.
"""
from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Iterator

import torch
from torch import nn

from .decorated import Decorated
from .errors import PdkitError
from .evaluate import selection_scores
from .policies import Policy
from .tasks.lanes import must_be_importable
from .tasks.spec import TaskSpec
from .torch_setup import one_thread, set_threads

LANES = 25  # episodes side by side in one evaluation
DIED = "The process that evaluates died; run `pdkit doctor`, or set eval_workers=0 to see its error."
State = dict[str, torch.Tensor]


class Evaluations:
    """Scores actors on the selection seeds, one after the other, in the order in which they were submitted.

    Args:
        spec: the task.
        policy, actor: a policy, and the part of it that an actor's weights are loaded into; both on the CPU and used by nobody else.
        episodes: selection episodes of each evaluation.
        seed: restarts the base policy's random numbers before each evaluation.
        workers: 1 evaluates in another process, 0 in this one (then `collect` does the work).
    """

    def __init__(self, spec: TaskSpec, policy: Policy | Decorated, actor: nn.Module, *, episodes: int, seed: int, workers: int):
        self._arguments = (spec, policy, actor, episodes, seed)
        self.pending: dict[int, State] = {}  # step -> weights not scored yet: part of a checkpoint
        self._process, self._busy = None, False
        if workers:
            must_be_importable(spec.make, type(policy))
            context = multiprocessing.get_context("spawn")  # fork is unsafe once torch has threads
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=_worker, args=(theirs, self._arguments), daemon=True)
            self._process.start()
            theirs.close()

    def submit(self, step: int, weights: State) -> None:
        """Have the actor with these weights scored, as the one of `step`."""
        self.pending[step] = {name: tensor.detach().cpu().clone() for name, tensor in weights.items()}
        self._feed()

    def collect(self, wait: bool = False) -> Iterator[tuple[int, State, dict[str, float]]]:
        """What has been scored since: (step, weights, row with success_once, success_at_end and eval_seconds).

        Raises PdkitError when the process failed.
        """
        while self.pending:
            step = next(iter(self.pending))
            if self._process is None:
                row = _score(*self._arguments, self.pending[step])
            elif wait or self._pipe.poll():
                row = self._receive()
            else:
                return
            yield step, self.pending.pop(step), row
            self._feed()

    def _feed(self) -> None:
        # One at a time, and only to an idle process: a larger message would block until the one before is done.
        if self._process is not None and self.pending and not self._busy:
            try:
                self._pipe.send({name: tensor.numpy() for name, tensor in next(iter(self.pending.values())).items()})
            except OSError:
                raise PdkitError(DIED) from None
            self._busy = True

    def _receive(self) -> dict[str, float]:
        try:
            answer = self._pipe.recv()
        except (EOFError, ConnectionResetError):
            answer = PdkitError(DIED)
        self._busy = False
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def close(self) -> None:
        """End the process; an evaluation under way is lost."""
        if self._process is not None:
            self._process.terminate()
            self._process.join(timeout=2)


@torch.no_grad()
def _score(spec: TaskSpec, policy: Policy | Decorated, actor: nn.Module, episodes: int, seed: int, weights: State) -> dict[str, float]:
    started = time.monotonic()
    actor.load_state_dict(weights)
    with one_thread():  # as in the other process: scores choose the policy
        return selection_scores(spec, policy, episodes, seed, LANES) | {"eval_seconds": time.monotonic() - started}


def _worker(pipe, arguments) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    set_threads(1)
    try:
        while True:
            weights = pipe.recv()
            pipe.send(_score(*arguments, {name: torch.from_numpy(array) for name, array in weights.items()}))
    except (EOFError, BrokenPipeError):
        pass
    except Exception as error:
        pipe.send(PdkitError(f"The process that evaluates failed: {type(error).__name__}: {error}"))
