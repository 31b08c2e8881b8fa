"""Figures with one look. Each function takes tables or arrays and returns a Figure; nothing is shown or saved.

Colours mean the same everywhere: grey is the base policy, blue the decorated one, green what was gained, red what was
lost.
"""
from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .demos.format import Demos
from .errors import PdkitError
from .stats import Paired, Rate

COLORS = {"base": "#7d7d7d", "decorated": "#1f6fb4", "exploring": "#9cc3e6", "gained": "#2c9f6b", "lost": "#d1495b",
          "both": "#cfe3d8", "neither": "#3c3c46", "gate": "#e0a030", "recorded": "#c9c9c9"}
PALETTE = ["#1f6fb4", "#d1495b", "#2c9f6b", "#e0a030", "#7a4fa3", "#17a2b8", "#a8542a", "#e377c2", "#5f6b1f", "#3c3c46", "#9cc3e6",
           "#f4a6a0", "#98cfa9", "#c7b42c", "#5b4a8a", "#00c9a7", "#ff8c42", "#b79be0", "#0b3d2e"]  # enough for a leaderboard
STYLE = {"font.size": 10, "axes.titlesize": 11, "axes.titleweight": "bold", "axes.titlelocation": "left",
         "axes.spines.right": False, "axes.spines.top": False, "axes.grid": True, "grid.color": "#e8e8e8",
         "axes.axisbelow": True, "legend.frameon": False, "figure.dpi": 110, "savefig.dpi": 130, "lines.linewidth": 1.8,
         "xtick.color": "#444444", "ytick.color": "#444444"}


class Picture(Figure):
    """A Figure that a notebook shows as PNG when it ends a cell or is given to `display`, without pyplot."""

    def _repr_png_(self) -> bytes:
        return self.png()

    def png(self, dpi: int = 110) -> bytes:
        """The figure as PNG."""
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=dpi)
        return stream.getvalue()


def save_small(figure: Figure, path: str | Path, dpi: int = 130) -> None:
    """Write a figure as a PNG of 128 colours: lines and areas look the same in a third of the bytes."""
    from PIL import Image

    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    Image.open(stream).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(path, "PNG", optimize=True)


def styled(function: Callable[..., Picture]) -> Callable[..., Picture]:
    """Draw with our style, whatever the caller's is, and leave the caller's alone."""
    @wraps(function)
    def wrapper(*args, **kwargs) -> Picture:
        with mpl.rc_context(STYLE):
            return function(*args, **kwargs)

    return wrapper


def use_style() -> None:
    """Give a notebook's own figures the same look."""
    mpl.rcParams.update(STYLE)


def blank(rows: int = 1, columns: int = 1, size: tuple[float, float] = (7.2, 4.0),
          layout: str | None = "constrained", **options) -> tuple[Picture, np.ndarray]:
    """A figure of `size` inches and its axes (rows, columns). pyplot does not know it: it never leaks or shows twice."""
    figure = Picture(figsize=size, layout=layout)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def _percent(axes: Axes, label: str = "success") -> None:
    axes.set_ylim(-0.02, 1.05)
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.yaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    axes.set_ylabel(label)


def _columns(table: pd.DataFrame, *names: str) -> None:
    missing = [name for name in names if name not in table.columns]
    if missing or not len(table):
        raise PdkitError(f"This figure needs rows with the columns {', '.join(names)}; "
                         f"{', '.join(missing) or 'every row'} is missing.")


# ---- online training -------------------------------------------------------------------------------------------------

