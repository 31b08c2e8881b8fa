"""The registry of tasks: `get_task("Door")`, and one vectorised environment for all of them."""
from __future__ import annotations

from ..errors import unknown
from .adroit import ADROIT_TASKS
from .chair import CHAIR_TASKS
from .maniskill import MANISKILL_TASKS
from .spec import Sim, TaskSpec

TASKS: dict[str, TaskSpec] = {spec.name: spec for spec in (*MANISKILL_TASKS, *CHAIR_TASKS, *ADROIT_TASKS)}


def get_task(name: str) -> TaskSpec:
    """The task called `name`. Raises PdkitError listing the known names."""
    if name not in TASKS:
        raise unknown("task", name, TASKS)
    return TASKS[name]


__all__ = ["TASKS", "Sim", "TaskSpec", "get_task"]
