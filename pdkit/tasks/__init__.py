"""The registry of tasks: `get_task("Door")`, and one vectorised environment for all of them."""
from __future__ import annotations

from ..errors import unknown
from .adroit import ADROIT_TASKS
from .chair import CHAIR_TASKS
from .faucet import TURN_FAUCET, TURN_FAUCET_SOURCE
from .peg import PEG_INSERTION_SIDE
from .spec import Sim, TaskSpec
from .stack_cube import STACK_CUBE

_ALL = (STACK_CUBE, PEG_INSERTION_SIDE, TURN_FAUCET, TURN_FAUCET_SOURCE, *CHAIR_TASKS, *ADROIT_TASKS)
TASKS: dict[str, TaskSpec] = {spec.name: spec for spec in _ALL}


def get_task(name: str) -> TaskSpec:
    """The task called `name`. Raises PdkitError listing the known names."""
    if name not in TASKS:
        raise unknown("task", name, TASKS)
    return TASKS[name]


__all__ = ["TASKS", "Sim", "TaskSpec", "get_task"]