@styled
def learning_curve(metrics: pd.DataFrame, *, base: Rate | None = None, recorded: pd.DataFrame | None = None,
                   budget: int = 0, title: str = "Learning curve") -> Picture:
    """Success against environment steps, with minutes of training on top.

    Args:
        metrics: the rows of a Trainer (step, seconds, gate; success_once and success_at_end where it was evaluated;
            train_success where training episodes ended).
        base: the base policy's rate, drawn as a band of its interval.
        recorded: the same columns and `seed`, for runs done earlier, drawn in grey behind.
        budget: right end of the axis in steps, for a run that is still going on.
    """
    _columns(metrics, "step", "seconds")
    recorded = recorded if recorded is not None else pd.DataFrame({"seed": [], "step": []})
    figure, axes = blank()
    ax = axes[0, 0]
    if base is not None:
        ax.axhspan(base.low, base.high, color=COLORS["base"], alpha=0.18, lw=0)
        ax.axhline(base.value, color=COLORS["base"], lw=1.4, label="base policy (95 % interval)")
    for _, run in _evaluated(recorded).groupby("seed"):
        ax.plot(run.step, run.success_once, color=COLORS["recorded"], lw=1.2, zorder=1)
    _training_and_gate(ax, metrics)
    points = _evaluated(metrics)
    if len(points):
        color, last = COLORS["decorated"], points.iloc[-1]
        ax.plot(points.step, points.success_at_end, "--o", color=color, ms=4, mfc="white", lw=1.2, alpha=0.8,
                label="decorated, solved at the end")
        ax.plot(points.step, points.success_once, "-o", color=color, ms=5, label="decorated, solved at any step")
        ax.annotate(f"{last.success_once:.0%}", (last.step, last.success_once), (6, -4), textcoords="offset points",
                    color=color, weight="bold")
    handles = ax.get_legend_handles_labels()[0]
    if len(recorded):
        label = f"recorded runs ({recorded.seed.nunique()} seeds)"
        handles.append(Line2D([], [], color=COLORS["recorded"], label=label))
    right = max(budget, metrics.step.max(), recorded.step.max() if len(recorded) else 0)
    ax.set_xlim(0, right * 1.07)
    ax.set_xlabel("environment steps")
    ax.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda x, _: f"{x:,.0f}"))
    _percent(ax)
    _minutes(ax, metrics, right)
    ax.set_title(title, pad=12)
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8.5)
    return figure


def _evaluated(table: pd.DataFrame) -> pd.DataFrame:
    """The rows that hold an evaluation."""
    if "success_once" not in table.columns:
        return table.assign(success_once=np.nan, success_at_end=np.nan).iloc[:0]
    return table[table.success_once.notna()]


def _training_and_gate(ax: Axes, metrics: pd.DataFrame) -> None:
    if "train_success" in metrics.columns and metrics.train_success.notna().any():
        rows = metrics[metrics.train_success.notna()]
        smooth = rows.train_success.rolling(5, min_periods=1, center=True).mean()
        ax.plot(rows.step, smooth, color=COLORS["exploring"], lw=1, label="training episodes (exploring)")
    if "gate" in metrics.columns:
        ax.plot(metrics.step, metrics.gate, ":", color=COLORS["gate"], lw=1.4,
                label="gate: chance that the residual is on")


def _minutes(ax: Axes, metrics: pd.DataFrame, right: float) -> None:
    """A second x axis: whole minutes (seconds in a short run) of training, at the steps where they were reached."""
    seconds, steps = np.array([0.0, *metrics.seconds]), np.array([0.0, *metrics.step])
    unit, name = (60.0, "minutes of training") if seconds[-1] >= 60 else (1.0, "seconds of training")
    count = max(1, round(8 * steps[-1] / right))
    marks = mpl.ticker.MaxNLocator(count, integer=True).tick_values(0, max(seconds[-1] / unit, 1))
    marks = [m for m in marks if 0 <= m * unit <= seconds[-1]]
    marks = marks[-1:] if count == 1 else marks  # no room for more
    top = ax.secondary_xaxis("top")
    top.set_xticks([float(np.interp(m * unit, seconds, steps)) for m in marks], [f"{m:g}" for m in marks])
    top.set_xlabel(name, fontsize=9, labelpad=2)
    top.tick_params(length=3, labelsize=8.5)


# ---- comparisons -----------------------------------------------------------------------------------------------------

@styled
def paired_figure(result: Paired, base: pd.DataFrame, other: pd.DataFrame, *,
                  labels: tuple[str, str] = ("base", "decorated")) -> Picture:
    """Bars with intervals, and every seed as one cell: solved by both, gained, lost, or solved by neither.

    `base` and `other` are the evaluate() tables that `result` compares.
    """
    figure, axes = blank(1, 2, (9.2, 3.6), width_ratios=[1, 2.1])
    _rate_bars(axes[0, 0], [(labels[0], result.base, COLORS["base"]), (labels[1], result.other, COLORS["decorated"])])
    first, second = (t.set_index("seed")[result.column].astype(bool).sort_index() for t in (base, other))
    outcome = np.where(first & second, 0, np.where(second, 1, np.where(first, 2, 3)))
    kinds = {"both": "both solve", "gained": f"only {labels[1]}: gained", "lost": f"only {labels[0]}: lost",
             "neither": "neither"}
    _cells(axes[0, 1], outcome, kinds)
    axes[0, 1].set_title(f"The same {result.n} episodes, one cell each")
    points = f"{100 * result.difference:+.1f} points ({100 * result.low:+.1f} to {100 * result.high:+.1f})"
    axes[0, 0].set_title(points, fontsize=10)
    return figure


