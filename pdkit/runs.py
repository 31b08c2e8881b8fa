"""A run's folder: manifest.json (what was asked, with what, where), metrics.csv, checkpoint/ (safetensors + json)."""
from __future__ import annotations

import platform
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .errors import PdkitError
from .files import ROOT, atomic_file, atomic_folder, code_checksum, locked, read_json, recover, sha256, write_json
from .machine import cores, cpu_has_bf16

PACKAGES = ("torch", "numpy", "gymnasium", "gymnasium-robotics", "mujoco", "mani-skill", "sapien")

NO_MATTER = {"env_workers", "eval_workers", "checkpoint_every"}  # results do not depend on these: a run may go on with others


def commit() -> str:
    """The commit of this working copy, "+changes" behind it where files differ from it, recorded results aside; "unknown" outside git."""
    try:
        head = ["git", "rev-parse", "HEAD"]
        found = subprocess.run(head, cwd=ROOT, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
        status = ["git", "status", "--porcelain", "--", ".", ":(exclude)data/results"]
        dirty = subprocess.run(status, cwd=ROOT, capture_output=True, text=True, check=True, timeout=10).stdout
        return found + ("+changes" if dirty.strip() else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def describe_machine() -> dict[str, Any]:
    """Versions, processor count, threads, whether the CPU computes in bfloat16 (where it does not, bf16=True means float32) and the GPU's
    name (false without one), for the manifest."""
    import torch

    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    return {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}", "cores": cores(),
            "torch_threads": torch.get_num_threads(), "cpu_bf16": cpu_has_bf16(),
            "cuda": torch.cuda.is_available() and torch.cuda.get_device_name(), "versions": versions, "git": commit()}


def origin(base_card: dict[str, Any], demos: Any | None, encoder: Any | None = None, objects: str = "") -> dict[str, Any]:
    """What a run starts from, for its manifest: checksums of the base policy (of its card), of the demonstrations, how many, of the
    encoder where there is one, and whose objects it meets (tasks.partnet.object_set) where they are not generated."""
    found = {"base": base_card["weights_sha256"], "demos": demos.checksum if demos else None, "num_demos": demos.num if demos else 0}
    return found | ({"encoder": encoder.checksum} if encoder else {}) | ({"objects": objects} if objects else {})


def machines(manifest: dict[str, Any]) -> list[dict[str, Any]]:
    """Where and with which code a run was computed, as `describe_machine` tells it: a first entry, and one for each change on resuming."""
    return [manifest["machine"], *(one["machine"] for one in manifest.get("resumed", ()))]


def commits(manifest: dict[str, Any]) -> str:
    """The commit of a run, or all of those that had a part in it, in order."""
    return " then ".join(dict.fromkeys(machine["git"] for machine in machines(manifest)))


def only_here(folder: Path) -> AbstractContextManager[None]:
    """Within this block no other process works in this folder. Raises PdkitError where one does."""
    return locked(folder / "lock", f"Another process is at work in {folder}; wait for it, or choose another folder.")


class Run:
    """One run folder. Opening an existing one with the same parameters resumes it; with other parameters is an error.

    Of parameters that are newer than the run, which its manifest does not tell, it had the `defaults`.
    """

    def __init__(self, folder: str | Path, kind: str, parameters: dict[str, Any], defaults: Mapping[str, Any] | None = None):
        self.folder = Path(folder)
        self.manifest_path = self.folder / "manifest.json"
        recover(self.folder / "checkpoint")
        if self.manifest_path.exists():
            self.manifest = read_json(self.manifest_path)
            self._must_match(kind, parameters, defaults or {})
        elif self.has_checkpoint:
            raise PdkitError(f"{self.folder} holds a checkpoint without the manifest.json that would tell of what; delete that folder.")
        else:
            self.manifest = {"kind": kind, "parameters": parameters, "started": _now(), "finished": None, "machine": describe_machine()}
            self._write_manifest()

    def _must_match(self, kind: str, parameters: dict[str, Any], defaults: Mapping[str, Any]) -> None:
        import json

        asked, usual = json.loads(json.dumps([parameters, dict(defaults)]))
        old = {name: usual[name] for name in usual.keys() & asked.keys()} | self.manifest.get("parameters", {})
        differing = sorted(k for k in (asked.keys() | old.keys()) - NO_MATTER if asked.get(k) != old.get(k))
        if self.manifest.get("kind") != kind or differing:
            raise PdkitError(f"{self.folder} holds another run (differing: {', '.join(differing) or 'kind'}); choose another folder or "
                             "delete this one.")

    def _write_manifest(self) -> None:
        write_json(self.manifest_path, self.manifest)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Within this block no other process works in this folder. Raises PdkitError where one does.

        Where an unfinished run goes on with other code or on another machine, its manifest says so (`resumed`).
        """
        with only_here(self.folder):
            self.manifest = read_json(self.manifest_path)
            if not self.finished:
                if (machine := describe_machine()) != machines(self.manifest)[-1]:
                    self.manifest.setdefault("resumed", []).append({"at": _now(), "machine": machine})
                self.manifest["code"] = list(dict.fromkeys([*self.manifest.get("code", ()), code_checksum()]))
                self._write_manifest()
            yield

    @property
    def finished(self) -> bool:
        return bool(self.manifest["finished"])

    def finish(self, **results: Any) -> None:
        """Mark the run complete and store its results in the manifest."""
        self.manifest |= {"finished": self.manifest["finished"] or _now(), "results": results}
        self._write_manifest()

    def already(self) -> str:
        """That a finished run is not trained again, and what to do for that, in a sentence."""
        changed = ", and the kit's code has changed since" if set(self.manifest.get("code", ())) - {code_checksum()} else ""
        return f"Trained already ({self.manifest['finished'][:16]} UTC{changed}); to train it again, delete {self.folder}"

    def write_metrics(self, rows: list[dict[str, Any]]) -> None:
        """metrics.csv, one row each."""
        with atomic_file(self.folder / "metrics.csv") as temporary:
            pd.DataFrame(rows).to_csv(temporary, index=False)

    @property
    def has_checkpoint(self) -> bool:
        return (self.folder / "checkpoint" / "state.json").exists()

    def save_checkpoint(self, arrays: dict[str, np.ndarray], values: dict[str, Any]) -> None:
        """Replace the checkpoint by named arrays and JSON values; after a crash there is the old one (`recover` puts it back)."""
        from safetensors.numpy import save_file

        with atomic_folder(self.folder / "checkpoint") as temporary:
            save_file({k: np.asarray(v, order="C") for k, v in arrays.items()}, temporary / "arrays.safetensors")
            write_json(temporary / "state.json", values | {"sha256": sha256(temporary / "arrays.safetensors"), "time": time.time()})

    def load_checkpoint(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The arrays and values saved last. Raises PdkitError when they were truncated or altered."""
        from safetensors.numpy import load_file

        folder = self.folder / "checkpoint"
        values = read_json(folder / "state.json")
        arrays = folder / "arrays.safetensors"
        if not arrays.exists() or sha256(arrays) != values.get("sha256"):
            raise PdkitError(f"The checkpoint in {folder} is truncated or altered; delete {self.folder} and start the run again.")
        return load_file(arrays), values


def kept_so_far(folder: Path) -> str:
    """What an interrupted training in `folder` has saved, to be followed by the command that goes on with it."""
    state = folder / "checkpoint" / "state.json"
    if not state.exists():
        return "Nothing had been saved yet; start again with:"
    return f"Training is saved up to step {read_json(state)['step']:,}; go on with:"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
