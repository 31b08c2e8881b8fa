"""The demonstration file: one .safetensors (never pickle) with arrays, provenance and a checksum, all checked on load.

Arrays, for N episodes of T_i primitive steps: observations (sum(T_i) + N, obs_dim) float32, the last one of an episode
being the one after its last action; actions (sum(T_i), act_dim) float32 in [-1, 1]; success (sum(T_i),) bool, judged
after each step; lengths (N,) and seeds (N,) int64 (-1 where the episode cannot be reset from a seed).
"""
from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PdkitError
from ..files import atomic_file
from ..seeds import ROLLOUT, TEST
from ..tasks import get_task
from ..tasks.partnet import object_set
from ..tasks.spec import TaskSpec

FORMAT = "pdkit-demos-1"
LABELS = ("scripted", "agent", "human")  # who acted
_DTYPES = {"observations": np.float32, "actions": np.float32, "success": np.bool_, "lengths": np.int64, "seeds": np.int64}


@dataclass(frozen=True)
class Demos:
    """Demonstrations of one task."""

    task: str
    label: str  # one of LABELS
    how: str  # one sentence: how they were made
    command: str  # what makes them again
    observations: np.ndarray
    actions: np.ndarray
    success: np.ndarray
    lengths: np.ndarray
    seeds: np.ndarray
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def num(self) -> int:
        return len(self.lengths)

    @property
    def checksum(self) -> str:
        """SHA-256 over all arrays."""
        digest = hashlib.sha256()
        for name, dtype in _DTYPES.items():
            digest.update(np.ascontiguousarray(getattr(self, name), dtype).tobytes())
        return digest.hexdigest()

    def episode(self, i: int) -> dict[str, np.ndarray]:
        """Episode i: observations (T+1, obs_dim), actions (T, act_dim), success (T,)."""
        start, length = int(self.lengths[:i].sum()), int(self.lengths[i])
        return {"observations": self.observations[start + i: start + i + length + 1],
                "actions": self.actions[start: start + length], "success": self.success[start: start + length]}

    def episodes(self):
        """All episodes, in order."""
        return (self.episode(i) for i in range(self.num))

    def first(self, num: int) -> Demos:
        """The first `num` episodes. Raises PdkitError when there are fewer."""
        if not 1 <= num <= self.num:
            raise PdkitError(f"These {self.task} demonstrations hold {self.num} episodes, so num_demos must be 1 to {self.num}, not {num}.")
        steps = int(self.lengths[:num].sum())
        return Demos(self.task, self.label, self.how, self.command, self.observations[: steps + num], self.actions[:steps],
                     self.success[:steps], self.lengths[:num], self.seeds[:num], self.extra)


def from_episodes(task: str, episodes: list[dict[str, Any]], *, label: str, how: str, command: str, spec: TaskSpec | None = None,
                  **extra: Any) -> Demos:
    """Demos from a list of dicts with observations (T+1, obs_dim), actions (T, act_dim), success (T,) and seed."""
    if not episodes:
        raise PdkitError(f"No {task} episode to keep: every attempt failed.")
    if objects := object_set(spec or get_task(task)):
        extra = {"objects": objects} | extra
    made = Demos(
        task, label, how, command,
        np.concatenate([e["observations"] for e in episodes]).astype(np.float32),
        np.concatenate([e["actions"] for e in episodes]).astype(np.float32),
        np.concatenate([e["success"] for e in episodes]).astype(np.bool_),
        np.array([len(e["actions"]) for e in episodes], np.int64),
        np.array([e.get("seed", -1) for e in episodes], np.int64), extra)
    return validate(made, spec=spec)


def validate(demos: Demos, where: str = "demonstrations", spec: TaskSpec | None = None) -> Demos:
    """`demos` itself if every shape, range and label is right; otherwise PdkitError naming the first thing that is not.

    `spec` is for worlds outside the registry, such as the probes.
    """
    spec = spec or get_task(demos.task)
    total, num = int(demos.lengths.sum()), demos.num
    problems = [
        (demos.label not in LABELS, f"label {demos.label!r} is none of {', '.join(LABELS)}"),
        (num == 0 or (demos.lengths < 1).any(), "an episode is empty"),
        (demos.observations.shape != (total + num, spec.obs_dim),
         f"observations have shape {demos.observations.shape}, {spec.name} needs {(total + num, spec.obs_dim)}"),
        (demos.actions.shape != (total, spec.act_dim),
         f"actions have shape {demos.actions.shape}, {spec.name} needs {(total, spec.act_dim)}"),
        (demos.success.shape != (total,), f"success has shape {demos.success.shape}, not {(total,)}"),
        (demos.seeds.shape != (num,), f"seeds have shape {demos.seeds.shape}, not {(num,)}"),
        (not np.isfinite(demos.observations).all() or not np.isfinite(demos.actions).all(), "a number is NaN or infinite"),
        (demos.actions.size > 0 and float(np.abs(demos.actions).max(initial=0)) > 1.0 + 1e-6, "an action lies outside [-1, 1]"),
    ]
    for wrong, what in problems:
        if wrong:
            raise PdkitError(f"Bad {where}: {what}; make the file again with `pdkit demos {demos.task}`.")
    return demos


def save_demos(demos: Demos, path: str | Path) -> None:
    """Write `demos` to `path` (.safetensors), atomically.

    Raises PdkitError, too, for episodes with seeds of the tests or of choosing policies: what learned from them would be tested on them.
    """
    from safetensors.numpy import save_file

    validate(demos)
    if ((demos.seeds >= TEST) & (demos.seeds < ROLLOUT)).any():
        raise PdkitError(f"An episode has a seed from {TEST:,} to {ROLLOUT - 1:,}, and these are for testing and for choosing policies; "
                         "make demonstrations from others.")
    card = {"format": FORMAT, "task": demos.task, "label": demos.label, "how": demos.how, "command": demos.command,
            "checksum": demos.checksum, "extra": demos.extra}
    arrays = {name: np.ascontiguousarray(getattr(demos, name), dtype) for name, dtype in _DTYPES.items()}
    with atomic_file(path) as temporary:
        save_file(arrays, temporary, metadata={"pdkit": json.dumps(card)})


def load_demos(path: str | Path) -> Demos:
    """The demonstrations in `path`.

    Raises PdkitError when the file is missing, truncated, altered (checksum), foreign, or of wrong shapes or ranges.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        raise PdkitError(f"{path} does not exist; `pdkit demos --list` shows which demonstrations there are.")
    try:
        with safe_open(path, framework="numpy") as handle:
            card = json.loads((handle.metadata() or {}).get("pdkit", "{}"))
            arrays = {name: handle.get_tensor(name) for name in handle.keys()}
    except (SafetensorError, OSError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise PdkitError(f"{path} is not a readable demonstration file (truncated or another format); restore it or make it again "
                         "with `pdkit demos`.") from error
    known = isinstance(card, dict) and card.get("format") == FORMAT and {"task", "label", "how", "command", "checksum"} <= set(card)
    if not known or set(arrays) != set(_DTYPES):
        raise PdkitError(f"{path} is not a {FORMAT} file; it was written by something else.")
    for name, dtype in _DTYPES.items():
        if arrays[name].dtype != dtype:
            raise PdkitError(f"{path} is altered: {name} is {arrays[name].dtype}, not {np.dtype(dtype).name}; restore the file.")
    demos = Demos(card["task"], card["label"], card["how"], card["command"], **arrays, extra=card.get("extra", {}))
    validate(demos, str(path))
    if demos.checksum != card["checksum"]:
        raise PdkitError(f"{path} was altered: its checksum does not match; restore the file.")
    return demos
