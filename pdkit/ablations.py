"""One change at a time: the grid of bound and schedule, and differences from a reference recipe (notebook 13; appendix B.2, E, G.1).

A table of runs is one of data/results: a row a run with task, recipe, seed, base_success, decorated_success, ... Two recipes are
compared seed by seed, with the interval of pdkit/claims.py and none below three seeds.
"""
from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import pandas as pd

from .claims import TooLittle, by_seed, difference, judged, weakest
from .demos import Demos
from .errors import PdkitError
from .profiles import online_config
from .stats import Interval

GRID = "alpha=0.1,H=20000"  # the ablations' recipe that is the lesson's
RECORDED_STEPS = 40_000  # of every run of ablations.toml
CELL = re.compile(r"alpha=([\d.]+),H=(\d+)")
ENOUGH = 0.1  # ours: a setting works when it is less than 10 points behind the best


# ---- differences -----------------------------------------------------------------------------------------------------

def differences(table: pd.DataFrame, labels: Mapping[str, str], reference: str = "", column: str = "decorated_success") -> pd.DataFrame:
    """Each recipe of `labels` less `reference` (left out: less the success of the policy that it starts from), seed by seed.

    A row a recipe: recipe, label, seeds (pairs), value, low, high, as fractions. Recipes that are not recorded, or share no seed with
    the reference, have no row; below three seeds low and high are NaN.
    """
    rows = []
    for recipe, label in labels.items():
        mine, theirs = _by_seed(table, recipe, column), _by_seed(table, reference or recipe, column if reference else "base_success")
        values = (mine - theirs).dropna()
        if recipe == reference or values.empty:
            continue
        try:
            interval, values = difference(mine, theirs)
        except TooLittle:
            interval = Interval(values.mean(), np.nan, np.nan)
        rows.append({"recipe": recipe, "label": label, "seeds": len(values), **vars(interval)})
    return pd.DataFrame(rows, columns=["recipe", "label", "seeds", "value", "low", "high"])


def lines(rows: pd.DataFrame) -> list[str]:
    """`differences` in words, a line each."""
    return [f"{row.label}: {100 * row.value:+.1f} points" + (f" over {row.seeds} seeds, too few for an interval" if np.isnan(row.low) else
            f" ({100 * row.low:+.1f} to {100 * row.high:+.1f}), {row.seeds} pairs") for row in rows.itertuples()]


def _by_seed(table: pd.DataFrame, recipe: str, column: str) -> pd.Series:
    """As claims.by_seed, but with however few seeds there are, none included (an empty table has no such column)."""
    if table.empty:
        return pd.Series(dtype=float, index=pd.MultiIndex.from_arrays([[], []], names=["task", "seed"]))
    return table[table.recipe == recipe].set_index(["task", "seed"])[column].astype(float).dropna()


# ---- the grid of bound and schedule ----------------------------------------------------------------------------------

def cell_name(alpha: float, H: int) -> str:
    """What the sweep calls a cell of the grid."""
    return f"alpha={float(alpha)},H={H}"


def cell_of(alpha: float, H: int, total_steps: int, critic_input: str = "sum", actor_input: str = "obs", units: str = "action") -> str:
    """The recorded recipe that a run of another length corresponds to: H counts as a share of the steps, and inputs are named where
    they differ from the lesson's (alone, where alpha and H do not)."""
    cell = cell_name(alpha, round(RECORDED_STEPS * H / total_steps))
    usual = (("critic_input", critic_input, "sum"), ("residual_units", "action" if critic_input == "sum" else units, "action"),
             ("actor_input", actor_input, "obs"))
    inputs = [f"{name}={value}" for name, value, lesson in usual if value != lesson]
    return ",".join(inputs if inputs and cell == GRID else [cell, *inputs])


def grid(table: pd.DataFrame, column: str = "decorated_success") -> pd.DataFrame:
    """Mean of `column` over seeds, alpha (rows) by H (columns); NaN where no such recipe is recorded. Raises PdkitError without any."""
    found = {recipe: CELL.fullmatch(recipe) for recipe in dict.fromkeys(table.recipe)}
    rows = [{"alpha": float(m[1]), "H": int(m[2]), "value": table.loc[table.recipe == r, column].mean()} for r, m in found.items() if m]
    if not rows:
        raise PdkitError("These results hold no recipe called alpha=...,H=..., so there is no grid.")
    return pd.DataFrame(rows).pivot(index="alpha", columns="H", values="value")


def gate_effects(table: pd.DataFrame, H: int = 20_000) -> pd.DataFrame:
    """Each cell of the grid less the one of its own bound and this `H`, seed by seed: rows as in `differences`, by bound, then H."""
    cells = sorted({(float(m[1]), int(m[2])) for m in map(CELL.fullmatch, table.recipe) if m})
    rows = [differences(table, {cell_name(alpha, h): f"alpha {alpha:g}, H {h:,}"}, cell_name(alpha, H)) for alpha, h in cells if h != H]
    return pd.concat([row for row in rows if len(row)] or [differences(table, {})], ignore_index=True)


def action_scales(demos: Demos) -> dict[str, float]:
    """Two readings of "the action scale observed in the demonstration dataset" (appendix B.2), averaged over action dimensions and
    clipped to [-1, 1]: the size of an action, mean |a|, and of a step between two, mean |a_t - a_(t-1)| inside an episode. Dimensions
    whose bound is a multiple of alpha in the lesson's recipe (StackCube's gripper: it may be changed wholly) are left out."""
    scales = online_config(demos.task, "lesson").decorator.alpha_scale
    bounded = np.broadcast_to(np.asarray(scales or 1.0) <= 1, demos.actions.shape[1:])
    episodes = [np.clip(episode["actions"][:, bounded], -1, 1) for episode in demos.episodes()]
    steps = np.concatenate([np.abs(np.diff(actions, axis=0)) for actions in episodes])
    return {"mean |a|": float(np.abs(np.concatenate(episodes)).mean()), "mean |a_t - a_(t-1)|": float(steps.mean())}


def alpha_works(table: pd.DataFrame, scale: float, H: int = 20_000) -> tuple[str, Interval, str]:
    """Appendix B.2: does the bound of the grid that is closest to `scale` (in ratio) work?

    It works where it ends above the base policy *and* less than ENOUGH behind the best bound, both seed by seed; each is judged as
    any claim (pdkit/claims.py), and the worse of the two is the verdict. Returns the verdict, the difference to the best bound
    (0 for itself), and the recipe. Raises TooLittle below three seeds or two bounds at this H.
    """
    bounds = {}
    for recipe in dict.fromkeys(table.recipe):
        match = CELL.fullmatch(recipe)
        if match and int(match[2]) == H:
            bounds[recipe] = (float(match[1]), by_seed(table, recipe, "decorated_success"))
    if len(bounds) < 2:
        raise TooLittle(f"Fewer than two bounds are recorded with H={H}.")
    near = min(bounds, key=lambda recipe: abs(np.log(bounds[recipe][0] / scale)))
    best = max(bounds, key=lambda recipe: bounds[recipe][1].mean())
    behind = Interval(0.0, 0.0, 0.0) if near == best else difference(bounds[near][1], bounds[best][1])[0]
    gain, _ = difference(bounds[near][1], by_seed(table, near, "base_success"))
    return weakest(judged(gain), judged(behind, -ENOUGH)), behind, near
