"""Figures of notebooks 08 (critics on a transformer) and 09 (Cal-QL), in the look of plots.py: each returns a Figure."""
from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
import pandas as pd

from .plots import COLORS, Picture, _columns, _percent, blank, styled
from .plots_compare import colours, dash, thousands

VALUES = {"data": "actions of the data", "policy": "the policy's actions", "random": "random actions"}
SOURCES = {"demonstrations": COLORS["gained"], "rollouts": COLORS["lost"]}


# ---- 08 --------------------------------------------------------------------------------------------------------------

@styled
def drifts_figure(rows: pd.DataFrame, labels: Mapping[str, str], title: str = "") -> Picture:
    """How far the policy moved (columns stage, kind, update, drift): a panel a stage, each with a scale of its own, a line a kind."""
    _columns(rows, "stage", "kind", "update", "drift")
    stages, color = list(dict.fromkeys(rows.stage)), colours(dict(labels))
    figure, axes = blank(1, len(stages), (4.7 * len(stages), 3.6))
    for ax, stage in zip(axes[0], stages, strict=True):
        for i, (kind, label) in enumerate(labels.items()):
            mine = rows[(rows.stage == stage) & (rows.kind == kind)]
            ax.plot(mine["update"], mine.drift, "-o", ms=4 + 3 * (i == 0), mfc="white" if i == 0 else color[kind], color=color[kind],
                    label=label)  # the first as open circles, seen below another line that lies on it
        ax.set(xlabel="updates", xlim=(0, None), ylim=(min(0.0, -0.03 * rows[rows.stage == stage].drift.max()), None))
        thousands(ax, integer=True)
        ax.set_title(stage)
    axes[0, 0].set_ylabel("mean |a - a0| per dimension")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(labels), fontsize=9)
    figure.suptitle(title, x=0.01, ha="left", weight="bold", fontsize=12)
    return figure


@styled
def values_figure(rows: pd.DataFrame, scatter: Mapping[str, np.ndarray], returns: np.ndarray, labels: Mapping[str, str]) -> Picture:
    """Left: error of Q against updates (columns kind, update, error), dotted the error of one constant. Then a panel a kind: Q at the
    end (`scatter`: kind -> (B,)) against the `returns` (B,), which a right critic meets on average at the line."""
    _columns(rows, "kind", "update", "error")
    color = colours(dict(labels))
    figure, axes = blank(1, 1 + len(labels), (3.9 + 2.6 * len(labels), 3.4), width_ratios=[1.5, *[1] * len(labels)])
    ax, spread = axes[0, 0], float(returns.std())
    for i, kind in enumerate(labels):  # lines that lie on each other stay visible
        mine = rows[rows.kind == kind]
        ax.plot(mine["update"], mine.error, ("-o", "-", "--")[i % 3], ms=7, mfc="white", color=color[kind])
    ax.axhline(spread, color=COLORS["base"], ls=":", lw=1.4)
    ax.annotate("the best constant", (0, spread), (4, 4), textcoords="offset points", color=COLORS["base"], fontsize=8.5)
    ax.set(xlabel="updates", ylabel="error of Q (reward)", xlim=(0, None), ylim=(0, None))
    thousands(ax, integer=True)
    ax.set_title("Error against returns")
    low = min(float(returns.min()), *(float(v.min()) for v in scatter.values()))
    high = max(float(returns.max()), *(float(v.max()) for v in scatter.values()))
    for ax, (kind, label) in zip(axes[0, 1:], labels.items(), strict=True):
        ax.plot(returns, scatter[kind], "o", ms=3, alpha=0.25, mew=0, color=color[kind])
        ax.plot([low, high], [low, high], color="black", lw=0.9)
        ax.set(xlabel="return", xlim=(low - 1, high + 1), ylim=(low - 1, high + 1))
        ax.set_title(label, color=color[kind])
    axes[0, 1].set_ylabel("Q")
    return figure


@styled
def costs_figure(rows: pd.DataFrame, labels: Mapping[str, str]) -> Picture:
    """Left: parameters of the critics, those that they share with the actor in grey. Right: milliseconds an update.

    `rows` has kind, parameters, own (not shared with the actor) and seconds.
    """
    _columns(rows, "kind", "parameters", "own", "seconds")
    rows, color = rows.set_index("kind").loc[list(labels)], colours(dict(labels))
    figure, axes = blank(1, 2, (8.6, 1.3 + 0.4 * len(labels)), sharey=True)
    y, tones = np.arange(len(labels)), [color[kind] for kind in labels]
    left, right = axes[0]
    left.barh(y, rows.own, 0.66, color=tones)
    left.barh(y, rows.parameters - rows.own, 0.66, left=rows.own, color=COLORS["recorded"], label="shared with the actor")
    right.barh(y, 1000 * rows.seconds, 0.66, color=tones)
    for i, row in enumerate(rows.itertuples()):
        left.text(row.parameters, i, f" {int(row.parameters):,}", va="center", fontsize=8.5)
        right.text(1000 * row.seconds, i, f" {1000 * row.seconds:.1f}", va="center", fontsize=8.5)
    left.set_yticks(y, list(labels.values()))
    left.set(xlim=(0, 1.25 * rows.parameters.max()), ylim=(len(labels) - 0.4, -0.6))
    right.set_xlim(0, 1200 * rows.seconds.max())
    thousands(left, 4)
    for ax, name in ((left, "Parameters of the critics"), (right, "Milliseconds an update")):
        ax.grid(axis="y", visible=False)
        ax.set_title(name)
    if (rows.own < rows.parameters).any():
        figure.legend(loc="outside lower center", fontsize=8.5)
    return figure


