"""From a method's name to its configuration, its starting policy and its trainer."""
from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from ..demos import Demos
from ..errors import PdkitError, unknown
from ..files import DATA
from ..online import Trainer
from ..online_config import OnlineConfig
from ..policies import Policy
from ..profiles import online_config, policy_values
from ..tasks import get_task
from ..tasks.spec import TaskSpec
from . import METHODS, Method
from .config import MethodConfig


def get_method(name: str) -> Method:
    """The method of this name. Raises PdkitError for an unknown one."""
    if name not in METHODS:
        raise unknown("method", name, METHODS)
    return METHODS[name]


def method_config(method: str, task: str, profile: str = "lesson", seed: int = 0, /, policy: Policy | None = None,
                  **changes: Any) -> OnlineConfig:
    """The configuration of a method on a task: the task's profile, what it sets otherwise over this base policy where the method acts
    in its chunks, then the method's changes, then `changes` (flat names).

    Raises PdkitError for a change that the method's trainer never looks at: two runs that differ in it alone would be the same run.
    (Settings that others switch off, such as calql_rollouts without calql_data="mixed", are taken.)
    """
    m = get_method(method)
    check_read(method, changes)
    own = m.changes | {"lesson": m.lesson, "smoke": m.lesson, "paper": m.paper}.get(profile, {})
    sees_state = policy is None or policy.config["obs_dim"] == get_task(task).obs_dim  # and not what an encoder makes of pictures
    chunks = policy is not None and trainer_of(method).chunks
    over = policy_values(task, profile, policy.kind, policy.chunk, not sees_state) if chunks else {}
    over |= {} if trainer_of(method).sees_features and sees_state else {"features": False}
    return online_config(task, profile, seed, **({"method": method} | over | own | changes))


def check_read(method: str, changes: dict[str, Any]) -> None:
    """Raises PdkitError for those of `changes` that the method's trainer never looks at."""
    trainer, own = trainer_of(method), MethodConfig.__dataclass_fields__
    unread = [name for name in changes if name in trainer.unread or (name in own and not name.startswith(trainer.reads))]
    if unread:
        raise PdkitError(f"{get_method(method).title} does not read {', '.join(unread)}; leave that out.")


def base_folder(method: str, task: str) -> Path:
    """Where the shipped policy lies that a method starts from. Raises PdkitError where the kit has none for this task."""
    m, folder = get_method(method), DATA / "checkpoints" / get_task(task).name / get_method(method).base
    if not (folder / "policy.json").exists():
        kind = "" if m.base == "base" else f" --policy {m.base}"
        have = ", ".join(sorted(path.parts[-3] for path in (DATA / "checkpoints").glob(f"*/{m.base}/policy.json"))) or "no task"
        raise PdkitError(f"{m.title} starts from a policy that comes with the kit for {have}, not for {task}: train one with "
                         f"`pdkit train base {task}{kind}` and give its folder as the base (--base).")
    return folder


def make_trainer(config: OnlineConfig, base: Policy, demos: Demos | None = None, spec: TaskSpec | None = None) -> Trainer:
    """The trainer of the method named in `config`."""
    return trainer_of(config.method)(config, base, demos, spec)


def trainer_of(method: str) -> type[Trainer]:
    """The class that runs a method."""
    module, name = get_method(method).trainer.split(":")
    return getattr(importlib.import_module(module), name)
