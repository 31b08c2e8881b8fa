"""The figure of all tasks (notebook 16): from base to decorated policy, beside the paper's averages."""
from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.lines import Line2D

from .plots import COLORS, Picture, _columns, blank, styled


@styled
def range_figure(tasks: pd.DataFrame, averages: pd.DataFrame, title: str = "") -> Picture:
    """Rows of `task_range.by_task`, an arrow from base to decorated success with intervals; below the tasks of a suite the mean, and
    the paper's as open marks."""
    _columns(tasks, "task", "suite", "base", "decorated", "low", "high", "seeds")
    lines, y = [], 0.0
    for suite, rows in tasks.groupby("suite", sort=False):
        lines += [(y + i, row) for i, row in enumerate(rows.itertuples())]
        y += len(rows)
        lines.append((y, averages[averages.over == suite].iloc[0]))
        y += 1.6
    figure, axes = blank(size=(8.2, 0.9 + 0.34 * y))
    ax, labels = axes[0, 0], {}
    for at, row in lines:
        if hasattr(row, "task"):
            seeds = "not recorded" if not row.seeds else f"{row.seeds} seed{'s' if row.seeds > 1 else ''}"
            labels[at] = f"{row.task} ({seeds})"
            if row.seeds:
                _way(ax, at, row.base, row.decorated)
                for low, high, color in ((row.base_low, row.base_high, "base"), (row.low, row.high, "decorated")):
                    ax.plot([low, high], [at, at], color=COLORS[color], lw=5, alpha=0.25, solid_capstyle="butt", zorder=1)
        else:
            labels[at] = f"mean, {row.tasks} tasks"
            if np.isfinite(row.decorated):
                _way(ax, at, row.base, row.decorated, "D")
            ax.plot(row.paper_base, at, "s", ms=8, mfc="none", color=COLORS["base"])
            ax.plot(row.paper_decorated, at, "s", ms=8, mfc="none", color=COLORS["decorated"])
    ax.set_yticks(list(labels), list(labels.values()))
    for tick, (_, row) in zip(ax.get_yticklabels(), lines, strict=True):
        tick.set_fontweight("normal" if hasattr(row, "task") else "bold")
    ax.set(ylim=(y - 0.9, -0.7), xlim=(0, 1.03), xlabel="success within the episode", title=title)
    ax.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    ax.grid(axis="y", visible=False)
    marks = [("o", COLORS["base"], COLORS["base"], "base policy"), ("o", COLORS["decorated"], COLORS["decorated"], "decorated"),
             ("s", "none", "0.3", "the paper's mean, four tasks")]
    handles = [Line2D([], [], marker=m, ls="", mfc=fill, color=edge, label=label) for m, fill, edge, label in marks]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8.5)
    return figure


def _way(ax, at: float, start: float, end: float, marker: str = "o") -> None:
    ax.annotate("", (end, at), (start, at), arrowprops=dict(arrowstyle="-|>", color="#8a93a0", lw=1.2, shrinkA=4, shrinkB=4))
    ax.plot(start, at, marker, ms=6, color=COLORS["base"])
    ax.plot(end, at, marker, ms=6, color=COLORS["decorated"])
