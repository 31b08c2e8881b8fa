"""Replay: one row a transition, and the n-step accumulator that makes the rows.

Columns: obs | residual | base | reward | next_obs | next_base | discount. `base` and `next_base` are the base policy's actions
at s and s', stored so that it is never run twice for one observation. `reward` sums the n-step rewards, each
discounted; `discount` is what the value of s' is multiplied by: gamma^k, or 0 where the episode stopped.
"""
from __future__ import annotations

from collections import deque

import numpy as np
import torch

COLUMNS = ("obs", "residual", "base", "reward", "next_obs", "next_base", "discount")


class Replay:
    """A ring of transitions in one float32 matrix, so that sampling is one gather. After COLUMNS come those of `wide` (name -> width),
    then those of `extra`, one number each."""

    def __init__(self, capacity: int, obs_dim: int, act_dim: int, device: str = "cpu", extra: tuple[str, ...] = (),
                 wide: dict[str, int] | None = None):
        usual = dict(zip(COLUMNS, (obs_dim, act_dim, act_dim, 1, obs_dim, act_dim, 1), strict=True))
        widths = usual | (wide or {}) | dict.fromkeys(extra, 1)
        ends = np.cumsum(list(widths.values()))
        self.slices = {name: slice(int(e - w), int(e)) for (name, w), e in zip(widths.items(), ends, strict=True)}
        self.scalars = ("reward", "discount", *extra)
        self.rows = torch.zeros(capacity, int(ends[-1]), device=device)
        self.capacity, self.size, self.position = capacity, 0, 0

    def add(self, rows: list[np.ndarray]) -> None:
        """Append rows (F,), overwriting the oldest when full."""
        if not rows:
            return
        block = torch.from_numpy(np.stack(rows)).to(self.rows.device)
        where = (self.position + torch.arange(len(rows))) % self.capacity
        self.rows[where] = block
        self.position = (self.position + len(rows)) % self.capacity
        self.size = min(self.size + len(rows), self.capacity)

    def draw(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """`count` rows drawn uniformly with replacement, (count, F)."""
        return self.rows[torch.randint(self.size, (count,), generator=generator).to(self.rows.device)]

    def unpack(self, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        """Columns by name; reward, discount and the extra ones as (B,)."""
        return {name: rows[:, s.start] if name in self.scalars else rows[:, s] for name, s in self.slices.items()}


class NStep:
    """Turns a stream of one-step transitions per lane into rows with n-step returns.

    At the end of an episode the transitions still waiting are written with the shorter return they have.
    """

    def __init__(self, num_envs: int, n: int, gamma: float):
        self.n, self.gamma = n, gamma
        self.waiting: list[deque] = [deque() for _ in range(num_envs)]

    def push(self, lane: int, obs, residual, base, reward: float, next_obs, next_base, stop: bool, done: bool) -> list[np.ndarray]:
        """Add one transition; the rows that are complete now.

        Args:
            stop: do not bootstrap from s' (the episode terminated, by the rule in force).
            done: the episode is over (terminated or truncated): flush.
        """
        queue = self.waiting[lane]
        queue.append((obs, residual, base, reward))
        rows = []
        while queue and (len(queue) == self.n or done):
            total = sum(self.gamma**k * item[3] for k, item in enumerate(queue))
            discount = 0.0 if stop else self.gamma ** len(queue)
            first = queue.popleft()
            rows.append(np.concatenate([first[0], first[1], first[2], [total], next_obs, next_base, [discount]]).astype(np.float32))
        return rows

    def state(self) -> dict[str, np.ndarray]:
        """Everything waiting, as arrays."""
        items = [np.concatenate([o, r, b, [w]]) for queue in self.waiting for o, r, b, w in queue]
        return {"counts": np.array([len(q) for q in self.waiting], np.int64),
                "items": np.stack(items).astype(np.float64) if items else np.zeros((0, 0))}

    def load(self, state: dict[str, np.ndarray], obs_dim: int, act_dim: int) -> None:
        rows = iter(state["items"])
        for queue, count in zip(self.waiting, state["counts"], strict=True):
            queue.clear()
            for _ in range(int(count)):
                o, r, b, w = np.split(next(rows), [obs_dim, obs_dim + act_dim, obs_dim + 2 * act_dim])
                queue.append((o.astype(np.float32), r.astype(np.float32), b.astype(np.float32), float(w[0])))
