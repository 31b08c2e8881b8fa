"""Figures of notebook 11: first episodes, sizes over training, nearest neighbours, the reward by optimal transport."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from .plots import COLORS, PALETTE, Picture, _columns, _percent, blank, styled
from .plots_compare import colours, labelled, nth, thousands
from .stats import Rate


@styled
def first_episodes_figure(strays: Mapping[str, np.ndarray], rates: Mapping[str, Rate], title: str = "") -> Picture:
    """Left: distance of the hand from where the base policy alone has it, by step: the mean over episodes, and the middle half of them.
    Right: success with 95 % Wilson intervals, for the base policy too (the first of `rates`, grey).

    `strays` are `residual_analysis.stray` arrays (episodes, steps + 1) by the names that `rates` have.
    """
    figure, axes = blank(1, 2, (9.8, 3.8), width_ratios=(3, 2))
    left, right = axes[0]
    for i, (name, apart) in enumerate(strays.items()):
        step, (low, high) = np.arange(apart.shape[1]), np.quantile(100 * apart, [0.25, 0.75], axis=0)
        left.plot(step, 100 * apart.mean(axis=0), color=PALETTE[i], label=name)
        left.fill_between(step, low, high, color=PALETTE[i], alpha=0.15, lw=0)
    left.set(xlabel="step of the episode", ylabel="hand, from the base policy's place (cm)", ylim=(0, None))
    left.legend(fontsize=8.5)
    for y, (name, rate) in enumerate(reversed(rates.items())):
        color = PALETTE[list(strays).index(name)] if name in strays else COLORS["base"]
        _rate(right, y, rate, color)
    right.set_yticks(range(len(rates)), list(rates)[::-1])
    _share(right, len(rates))
    left.set_title(title)
    return figure


def _rate(ax: Axes, y: float, rate: Rate, color: str) -> None:
    ax.plot([rate.low, rate.high], [y, y], color=color, lw=2.4)
    ax.plot(rate.value, y, "o", ms=7, color=color)


def _share(ax: Axes, rows: int) -> None:
    """The axis of success rates that lie below each other."""
    ax.set(xlim=(-0.02, 1.03), ylim=(-0.6, rows - 0.4), xlabel="success, 95 % interval")
    ax.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    ax.grid(axis="y", visible=False)


@styled
def sizes_figure(curves: pd.DataFrame, labels: dict[str, str], *, own: pd.DataFrame | None = None, title: str = "") -> Picture:
    """Left: mean |residual| (lines) and mean |base action| (dashes) per decision, as executed, against environment steps. Right:
    success at the evaluations.

    Args:
        curves: rows of recorded curves (recipe, seed, step, residual_size, base_size, success_once): the mean over seeds, in a band from
            the least to the largest. May be empty.
        labels: recipe -> name.
        own: the reader's rows (the same columns), dotted with open circles.
    """
    both = curves if own is None else pd.concat([curves, own]) if len(curves) else own
    _columns(both, "recipe", "seed", "step", "residual_size", "base_size")
    names = labelled(both, labels)
    color = colours(labels)
    figure, axes = blank(1, 2, (10, 4.0), sharex=True)
    for ax, columns in zip(axes[0], (("residual_size", "base_size"), ("success_once",)), strict=True):
        for recipe, name in names.items():
            for column, style in zip(columns, ("-", "--"), strict=False):
                _mean(ax, curves[curves.recipe == recipe] if len(curves) else curves, column, style, color[recipe], name)
                mine = own[(own.recipe == recipe) & own[column].notna()] if own is not None and column in own else both[:0]
                if len(mine):
                    marks = dict(marker="o", ms=4, mfc="white") if style == "-" else {}
                    ax.plot(mine.step, mine[column], ":", color=color[recipe], lw=1.3, **marks,
                            label=f"{name}, your run" if column == "residual_size" else None)
        ax.set(xlabel="environment steps", xlim=(0, None))
        thousands(ax, 4)
    axes[0, 0].set(ylabel="mean size per action dimension", ylim=(0, None))
    for style, name in (("-", "residual"), ("--", "base action")):
        axes[0, 0].plot([], [], style, color="0.3", label=name)
    axes[0, 0].set_title(title)
    _percent(axes[0, 1])
    handles = [handle for ax in axes[0] for handle in ax.get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8.5)
    return figure


def _mean(ax: Axes, rows: pd.DataFrame, column: str, style: str, color: str, name: str) -> None:
    """The mean over seeds in its band."""
    rows = rows[rows[column].notna()] if column in rows else rows[:0]
    if rows.empty:
        return
    by = nth(rows)
    ax.plot(by.step.mean(), by[column].mean(), style, color=color,
            label=f"{name} ({rows.seed.nunique()} seeds)" if column == "residual_size" else None)
    ax.fill_between(by.step.mean(), by[column].min(), by[column].max(), color=color, alpha=0.13, lw=0)


@styled
def lookups_figure(rates: Mapping[str, Rate], bet: Rate, *, recorded: pd.DataFrame | None = None, title: str = "",
                   whose: str = "BeT") -> Picture:
    """VINN's success, a row each of `residual_analysis.lookups`, with Wilson intervals; the BeT's (or who is named) as a grey band, half of
    it in red.

    `recorded` (recipe, seed, success) are other runs' values by the same names, a small dot each.
    """
    figure, axes = blank(size=(7.8, 1.4 + 0.42 * len(rates)))
    ax, groups = axes[0, 0], list(dict.fromkeys(name.split(",")[0] for name in rates))
    ax.axvspan(bet.low, bet.high, color=COLORS["base"], alpha=0.18, lw=0)
    ax.axvline(bet.value, color=COLORS["base"], lw=1.4, label=f"{whose} on the same episodes")
    ax.axvline(bet.value / 2, color=COLORS["lost"], ls="--", lw=1.4, label="half of it: below, extremely poor")
    for y, (name, rate) in enumerate(reversed(rates.items())):
        color = PALETTE[groups.index(name.split(",")[0])]
        if recorded is not None:
            values = recorded.success[recorded.recipe == name]
            ax.plot(values, np.full(len(values), y - 0.25), "o", ms=4, alpha=0.55, mew=0, color=color)
        _rate(ax, y, rate, color)
    if recorded is not None:
        ax.plot([], [], "o", ms=4, alpha=0.55, color="0.3", label=f"recorded ({recorded.seed.nunique()} seeds)")
    ax.set_yticks(range(len(rates)), [name.replace(",", ", ").replace("=", " ") for name in reversed(rates)])
    _share(ax, len(rates))
    ax.set_title(title)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8.5)
    return figure


@styled
def transport_figure(table: pd.DataFrame, rewards: Sequence[np.ndarray], picked: Mapping[str, int], title: str = "") -> Picture:
    """Left: total reward by optimal transport of each episode of `residual_analysis.transport`, a column a policy, solved ones green.
    Right: the reward of every step of the `picked` episodes (name -> row)."""
    _columns(table, "who", "solved", "total")
    figure, axes = blank(1, 2, (10, 3.8))
    left, right = axes[0]
    who = list(dict.fromkeys(table.who))
    for solved, color, label in ((True, COLORS["gained"], "solved"), (False, COLORS["lost"], "failed")):
        rows = table[table.solved == solved]
        x = rows.who.map(who.index) + (0.12 if solved else -0.12) + 0.08 * np.linspace(-1, 1, max(len(rows), 1))[: len(rows)]
        left.plot(x, rows.total, "o", ms=5, alpha=0.6, mew=0, color=color, label=f"{label} ({len(rows)})")
    left.set_xticks(range(len(who)), [name.replace(" + ", "\n+ ") for name in who])
    left.set(xlim=(-0.5, len(who) - 0.5), ylabel="reward of the whole episode")
    left.grid(axis="x", visible=False)
    for name, row in picked.items():
        values, color = rewards[row], COLORS["gained" if name == "solved" else "lost"]
        right.plot(np.arange(1, len(values) + 1), values, color=color, lw=1.4,
                   label=f"{name}: {table.who[row]}, seed {table.seed[row]}, sum {table.total[row]:.2f}")
    right.set(xlabel="step of the episode", ylabel="reward of a step")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, fontsize=8.5)
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), fontsize=8.5)
    left.set_title(title)
    return figure
