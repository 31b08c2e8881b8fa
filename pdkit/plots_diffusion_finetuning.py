"""Figures of notebook 12: two decision processes, one in the other; actions that climb a critic; what updates cost; how runs end."""
from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.patches import FancyArrowPatch, Rectangle

from .plots import COLORS, PALETTE, Picture, _columns, blank, styled

TUNED = COLORS["decorated"]


@styled
def two_layers_figure(denoising: int, tuned: int, decisions: int = 3, chunk: int = 4) -> Picture:
    """The environment's decisions from left to right and, in each, the steps of denoising from top to bottom, of which the last `tuned`
    are fine-tuned; a reward comes only where a decision is executed."""
    figure, axes = blank(size=(2.6 * decisions + 1.6, 1.0 + 0.52 * (denoising + 2)))
    ax = axes[0, 0]

    def box(x: float, y: float, text: str, color: str, width: float = 1.5) -> None:
        ax.add_patch(Rectangle((x - width / 2, y - 0.33), width, 0.66, fc=color, ec="#444444", lw=0.8, zorder=3))
        ax.text(x, y, text, ha="center", va="center", fontsize=9, zorder=4, color="white" if color == TUNED else "black")

    def arrow(start: tuple[float, float], end: tuple[float, float], color: str = "#444444") -> None:
        ax.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=color, lw=1.2, shrinkA=0, shrinkB=0))

    for d in range(decisions):
        x = 3.0 * d
        box(x, denoising + 1, f"state $s_{{{d}}}$", COLORS["gate"])
        for k in range(denoising + 1):
            late = k > denoising - tuned
            box(x, denoising - k, f"$x_{{{denoising - k}}}$" + ("  noise" if k == 0 else f"  = {chunk} actions" if k == denoising else ""),
                TUNED if late else "#e4e4e4")
            if k:
                arrow((x, denoising - k + 0.67), (x, denoising - k + 0.33), TUNED if late else "#444444")
        arrow((x, denoising + 0.67), (x, denoising + 0.33))
        arrow((x + 0.75, 0), (x + 1.5, 0))
        ax.plot([x + 1.5, x + 1.5], [0, denoising + 1], color="#444444", lw=1.2)
        ax.text(x + 1.6, denoising / 2, f"reward $r_{{{d}}}$", rotation=90, va="center", fontsize=9)
        arrow((x + 1.5, denoising + 1), (x + (2.25 if d < decisions - 1 else 1.95), denoising + 1))
    ax.set(xlim=(-1.0, 3.0 * decisions - 0.5), ylim=(-0.6, denoising + 1.6), xticks=[], yticks=[])
    ax.grid(visible=False)
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.set_title("across: the environment's process; down: denoising, blue is fine-tuned")
    return figure


@styled
def inner_figure(rows: pd.DataFrame) -> Picture:
    """For each step of sampling: noise (grey: what DDPM or DDIM with eta 1 adds; blue: what DPPO adds), the ratio's clip, and the
    discount of the advantage. Rows of `diffusion_finetuning.inner_steps`."""
    _columns(rows, "step", "sigma", "noise", "clip", "discount")
    figure, axes = blank(1, 3, (9.2, 2.7))
    places, labels = np.arange(len(rows)), [str(step) for step in rows.step]
    axes[0, 0].bar(places - 0.18, rows.sigma, width=0.36, color=COLORS["base"], label="the schedule's")
    axes[0, 0].bar(places + 0.18, rows.noise, width=0.36, color=TUNED, label="DPPO's")
    axes[0, 0].legend(fontsize=8.5)
    for ax, column, form in ((axes[0, 1], "clip", ".4f"), (axes[0, 2], "discount", ".3f")):
        ax.bar(places, rows[column].fillna(0), width=0.6, color=TUNED)
        for x, value in zip(places, rows[column], strict=True):
            ax.text(x, 0 if np.isnan(value) else value, "as imitated" if np.isnan(value) else f"{value:{form}}", ha="center", va="bottom",
                    fontsize=8, rotation=90 if np.isnan(value) else 0)
        ax.set_ylim(0, 1.15 * float(np.nan_to_num(rows[column]).max()))
    for ax, title in zip(axes[0], ("std of the noise added", "clip of the ratio", "discount of the advantage"), strict=True):
        ax.set_xticks(places, labels)
        ax.set(xlabel="diffusion step asked")
        ax.set_title(title)
        ax.grid(axis="x", visible=False)
    return figure


