"""Figures of notebook 10: a quantity against the horizon, which is the share of the way to success that is left."""
from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from .horizon_analysis import Progress
from .plots import COLORS, PALETTE, Picture, _columns, _percent, blank, styled
from .plots_compare import over_seeds
from .stats import mean, wilson

HORIZON = "horizon: share of the way to success that is left"
WHO = {"random actions": COLORS["neither"], "base of the decorator": PALETTE[0], "base of fine-tuning": PALETTE[1],
       "base of both": COLORS["base"]}  # the colours that the methods have which start from them


def _horizons(ax: Axes, fractions) -> None:
    """The horizontal axis: 1 - start_fraction, longer to the right."""
    marks = sorted(1 - f for f in set(fractions))
    ax.set(xlabel=HORIZON, xlim=(0, 1.06))
    ax.set_xticks(marks, [f"{m:.0%}" for m in marks])


@styled
def starts_figure(table: pd.DataFrame, measures: Mapping[str, Progress]) -> Picture:
    """How far along `horizon_analysis.starts` are, a panel each of `measures` (columns of the table); a dot a seed, a line for the mean."""
    _columns(table, "start_fraction", *measures)
    figure, axes = blank(1, len(measures), (4.3 * len(measures), 3.2))
    for ax, (column, progress) in zip(axes[0], measures.items(), strict=True):
        ax.plot(1 - table.start_fraction, table[column], "o", ms=4, color=COLORS["exploring"], mew=0)
        mean = table.groupby("start_fraction")[column].mean()
        ax.plot(1 - mean.index, mean, "-", color=COLORS["decorated"])
        _horizons(ax, table.start_fraction)
        ax.set_ylabel(progress.label)
        if progress.solved is not None:
            ax.axhline(progress.solved, color=COLORS["gained"], ls="--", lw=1.2)
            ax.annotate("solved", (0.03, progress.solved), (0, -11), textcoords="offset points", color=COLORS["gained"], fontsize=8.5)
    return figure


@styled
def exploration_figure(table: pd.DataFrame, title: str = "", *, recorded: pd.DataFrame | None = None) -> Picture:
    """Left: share of episodes with a reward, 95 % Wilson intervals. Right: steps per reward; a triangle at the steps tried where none came.

    `table` has who, start_fraction, episodes, solved, steps and steps_per_reward (see `horizon_analysis.exploration`); `recorded` (who,
    start_fraction, seed, met) are shares of other runs, a small dot each.
    """
    _columns(table, "who", "start_fraction", "episodes", "solved", "steps", "steps_per_reward")
    figure, axes = blank(1, 2, (9.4, 3.7))
    left, right = axes[0]
    for i, (who, rows) in enumerate(table.groupby("who", sort=False)):
        rows, color = rows.sort_values("start_fraction"), WHO.get(who, PALETTE[i])
        rates = [wilson(int(r.solved), int(r.episodes)) for r in rows.itertuples()]
        shift = 0.008 * (i - 1)  # side by side where they coincide
        x = 1 - rows.start_fraction.to_numpy() + shift
        bars = [[r.value - r.low for r in rates], [r.high - r.value for r in rates]]
        left.errorbar(x, [r.value for r in rates], bars, fmt="-o", ms=4, lw=1.4, capsize=2, color=color, label=who)
        if recorded is not None:
            others = recorded[(recorded.who == who) & recorded.start_fraction.isin(rows.start_fraction)]
            left.plot(1 - others.start_fraction + shift - 0.006, others.met, "o", ms=3.5, mew=0, alpha=0.5, color=color)
        met = rows.solved.to_numpy() > 0
        right.plot(x[met], rows.steps_per_reward[met], "-o", ms=4, color=color)
        right.plot(x[~met], rows.steps[~met], "^", ms=8, mfc="white", color=color)
    right.plot([], [], "^", ms=8, mfc="white", color="0.3", label="none within so many steps")
    if recorded is not None:
        left.plot([], [], "o", ms=3.5, mew=0, alpha=0.5, color="0.3", label=f"recorded ({recorded.seed.nunique()} runs)")
    right.set(yscale="log", ylabel="environment steps per reward")
    _percent(left, "episodes with a reward")
    for ax in (left, right):
        _horizons(ax, table.start_fraction)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8.5)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")
    return figure


