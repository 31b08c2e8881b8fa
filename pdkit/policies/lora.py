"""Low-rank adapters (LoRA; Hu et al., 2021; peft) on all layers of a policy that peft can adapt, and back to plain weights.

peft adapts nn.Linear and nn.Conv1d. It refuses nn.ConvTranspose1d and has nothing for normalisation: of Diffusion Policy's U-Net the
layers that double the time again (`grow`) and the scales and shifts of GroupNorm therefore stay as imitated, and all others have adapters.
"""
from __future__ import annotations

import copy
from typing import TypeVar

from torch import nn

ADAPTED = (nn.Linear, nn.Conv1d)
Module = TypeVar("Module", bound=nn.Module)


def with_lora(module: Module, rank: int) -> Module:
    """A copy that acts as `module` does, in which adapters of this rank alone train; with rank 0 all weights do."""
    from peft import LoraConfig, inject_adapter_in_model

    adapted = copy.deepcopy(module).requires_grad_(not rank)
    if rank:
        names = [name for name, part in adapted.named_modules() if isinstance(part, ADAPTED)]
        inject_adapter_in_model(LoraConfig(r=rank, lora_alpha=rank, target_modules=names), adapted)
    return adapted


def merged(module: Module) -> Module:
    """A copy without adapters, whose plain weights do what weights and adapters did together."""
    from peft.tuners.tuners_utils import BaseTunerLayer

    plain = copy.deepcopy(module)
    for name, part in list(plain.named_modules()):
        if isinstance(part, BaseTunerLayer):
            part.merge()
            parent, _, own = name.rpartition(".")
            setattr(plain.get_submodule(parent), own, part.get_base_layer())
    return plain.requires_grad_(True)
