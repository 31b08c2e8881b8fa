"""Networks and optimisers as named tensors, and back: what a learner adds to a checkpoint."""
from __future__ import annotations

import torch
from torch import nn


def pack(modules: dict[str, nn.Module], optimizers: dict[str, torch.optim.Optimizer]) -> dict[str, torch.Tensor]:
    """Everything in them that training goes on from; names must not be prefixes of each other up to a dot."""
    tensors = {}
    for name, module in modules.items():
        tensors |= {f"{name}.{k}": v for k, v in module.state_dict().items()}
    for name, optimizer in optimizers.items():
        for i, slots in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}.{i}.{slot}": value for slot, value in slots.items()}
    return tensors


def unpack(tensors: dict[str, torch.Tensor], modules: dict[str, nn.Module], optimizers: dict[str, torch.optim.Optimizer]) -> None:
    """Restore what `pack` gave."""
    for name, module in modules.items():
        module.load_state_dict({k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")})
    for name, optimizer in optimizers.items():
        state: dict[int, dict[str, torch.Tensor]] = {}
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        for key, value in tensors.items():
            if key.startswith(f"{name}."):
                _, index, slot = key.split(".")
                like = parameters[int(index)]
                # Numbers lie in memory as the parameter's do (a convolution's may have their channels last): fused kernels rely on it.
                same = torch.empty_like(like, dtype=value.dtype).copy_(value) if value.shape == like.shape else value.clone()
                state.setdefault(int(index), {})[slot] = same
        optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
