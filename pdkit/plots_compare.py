"""Figures that compare recipes (methods, settings) over seeds, from tables as data/results holds them.

A recipe keeps its colour in every figure of a notebook when both are given the same `labels`.
"""
from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from .plots import COLORS, Picture, _columns, _percent, blank, styled
from .stats import iqm, stratified_bootstrap

PALETTE = ["#1f6fb4", "#d1495b", "#2c9f6b", "#e0a030", "#7a4fa3", "#17a2b8", "#a8542a", "#e377c2", "#5f6b1f", "#3c3c46", "#9cc3e6",
           "#f4a6a0", "#98cfa9"]
BOOTSTRAP_SEED = 0  # of every interval here: a figure drawn twice is the same


def labelled(table: pd.DataFrame, labels: dict[str, str] | None) -> dict[str, str]:
    """Recipe -> what it is called in a figure, in drawing order: `labels` for those that the table has, or all by their names."""
    present = list(dict.fromkeys(table.recipe))
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
        interval = stratified_bootstrap(iqm, values[:, None], seed=BOOTSTRAP_SEED)
        rows.append({"recipe": recipe, "label": label, "seeds": len(values), "mean": values.mean(), "iqm": interval.value,
                     "low": interval.low, "high": interval.high})
    return pd.DataFrame(rows)


@styled
def curves_figure(curves: pd.DataFrame, *, column: str = "success_once", labels: dict[str, str] | None = None, base: float | None = None,
                  own: pd.DataFrame | None = None, title: str = "", ylabel: str = "", log: bool = False) -> Picture:
    """`column` against environment steps: a line a recipe, the mean over its seeds, in a band from the least to the largest seed.

    Args:
        curves: rows of data/results/NAME_curves.csv (recipe, seed, step and `column`, empty where it was not measured).
        labels: recipe -> name, in drawing order; None: all.
        base: the base policy's value, dashed.
        own: the reader's own rows (the same columns), dotted with open circles.
        log: a logarithmic axis.
    """
    _columns(curves, "recipe", "seed", "step", column)
    names = labelled(curves if own is None else pd.concat([curves, own]), labels)
    color = colours(labels or names)
    figure, axes = blank(size=(7.6, 4.4))
    ax = axes[0, 0]
    for recipe, label in names.items():
        rows = curves[(curves.recipe == recipe) & curves[column].notna()].copy()
        if len(rows):
            rows["number"] = rows.groupby("seed").cumcount()  # seeds are logged a few steps apart: n-th belongs to n-th
            by = rows.groupby("number")
            step, values = by.step.mean(), by[column]
            ax.plot(step, values.mean(), "-o", ms=3.5, color=color[recipe], label=f"{label} ({rows.seed.nunique()})")
            ax.fill_between(step, values.min(), values.max(), color=color[recipe], alpha=0.13, lw=0)
        if own is not None and len(mine := own[(own.recipe == recipe) & own[column].notna()]):
            ax.plot(mine.step, mine[column], ":o", ms=5, mfc="white", color=color[recipe], label=f"{label}, your run")
    if base is not None:
        ax.axhline(base, color=COLORS["base"], ls="--", lw=1.3, label="base policy")
    ax.set(xlabel="environment steps", xlim=(0, None))
    ax.xaxis.set_major_locator(mpl.ticker.MaxNLocator(5))
    ax.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda x, _: f"{x:,.0f}"))
    _values(ax, "y", column, ylabel, log)
    ax.set_title(title)
    figure.legend(loc="outside right upper", fontsize=8.5, title="recipe (seeds)", title_fontsize=8.5)
    return figure


@styled
def finals_figure(table: pd.DataFrame, *, column: str = "decorated_success", labels: dict[str, str] | None = None,
                  base: float | None = None, own: pd.DataFrame | None = None, title: str = "", xlabel: str = "",
                  log: bool = False) -> Picture:
    """`column` at the end: a row a recipe with a dot a seed, the interquartile mean and its bootstrap interval over seeds.

    `own` holds the reader's rows, drawn as open circles; the other arguments are those of `curves_figure`.
    """
    _columns(table, "recipe", "seed", column)
    names = labelled(table if own is None else pd.concat([table, own]), labels)
    color, found = colours(labels or names), summary(table, column, labels).set_index("recipe")
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
    ax.set_title(title)
    return figure


def _values(ax: Axes, axis: str, column: str, label: str, log: bool) -> None:
    """The axis of the values: percent from 0 to 100 for a success rate, as it comes for all else."""
    if "success" in column and axis == "y":
        _percent(ax, label or "success")
    elif "success" in column:
        ax.set(xlim=(-0.02, 1.03), xlabel=label or "success")
        ax.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    else:
        ax.set(**{f"{axis}label": label or column.replace("_", " "), f"{axis}scale": "log" if log else "linear"})