def _rate_bars(ax: Axes, bars: Sequence[tuple[str, Rate, str]]) -> None:
    for x, (_, rate, color) in enumerate(bars):
        ax.bar(x, rate.value, 0.62, color=color)
        reach = [[rate.value - rate.low], [rate.high - rate.value]]
        ax.errorbar(x, rate.value, reach, color="black", capsize=5, lw=1.4)
        inside = rate.low > 0.2
        ax.text(x, rate.low - 0.03 if inside else rate.high + 0.03, f"{rate.value:.1%}", ha="center", weight="bold",
                va="top" if inside else "bottom", color="white" if inside else "black")
    ax.set_xticks(range(len(bars)), [name for name, _, _ in bars])
    ax.set_xlim(-0.6, len(bars) - 0.4)
    ax.grid(axis="x", visible=False)
    _percent(ax, "success, 95 % interval")


def _cells(ax: Axes, values: np.ndarray, kinds: dict[str, str]) -> None:
    """One square for each value (an index into `kinds`: colour name to label), sorted, so that areas compare."""
    colors = [COLORS[name] for name in kinds]
    per_row = int(np.ceil(np.sqrt(2 * len(values))))  # twice as wide as high
    for i, value in enumerate(np.sort(values)):
        corner = (i % per_row + 0.06, i // per_row + 0.06)
        ax.add_patch(mpl.patches.Rectangle(corner, 0.88, 0.88, color=colors[value], lw=0))
    rows = -(-len(values) // per_row)
    ax.set(xlim=(0, per_row), ylim=(rows, 0), aspect="equal", xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    labels = [f"{label} ({(values == i).sum()})" for i, label in enumerate(kinds.values())]
    handles = [Patch(color=color, label=label) for color, label in zip(colors, labels, strict=True)]
    ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2, fontsize=9)


@styled
def rates_figure(rates: dict[str, Rate], *, title: str = "") -> Picture:
    """Bars with intervals for named success rates."""
    figure, axes = blank(size=(1.4 + 1.25 * len(rates), 3.4))
    palette = [COLORS["base"], COLORS["decorated"], COLORS["gained"], COLORS["gate"], COLORS["neither"]]
    bars = [(name, rate, palette[i % len(palette)]) for i, (name, rate) in enumerate(rates.items())]
    _rate_bars(axes[0, 0], bars)
    axes[0, 0].set_title(title)
    return figure


@styled
def residual_figure(trace: pd.DataFrame, *, bound: float, title: str = "How large the correction is") -> Picture:
    """Mean size per action dimension of the base action and of alpha times the residual over one episode, and their bound.

    `trace` has one row a step: step, base, residual (already times alpha), success; `video.trace` makes it.
    """
    _columns(trace, "step", "base", "residual", "success")
    figure, axes = blank(size=(7.2, 3.2))
    ax = axes[0, 0]
    ax.plot(trace.step, trace.base, color=COLORS["base"], label="base action, mean |a|")
    ax.fill_between(trace.step, trace.residual, color=COLORS["decorated"], alpha=0.35, lw=0)
    ax.plot(trace.step, trace.residual, color=COLORS["decorated"], label="correction, mean |alpha x residual|")
    ax.axhline(bound, color=COLORS["decorated"], ls=":", lw=1.2, label=f"its bound, {bound:g} on average")
    solved = trace.step[trace.success.astype(bool)]
    if len(solved):
        ax.axvline(solved.iloc[0], color=COLORS["gained"], lw=1.6)
        ax.annotate(f"solved at step {solved.iloc[0]}", (solved.iloc[0], 1), (5, -4), textcoords="offset points",
                    xycoords=("data", "axes fraction"), va="top", color=COLORS["gained"], weight="bold")
    ax.set(xlabel="step of the episode", ylabel="size per dimension", xlim=(0, trace.step.max()),
           ylim=(0, 1.2 * max(bound, trace.base.max(), trace.residual.max())))
    ax.set_title(title)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8.5)
    return figure


# ---- demonstrations and base policies --------------------------------------------------------------------------------

@styled
def demo_figure(demos: Demos) -> Picture:
    """What a demonstration set looks like: lengths with the first success, and how large each action dimension is."""
    figure, axes = blank(1, 3, (10.5, 3.2), width_ratios=[1, 1, 1.5])
    first = [int(np.argmax(e["success"])) + 1 for e in demos.episodes() if e["success"].any()]
    bins = np.linspace(0, max(demos.lengths) * 1.02, 16)
    axes[0, 0].hist(demos.lengths, bins, color=COLORS["base"])
    axes[0, 0].set(xlabel="steps", ylabel="episodes")
    axes[0, 0].set_title("Length")
    axes[0, 1].hist(first, bins, color=COLORS["gained"])
    axes[0, 1].set(xlabel="step", ylabel="episodes")
    axes[0, 1].set_title("First success")
    low, middle, high = np.quantile(demos.actions, [0.05, 0.5, 0.95], axis=0)
    x = np.arange(demos.actions.shape[1])
    axes[0, 2].bar(x, high - low, bottom=low, width=0.75, color=COLORS["decorated"], alpha=0.6)
    axes[0, 2].plot(x, middle, "_", color="black", ms=8)
    axes[0, 2].set(xlabel="action dimension", ylabel="action", ylim=(-1.05, 1.05))
    axes[0, 2].set_title("Actions: 5 % to 95 %, and the median")
    axes[0, 2].xaxis.set_major_locator(mpl.ticker.MaxNLocator(8, integer=True))
    for ax in axes[0, :2]:
        ax.yaxis.set_major_locator(mpl.ticker.MaxNLocator(6, integer=True))
    return figure


@styled
def bins_figure(actions: np.ndarray, centres: np.ndarray, limit: int = 4000) -> Picture:
    """Behavior Transformer's bins: actions (N, act_dim) on their two main axes, coloured by the nearest of `centres`
    (K, act_dim), and how many actions each bin holds."""
    from sklearn.decomposition import PCA

    if not len(actions) or actions.shape[1] != centres.shape[1]:
        raise PdkitError(f"Actions {actions.shape} and bin centres {centres.shape} do not fit together.")
    picked = actions[np.linspace(0, len(actions) - 1, min(limit, len(actions))).astype(int)]
    nearest, all_nearest = (np.linalg.norm(a[:, None] - centres, axis=-1).argmin(axis=1) for a in (picked, actions))
    plane = PCA(2).fit(actions)
    flat, flat_centres = plane.transform(picked), plane.transform(centres)
    figure, axes = blank(1, 2, (9.2, 3.8), width_ratios=[1.6, 1])
    colors = mpl.colormaps["tab10" if len(centres) <= 10 else "tab20"](np.arange(len(centres)) % 20)
    axes[0, 0].scatter(*flat.T, c=colors[nearest], s=6, alpha=0.5, lw=0)
    axes[0, 0].scatter(*flat_centres.T, c=colors, s=170, marker="o", edgecolors="black", linewidths=1.4, zorder=3)
    for k, at in enumerate(flat_centres):
        axes[0, 0].annotate(str(k), at, ha="center", va="center", weight="bold", fontsize=8.5, color="white", zorder=4)
    share = plane.explained_variance_ratio_
    axes[0, 0].set(xlabel=f"first main axis ({share[0]:.0%} of the variance)", ylabel=f"second ({share[1]:.0%})")
    axes[0, 0].set_title("Actions, coloured by bin; centres numbered")
    axes[0, 1].bar(range(len(centres)), np.bincount(all_nearest, minlength=len(centres)) / len(actions), color=colors)
    axes[0, 1].yaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0, decimals=0))
    axes[0, 1].set(xlabel="bin", ylabel="share of the actions", xticks=range(len(centres)))
    axes[0, 1].set_title("How full each bin is")
    axes[0, 1].grid(axis="x", visible=False)
    return figure


@styled
def loss_curves(history: pd.DataFrame, terms: Sequence[str] | None = None) -> Picture:
    """Each loss term of an imitation run against iterations (logarithmic where all values are positive), and success
    where it was measured; `history` are the rows of imitate()."""
    _columns(history, "iteration")
    skip = {"iteration", "seconds", "success_once", "success_at_end"}
    terms = list(terms or [c for c in history.columns if c not in skip])
    evaluated = "success_once" in history.columns and history.success_once.notna().any()
    count = len(terms) + evaluated
    figure, axes = blank(1, count, (2.6 * count + 0.6, 2.8))
    for ax, name in zip(axes[0], terms, strict=False):
        ax.plot(history.iteration, history[name], "-o", color=COLORS["decorated"], ms=4)
        if "accuracy" not in name and (history[name] > 0).all():
            ax.set_yscale("log")
        ax.set_title(name.replace("_", " "))
        ax.set_xlabel("iteration")
    if evaluated:
        rows = history[history.success_once.notna()]
        axes[0, -1].plot(rows.iteration, rows.success_once, "-o", color=COLORS["gained"], ms=4)
        axes[0, -1].set(xlabel="iteration")
        axes[0, -1].set_title("success")
        _percent(axes[0, -1], "")
    return figure
