"""Gradient steps of imitation: bfloat16 where the hardware has it, one kernel for all weights, and on a GPU one launch for a whole step.

A base policy is small enough that a GPU waits for its hundreds of kernels to be launched one by one. There a step is recorded once as
a CUDA graph and then replayed: the same kernels on the same memory, started together.
"""
from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch

from .torch_setup import autocast

if TYPE_CHECKING:
    from .imitate import ImitateConfig
    from .policies import Policy

EAGER = 3  # steps taken as written before one is recorded: the optimizer's state and the libraries' workspaces must be there by then

Terms = dict[str, torch.Tensor]


def make_optimizer(policy: Policy, config: ImitateConfig, others: Sequence[dict[str, Any]] = (), device: str = "cpu") -> torch.optim.AdamW:
    """AdamW over the policy's parameter groups and `others`, as one kernel for all of them; on a GPU it can be recorded."""
    groups = [*policy.parameter_groups(config.weight_decay), *others]
    recorded = torch.device(device).type == "cuda"  # a learning rate that is a number would be the same in every replay
    lr = torch.tensor(config.lr, device=device) if recorded else config.lr
    return torch.optim.AdamW(groups, lr=lr, betas=(config.beta1, 0.999), fused=True, capturable=recorded)


def gradient_step(loss: Callable[..., Terms], optimizer: torch.optim.Optimizer, device: str, bf16: bool, *batch: torch.Tensor) -> Terms:
    """One step down `loss` of a batch's tensors, as written; the loss terms before it."""
    with autocast(device, bf16):
        terms = loss(*batch)
    optimizer.zero_grad(set_to_none=True)
    terms["loss"].backward()
    optimizer.step()
    return {name: term.detach() for name, term in terms.items()}


class GradientSteps:
    """Calling it takes one `gradient_step`, on a GPU a recorded one; batches must be of one shape.

    Args:
        loss: of a batch's tensors: a dict of scalars of which `loss` is minimised. To be recorded it must not wait for any of its results,
            nor make, draw or copy anything on the CPU.
        optimizer: of `make_optimizer`, for the same device.
        bf16: autocast to bfloat16 where the device has it.
    """

    def __init__(self, loss: Callable[..., Terms], optimizer: torch.optim.Optimizer, device: str, bf16: bool):
        self._device, self._optimizer = torch.device(device).type, optimizer
        self._step = partial(gradient_step, loss, optimizer, self._device, bf16)
        self._eager, self._graph = EAGER, None

    def __call__(self, *batch: torch.Tensor) -> Terms:
        """The loss terms of the batch before the step; a replayed step overwrites those of the last one."""
        if self._device != "cuda":
            return self._step(*batch)
        if self._eager:
            self._eager -= 1
            return self._aside(batch)
        if self._graph is None:
            self._record(batch)
        for kept, new in zip(self._batch, batch, strict=True):
            kept.copy_(new)
        self._graph.replay()
        return self._terms

    def _aside(self, batch: Sequence[torch.Tensor]) -> Terms:
        """A step on a stream of its own, as PyTorch asks for before recording."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream), warnings.catch_warnings():
            # The optimizer is made to be recorded, and wonders that it is not.
            warnings.filterwarnings("ignore", message="This instance was constructed with capturable=True")
            terms = self._step(*batch)
        torch.cuda.current_stream().wait_stream(stream)
        return terms

    def _record(self, batch: Sequence[torch.Tensor]) -> None:
        self._batch = [x.clone() for x in batch]
        self._optimizer.zero_grad(set_to_none=True)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._terms = self._step(*self._batch)
