"""Figures that compare recipes (methods, settings) over seeds, from tables as data/results holds them.

A recipe keeps its colour in every figure of a notebook when both are given the same `labels`.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from .claims import LEAST_SEEDS
from .errors import PdkitError
from .plots import COLORS, PALETTE, Picture, _columns, _percent, blank, styled
from .stats import Interval, iqm, mean, stratified_bootstrap

BOOTSTRAP_SEED = 0  # of every interval here: a figure drawn twice is the same


def labelled(table: pd.DataFrame, labels: dict[str, str] | None, own: pd.DataFrame | None = None) -> dict[str, str]:
    """Recipe -> what it is called in a figure, in drawing order: `labels` for those that the table or the reader's `own` rows have, or all
    by their names."""
    present = list(dict.fromkeys([*table.recipe, *([] if own is None else own.recipe)]))
    return {r: r for r in present} if labels is None else {r: name for r, name in labels.items() if r in present}


def colours(labels: dict[str, str]) -> dict[str, str]:
    """Recipe -> colour, by its place in `labels`."""
    return {recipe: PALETTE[i % len(PALETTE)] for i, recipe in enumerate(labels)}


def summary(table: pd.DataFrame, column: str = "decorated_success", labels: dict[str, str] | None = None) -> pd.DataFrame:
    """One row a recipe: label, seeds, mean, iqm and its 95 % interval (low, high; bootstrap over seeds) of `column`."""
    _columns(table, "recipe", "seed", column)
    rows = []
    for recipe, label in labelled(table, labels).items():
        values = table.loc[table.recipe == recipe, column].dropna().to_numpy()
        if not len(values):
            continue
        interval = over_seeds(iqm, values[:, None])
        rows.append({"recipe": recipe, "label": label, "seeds": len(values), "mean": values.mean(), "iqm": interval.value,
                     "low": interval.low, "high": interval.high})
    return pd.DataFrame(rows)


def nth(rows: pd.DataFrame) -> pd.api.typing.DataFrameGroupBy:
    """Rows of one recipe's curves by their number within a seed: seeds are logged a few steps apart, so the n-th belongs to the n-th."""
    rows = rows.sort_values("step")
    return rows.assign(number=rows.groupby("seed").cumcount()).groupby("number")


def dash(drawn: list[pd.Series], line: pd.Series) -> str:
    """The style of a line: dashed where it lies on one that was `drawn` before, which would be hidden; it is added to these."""
    hidden = any(line.equals(other) for other in drawn)
    drawn.append(line)
    return "--" if hidden else "-"


def over_seeds(statistic: Callable[..., Any], *arrays: np.ndarray, repetitions: int = 2000) -> Interval:
    """A statistic of one or two (runs x tasks) arrays with its bootstrap interval, which is NaN below three runs: one or two values would
    give one of no width."""
    if min(map(len, arrays)) < LEAST_SEEDS:
        return Interval(float(statistic(*arrays)), np.nan, np.nan)
    return stratified_bootstrap(statistic, *arrays, seed=BOOTSTRAP_SEED, repetitions=repetitions)


@styled
def curves_figure(curves: pd.DataFrame, *, column: str = "success_once", labels: dict[str, str] | None = None, base: float | None = None,
                  own: pd.DataFrame | None = None, starts: Mapping[str, float] | None = None, title: str = "", ylabel: str = "",
                  log: bool = False) -> Picture:
    """`column` against environment steps: a line a recipe, the mean over its seeds, in a band from the least to the largest seed.

    Args:
        curves: rows of data/results/NAME_curves.csv (recipe, seed, step and `column`, empty where it was not measured).
        labels: recipe -> name, in drawing order; None: all.
        base: the base policy's value, dashed.
        own: the reader's own rows (the same columns), dotted with open circles.
        starts: recipe -> value at step 0, an open square before its curve.
        log: a logarithmic axis.
    """
    _columns(curves, "recipe", "seed", "step", column)
    names = labelled(curves, labels, own)
    color = colours(labels or names)
    figure, axes = blank(size=(7.6, 4.4))
    ax, drawn = axes[0, 0], []
    for recipe, label in names.items():
        rows = curves[(curves.recipe == recipe) & curves[column].notna()]
        if len(rows):
            by = nth(rows)
            step, values = by.step.mean(), by[column]
            ax.plot(step, values.mean(), dash(drawn, values.mean()) + "o", ms=3.5, color=color[recipe],
                    label=f"{label} ({rows.seed.nunique()})")
            ax.fill_between(step, values.min(), values.max(), color=color[recipe], alpha=0.13, lw=0)
        if starts and recipe in starts:
            ax.plot(0, starts[recipe], "s", ms=6, mfc="white", color=color[recipe], clip_on=False, zorder=4)
        if own is not None and len(mine := own[(own.recipe == recipe) & own[column].notna()]):
            ax.plot(mine.step, mine[column], ":o", ms=5, mfc="white", color=color[recipe], label=f"{label}, your run")
    if base is not None:
        ax.axhline(base, color=COLORS["base"], ls="--", lw=1.3, label="base policy")
    ax.set(xlabel="environment steps", xlim=(0, None))
    thousands(ax)
    _values(ax, "y", column, ylabel, log)
    ax.set_title(title)
    figure.legend(loc="outside right upper", fontsize=8.5, title="recipe (seeds)\nband: least to largest seed", title_fontsize=8.5)
    return figure


