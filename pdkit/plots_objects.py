"""Figures of lesson 14: the objects themselves, and what policies make of those that no demonstration shows."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
import pandas as pd
import trimesh
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from .object_shapes import parts
from .plots import COLORS, Picture, _columns, _percent, blank, styled
from .stats import Interval, Rate
from .tasks.partnet import Model

KINDS = {"source": "#7d8794", "novel": COLORS["gate"]}
PARTS = {"switch": "#d1495b", "wheel": "#3c3c46"}  # what is drawn in a colour of its own: what is to be moved, what it rolls on
EDGE = 0.05  # metres: the longest edge of a triangle that is drawn
LIGHT = np.array([0.4, 0.25, 0.88])  # where light comes from


@styled
def objects_figure(groups: Mapping[str, Sequence[Model]]) -> Picture:
    """A drawing of each object of "source" and "novel", all to one scale; source objects grey, novel ones coloured, handles red."""
    shapes = [(kind, model, parts(model)) for kind, models in groups.items() for model in models]
    rows, columns = 2, -(-len(shapes) // 2)
    figure, axes = blank(rows, columns, (1.5 * columns, 1.8 * rows), subplot_kw=dict(projection="3d"))
    corners = np.concatenate([part.triangles.reshape(-1, 3) for _, _, found in shapes for part in found])
    middle, half = (corners.max(0) + corners.min(0)) / 2, (corners.max(0) - corners.min(0)).max() / 2
    for ax in axes.flat[len(shapes):]:
        ax.remove()
    for ax, (kind, model, found) in zip(axes.flat, shapes, strict=False):
        triangles = [_small(part.triangles) for part in found]
        colours = [_shaded(few, PARTS.get(part.name, KINDS[kind])) for few, part in zip(triangles, found, strict=True)]
        ax.add_collection3d(Poly3DCollection(np.concatenate(triangles), facecolors=np.concatenate(colours), lw=0, antialiased=False))
        for axis, centre in zip("xyz", middle, strict=True):
            getattr(ax, f"set_{axis}lim")(centre - half, centre + half)
        ax.set_box_aspect((1, 1, 1), zoom=1.45)
        ax.view_init(elev=24, azim=-140)
        ax.set_axis_off()
        ax.set_title(f"{model.name}\n{kind}", fontsize=8, loc="center", y=0.98, weight="normal")
    return figure


def _small(triangles: np.ndarray) -> np.ndarray:
    """The same surface in triangles small enough for matplotlib, which draws the farther middle first, to get right."""
    vertices, faces = trimesh.remesh.subdivide_to_size(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), EDGE)
    return vertices[faces]


def _shaded(triangles: np.ndarray, colour: str) -> np.ndarray:
    """Colours (N, 4) of triangles, lighter the more they face the light."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = 0.55 + 0.45 * np.clip(normals @ LIGHT / np.linalg.norm(LIGHT), 0, 1)
    return np.column_stack([light[:, None] * mpl.colors.to_rgb(colour), np.ones(len(light))])


@styled
def strangeness_figure(distances: Mapping[str, np.ndarray], title: str = "") -> Picture:
    """Shares of starts up to a distance from the nearest demonstrated start, a line for "source" and one for "novel"."""
    figure, axes = blank(size=(6.4, 3.3))
    ax = axes[0, 0]
    for kind, values in distances.items():
        ax.ecdf(values, color=KINDS[kind], label=f"{kind} objects ({len(values)} starts)", lw=2.4 if kind == "source" else 1.6)
    _percent(ax, "share of the starts")
    ax.set(xlabel="distance from the nearest demonstrated start (standard deviations)", xlim=(0, None), title=title)
    ax.legend(loc="lower right")
    return figure


@styled
def by_object_figure(summary: pd.DataFrame, totals: Mapping[tuple[str, str], Rate | Interval], title: str = "") -> Picture:
    """Success on each object, with Wilson intervals: `object_analysis.summary`; `totals` (policy, objects) are drawn as lines."""
    _columns(summary, "policy", "objects", "object", "success", "low", "high")
    policies = list(dict.fromkeys(summary.policy))
    palette = dict(zip(policies, (COLORS["base"], COLORS["decorated"]), strict=False))
    kinds = [kind for kind in KINDS if kind in set(summary.objects)]
    widths = [summary[summary.objects == kind].object.nunique() for kind in kinds]
    figure, axes = blank(1, len(kinds), (2.4 + 0.62 * sum(widths), 3.6), sharey=True, width_ratios=widths)
    for ax, kind in zip(axes[0], kinds, strict=True):
        names = sorted(set(summary[summary.objects == kind].object), key=lambda name: (len(name), name))
        for i, policy in enumerate(policies):
            rows = summary[(summary.objects == kind) & (summary.policy == policy)].set_index("object").reindex(names)
            x = np.arange(len(names)) + 0.24 * (i - (len(policies) - 1) / 2)
            ax.errorbar(x, rows.success, [rows.success - rows.low, rows.high - rows.success], fmt="o", ms=5, lw=1.3, capsize=2,
                        color=palette[policy], label=policy)
            if (policy, kind) in totals:
                ax.axhline(totals[policy, kind].value, color=palette[policy], ls="--", lw=1)
        ax.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
        ax.set(title=f"{kind} objects", xlim=(-0.6, len(names) - 0.4))
        ax.grid(axis="x", visible=False)
    _percent(axes[0, 0], "success, 95 % intervals")
    axes[0, -1].legend(loc="lower left", bbox_to_anchor=(1.0, 0.0), title="dashes: all episodes", fontsize=8.5, title_fontsize=8.5)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")
    return figure


@styled
def paths_figure(paths: Mapping[str, np.ndarray], label: str, chunk: int = 1, goal: float = 0.0, title: str = "") -> Picture:
    """`object_analysis.paths` of each policy, a thin line an episode and the median; up to `goal` counts as done."""
    figure, axes = blank(1, len(paths), (4.4 * len(paths), 3.3), sharey=True)
    for ax, (name, values) in zip(axes[0], paths.items(), strict=True):
        steps = chunk * np.arange(values.shape[1])
        ax.plot(steps, values.T, color=COLORS["exploring"], lw=0.9, alpha=0.8)
        ax.plot(steps, np.median(values, axis=0), color=COLORS["decorated"], lw=2.4, label="median")
        ax.axhline(goal, color=COLORS["gained"], ls="--", lw=1.2, label="done")
        ax.set(title=name, xlabel="environment steps", ylim=(-0.03 * values.max(), 1.05 * values.max()))
    axes[0, 0].set_ylabel(label)
    figure.legend(*axes[0, -1].get_legend_handles_labels(), loc="outside right upper", fontsize=8.5)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")
    return figure