@styled
def ascent_figure(axis: np.ndarray, value: np.ndarray, solved: np.ndarray, path: np.ndarray, clouds: Mapping[str, np.ndarray],
                  title: str = "") -> Picture:
    """Left: stored actions (open) on their way up the least critic's value (colour) to where they are put back (full). Right: what the
    policy draws, a colour a moment. The line encloses the actions that solve the task at once.

    Args:
        axis: (G,) of both numbers of an action.
        value, solved: (G, G), rows by the second number.
        path: (1 + steps, B, 2) positions of B actions.
        clouds: moment -> (N, 2) sampled actions.
    """
    figure, axes = blank(1, 2, (9.4, 4.2), sharex=True, sharey=True)
    left, right = axes[0]
    shown = left.contourf(axis, axis, value, levels=14, cmap="YlGnBu")
    figure.colorbar(shown, ax=left, label="least critic's value", shrink=0.85)
    for ax in (left, right):
        ax.contour(axis, axis, solved.astype(float), levels=[0.5], colors=COLORS["gained"], linewidths=2)
        ax.set(xlabel="first number of the action", aspect="equal", xticks=[-1, -0.5, 0, 0.5, 1], yticks=[-1, -0.5, 0, 0.5, 1])
        ax.grid(visible=False)
    for one in path.swapaxes(0, 1):
        left.plot(*one.T, color=COLORS["lost"], lw=1.1)
    left.plot(*path[0].T, "o", mfc="white", color=COLORS["lost"], ms=4.5, label="stored")
    left.plot(*path[-1].T, "o", color=COLORS["lost"], ms=4.5, label="put back")
    shades = [COLORS["gate"], *mpl.colormaps["Blues"](np.linspace(0.4, 1.0, max(len(clouds) - 1, 1))).tolist()]
    for (name, points), color in zip(clouds.items(), shades, strict=False):
        right.plot(*points.T, "o", ms=4, alpha=0.6, mew=0, color=color, label=name)
    left.set(ylabel="second number of the action", xlim=(axis[0], axis[-1]), ylim=(axis[0], axis[-1]))
    left.set_title("actions climb the critic")
    right.set_title("the policy follows")
    for ax in (left, right):
        ax.legend(fontsize=8.5, loc="lower left")
    figure.suptitle(title, x=0.01, ha="left", weight="bold", fontsize=12)
    return figure


@styled
def costs_figure(table: pd.DataFrame) -> Picture:
    """Milliseconds of an update, of a transition within it, and of an environment step's share. Rows of `update_costs`."""
    _columns(table, "method", "ms", "rows", "per_step")
    figure, axes = blank(1, 3, (9.6, 0.9 + 0.42 * len(table)), sharey=True)
    columns = {"an update": table.ms, "a transition of its batch": table.ms / table.rows, "an environment step": table.ms * table.per_step}
    for ax, (name, milliseconds) in zip(axes[0], columns.items(), strict=True):
        for y, (value, color) in enumerate(zip(milliseconds, PALETTE, strict=False)):
            ax.barh(y, value, color=color, height=0.6)
            ax.text(value, y, f" {value:.3g}", va="center", fontsize=8.5)
        ax.set(xlim=(0, 1.3 * milliseconds.max()), xlabel="milliseconds")
        ax.set_title(name)
        ax.grid(axis="y", visible=False)
    axes[0, 0].set_yticks(range(len(table)), table.method)
    axes[0, 0].invert_yaxis()
    return figure


@styled
def outcomes_figure(panels: Mapping[str, pd.DataFrame], labels: Mapping[str, str], title: str = "") -> Picture:
    """A panel a measure: each run's start (grey) and end (colour) with 95 % Wilson intervals. Rows of `outcomes`."""
    most = max(len(rows) for rows in panels.values())
    figure, axes = blank(1, len(panels), (4.6 * len(panels) + 1.2, 1.2 + 0.62 * most), sharey=True)
    for ax, (name, rows) in zip(axes[0], panels.items(), strict=True):
        for y, row in enumerate(rows.itertuples()):
            color = PALETTE[list(labels).index(row.recipe) % len(PALETTE)]
            for shift, rate, shade in ((-0.14, row.before, COLORS["base"]), (0.14, row.after, color)):
                ax.plot([rate.low, rate.high], [y + shift] * 2, color=shade, lw=2.4)
                ax.plot(rate.value, y + shift, "o", color=shade, ms=6)
        ax.set(xlim=(-0.03, 1.03), ylim=(most - 0.5, -0.5), xlabel="success (grey: where it starts)")
        ax.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
        ax.set_title(name)
        ax.grid(axis="y", visible=False)
    first = next(iter(panels.values()))
    axes[0, 0].set_yticks(range(len(first)), [f"{labels[r.recipe]}, seed {r.seed}" for r in first.itertuples()])
    figure.suptitle(title, x=0.01, ha="left", weight="bold", fontsize=12)
    return figure
