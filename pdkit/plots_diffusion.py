"""Figures of notebook 03: ways past an obstacle, actions on their way to noise and back, chunks, and samplers compared."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from .plots import COLORS, PALETTE, Picture, blank, styled
from .probes import ForkSim
from .stats import Rate, wilson


@styled
def fork_figure(ways: Mapping[str, Sequence[np.ndarray]], rates: Mapping[str, Rate]) -> Picture:
    """A panel for the demonstrations and one a policy: the paths (T + 1, 2) of some episodes past the obstacle.

    `ways` are paths by name; `rates` are the success rates of those that were tested.
    """
    figure, axes = blank(1, len(ways), (2.6 * len(ways), 2.9), sharey=True)
    for ax, (name, paths) in zip(axes[0], ways.items(), strict=True):
        ax.add_patch(Circle(tuple(ForkSim.CENTRE), ForkSim.RADIUS, color="#d9d9d9", lw=0))
        for path in paths:
            crashed = np.linalg.norm(path[-1] - ForkSim.CENTRE) < ForkSim.RADIUS
            ax.plot(*path.T, color=COLORS["lost"] if crashed else COLORS["decorated"], lw=1.1, alpha=0.6)
            ax.plot(*path[-1], "x" if crashed else ".", color=COLORS["lost"] if crashed else COLORS["decorated"], ms=5)
        ax.set(xlim=(-0.2, 2.5), ylim=(-1, 1), aspect="equal", xlabel="x")
        ax.set_title(name + (f"\n{rates[name].value:.0%} pass" if name in rates else "\n"))
        ax.grid(visible=False)
    axes[0, 0].set_ylabel("y")
    figure.suptitle("paths from left to right: blue passes, red runs into the disc", x=0.01, ha="left", fontsize=9)
    return figure


@styled
def schedule_figure(alpha_bar: np.ndarray, asked: Mapping[str, Sequence[int]]) -> Picture:
    """What is left of the actions and how much noise there is at each diffusion step, and the steps at which samplers ask the network.

    Args:
        alpha_bar: (diffusion steps,) the schedule's cumulative product.
        asked: sampler -> the steps it visits.
    """
    figure, axes = blank(size=(6.4, 3.2))
    ax, steps = axes[0, 0], np.arange(len(alpha_bar))
    ax.plot(steps, np.sqrt(alpha_bar), color=COLORS["decorated"], label="actions, times $\\sqrt{\\bar\\alpha_k}$")
    ax.plot(steps, np.sqrt(1 - alpha_bar), color=COLORS["base"], label="noise, times $\\sqrt{1 - \\bar\\alpha_k}$")
    for row, (name, visited) in enumerate(asked.items()):
        ax.plot(visited, np.full(len(visited), -0.1 - 0.11 * row), "|", ms=8, mew=1.6, color=PALETTE[row])
        ax.text(len(steps) + 1, -0.1 - 0.11 * row, name, va="center", fontsize=8.5, color=PALETTE[row])
    ax.set(xlabel="diffusion step k", ylabel="share", ylim=(-0.15 - 0.11 * len(asked), 1.05), xlim=(-2, len(steps) + 22))
    ax.set_xticks(range(0, len(steps) + 1, 25))
    ax.set_yticks(np.arange(0, 1.01, 0.25))  # below 0 are the samplers
    ax.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=2, fontsize=8.5)
    return figure


@styled
def sequences_figure(rows: Mapping[str, tuple[Sequence[int | str], np.ndarray]], *, chunk: slice | None = None) -> Picture:
    """A row of panels for each item: action sequences (panels, T, act_dim), a line a dimension, under the diffusion steps they belong to.

    `chunk` marks the actions of the very last panel that are executed.
    """
    most = max(len(labels) for labels, _ in rows.values())
    figure, axes = blank(len(rows), most, (1.75 * most, 1.9 * len(rows)), sharex=True, sharey=True)
    for line, (name, (labels, sequences)) in zip(axes, rows.items(), strict=True):
        for ax in line[len(labels):]:
            ax.axis("off")
        for ax, label, sequence in zip(line, labels, sequences, strict=False):
            for d in range(sequence.shape[1]):
                ax.plot(sequence[:, d], color=PALETTE[d % len(PALETTE)], lw=1.3)
            ax.set_title(str(label), fontsize=9)
            ax.set(ylim=(-2.6, 2.6))
        line[0].set_ylabel(f"{name}\n(action)", fontsize=9)
    if chunk is not None:
        axes[-1][len(labels) - 1].axvspan(chunk.start - 0.4, chunk.stop - 0.6, color=COLORS["gate"], alpha=0.3, lw=0)
    for ax in axes[-1]:
        ax.set_xlabel("action of the sequence", fontsize=8)
    return figure


@styled
def chunks_figure(window: int, chunk: int, horizon: int, decisions: int = 3) -> Picture:
    """What a chunked policy sees, predicts and executes at its first decisions, on the axis of environment steps."""
    figure, axes = blank(size=(7.6, 0.75 + 0.6 * decisions))
    ax = axes[0, 0]
    for d in range(decisions):
        now, y = d * chunk, decisions - d
        parts = (("sees", now - window + 1, window, COLORS["base"], 0.26), ("predicts", now - window + 1, horizon, "#dddddd", 0.0),
                 ("executes", now, chunk, COLORS["decorated"], 0.0))
        for name, start, length, color, up in parts:
            for k in range(length):
                ax.barh(y + up - 0.13, 0.9, left=start + k - 0.45, height=0.22, color=color, label=name if d == k == 0 else None)
    ax.set(xlabel="environment step", ylabel="decision", ylim=(0.4, decisions + 0.7))
    ax.set_yticks(range(1, decisions + 1), range(decisions, 0, -1))
    ax.grid(visible=False)
    ax.legend(ncols=3, loc="upper right", fontsize=8.5)
    return figure


@styled
def sampling_figure(table: pd.DataFrame, title: str = "") -> Picture:
    """Left: success of the variants with 95 % Wilson intervals; right: what a primitive step of one environment costs.

    Rows of `diffusion_analysis.compare_sampling`.
    """
    figure, axes = blank(1, 2, (9.0, 0.9 + 0.42 * len(table)), sharey=True)
    left, right = axes[0]
    for y, row in enumerate(table.itertuples()):
        rate, color = wilson(row.successes, row.episodes), PALETTE[y % len(PALETTE)]
        left.plot([rate.low, rate.high], [y, y], color=color, lw=2.4)
        left.plot(rate.value, y, "o", color=color, ms=7)
        right.barh(y, row.ms_per_step, color=color, height=0.6)
        right.text(row.ms_per_step, y, f" {row.ms_per_step:.2g}", va="center", fontsize=8.5)
    left.set_yticks(range(len(table)), table.variant)
    left.invert_yaxis()
    left.set(xlim=(-0.02, 1.02), xlabel=f"success, {table.episodes.iloc[0]} episodes, 95 % interval", title=title)
    left.xaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    right.set(xlabel="milliseconds a step and environment", xlim=(0, 1.25 * table.ms_per_step.max()))
    _flat(left, right)
    return figure


@styled
def temperature_figure(table: pd.DataFrame) -> Picture:
    """Success against how much noise sampling starts from, a panel a task, at most four a row. Rows of `task_range.by_temperature`."""
    tasks = list(dict.fromkeys(table.task))
    columns = min(len(tasks), 4)
    lines = -(-len(tasks) // columns)
    figure, axes = blank(lines, columns, (2.3 * columns, 2.3 * lines), sharey=True)
    for ax in axes.flat[len(tasks):]:
        ax.remove()
    for ax, task, color in zip(axes.flat, tasks, PALETTE, strict=False):
        rows = table[table.task == task]
        errors = np.stack([rows.success - rows.low, rows.high - rows.success])
        ax.errorbar(rows.temperature, rows.success, errors, color=color, marker="o", ms=5, lw=1.6, capsize=2)
        ax.set(title=task, xlim=(-0.15, table.temperature.max() + 0.15), ylim=(-0.02, 1.04))
        ax.set_xticks(sorted(rows.temperature))
        ax.yaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    figure.supxlabel("temperature")
    figure.supylabel(f"success, {table.episodes.iloc[0]} episodes")
    return figure


def _flat(*axes: Axes) -> None:
    for ax in axes:
        ax.grid(axis="y", visible=False)
