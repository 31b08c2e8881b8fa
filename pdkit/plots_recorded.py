"""The picture beside a recorded table of trainings: data/results/NAME.png."""
from __future__ import annotations

import re

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .plots import PALETTE
from .stats import wilson

OTHER_BASE = re.compile(r",base=[^,]*")  # in the recipe of a method that starts from another policy than its own


def figure(table: pd.DataFrame, curves: pd.DataFrame, task: str = "Door") -> Figure:
    """Left: evaluations on selection seeds during training, a line a run. Right: success on the test seeds, with intervals.

    Runs are named by their recipe where there are several recipes, by their seed otherwise; several recipes with several seeds
    are a line a recipe (the mean), and a bar with a dot a seed, the best on top; what starts from another policy (`,base=`) has its
    method's colour, dashed and hatched. Where recipes start from different successes of one kind of policy, or each from a kind of its
    own, that has no bar: their curves begin with an open square, grey where it is that of several, and their bars have a tick there.
    """
    table, curves = table[table.task == task], curves[curves.task == task]
    recipes, several = list(dict.fromkeys(table.recipe)), table.recipe.nunique() > 1
    means = several and len(table) > len(recipes)
    if means:
        recipes = list(table.groupby("recipe", sort=False).decorated_success.mean().sort_values(ascending=False, kind="stable").index)
    height = max(4.4 if several else 3.6, 0.22 * (len(recipes) if means else len(table)))
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, height), width_ratios=(3, 2), layout="constrained")
    methods = list(dict.fromkeys(OTHER_BASE.sub("", recipe) for recipe in recipes))
    groups = [(r, r, table[table.recipe == r]) for r in recipes] if means else \
        [(f"{r.recipe}, seed {r.seed}" if several else f"seed {r.seed}", r.recipe, table.loc[[i]]) for i, r in table.iterrows()]
    kind_of = "policy" if "policy" in table else "task"
    kinds = table.groupby(kind_of, sort=False).base_success
    each_its_own = len(kinds) > 1 and (table.groupby(kind_of).recipe.nunique() == 1).all()
    scattered = {kind for kind, starts in kinds if each_its_own or starts.nunique() > 1}
    bases = {f"base ({kind})" if len(kinds) > 1 else "base": starts.iloc[0] for kind, starts in kinds if kind not in scattered}
    ticks = {name: rows.base_success.mean() for name, _, rows in groups if rows[kind_of].iloc[0] in scattered}
    bars = [(name, [value], "0.65", table.episodes.iloc[0]) for name, value in bases.items()]
    for i, (name, recipe, rows) in enumerate(groups):
        color = PALETTE[(methods.index(OTHER_BASE.sub("", recipe)) if several else i) % len(PALETTE)]
        curve = curves[(curves.recipe == recipe) & curves.seed.isin(rows.seed)].reindex(columns=["seed", "step", "success_once"]).dropna()
        # Seeds are logged a few steps apart: the n-th evaluations belong together.
        curve = curve.assign(number=curve.groupby("seed").cumcount()).groupby("number")[["step", "success_once"]].mean()
        left.plot(curve.step / 1000, 100 * curve.success_once, "--o" if OTHER_BASE.search(recipe) else "-o", ms=3, lw=1.2, color=color,
                  label=name)
        if name in ticks:
            shared = list(ticks.values()).count(ticks[name]) > 1
            left.plot(0, 100 * ticks[name], "s", ms=5, mfc="white", color="0.4" if shared else color, clip_on=False)
        bars.append((name, list(rows.decorated_success), color if several else "#2c9f6b", rows.episodes.iloc[0]))
    for value in bases.values():
        left.axhline(100 * value, color="0.4", ls="--", lw=1, label="base policy")
    left.set(xlabel="environment steps (thousands)", ylabel="success within the episode (%)", ylim=(0, 102),
             title=f"{task}: evaluations during training" + " (colours: right)" * several)
    left.xaxis.set_major_locator(MaxNLocator(8, integer=True, steps=[1, 2, 5, 10]))
    if not several:
        left.legend(fontsize=8, loc="best")
    for y, (name, values, color, count) in enumerate(reversed(bars)):
        value = sum(values) / len(values)
        right.barh(y, 100 * value, color=color, hatch="///" if OTHER_BASE.search(name) else "", edgecolor="white", lw=0)
        right.plot(0, y, "s", ms=6, color=color, clip_on=False)  # bars of 0 have a colour, too
        if means and name not in bases:
            right.plot([100 * v for v in values], [y] * len(values), "k.", ms=4)
        else:
            rate = wilson(round(value * count), int(count))
            right.errorbar(100 * value, y, xerr=[[100 * (value - rate.low)], [100 * (rate.high - value)]], color="k", capsize=3, lw=1)
        if name in ticks:
            right.plot([100 * ticks[name]] * 2, [y - 0.4, y + 0.4], color="0.4", lw=2)
        right.text(104, y, f"{100 * value:.3g}", va="center", fontsize=8)
    right.set_yticks(range(len(bars)), [name for name, *_ in reversed(bars)], fontsize=8)
    least, most = int(table.episodes.min()), int(table.episodes.max())
    shown = f"{least if least == most else f'{least} to {most}'} test episodes, {'mean and seeds' if means else '95 % intervals'}"
    right.set(xlabel="success within the episode (%)", xlim=(0, 102), title=f"{shown}\n(grey tick: its start)" if ticks else shown)
    for ax in (left, right):
        ax.spines[["top", "right"]].set_visible(False)
    plt.close(fig)
    return fig
