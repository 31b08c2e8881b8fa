"""How far a sweep is, and how long it will take."""
from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from .durations import duration
from .nb import Line
from .sweep_run import Job


class Progress:
    """How many jobs are done, running and failed, and the time left: one line on a terminal, a line a change elsewhere."""

    def __init__(self, jobs: Sequence[Job], done: int, limit: int, measured: Sequence[tuple[str, float, float | None]] = ()):
        """measured: (like, seconds, expected minutes) of jobs that were finished before."""
        self.total, self.done, self.limit = len(jobs) + done, done, limit
        self.waiting, self.running, self.failed = list(jobs), {}, 0
        self._measured, self._line, self._terminal = list(measured), Line(every=1.0), sys.stdout.isatty()

    def started(self, job: Job) -> None:
        self.waiting.remove(job)
        self.running[job.name] = (job, time.monotonic())
        self._say("started", job)

    def ended(self, job: Job, problem: str) -> None:
        _, since = self.running.pop(job.name)
        if problem:
            self.failed += 1
        else:
            self.done += 1
            self._measured.append((job.like, time.monotonic() - since, job.minutes))
        self._say("failed" if problem else "finished", job)

    def tick(self) -> None:
        if self._terminal:
            self._line.update(self.text())

    def close(self) -> None:
        if self._terminal:
            self._line.close(self.text())

    def _say(self, event: str, job: Job) -> None:
        if self._terminal:
            self._line.update(self.text())
        else:
            print(f"{event} {job.name}; {self.text()}", flush=True)

    def text(self) -> str:
        counts = f"{self.done} of {self.total} done, {len(self.running)} running, {self.failed} failed"
        if not self.waiting and not self.running:
            return counts
        left = self.seconds_left()
        return counts + (", time left not known yet" if left is None else f", {duration(left / 60)} left")

    def seconds_left(self) -> float | None:
        """An estimate from what each job is expected to take and what jobs like it took; None while nothing is known."""
        now = time.monotonic()
        each = [(self.seconds(job), 0.0) for job in self.waiting]
        each += [(self.seconds(job), now - since) for job, since in self.running.values()]
        if any(expected is None for expected, _ in each):
            return None
        left = [max(expected - elapsed, 0.0) for expected, elapsed in each]
        return max(sum(left) / self.limit, max(left, default=0.0))

    def seconds(self, job: Job) -> float | None:
        """How long a job will take: expected, corrected by how far off that was for jobs like it (else, for any)."""
        alike = [m for m in self._measured if m[0] == job.like]
        if job.minutes is None:
            return sum(seconds for _, seconds, _ in alike) / len(alike) if alike else None
        known = [(seconds, 60 * minutes) for _, seconds, minutes in alike or self._measured if minutes]
        return 60 * job.minutes * (sum(s for s, _ in known) / sum(e for _, e in known) if known else 1.0)
