"""Device, threads and precision, set in one place and always explicitly."""
from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator

import torch

from .errors import PdkitError
from .machine import cpu_has_bf16


def set_threads(num: int) -> None:
    """Use `num` threads for matrix work in this process. Two processes with two threads each on two cores are ten times slower."""
    torch.set_num_threads(max(1, num))


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Within this block torch computes with one thread: what one process does must round as it would in a worker."""
    threads = torch.get_num_threads()
    if threads > 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if threads > 1:
            torch.set_num_threads(threads)


def pick_device(name: str = "auto") -> str:
    """`name`, or with "auto" CUDA where there is one. Raises PdkitError when the device asked for is not there."""
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise PdkitError("No CUDA device was found; choose cpu as the device, or check the driver with `pdkit doctor`.")
    if name not in ("cpu", "cuda"):
        raise PdkitError(f"Unknown device {name!r}; choose one of: auto, cpu, cuda.")
    return name


@functools.cache
def has_bf16(device: str = "cpu") -> bool:
    """Whether bfloat16 matrix products are done by the hardware (emulated ones are slower than float32)."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capability = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    flags = {k.lower() for k, v in capability.items() if v}
    return bool(flags & {"avx512_bf16", "amx_bf16", "bf16"}) or cpu_has_bf16()


def autocast(device: str, enabled: bool):
    """Autocast to bfloat16 where `enabled` and the hardware has it."""
    if enabled and has_bf16(device):
        return torch.autocast(device, torch.bfloat16)
    return contextlib.nullcontext()
