"""Figures of notebook 04: what families cost, where demonstrations leave a choice, curves of imitation, flattering selection, gains."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from .base_analysis import best_of
from .plots import COLORS, PALETTE, Picture, _columns, _percent, blank, styled
from .stats import Rate


def _share(ax: Axes, label: str) -> None:
    ax.set(xlim=(-0.02, 1.03), xlabel=label)
    ax.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    ax.grid(axis="y", visible=False)


@styled
def costs_figure(table: pd.DataFrame) -> Picture:
    """Rows of `base_analysis.costs`: parameters, milliseconds a gradient step and a primitive step of one environment, on log axes."""
    panels = {"parameters": "parameters", "ms_gradient_step": "ms a gradient step", "ms_step": "ms to act, a step and environment"}
    _columns(table, "family", *panels)
    figure, axes = blank(1, 3, (10.4, 0.9 + 0.4 * len(table)), sharey=True)
    for ax, (column, label) in zip(axes[0], panels.items(), strict=True):
        values, low = table[column], table[column].min() / 3
        ax.barh(range(len(table)), values - low, left=low, color=PALETTE[: len(table)], height=0.62)
        for y, value in enumerate(values):
            ax.text(value * 1.12, y, f"{value:,.0f}" if value >= 100 else f"{value:.2g}", va="center", fontsize=8.5)
        ax.set(xscale="log", xlim=(low, 6 * values.max()), xlabel=label)
        ax.grid(axis="y", visible=False)
    axes[0, 0].set_yticks(range(len(table)), table.family)
    axes[0, 0].invert_yaxis()
    return figure


@styled
def doubts_figure(doubts: Mapping[str, np.ndarray], along: Mapping[str, np.ndarray]) -> Picture:
    """Left: how many steps have at most so much doubt, a line a set of demonstrations. Right: a histogram for each, neighbours' actions
    along the direction in which they differ most, in standard units, at its most doubtful steps; grey is the normal distribution.

    Args:
        doubts: `base_analysis.doubt` by name.
        along: `base_analysis.along_first` of the most doubtful steps by the same names.
    """
    figure, axes = blank(1, 1 + len(doubts), (3.6 + 2.3 * len(doubts), 3.1), width_ratios=[1.7] + [1] * len(doubts))
    left, grid = axes[0, 0], np.linspace(-3, 3, 61)
    for i, (name, values) in enumerate(doubts.items()):
        left.plot(np.sort(values), np.arange(1, len(values) + 1) / len(values), color=PALETTE[i], label=name)
        ax = axes[0, 1 + i]
        ax.hist(along[name].ravel(), bins=np.linspace(-2.8, 2.8, 29), density=True, color=PALETTE[i], alpha=0.75)
        ax.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), color=COLORS["base"], lw=1.2)
        ax.set(title=name, xlabel="standard units", yticks=[], xlim=(-3, 3))
        ax.grid(visible=False)
    _percent(left, "steps with at most that doubt")
    left.set(xlim=(-0.02, max(1.05, *(values.max() for values in doubts.values()))), xlabel="doubt: variance of neighbours' actions")
    left.legend(fontsize=8.5, loc="lower right")
    return figure


@styled
def imitation_figure(curves: Mapping[str, pd.DataFrame], chosen: Mapping[str, Mapping[str, float]], *, recorded: pd.DataFrame | None = None,
                     title: str = "") -> Picture:
    """Success on the selection episodes against gradient steps, a line a family; a ring around the selected checkpoint and, joined to it,
    a diamond: its success on the test episodes.

    Args:
        curves: family -> step, success.
        chosen: family -> step, selected, test.
        recorded: rows of `base_analysis.recorded_curves`: thin lines, one a seed.
    """
    figure, axes = blank(size=(8.4, 4.2))
    ax = axes[0, 0]
    for i, (name, curve) in enumerate(curves.items()):
        color, pick = PALETTE[i], chosen[name]
        if recorded is not None:
            for _, run in recorded[recorded.family == name].groupby("seed"):
                ax.plot(run.step, run.success, color=color, lw=0.9, alpha=0.4)
        ax.plot(curve.step, curve.success, "-o", ms=4, color=color, label=name)
        ax.plot([pick["step"]] * 2, [pick["selected"], pick["test"]], ":", color=color, lw=1.4)
        ax.plot(pick["step"], pick["selected"], "o", ms=11, mfc="none", color=color)
        ax.plot(pick["step"], pick["test"], "D", ms=6, color=color)
    ax.plot([], [], "o", ms=11, mfc="none", color="0.3", label="selected: best of the curve")
    ax.plot([], [], "D", ms=6, color="0.3", label="the same policy on test episodes")
    if recorded is not None and len(recorded):
        ax.plot([], [], color="0.3", lw=0.9, alpha=0.5, label=f"recorded ({recorded.seed.nunique()} seeds)")
    _percent(ax)
    ax.set(xlabel="gradient steps", xlim=(0, None), title=title)
    figure.legend(loc="outside right upper", fontsize=8.5)
    return figure


@styled
def optimism_figure(episodes: Sequence[int], checkpoints: Sequence[int], success: float, seen: pd.DataFrame | None = None) -> Picture:
    """Left: what the best of so many evaluations shows (`best_of`) when every checkpoint truly solves a share `success`, a line for each
    number of episodes. Right: measured, the selected evaluation against the test, a dot a run (columns family, selected, test).
    """
    figure, axes = blank(1, 2, (9.6, 3.6))
    left, right = axes[0]
    for i, n in enumerate(episodes):
        left.plot(checkpoints, [best_of(success, n, m) for m in checkpoints], "-o", ms=3.5, color=PALETTE[i], label=f"{n} episodes each")
    left.axhline(success, color=COLORS["base"], ls="--", lw=1.3, label="the truth")
    left.set(xlabel="checkpoints that were evaluated", xscale="log")
    left.set_xticks(list(checkpoints), [str(m) for m in checkpoints])
    left.minorticks_off()
    left.set(ylim=(success - 0.1, min(1.0, success + 0.4)), ylabel="success of the best one")
    left.yaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    left.legend(fontsize=8.5, loc="upper left")
    right.plot([0, 1], [0, 1], color=COLORS["base"], ls="--", lw=1.3)
    if seen is not None:
        for i, (name, rows) in enumerate(seen.groupby("family", sort=False)):
            right.plot(rows.selected, rows.test, "o", ms=7, alpha=0.75, mew=0, color=PALETTE[i], label=name)
        right.legend(fontsize=8.5, loc="upper left")
    _percent(right, "on test episodes")
    _share(right, "when it was selected")
    right.set_title("below the line: it flattered", fontsize=9.5)
    return figure


@styled
def gains_figure(table: pd.DataFrame, labels: Mapping[str, str], title: str = "") -> Picture:
    """An arrow a run from the base policy's success to the decorated one's: at any step of the episode (full), and at its last (pale).

    `table`: recorded rows (recipe, seed, base_success, decorated_success and both _at_end); `labels`: recipe -> name, from above.
    """
    _columns(table, "recipe", "seed", "base_success", "decorated_success", "base_success_at_end", "decorated_success_at_end")
    rows = [(name, row) for recipe, name in labels.items() for row in table[table.recipe == recipe].sort_values("seed").itertuples()]
    figure, axes = blank(size=(8.0, 1.1 + 0.52 * len(rows)))
    ax = axes[0, 0]
    for y, (_, row) in enumerate(rows):
        pairs = ((row.base_success, row.decorated_success, -0.14, 1.0), (row.base_success_at_end, row.decorated_success_at_end, 0.14, 0.45))
        for start, end, shift, alpha in pairs:
            color = COLORS["gained" if end >= start else "lost"]
            ax.annotate("", (end, y + shift), (start, y + shift), arrowprops=dict(arrowstyle="-|>", color=color, lw=2.2, alpha=alpha,
                                                                              shrinkA=0, shrinkB=0))
            ax.plot(start, y + shift, "o", ms=5, color=COLORS["base"], alpha=alpha)
            ax.text(max(start, end) + 0.015, y + shift, f"{100 * end:.0f}", va="center", fontsize=8, color=color, alpha=max(alpha, 0.7))
    ax.set_yticks(range(len(rows)), [f"{name}, seed {row.seed}" for name, row in rows])
    ax.set_ylim(len(rows) - 0.4, -0.6)
    _share(ax, "success: dark, at any step of the episode; pale, at its last")
    ax.set_title(title)
    return figure


@styled
def neighbours_figure(rates: Mapping[str, Mapping[int, Rate]], others: Mapping[str, tuple[str, float]]) -> Picture:
    """VINN's success by the number of neighbours with 95 % intervals, a line a task; dashed, another policy's (name, success)."""
    figure, axes = blank(size=(7.4, 3.6))
    ax = axes[0, 0]
    ks = sorted({k for by_k in rates.values() for k in by_k})
    for i, (task, by_k) in enumerate(rates.items()):
        x = [ks.index(k) + 0.06 * (i - (len(rates) - 1) / 2) for k in by_k]
        values = [rate.value for rate in by_k.values()]
        errors = [[r.value - r.low for r in by_k.values()], [r.high - r.value for r in by_k.values()]]
        ax.errorbar(x, values, errors, fmt="-o", ms=5, color=PALETTE[i], capsize=3, lw=1.6, label=f"{task}: VINN")
        if task in others:
            ax.axhline(others[task][1], color=PALETTE[i], ls="--", lw=1.2, label=f"{task}: {others[task][0]}")
    ax.set_xticks(range(len(ks)), [str(k) for k in ks])
    ax.set_xlabel("neighbours k")
    _percent(ax)
    figure.legend(loc="outside right upper", fontsize=8.5)
    return figure