@styled
def propagation_figure(table: pd.DataFrame, title: str = "", *, recorded: pd.DataFrame | None = None) -> Picture:
    """Updates until a corridor is valued right against its length, from rows length, n_step, updates; a line for each n-step return.

    `recorded` (length, n_step, seed, updates) are means of other runs, a ring each.
    """
    _columns(table, "length", "n_step", "updates")
    figure, axes = blank(size=(6.4, 3.7))
    ax = axes[0, 0]
    for i, (n_step, rows) in enumerate(table.dropna(subset=["updates"]).groupby("n_step")):
        mean = rows.groupby("length").updates.mean()
        ax.plot(mean.index, mean, "-", color=PALETTE[i], label=f"{n_step}-step returns")
        ax.plot(rows.length, rows.updates.astype(float), "o", ms=4, mew=0, alpha=0.7, color=PALETTE[i])
        if recorded is not None:
            others = recorded[recorded.n_step == n_step]
            ax.plot(others.length, others.updates, "o", ms=8, mfc="none", mew=0.9, alpha=0.6, color=PALETTE[i])
    if recorded is not None:
        ax.plot([], [], "o", ms=8, mfc="none", mew=0.9, alpha=0.6, color="0.3", label=f"recorded ({recorded.seed.nunique()} runs)")
    ax.set(xlabel="length of the corridor (steps)", ylabel="gradient steps", xlim=(0, None), ylim=(0, None))
    ax.set_xticks(sorted({*table.length, *(() if recorded is None else recorded.length)}))
    ax.yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda y, _: f"{y:,.0f}"))
    ax.legend(fontsize=8.5)
    ax.set_title(title)
    return figure


@styled
def sweep_figure(table: pd.DataFrame, column: str, labels: dict[str, str], *, own: pd.DataFrame | None = None,
                 trained: pd.DataFrame | None = None, budget: int = 0, title: str = "", ylabel: str = "") -> Picture:
    """`column` of `by_fraction` rows against the horizon: a dot a seed, the mean and its bootstrap interval, a line a method of `labels`.

    Args:
        own: the reader's rates of base policies (who, start_fraction, success), as dashed lines; only where `column` is a success.
        trained: the reader's own training, as `table` has it, with episodes: a star of its method's colour.
        budget: for steps: a run without a value is drawn there (the reader's at its own env_steps) as an open triangle, left out of the
            mean; the axis is logarithmic.
    """
    _columns(table, "method", "start_fraction", column)
    figure, axes = blank(size=(7.6, 4.2))
    ax = axes[0, 0]
    drawn = pd.concat([runs[["method", "start_fraction"]] for runs in (table, trained) if runs is not None])
    present = {method: name for method, name in labels.items() if method in set(drawn.method)}
    for i, (method, name) in enumerate(present.items()):
        rows, color, shift = table[table.method == method], PALETTE[i], 0.012 * (i - 1)
        known = rows.dropna(subset=[column])
        ax.plot(1 - known.start_fraction + shift, known[column], "o", ms=3.5, mew=0, alpha=0.45, color=color)
        for fraction, lost in rows[rows[column].isna()].groupby("start_fraction"):  # side by side, or else they would hide each other
            ax.plot(1 - fraction + shift + 0.004 * np.arange(len(lost)), [budget] * len(lost), "^", ms=7, mfc="white", color=color)
        groups = [(f, part[column]) for f, part in known.groupby("start_fraction")]
        for fraction, values in groups:
            interval = over_seeds(mean, values.to_numpy()[:, None], repetitions=500)
            ax.plot([1 - fraction + shift] * 2, [interval.low, interval.high], color=color, lw=2.2)
        ax.plot([1 - f + shift for f, _ in groups], [v.mean() for _, v in groups], "-o", ms=6, color=color, label=name)
    for run in () if trained is None else trained[trained.method.isin(present)].itertuples():
        known = pd.notna(value := getattr(run, column))
        ax.plot(1 - run.start_fraction, value if known else run.env_steps, "*" if known else "^", ms=15, mec="k", mew=0.8,
                color=PALETTE[list(present).index(run.method)], mfc=None if known else "white", zorder=5,
                label=f"your run, {present[run.method]}, {run.env_steps:,} steps, {run.episodes} episodes")
    if own is not None:
        for who, rows in own.groupby("who", sort=False):
            ax.plot(1 - rows.start_fraction, rows.success, "--", marker="o", ms=6, mfc="white", lw=1.2, color=COLORS["base"],
                    alpha=1.0 if who == own.who.iloc[0] else 0.5, label=f"{who}, your run")
    _horizons(ax, drawn.start_fraction)
    if budget:
        ax.plot([], [], "^", ms=7, mfc="white", color="0.3", label="no reward in the whole run")
        ax.set(yscale="log", ylabel=ylabel or column.replace("_", " "))
    elif column == "gain":
        ax.axhline(0, color=COLORS["base"], lw=1.2, ls="--")
        ax.yaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
        ax.set_ylabel(ylabel or "success gained over the base policy")
    else:
        _percent(ax, ylabel or "success")
    ax.set_title(title)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8.5)
    return figure
