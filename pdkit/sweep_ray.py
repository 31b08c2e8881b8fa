"""The same jobs on Ray: this machine's (`--ray`) or a cluster's (`--address`). Ray is not part of the environment."""
from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from .errors import PdkitError
from .files import ROOT, write_json
from .sweep_run import ONE_THREAD, Job, JobFunction, reason, work


def must_be_installed() -> None:
    """Raises PdkitError where Ray is missing."""
    if find_spec("ray") is None:
        raise PdkitError("Ray is not installed; run `pip install ray`, or leave out --ray and --address to use local workers.")


def on_ray(function: JobFunction, job: Job) -> dict[str, Any]:
    """`work` in a worker of Ray, with the exit codes of what it starts."""
    _keep_exit_codes(signal.SIG_DFL)
    return work(function, job)


def _keep_exit_codes(handler: Any) -> None:
    """Undo what Ray does to a process when it is to end children: SIGCHLD ignored, so that each seems to exit with 0."""
    if threading.current_thread() is threading.main_thread():  # no other may
        signal.signal(signal.SIGCHLD, handler)


class Ray:
    """A Ray task for each job, never retried.

    On a cluster every node needs this project, and the results' folder, under the same path; PDKIT_PARTNET goes along.
    """

    def __init__(self, address: str | None, workers: int | None):
        must_be_installed()
        # Ray would leave the training of a killed worker running; it reads this when it starts.
        os.environ.setdefault("RAY_kill_child_processes_on_worker_exit_with_raylet_subreaper", "true")
        import ray

        self._ray = ray
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        before = signal.getsignal(signal.SIGCHLD) or signal.SIG_DFL
        handed = {"PYTHONPATH": path} | {name: os.environ[name] for name in ("PDKIT_PARTNET",) if name in os.environ}
        own = {"address": address} if address else {"address": "local", "num_cpus": workers or 2, "include_dashboard": False}
        try:
            ray.init(**own, log_to_driver=False, logging_level="error", runtime_env={"env_vars": ONE_THREAD | handed})
        except Exception as error:  # ConnectionError, ValueError, RuntimeError ...: depends on what is wrong with the address
            raise PdkitError(f"Ray does not start at {address or 'this machine'}: {reason(error)[:200].rstrip('.')}.") from None
        _keep_exit_codes(before)
        self.limit = workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._work = ray.remote(num_cpus=1, max_retries=0)(on_ray)

    def start(self, function: JobFunction, job: Job) -> Any:
        return self._work.remote(function, job)

    def ended(self, handles: Sequence[Any], timeout: float) -> list[Any]:
        return self._ray.wait(list(handles), num_returns=1, timeout=timeout)[0]

    def problem(self, handle: Any, job: Job) -> str:
        try:
            write_json(job.result, self._ray.get(handle))
        except self._ray.exceptions.RayTaskError as error:
            return reason(error.cause)
        except self._ray.exceptions.RayError as error:
            return f"its worker was lost ({type(error).__name__})"
        except (PdkitError, TypeError) as error:  # a full disk; a result that is no JSON
            return reason(error)
        return ""

    def stop(self, handles: Sequence[Any]) -> None:
        for handle in handles:
            self._ray.cancel(handle)
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._ray.wait(list(handles), num_returns=len(handles), timeout=10.0) if handles else None
        self._ray.shutdown()