# ---- 09 --------------------------------------------------------------------------------------------------------------

@styled
def returns_figure(rows: pd.DataFrame, lowest: float) -> Picture:
    """What the critics learn from: rows of the offline data by their return (columns source, mc), sources stacked; dashed the value of
    an episode that is never solved."""
    _columns(rows, "source", "mc")
    figure, axes = blank(size=(7.2, 3.4))
    ax, edges = axes[0, 0], np.linspace(lowest * 1.02, max(0.0, rows.mc.max()) + 0.5, 36)
    present = [name for name in SOURCES if (rows.source == name).any()]
    ax.hist([rows.mc[rows.source == name] for name in present], edges, stacked=True, color=[SOURCES[n] for n in present],
            label=[f"{name} ({(rows.source == name).sum():,} rows)" for name in present])
    ax.axvline(lowest, color="black", ls="--", lw=1)
    ax.annotate("never solved", (lowest, 1), (5, -10), xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8.5)
    ax.set(xlabel="return of state and action", ylabel="rows of the offline data")
    ax.set_title("Good and bad news in the offline data")
    figure.legend(loc="outside lower center", ncols=2, fontsize=8.5)
    return figure


@styled
def calibration_figure(rows: pd.DataFrame, returns: float) -> Picture:
    """Values during the offline stage, a panel a loss (columns loss, update and one a key of VALUES: mean Q), dashed the mean return."""
    _columns(rows, "loss", "update", *VALUES)
    losses = list(dict.fromkeys(rows.loss))
    figure, axes = blank(1, len(losses), (3.6 * len(losses), 3.7), sharey=True)
    tones = {"data": COLORS["gained"], "policy": COLORS["decorated"], "random": COLORS["lost"]}
    for ax, loss in zip(axes[0], losses, strict=True):
        mine = rows[rows.loss == loss]
        for name, label in VALUES.items():
            ax.plot(mine["update"], mine[name], "-o", ms=3, color=tones[name], label=label)
        ax.axhline(returns, color="black", ls="--", lw=1.1, label="mean return of the data")
        ax.set(xlabel="offline updates", xlim=(0, None))
        thousands(ax, integer=True)
        ax.set_title(loss)
    axes[0, 0].set_ylabel("mean Q")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    return figure


@styled
def offline_figure(curves: pd.DataFrame, labels: Mapping[str, str], own: pd.DataFrame | None = None, title: str = "") -> Picture:
    """The offline stage of each setup (the rows of step 0): mean Q of the data, the conservative gap, and the share of the policy's
    values that the max lifts, against updates; the mean over seeds, dashed where it lies on another's. `own` (the same columns) is dotted.
    """
    _columns(curves, "recipe", "seed", "step", "updates", "q_mean", "conservative", "calibrated")
    panels = {"q_mean": "Mean Q of the data", "conservative": "Gap to other actions", "calibrated": "Lifted by the max"}
    figure, axes = blank(1, 3, (10.6, 3.5))
    color = colours(dict(labels))
    for ax, (column, name) in zip(axes[0], panels.items(), strict=True):
        drawn: list[pd.Series] = []
        for recipe, label in labels.items():
            rows = curves[(curves.recipe == recipe) & (curves.step == 0)]
            if len(rows):
                line = rows.groupby("updates")[column].mean()
                ax.plot(line, dash(drawn, line), color=color[recipe], label=f"{label} ({rows.seed.nunique()})")
            if own is not None and len(mine := own[(own.recipe == recipe) & (own.step == 0)]):
                ax.plot(mine.updates, mine[column], ":o", ms=4, mfc="white", color=color[recipe], label=f"{label}, your run")
        ax.set(xlabel="offline updates", xlim=(0, None))
        thousands(ax, integer=True)
        ax.set_title(name)
    axes[0, 0].set_ylabel("Q, a discounted return")
    axes[0, 1].set_ylabel("difference of Q")
    _percent(axes[0, 2], "share of values")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=8.5)
    figure.suptitle(title, x=0.01, ha="left", weight="bold", fontsize=12)
    return figure


@styled
def times_figure(rows: pd.DataFrame, title: str = "") -> Picture:
    """Milliseconds an update (columns label, online, seconds), a row a label, bars coloured by the online loss; logarithmic."""
    _columns(rows, "label", "online", "seconds")
    tones = {"SAC": COLORS["decorated"], "Cal-QL": COLORS["gate"]}
    figure, axes = blank(size=(7.6, 1.3 + 0.36 * len(rows)))
    ax = axes[0, 0]
    for y, row in enumerate(rows.itertuples()):
        ax.barh(y, 1000 * row.seconds, 0.66, color=tones[row.online])
        ax.text(1000 * row.seconds, y, f" {1000 * row.seconds:.0f}", va="center", fontsize=9)
    ax.set_yticks(range(len(rows)), list(rows.label))
    ax.set(xscale="log", xlabel="milliseconds an update (logarithmic)", ylim=(len(rows) - 0.4, -0.6),
           xlim=(300 * rows.seconds.min(), 2500 * rows.seconds.max()))
    ax.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    ax.grid(axis="y", visible=False)
    handles = [mpl.patches.Patch(color=c, label=f"online {name}") for name, c in tones.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=8.5)
    ax.set_title(title)
    return figure