@styled
def finals_figure(table: pd.DataFrame, *, column: str = "decorated_success", labels: dict[str, str] | None = None,
                  base: float | None = None, own: pd.DataFrame | None = None, order: Sequence[str] = (), title: str = "",
                  xlabel: str = "", log: bool = False, colors: Mapping[str, str] | None = None) -> Picture:
    """`column` at the end: a row a recipe with a dot a seed, the interquartile mean and its bootstrap interval over seeds.

    `own` holds the reader's rows, drawn as open circles; `order` names the recipes that come first, from the top, where that is another
    order than that of the colours; `colors` has those that differ from `colours`; the other arguments are those of `curves_figure`.
    """
    _columns(table, "recipe", "seed", column)
    names = labelled(table, labels, own)
    names = {recipe: names[recipe] for recipe in dict.fromkeys([*(r for r in order if r in names), *names])}
    color, found = colours(labels or names) | dict(colors or {}), summary(table, column, labels).set_index("recipe")
    figure, axes = blank(size=(7.2, 1.2 + 0.42 * len(names)))
    ax = axes[0, 0]
    for y, recipe in enumerate(reversed(names)):
        values = table.loc[table.recipe == recipe, column].dropna()
        spread = y + 0.22 * np.linspace(-1, 1, len(values)) if len(values) > 1 else np.full(len(values), y)
        ax.plot(values, spread, "o", ms=4, color=color[recipe], alpha=0.55, mew=0)
        if recipe in found.index:
            row = found.loc[recipe]
            ax.plot([row.low, row.high], [y, y], color=color[recipe], lw=2.2)
            ax.plot(row.iqm, y, "|", ms=15, mew=3, color=color[recipe])
        if own is not None:
            ax.plot(mine := own.loc[own.recipe == recipe, column], [y] * len(mine), "o", ms=8, mfc="none", color="black")
    if base is not None:
        ax.axvline(base, color=COLORS["base"], ls="--", lw=1.3)
        ax.annotate("base policy", (base, len(names) - 0.45), (3, 0), textcoords="offset points", color=COLORS["base"], fontsize=8.5)
    ax.set_yticks(range(len(names)), list(names.values())[::-1])
    ax.set_ylim(-0.6, len(names) - 0.2)
    ax.grid(axis="y", visible=False)
    _values(ax, "x", column, xlabel, log)
    figure.suptitle(title, x=0.01, ha="left", weight="bold", fontsize=12)  # of the figure: long names leave the axes little room
    return figure


def thousands(ax: Axes, most: int = 5, integer: bool = False) -> None:
    """The axis of steps or updates: at most so many marks, with commas."""
    ax.xaxis.set_major_locator(mpl.ticker.MaxNLocator(most, integer=integer))
    ax.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda x, _: f"{x:,.0f}"))


def _plain(axis: mpl.axis.Axis, subs: Sequence[float]) -> None:
    """Numbers instead of powers along a logarithmic axis, at these multiples of each power of ten."""
    axis.set_major_locator(mpl.ticker.LogLocator(subs=subs))
    axis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:,.3g}" if value < 1000 else f"{value:,.0f}"))
    axis.set_minor_formatter(mpl.ticker.NullFormatter())


def _values(ax: Axes, axis: str, column: str, label: str, log: bool) -> None:
    """The axis of the values: percent from 0 to 100 for a success rate, as it comes for all else."""
    if "success" in column and axis == "y":
        _percent(ax, label or "success")
    elif "success" in column:
        ax.set(xlim=(-0.02, 1.03), xlabel=label or "success")
        ax.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    else:
        ax.set(**{f"{axis}label": label or column.replace("_", " "), f"{axis}scale": "log" if log else "linear"})
        if log:
            one = ax.xaxis if axis == "x" else ax.yaxis
            low, high = one.get_view_interval()
            subs = (1, 1.5, 2, 3, 5, 7) if high < 10 * low else (1, 2, 5) if high < 100 * low else (1,)
            _plain(one, subs)


