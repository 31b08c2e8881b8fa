"""Figures of all tasks: from base to decorated policy, beside the paper's averages (notebook 16) and beside longer imitation (05); what
a bound allows (13)."""
from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.lines import Line2D

from .plots import COLORS, PALETTE, Picture, _columns, blank, styled
from .task_range import COLD, PAPER_DIFFUSION, averages

NAMES = {"maniskill": " ManiSkill", "adroit": " Adroit"}  # of suites


@styled
def range_figure(tasks: pd.DataFrame, means: pd.DataFrame, title: str = "", paper: str = "four tasks",
                 notes: Mapping[str, str] | None = None) -> Picture:
    """Rows of `task_range.by_task`, an arrow from base to decorated success with intervals; below the tasks of a suite the mean, and
    the paper's (over which tasks: `paper`) as open marks. Where `means` has no row a suite, one group of all tasks. `notes`: what
    stands behind a task's number of seeds."""
    notes = notes or {}
    _columns(tasks, "task", "suite", "base", "decorated", "low", "high", "seeds")
    lines, y = [], 0.0
    groups = tasks.suite if tasks.suite.isin(means.over).all() else tasks.suite.map(lambda _: "all")
    for group, rows in tasks.groupby(groups, sort=False):
        lines += [(y + i, row) for i, row in enumerate(rows.itertuples())]
        y += len(rows)
        lines.append((y, means[means.over == group].iloc[0]))
        y += 1.6
    figure, axes = blank(size=(8.2, 0.9 + 0.34 * y))
    ax, labels = axes[0, 0], {}
    for at, row in lines:
        if hasattr(row, "task"):
            seeds = "not recorded" if not row.seeds else f"{row.seeds} seed{'s' if row.seeds > 1 else ''}"
            labels[at] = f"{row.task} ({seeds}{notes.get(row.task, '')})"
            if row.seeds:
                _way(ax, at, row.base, row.decorated)
                for low, high, color, aside in ((row.base_low, row.base_high, "base", -0.09), (row.low, row.high, "decorated", 0.09)):
                    ax.plot([low, high], [at + aside, at + aside], color=COLORS[color], lw=5, alpha=0.25, solid_capstyle="butt", zorder=1)
        else:
            labels[at] = f"mean, {row.tasks}{NAMES.get(row.over, '')} tasks"
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
             ("s", "none", "0.3", f"the paper's mean, {paper}")]
    handles = [Line2D([], [], marker=m, ls="", mfc=fill, color=edge, label=label) for m, fill, edge, label in marks]
    handles.insert(2, Line2D([], [], lw=5, alpha=0.8, color=COLORS["recorded"], solid_capstyle="butt", label="95 % interval"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
    return figure


def over_diffusion_figure(tasks: pd.DataFrame) -> Picture:
    """The same of `task_range.over_diffusion`."""
    return range_figure(tasks, averages(tasks, {"all": PAPER_DIFFUSION}), "Over a Diffusion Policy, the last policy of a run",
                        "what seem to be six tasks, not named",
                        {task: f"; from {share:g} of the noise" for task, share in COLD.items()})


@styled
def beside_imitation_figure(tasks: pd.DataFrame, title: str = "") -> Picture:
    """Rows of `task_range.beside_imitation`: base policy, longer imitation and what decoration makes of either, with intervals:
    the base policy's over its test episodes, the others' over seeds."""
    _columns(tasks, "task", "base", "decorated", "imitated", "over")
    figure, axes = blank(size=(8.2, 1.5 + 0.46 * len(tasks)))
    ax, marks = axes[0, 0], []
    kinds = (("base policy", "base", "o", COLORS["base"]), ("the base, decorated", "decorated", "o", COLORS["decorated"]),
             ("longer imitation", "imitated", "D", PALETTE[2]), ("that, decorated", "over", "D", PALETTE[4]))
    for place, (name, column, marker, color) in enumerate(kinds):
        low, high, seeds = ("low", "high", "seeds") if column == "decorated" else (f"{column}_{end}" for end in ("low", "high", "seeds"))
        y = np.arange(len(tasks)) + 0.2 * place - 0.3
        ax.hlines(y, tasks[low], tasks[high], color=color, lw=4, alpha=0.25, zorder=1)
        ax.plot(tasks[column], y, marker, ms=5.5, color=color)
        counts = sorted(set(tasks[seeds].dropna().astype(int))) if seeds in tasks else []
        told = f" ({' or '.join(map(str, counts))} seeds)" if counts else ""
        marks.append(Line2D([], [], marker=marker, ls="", color=color, label=name + told))
    ax.set_yticks(range(len(tasks)), tasks.task)
    ax.set(ylim=(len(tasks) - 0.5, -0.5), xlim=(0, 1.03), xlabel="success within the episode", title=title)
    ax.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    ax.grid(axis="y", visible=False)
    marks.append(Line2D([], [], lw=4, alpha=0.8, color=COLORS["recorded"], solid_capstyle="butt", label="95 % interval"))
    figure.legend(handles=marks, loc="outside lower center", ncols=5, fontsize=8.5, columnspacing=1.2, handletextpad=0.3)
    return figure


@styled
def bounds_figure(table: pd.DataFrame, reached: pd.DataFrame | None = None, title: str = "") -> Picture:
    """A panel a task: success of a base policy that a demonstrator corrects, by the bound (rows of `oracle.by_bound`), with its intervals.

    `reached` has task, alpha and success of decorated policies: a diamond at the bound that they were trained with. alpha is logarithmic
    above its least value, and linear below.
    """
    _columns(table, "task", "alpha", "success", "low", "high")
    tasks = list(dict.fromkeys(table.task))
    figure, axes = blank(-(-len(tasks) // 4), min(4, len(tasks)), size=(2.5 * min(4, len(tasks)) + 0.4, 2.2 * -(-len(tasks) // 4) + 0.7))
    least = table.alpha[table.alpha > 0].min() if table.alpha.any() else 0.1
    most = max(table.alpha.max(), reached.alpha.max() if reached is not None else 0)
    ticks = sorted(set.intersection(*(set(table.alpha[table.task == task]) for task in tasks)))  # a task's own bound would crowd them
    for ax, task in zip(axes.flat, tasks, strict=False):
        rows = table[table.task == task].sort_values("alpha")
        for _, line in rows.groupby("policy") if "policy" in rows else [("", rows)]:
            ax.fill_between(line.alpha, line.low, line.high, color=COLORS["base"], alpha=0.2, lw=0)
            ax.plot(line.alpha, line.success, "-o", ms=4, color=COLORS["base"])
        for row in reached[reached.task == task].itertuples() if reached is not None else ():
            ax.plot(row.alpha, row.success, "D", ms=6, color=COLORS["decorated"])
        ax.set_xscale("symlog", linthresh=least)  # 0, the base policy alone, stands on it too
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.xaxis.set_minor_locator(mpl.ticker.NullLocator())
        ax.set(title=task, ylim=(0, 1.04), xlim=(-least / 4, most * 1.3))
        ax.yaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    for ax in axes.flat[len(tasks):]:
        ax.set_visible(False)
    for ax in axes.flat[max(0, len(tasks) - axes.shape[1]):len(tasks)]:
        ax.set_xlabel("alpha")
    figure.supylabel("success within the episode", fontsize=9.5)
    figure.suptitle(title)
    marks = [("o", COLORS["base"], "base, corrected by a demonstrator (95 % intervals)"),
             ("D", COLORS["decorated"], "decorated, at its own bound")]
    handles = [Line2D([], [], marker=m, ls="", color=color, label=label) for m, color, label in marks[: 1 + (reached is not None)]]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=8.5)
    return figure


def _way(ax, at: float, start: float, end: float, marker: str = "o") -> None:
    ax.annotate("", (end, at), (start, at), arrowprops=dict(arrowstyle="-|>", color="#8a93a0", lw=1.2, shrinkA=4, shrinkB=4))
    ax.plot(start, at, marker, ms=6, color=COLORS["base"])
    ax.plot(end, at, marker, ms=6, color=COLORS["decorated"])
