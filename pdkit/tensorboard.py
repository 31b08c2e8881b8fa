"""TensorBoard, for those who want it beside metrics.csv: `pdkit train decorated TASK --tensorboard`."""
from __future__ import annotations

from pathlib import Path
from typing import Any

UNITS = ("step", "updates", "seconds")  # columns that say when, not what


class Board:
    """Event files in FOLDER/tensorboard: every number of a metrics row against the environment step."""

    def __init__(self, folder: Path):
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder / "tensorboard"))
        self._written: set[tuple[int, str]] = set()

    def update(self, rows: list[dict[str, Any]]) -> None:
        """Write what is new; evaluations come back later than the row to which they belong."""
        for row in rows:
            for name, value in row.items():
                if name not in UNITS and (row["step"], name) not in self._written:
                    self._written.add((row["step"], name))
                    self._writer.add_scalar(name, value, row["step"])
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
