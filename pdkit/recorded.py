"""Recorded results: tidy files in data/results, a row a training seed, and the picture drawn from them."""
from __future__ import annotations

import contextlib
import fcntl
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure

from .files import DATA, atomic_file, write_json
from .runs import describe_machine
from .stats import wilson

KEYS = ["task", "recipe", "seed"]  # a row with the same ones is replaced


def record(name: str, rows: pd.DataFrame, curves: pd.DataFrame) -> None:
    """Add rows to data/results/NAME.csv and NAME_curves.csv, and draw NAME.png anew."""
    folder = DATA / "results"
    tables = []
    with _alone(name):
        for path, new in ((folder / f"{name}.csv", rows), (folder / f"{name}_curves.csv", curves)):
            tables.append(_merged(path, new))
            with atomic_file(path) as temporary:
                tables[-1].to_csv(temporary, index=False, float_format="%.6g")
        write_json(folder / f"{name}_manifest.json", {"written": time.strftime("%Y-%m-%d"), "machine": describe_machine(),
                                                     "again": sorted(set(tables[0].command))})
        with atomic_file(folder / f"{name}.png") as temporary:
            figure(*tables, "Door" if "Door" in set(tables[0].task) else str(rows.task.iloc[0])).savefig(temporary, dpi=130)


@contextlib.contextmanager
def _alone(name: str) -> Iterator[None]:
    """Wait until no other process records: two trainings that end together must not lose each other's rows."""
    with open(Path(tempfile.gettempdir()) / f"pdkit-record-{name}.lock", "w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def _merged(path: Path, new: pd.DataFrame) -> pd.DataFrame:
    """The file's rows without those that `new` replaces, then `new`, sorted."""
    if path.exists():
        old = pd.read_csv(path)
        mine = new[KEYS].drop_duplicates()
        old = old.merge(mine, on=KEYS, how="left", indicator=True).query("_merge == 'left_only'").drop(columns="_merge")
        new = pd.concat([old, new], ignore_index=True)
    return new.sort_values([*KEYS, *(["step"] if "step" in new else [])], ignore_index=True)


def figure(table: pd.DataFrame, curves: pd.DataFrame, task: str = "Door") -> Figure:
    """Left: evaluations on selection seeds during training, a line a run. Right: success on the test seeds, with intervals.

    Runs are named by their recipe where there are several recipes, by their seed otherwise.
    """
    table, curves = table[table.task == task], curves[curves.task == task]
    several = table.recipe.nunique() > 1
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4 if several else 3.6), width_ratios=(3, 2), layout="constrained")
    colors = plt.get_cmap("tab20" if several else "tab10")
    bars = [("base", table.base_success.iloc[0], "0.65")]  # the first row's; a recipe with another base policy is named so
    for i, row in enumerate(table.itertuples()):
        name, color = (f"{row.recipe}, seed {row.seed}" if several else f"seed {row.seed}"), colors(i % colors.N)
        curve = curves[(curves.recipe == row.recipe) & (curves.seed == row.seed)].dropna(subset=["success_once"])
        left.plot(curve.step / 1000, 100 * curve.success_once, "-o", ms=3, lw=1.2, color=color, label=name)
        bars.append((name, row.decorated_success, color if several else "#2c9f6b"))
    left.axhline(100 * table.base_success.iloc[0], color="0.4", ls="--", lw=1, label="base policy")
    left.set(xlabel="environment steps (thousands)", ylabel="success within the episode (%)", ylim=(0, 102),
             title=f"{task}: evaluations during training")
    if not several:
        left.legend(fontsize=8, loc="lower right")
    count = int(table.episodes.iloc[0])
    for y, (_, value, color) in enumerate(reversed(bars)):
        rate = wilson(round(value * count), count)
        right.barh(y, 100 * value, color=color)
        right.errorbar(100 * value, y, xerr=[[100 * (value - rate.low)], [100 * (rate.high - value)]], color="k", capsize=3, lw=1)
        right.text(3, y, f"{100 * value:.0f}", va="center", color="white", weight="bold", fontsize=8)
    right.set_yticks(range(len(bars)), [name for name, _, _ in reversed(bars)], fontsize=8)
    right.set(xlabel="success within the episode (%)", xlim=(0, 102), title=f"{count} test episodes, 95 % intervals")
    for ax in (left, right):
        ax.spines[["top", "right"]].set_visible(False)
    plt.close(fig)
    return fig
