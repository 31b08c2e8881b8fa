"""Recorded results: tidy files in data/results, a row a training seed, and the picture drawn from them."""
from __future__ import annotations

import time
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
    for path, new in ((folder / f"{name}.csv", rows), (folder / f"{name}_curves.csv", curves)):
        tables.append(_merged(path, new))
        with atomic_file(path) as temporary:
            tables[-1].to_csv(temporary, index=False, float_format="%.6g")
    write_json(folder / f"{name}_manifest.json", {"written": time.strftime("%Y-%m-%d"), "machine": describe_machine(),
                                                 "again": sorted(set(tables[0].command))})
    with atomic_file(folder / f"{name}.png") as temporary:
        figure(*tables).savefig(temporary, dpi=130)


def _merged(path: Path, new: pd.DataFrame) -> pd.DataFrame:
    """The file's rows without those that `new` replaces, then `new`, sorted."""
    if path.exists():
        old = pd.read_csv(path)
        mine = new[KEYS].drop_duplicates()
        old = old.merge(mine, on=KEYS, how="left", indicator=True).query("_merge == 'left_only'").drop(columns="_merge")
        new = pd.concat([old, new], ignore_index=True)
    return new.sort_values([*KEYS, *(["step"] if "step" in new else [])], ignore_index=True)


def figure(table: pd.DataFrame, curves: pd.DataFrame, task: str = "Door") -> Figure:
    """Left: evaluations on selection seeds during training, a line a seed. Right: success on the test seeds, with intervals."""
    table, curves = table[table.task == task], curves[curves.task == task]
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), width_ratios=(3, 2), layout="constrained")
    for seed, curve in curves.dropna(subset=["success_once"]).groupby("seed"):
        left.plot(curve.step / 1000, 100 * curve.success_once, "-o", ms=3, lw=1.2, label=f"seed {seed}")
    base = 100 * float(table.base_success.iloc[0])
    left.axhline(base, color="0.4", ls="--", lw=1, label="base policy")
    left.set(xlabel="environment steps (thousands)", ylabel="success within the episode (%)", ylim=(0, 102),
             title=f"{task}: evaluations during training")
    left.legend(fontsize=8, loc="lower right")
    count = int(table.episodes.iloc[0])
    bars = {"base": table.base_success.iloc[0]} | {f"seed {row.seed}": row.decorated_success for row in table.itertuples()}
    for x, (name, value) in enumerate(bars.items()):
        rate = wilson(round(value * count), count)
        right.bar(x, 100 * value, color="0.65" if name == "base" else "#2c9f6b")
        right.errorbar(x, 100 * value, yerr=[[100 * (value - rate.low)], [100 * (rate.high - value)]], color="k", capsize=3, lw=1)
        right.text(x, 4, f"{100 * value:.0f}", ha="center", color="white", weight="bold", fontsize=9)
    right.set_xticks(range(len(bars)), list(bars), rotation=30, fontsize=8)
    right.set(ylabel="success within the episode (%)", ylim=(0, 102), title=f"{count} test episodes, 95 % intervals")
    for ax in (left, right):
        ax.spines[["top", "right"]].set_visible(False)
    plt.close(fig)
    return fig
