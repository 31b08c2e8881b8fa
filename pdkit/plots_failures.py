"""Figures of the failure analyses (notebooks 06 and 07), in the look of plots.py: each returns a Figure."""
from __future__ import annotations

from collections.abc import Iterable, Sequence

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.patches import Patch

from .plots import COLORS, Picture, blank, styled
from .plots_compare import colours
from .stats import Rate

ARMS = {"random critic": "#d1495b", "critic alone": "#e0a030", "critic learns": "#3c3c46",
        "decorated, pushed": "#6aaed6", "decorated, no entropy": "#3fa7a0", "decorated": COLORS["decorated"]}
OTHER = "#2c9f6b"  # of an arm without a colour of its own


def arm_colors(names: Iterable[str]) -> dict[str, str]:
    """The colour of each, by the arm that the name begins with."""
    return {name: next((c for arm, c in ARMS.items() if name.startswith(arm)), COLORS["base"]) for name in names}


@styled
def directions_figure(cosines: Sequence[np.ndarray], dim: int, sizes: dict[str, float]) -> Picture:
    """Left: the distribution of cosines between each critic's pull and the improvement, and that of random directions in `dim`
    dimensions. Right: the mean size of named pushes on an action."""
    figure, axes = blank(1, 2, (9.2, 3.4), width_ratios=[2.2, 1])
    ax, edges = axes[0, 0], np.linspace(-0.8, 0.8, 25)
    middle = (edges[1:] + edges[:-1]) / 2
    density = (1 - middle**2) ** ((dim - 3) / 2)  # of the cosine between two random directions
    ax.fill_between(middle, density / density.sum(), color="#dddddd", label="random directions")
    for i, values in enumerate(cosines):
        counts, _ = np.histogram(np.clip(values, -0.799, 0.799), edges)
        ax.plot(middle, counts / len(values), color=ARMS["random critic"], lw=1.2, alpha=0.8,
                label=f"each of {len(cosines)} random critics" if i == 0 else None)
        ax.axvline(values.mean(), 0, 0.05, color=ARMS["random critic"], lw=2)
    ax.axvline(0, color="black", lw=0.8)
    ax.set(xlabel="cosine with the improvement: below 0 the push makes it worse", ylabel="share of the states", ylim=(0, None))
    ax.set_title("Which way the critic pushes")
    ax.legend(fontsize=8.5, loc="upper left")
    ax = axes[0, 1]
    ax.bar(range(len(sizes)), list(sizes.values()), 0.6, color=[ARMS.get(name, COLORS["base"]) for name in sizes])
    ax.set_yscale("log")
    ax.set_ylim(min(sizes.values()) / 4, max(sizes.values()) * 4)
    for x, value in enumerate(sizes.values()):
        ax.text(x, value * 1.15, f"{value:.1g}", ha="center", fontsize=9)
    ax.set_xticks(range(len(sizes)), list(sizes))
    ax.set_xlim(-0.6, len(sizes) - 0.4)
    ax.grid(axis="x", visible=False)
    ax.set_ylabel("mean size per dimension")
    ax.set_title("How hard")
    return figure


@styled
def drift_figure(drifts: pd.DataFrame, *, bound: float, distance: float) -> Picture:
    """Left: mean |a - a_0| against updates for each arm (columns arm, update, drift, heading), the residual's bound, and how far a better
    policy is. Right: whether they drift towards that one."""
    figure, axes = blank(1, 2, (10.4, 3.6), width_ratios=[1.5, 1])
    ax = axes[0, 0]
    ax.axhline(distance, color=COLORS["recorded"], lw=1.4)
    ax.axhline(bound, color=COLORS["decorated"], ls=":", lw=1.2)
    for name, rows in drifts.groupby("arm", sort=False):
        ax.plot(rows["update"], rows.drift, "-o", ms=3.5, color=ARMS.get(name, OTHER), label=name)
    right = drifts["update"].max()
    ax.annotate(f"bound {bound:g}", (right, bound), (-2, 3), textcoords="offset points", ha="right", color=COLORS["decorated"],
                fontsize=8.5)
    ax.annotate("distance to the better policy", (right, distance), (-2, -12), textcoords="offset points", ha="right", color="#888888",
                fontsize=8.5)
    ax.set(xlabel="updates of the actor", ylabel="mean |a - a0| per dimension", xlim=(0, right * 1.02), ylim=(0, None))
    ax.set_title("How far the policy has drifted")
    other = axes[0, 1]
    other.axhline(0, color="black", lw=0.8)
    for name, rows in drifts[drifts["update"] > 0].groupby("arm", sort=False):
        other.plot(rows["update"], rows.heading, "-o", ms=3.5, color=ARMS.get(name, OTHER))
    other.set(xlabel="updates of the actor", ylabel="cosine; 1: straight to the better policy", xlim=(0, right * 1.02), ylim=(-1.05, 1.05))
    other.set_title("Where to")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9)
    return figure