# ---- many recipes ----------------------------------------------------------------------------------------------------

@styled
def panels_figure(curves: pd.DataFrame, panels: Mapping[str, Sequence[str]], *, column: str = "success_once",
                  labels: dict[str, str] | None = None, reference: str = "", base: float | None = None,
                  starts: Mapping[str, float] | None = None, own: pd.DataFrame | None = None, title: str = "") -> Picture:
    """Learning curves of many recipes, a panel a family, all with the same axes: the mean over seeds in its 95 % bootstrap interval.

    Args:
        panels: panel title -> its recipes, of those in the curves.
        reference: a recipe that every panel shows, in grey where it does not belong.
        base: the base policy's value, dashed.
        starts: recipe -> value at step 0, an open square before its curve.
        own: the reader's own rows, dotted with open circles, in the panel that holds their recipe.
    """
    _columns(curves, "recipe", "seed", "step", column)
    names = labelled(curves, labels, own)
    color = colours(labels or names)
    count = len(panels)
    figure, axes = blank(-(-count // 2), min(count, 2), (6.6 * min(count, 2), 0.4 + 2.9 * -(-count // 2)), sharex=True, sharey=True)
    for ax, (family, members) in zip(axes.flat, panels.items(), strict=False):
        if reference and reference not in members:
            _band(ax, curves, reference, column, "#9a9a9a", names.get(reference, reference), [])
        mine, drawn = [recipe for recipe in names if recipe in members], []
        for above, recipe in zip(reversed(range(len(mine))), mine, strict=True):
            _band(ax, curves, recipe, column, color[recipe], names[recipe], drawn)
            if starts and recipe in starts:  # a square in the other where they coincide
                ax.plot(0, starts[recipe], "s", ms=5 + 2 * above, mfc="white", color=color[recipe], clip_on=False, zorder=4)
            if own is not None and len(yours := own[(own.recipe == recipe) & own[column].notna()]):
                ax.plot(yours.step, yours[column], ":o", ms=5, mfc="white", color=color[recipe], label=f"{names[recipe]}, your run")
        if base is not None:
            ax.axhline(base, color=COLORS["base"], ls="--", lw=1.2)
        _values(ax, "y", column, "", False)
        thousands(ax)
        ax.set_title(family)
        ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.02), borderaxespad=0.2, handlelength=1.4)  # never over a curve
    for ax in axes.flat[count:]:
        ax.set_visible(False)
    for ax in axes[:, 1:].flat:
        ax.set_ylabel("")
    axes[0, 0].set_xlim(0, None)
    figure.supxlabel("environment steps; band: 95 % bootstrap interval over seeds", fontsize=10)
    figure.suptitle(title, x=0.01, ha="left", weight="bold", fontsize=12)
    return figure


def _band(ax: Axes, curves: pd.DataFrame, recipe: str, column: str, color: str, label: str, drawn: list[pd.Series]) -> None:
    """The mean over seeds at each evaluation, and its bootstrap interval where there are several seeds (`drawn`: see `dash`)."""
    rows = curves[(curves.recipe == recipe) & curves[column].notna()].sort_values("step")
    if rows.empty:
        return
    by = nth(rows)
    step = by.step.mean()
    limits = [over_seeds(mean, values.to_numpy()[:, None], repetitions=500) for _, values in by[column]]
    ax.plot(step, [i.value for i in limits], dash(drawn, by[column].mean()) + "o", ms=3.5, color=color,
            label=f"{label} ({rows.seed.nunique()})")
    ax.fill_between(step, [i.low for i in limits], [i.high for i in limits], color=color, alpha=0.15, lw=0)


@styled
def matrix_figure(values: pd.DataFrame, *, title: str = "", xlabel: str = "", ylabel: str = "", middle: float | None = None,
                  percent: bool = True) -> Picture:
    """A heat map of numbers in [0, 1], each written into its cell; NaN stays empty.

    `middle`: the value that says nothing (0.5 for a probability of improvement), drawn white between red and blue; without it, the
    more the bluer.
    """
    if values.empty:
        raise PdkitError("This figure needs at least one row and one column.")
    rows, columns = values.shape
    figure, axes = blank(size=(max(5.6, 2.6 + 0.62 * columns), 1.5 + 0.42 * rows))
    ax, numbers = axes[0, 0], values.to_numpy(float)
    scale = mpl.colors.TwoSlopeNorm(middle, 0, 1) if middle is not None else mpl.colors.Normalize(0, 1)
    ax.imshow(numbers, cmap="RdBu" if middle is not None else "Blues", norm=scale, aspect="auto")
    for (y, x), value in np.ndenumerate(numbers):
        if np.isfinite(value):
            dark = abs(scale(value) - 0.5) > 0.32 if middle is not None else value > 0.55
            ax.text(x, y, f"{value:.0%}" if percent else f"{value:.2f}", ha="center", va="center", fontsize=8.5,
                    color="white" if dark else "black")
    tilted = dict(rotation=40, ha="right", rotation_mode="anchor") if columns > 5 else {}
    ax.set_xticks(range(columns), [str(c) for c in values.columns], **tilted)
    ax.set_yticks(range(rows), [str(r) for r in values.index])
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    ax.set_title(title)
    return figure


