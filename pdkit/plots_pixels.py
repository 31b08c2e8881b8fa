"""Figures of notebook 15: what cameras see, what a random shift does, what a buffer weighs."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from .pixels.cameras import view_of
from .pixels.sim import Frame
from .plots import COLORS, Picture, _percent, blank, styled
from .plots_compare import nth


def _bare(ax: Axes, title: str = "") -> None:
    ax.set(xticks=[], yticks=[])
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    ax.set_title(title, fontsize=8.5, weight="normal", loc="center", pad=3)


@styled
def views_figure(frames: Mapping[str, Frame], *, columns: int = 4) -> Picture:
    """What each task's cameras see: colours, then distances (dark is near, white the farthest tenth or nothing).

    A task with several panels begins a row (of more than `columns`, where it has more); tasks with one share a row.
    """
    panels = {task: _panels(task, frame) for task, frame in frames.items()}
    columns = max(columns, *(len(p) for p in panels.values()))
    rows: list[list[tuple[np.ndarray, str]]] = []
    alone = True  # whether the last row may take no other task
    for own in panels.values():
        if alone or len(own) > 1 or len(rows[-1]) == columns:
            rows.append([])
        rows[-1] += own
        alone = len(own) > 1
    figure, axes = blank(len(rows), columns, (1.75 * columns, 1.85 * len(rows)))
    for row, content in zip(axes, rows, strict=True):
        for ax in row:
            _bare(ax)
        for ax, (picture, title) in zip(row, content, strict=False):
            ax.imshow(picture, cmap="gray")
            _bare(ax, title)
    return figure


def _panels(task: str, frame: Frame) -> list[tuple[np.ndarray, str]]:
    """Pictures with their titles."""
    cameras = view_of(task).cameras
    panels = [(frame.rgb[3 * i: 3 * i + 3].transpose(1, 2, 0), f"{task}: {name}" if i == 0 else name) for i, name in enumerate(cameras)]
    for distance, name in zip(frame.depth, cameras, strict=False):
        far = np.quantile(distance[distance > 0], 0.9) if distance.any() else 1
        panels.append((np.where(distance == 0, far, np.minimum(distance, far)), f"{name}, distance"))
    return panels


@styled
def shift_figure(picture: np.ndarray, shifted: Sequence[np.ndarray], pad: int) -> Picture:
    """A picture (H, W, 3), random shifts of it by up to `pad` pixels, and under each what it differs from the first in."""
    figure, axes = blank(2, 1 + len(shifted), (1.75 * (1 + len(shifted)), 3.6))
    for column, other in enumerate([picture, *shifted]):
        axes[0, column].imshow(other)
        _bare(axes[0, column], "as drawn" if column == 0 else f"shift {column}, up to {pad} pixels")
        difference = np.abs(other.astype(int) - picture).mean(axis=2)
        axes[1, column].imshow(255 - difference, cmap="gray", vmin=0, vmax=255)
        _bare(axes[1, column], "" if column == 0 else f"changed: {(difference > 8).mean():.0%} of the pixels")
    return figure


@styled
def memory_figure(table: pd.DataFrame, steps: int) -> Picture:
    """Gigabytes of a buffer of `steps` transitions for each task, as pictures and as features, on a logarithmic axis."""
    figure, axes = blank(size=(7.2, 0.42 * len(table) + 1.3))
    ax, y = axes[0, 0], np.arange(len(table))[::-1]
    for offset, name, colour in ((0.2, "pictures", COLORS["base"]), (-0.2, "features", COLORS["decorated"])):
        ax.barh(y + offset, table[name], 0.38, color=colour, label=name)
        for place, value in zip(y + offset, table[name], strict=True):
            ax.text(value * 1.08, place, f"{value:,.1f}" if value < 100 else f"{value:,.0f}", va="center", fontsize=8.5)
    ax.axvline(16, color="#999999", ls="--", lw=1)
    ax.text(16.6, y.max() + 0.42, "a laptop's 16 GB", fontsize=8, color="#777777", va="bottom")
    ax.set_xscale("log")
    ax.set_yticks(y, table.task)
    ax.set_xlim(table.features.min() / 2, table.pictures.max() * 4)
    ax.set_xlabel(f"gigabytes in a buffer of {steps:,} transitions (logarithmic)")
    ax.set_title("What a buffer weighs")
    ax.legend(loc="lower right", fontsize=9)
    return figure


@styled
def training_figure(curves: pd.DataFrame, labels: Mapping[str, str], *, base: float | None = None, title: str = "") -> Picture:
    """Solved training episodes between logged steps, a line a recipe of `labels` (the mean over its seeds), and evaluations as squares;
    dashed, the visual base.

    `curves` has recipe, seed, step, train_success and, where it was evaluated, success_once.
    """
    figure, axes = blank(size=(7.2, 3.4))
    ax = axes[0, 0]
    for recipe, colour in zip(labels, (COLORS["gate"], COLORS["decorated"], COLORS["lost"]), strict=False):
        mine = curves[curves.recipe == recipe]
        seeds = mine.seed.nunique()
        rows = nth(mine)[[name for name in ("step", "train_success", "success_once") if name in mine]].mean()
        known = rows.dropna(subset=["train_success"])
        ax.plot(known.step, known.train_success, "-o", ms=3.5, color=colour, label=labels[recipe] + f", {seeds} seeds" * (seeds > 1))
        if "success_once" in rows:
            ax.plot(rows.step, rows.success_once, "s", ms=7, mfc="none", color=colour)
    ax.plot([], [], "s", ms=7, mfc="none", color="0.3", label="evaluation, to the test's time limit")
    if base is not None:
        ax.axhline(base, color=COLORS["base"], ls="--", lw=1.2, label="visual base policy, test episodes")
    _percent(ax, "episodes solved")
    ax.set(xlabel="environment steps", xlim=(0, None), title=title)
    ax.xaxis.set_major_formatter("{x:,.0f}")
    ax.legend(loc="lower right", fontsize=8.5)
    return figure