@styled
def costs_figure(rates: dict[str, Rate], *, title: str = "") -> Picture:
    """Named success rates as horizontal bars with intervals, coloured by the arm that the name begins with."""
    figure, axes = blank(size=(7.6, 0.7 + 0.34 * len(rates)))
    ax, colors = axes[0, 0], arm_colors(rates)
    for y, (name, rate) in enumerate(rates.items()):
        ax.barh(y, rate.value, 0.66, color=colors[name], alpha=0.85)
        ax.errorbar(rate.value, y, xerr=[[rate.value - rate.low], [rate.high - rate.value]], color="black", capsize=3, lw=1.1)
        ax.text(1.03, y, f"{rate.value:.0%}", va="center", fontsize=9)
    ax.set_yticks(range(len(rates)), list(rates))
    ax.set(xlim=(0, 1.0), ylim=(len(rates) - 0.4, -0.6), xlabel="success, 95 % interval")
    ax.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    ax.grid(axis="y", visible=False)
    ax.set_title(title, loc="left", pad=8)
    return figure


@styled
def warm_figure(rows: pd.DataFrame, *, warmup: int, bound: float, target: float) -> Picture:
    """Temperature, entropy against its target, and mean Q over updates, a line for each arm (columns arm, update, temperature,
    entropy, q_mean); grey: while the actor of the warm-started arms stands still."""
    figure, axes = blank(1, 3, (10.8, 3.5))
    colors = colours(dict.fromkeys(rows.arm))
    titles = {"temperature": "Temperature", "entropy": "Entropy of the actor", "q_mean": "Mean Q"}
    for ax, (column, title) in zip(axes[0], titles.items(), strict=True):
        ax.axvspan(0, warmup, color="#f0f0f0", lw=0)
        for name, run in rows.groupby("arm", sort=False):
            smooth = run[column].rolling(9, min_periods=1, center=True).mean()
            ax.plot(run["update"], smooth, color=colors[name], label=name, lw=1.6, ls="--" if name == "fixed" else "-")
        ax.set(xlabel="updates", xlim=(0, rows["update"].max()))
        ax.set_title(title)
    axes[0, 0].set_ylim(0, None)
    axes[0, 1].axhline(target, color="black", ls=":", lw=1.2)
    axes[0, 1].annotate("target", (rows["update"].max(), target), (-3, -11), textcoords="offset points", ha="right",
                        fontsize=8.5)
    axes[0, 2].axhspan(-bound, 0, color=COLORS["both"], lw=0)
    axes[0, 2].annotate("what rewards alone can be worth", (rows["update"].max(), 0), (-3, -11), textcoords="offset points", ha="right",
                        fontsize=8)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    return figure


@styled
def interventions_figure(arms: pd.DataFrame) -> Picture:
    """A row for each arm whose actor is frozen (columns arm, kind, gap, size, growth, loss), sorted by the side of the target; red: the
    temperature rises. Side, size of log pi, temperature and the critics' loss beside each other."""
    arms = arms.sort_values("gap", ascending=False, ignore_index=True)
    figure, axes = blank(1, 4, (11.4, 1.3 + 0.3 * len(arms)), sharey=True)
    rises = arms.growth > 1
    colors = np.where(rises, COLORS["lost"], COLORS["gained"])
    titles = {"gap": "Side of the target", "size": "Size of log pi", "growth": "Temperature", "loss": "Loss of Q"}
    labels = ("target entropy - entropy", "mean |log pi| at the start", "last / first", "at the end")
    for ax, (column, title), label in zip(axes[0], titles.items(), labels, strict=True):
        start = 1.0 if column == "growth" else 0.0
        ax.barh(arms.index, arms[column] - start, 0.68, left=start, color=colors)
        ax.axvline(start, color="black", lw=0.9)
        ax.set(xlabel=label)
        ax.set_title(title)
        ax.grid(axis="y", visible=False)
    axes[0, 3].set_xscale("symlog", linthresh=1)
    axes[0, 0].set_yticks(arms.index, [f"{row.kind}: {row.arm}" for row in arms.itertuples()])
    axes[0, 0].set_ylim(len(arms) - 0.4, -0.6)
    handles = [Patch(color=COLORS["lost"], label="temperature rises"), Patch(color=COLORS["gained"], label="temperature falls")]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9)
    return figure