@styled
def trade_figure(table: pd.DataFrame, *, x: str = "jerk", y: str = "success", labels: dict[str, str] | None = None,
                 own: pd.DataFrame | None = None, starts: Sequence[tuple[str, float, float]] = (), title: str = "", xlabel: str = ""
                 ) -> Picture:
    """Two columns of the final policies against each other, such as jerk and success: a faint dot a run, a large one the mean.

    The columns are called decorated_X and decorated_Y; `starts` (name, x, y), the policies that the methods start from, are crosses.
    x is logarithmic. `own` holds the reader's rows, drawn as open circles.
    """
    wanted = [f"decorated_{what}" for what in (x, y)]
    _columns(table, "recipe", *wanted)
    table = table.dropna(subset=wanted)
    if table.empty:
        raise PdkitError(f"No run of this table has both {x} and {y}.")
    names = labelled(table, labels, own)
    color = colours(labels or names)
    figure, axes = blank(size=(8.6, 4.6))
    ax = axes[0, 0]
    for recipe, label in names.items():
        rows = table[table.recipe == recipe]
        ax.plot(rows[f"decorated_{x}"], rows[f"decorated_{y}"], "o", ms=4, color=color[recipe], alpha=0.35, mew=0)
        if len(rows):
            ax.plot(rows[f"decorated_{x}"].mean(), rows[f"decorated_{y}"].mean(), "o", ms=10, color=color[recipe], label=label)
        if own is not None and len(mine := own[own.recipe == recipe].dropna(subset=wanted)):
            ax.plot(mine[f"decorated_{x}"], mine[f"decorated_{y}"], "o", ms=11, mfc="none", color="black", label=f"{label}, your run")
    for name, *place in starts:
        ax.plot(*place, "X", ms=10, color="black", mec="white", zorder=4)
        ax.annotate(f"start: {name}", place, (7, -11), textcoords="offset points", fontsize=8.5)
    ax.set_xscale("log")
    _plain(ax.xaxis, (1, 2, 5))
    _values(ax, "y", y, "success" if "success" in y else "", False)
    ax.set_xlabel(xlabel or x.replace("_", " "))
    ax.set_title(title)
    figure.legend(loc="outside right upper", fontsize=8.5)
    return figure


@styled
def differences_figure(rows: pd.DataFrame, *, colors: Mapping[str, str] | None = None, others: pd.DataFrame | None = None,
                       title: str = "", xlabel: str = "points of success, against the reference") -> Picture:
    """Differences with intervals, a row each (columns recipe, label, seeds, value, low, high; fractions, drawn as points).

    `others` (recipe, value) are single differences of another origin, drawn as diamonds; colours tell the side of zero where
    `colors` does not name them.
    """
    _columns(rows, "recipe", "label", "seeds", "value", "low", "high")
    figure, axes = blank(size=(7.6, 1.2 + 0.42 * len(rows)))
    ax = axes[0, 0]
    ax.axvline(0, color="black", lw=1)
    for y, row in enumerate(rows.iloc[::-1].itertuples()):
        side = COLORS["gained"] if row.low > 0 else COLORS["lost"] if row.high < 0 else COLORS["base"]
        color = (colors or {}).get(row.recipe, side)
        ax.plot([100 * row.low, 100 * row.high], [y, y], color=color, lw=2.4)
        ax.plot(100 * row.value, y, "o", ms=7, color=color)
        if others is not None and len(single := others[others.recipe == row.recipe]):
            ax.plot(100 * single.value, [y] * len(single), "D", ms=6, mfc="white", color="black")
    ax.set_yticks(range(len(rows)), [f"{row.label} ({row.seeds})" for row in rows.iloc[::-1].itertuples()])
    ax.set_ylim(-0.6, len(rows) - 0.4)
    ax.grid(axis="y", visible=False)
    ax.set(xlabel=xlabel)
    figure.suptitle(title, x=0.01, ha="left", weight="bold", fontsize=12)  # of the figure: long names leave the axes little room
    return figure
