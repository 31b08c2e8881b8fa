"""Tables that compare recipes (methods, settings) over the seeds and tasks of recorded results; pdkit/plots_compare.py draws them.

A table of runs is one of data/results: a row a run with task, recipe, seed, base_success, decorated_success, ...; its curves have
a row a logged step. What stands beside what:

- two recipes: the mean difference seed by seed, with the bootstrap interval of pdkit/claims.py (no interval below three seeds);
- many methods: interquartile mean and probability of improvement with a stratified bootstrap (pdkit/stats.py), on the tasks that both
  sides have.
"""
from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .claims import DECORATOR, LEAST_SEEDS, TooLittle, by_seed, difference, mean_interval
from .demos import Demos, sources
from .errors import PdkitError
from .methods import METHODS
from .methods.registry import base_folder, method_config, trainer_of
from .plots_compare import labelled
from .policies import load_policy
from .policies.base import read_card
from .profiles import flat
from .recorded import load
from .runs import Run, origin
from .stats import Interval, iqm, probability_of_improvement, stratified_bootstrap
from .train import decorate
from .verdicts import GRID

BOOTSTRAP_SEED = 0  # a table computed twice is the same
FAMILIES = {  # how the methods are told apart in a figure: by what learns
    "a small network on a frozen policy": ("policy_decorator", "residual_rl", "jsrl", "fish"),
    "fine-tuning the policy itself": ("sac_finetune", "rlpd_paper", "calql", "rot"),
    "PPO instead of SAC": ("ppo_decorator", "ppo_residual_rl", "ppo_finetune"),
    "from scratch": ("sac_from_scratch", "rlpd", "calql_a", "calql_b", "calql_c", "calql_d"),
}


# ---- recorded rows ---------------------------------------------------------------------------------------------------

def available(name: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """`recorded.load`, but where nothing is recorded two empty tables, and a printed sentence that tells which sweep makes them."""
    try:
        return load(name)
    except PdkitError as error:
        print(error)
        return pd.DataFrame(columns=["task", "recipe", "seed"]), pd.DataFrame(columns=["task", "recipe", "seed", "step"])


def titles(recipes: Sequence[str]) -> dict[str, str]:
    """Recipe -> title for those that are methods, in the order of FAMILIES, then the others by their own names."""
    order = [name for family in FAMILIES.values() for name in family]
    known = sorted((r for r in set(recipes) if r in order), key=order.index)
    return {r: METHODS[r].title for r in known} | {r: r for r in dict.fromkeys(recipes) if r not in known}


def families(recipes: Sequence[str]) -> dict[str, list[str]]:
    """Panels of a figure: family -> those of its methods that are among `recipes`; what belongs to none is "others"."""
    found = {name: [r for r in members if r in recipes] for name, members in FAMILIES.items()}
    found["others"] = [r for r in dict.fromkeys(recipes) if not any(r in members for members in FAMILIES.values())]
    return {name: members for name, members in found.items() if members}


def from_scratch(recipe: str) -> bool:
    """Whether a method starts without a policy, so that its row's base_success is not where it started."""
    return recipe in METHODS and METHODS[recipe].trainer.endswith(("Scratch", "SmallCalQL"))


def scores(table: pd.DataFrame, recipe: str, column: str, tasks: Sequence[str]) -> np.ndarray:
    """`column` of one recipe as (runs x tasks): the seeds that all of `tasks` have. Raises PdkitError when there is none."""
    rows = table[(table.recipe == recipe) & table.task.isin(tasks)]
    wide = rows.pivot(index="seed", columns="task", values=column).reindex(columns=list(tasks)).dropna()
    if wide.empty:
        raise PdkitError(f"No seed of {recipe} is recorded on all of {', '.join(tasks)}.")
    return wide.to_numpy(float)


def tasks_of(table: pd.DataFrame, *recipes: str) -> list[str]:
    """The tasks, in the table's order, on which every one of `recipes` is recorded."""
    sets = [set(table.task[table.recipe == recipe]) for recipe in recipes]
    return [task for task in dict.fromkeys(table.task) if all(task in one for one in sets)]


# ---- comparisons -----------------------------------------------------------------------------------------------------

def improvement(table: pd.DataFrame, first: str, second: str, column: str = "decorated_success", second_column: str = "") -> Interval:
    """Probability that a run of `first` ends above one of `second` (or, with `second_column`, above that of the same recipe).

    The interval is NaN below three seeds. Raises PdkitError when they have no task in common.
    """
    tasks = tasks_of(table, first, second)
    if not tasks:
        raise PdkitError(f"{first} and {second} are recorded on no common task.")
    arrays = scores(table, first, column, tasks), scores(table, second, second_column or column, tasks)
    if min(map(len, arrays)) < LEAST_SEEDS:
        return Interval(probability_of_improvement(*arrays), np.nan, np.nan)
    return stratified_bootstrap(probability_of_improvement, *arrays, seed=BOOTSTRAP_SEED)


def pairwise(table: pd.DataFrame, column: str = "decorated_success", labels: Mapping[str, str] | None = None) -> pd.DataFrame:
    """Probability that a run of the row's recipe ends above one of the column's; NaN on the diagonal and without a common task."""
    names = labelled(table, labels)
    grid = pd.DataFrame(np.nan, index=list(names.values()), columns=list(names.values()))
    for a in names:
        for b in names:
            if a != b and (tasks := tasks_of(table, a, b)):
                grid.loc[names[a], names[b]] = probability_of_improvement(scores(table, a, column, tasks), scores(table, b, column, tasks))
    return grid


def differences(table: pd.DataFrame, reference: str, labels: Mapping[str, str], column: str = "decorated_success") -> pd.DataFrame:
    """Each recipe of `labels` less `reference`, seed by seed: recipe, label, seeds (pairs), value, low, high.

    Recipes that are not recorded, or share no seed with the reference, have no row; below three seeds low and high are NaN.
    """
    rows, theirs = [], _by_seed(table, reference, column)
    for recipe, label in labels.items():
        mine = _by_seed(table, recipe, column)
        values = (mine - theirs).dropna()
        if recipe == reference or values.empty:
            continue
        try:
            interval, _ = difference(mine, theirs)
        except TooLittle:
            interval = Interval(values.mean(), np.nan, np.nan)
        rows.append({"recipe": recipe, "label": label, "seeds": len(values), **vars(interval)})
    return pd.DataFrame(rows, columns=["recipe", "label", "seeds", "value", "low", "high"])


def lines(rows: pd.DataFrame) -> list[str]:
    """`differences` in words, a line each."""
    return [f"{row.label}: {100 * row.value:+.1f} points" + (f" over {row.seeds} seeds, too few for an interval" if np.isnan(row.low) else
            f" ({100 * row.low:+.1f} to {100 * row.high:+.1f}), {row.seeds} pairs") for row in rows.itertuples()]


def _by_seed(table: pd.DataFrame, recipe: str, column: str) -> pd.Series:
    """As claims.by_seed, but with however few seeds there are."""
    return table[table.recipe == recipe].set_index(["task", "seed"])[column].astype(float).dropna()


def league(table: pd.DataFrame, curves: pd.DataFrame, labels: Mapping[str, str] | None = None, reference: str = DECORATOR) -> pd.DataFrame:
    """The final table, a row a recipe, best interquartile mean first.

    recipe, label, tasks, seeds; start (mean success of the policy it starts from, NaN from scratch); iqm, low, high of the final
    success; at_end; last (of the last evaluation, on selection episodes: what no choice of the best evaluation can flatter);
    gain, gain_low, gain_high over the start, seed by seed; p_start and p_reference with _low and _high (probability of improvement);
    minutes.
    """
    rows = []
    for recipe, label in labelled(table, labels).items():
        mine, tasks = table[table.recipe == recipe], tasks_of(table, recipe)
        final = scores(table, recipe, "decorated_success", tasks)
        enough = len(final) >= LEAST_SEEDS
        middle = stratified_bootstrap(iqm, final, seed=BOOTSTRAP_SEED) if enough else Interval(iqm(final), np.nan, np.nan)
        row = {"recipe": recipe, "label": label, "tasks": len(tasks), "seeds": mine.seed.nunique(), "start": np.nan, "iqm": middle.value,
               "low": middle.low, "high": middle.high, "at_end": mine.decorated_success_at_end.mean(), "last": np.nan,
               "minutes": mine.train_minutes.mean()}
        ends = curves[(curves.recipe == recipe) & curves.success_once.notna()] if "success_once" in curves else curves[:0]
        if len(ends):
            row["last"] = ends.sort_values("step").groupby(["task", "seed"]).success_once.last().mean()
        if not from_scratch(recipe):
            values = _by_seed(table, recipe, "decorated_success") - _by_seed(table, recipe, "base_success")
            gain = mean_interval(values) if enough else Interval(values.mean(), np.nan, np.nan)
            row |= {"start": mine.base_success.mean(), "gain": gain.value, "gain_low": gain.low, "gain_high": gain.high}
            row |= _numbered("p_start", improvement(table, recipe, recipe, "decorated_success", "base_success"))
        if recipe != reference and tasks_of(table, recipe, reference):
            row |= _numbered("p_reference", improvement(table, recipe, reference))
        rows.append(row)
    columns = ["recipe", "label", "tasks", "seeds", "start", "iqm", "low", "high", "at_end", "last", "gain", "gain_low", "gain_high",
               "p_start", "p_start_low", "p_start_high", "p_reference", "p_reference_low", "p_reference_high", "minutes"]
    return pd.DataFrame(rows, columns=columns).sort_values("iqm", ascending=False, ignore_index=True)


def _numbered(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


def formatted(standing: pd.DataFrame) -> pd.DataFrame:
    """`league` as text for a notebook: percent and points with their 95 % intervals; what is not known is a dash."""
    def cell(row: Any, name: str, low: str, high: str, scale: float, form: str) -> str:
        value = getattr(row, name)
        if np.isnan(value):
            return "-"
        limits = [getattr(row, limit) * scale for limit in (low, high)]
        return f"{value * scale:{form}}" + ("" if np.isnan(limits).any() else f" ({limits[0]:{form}} to {limits[1]:{form}})")

    return pd.DataFrame([{
        "method": row.label, "tasks": row.tasks, "seeds": row.seeds,
        "starts at, %": "-" if np.isnan(row.start) else f"{100 * row.start:.0f}",
        "final success, IQM, %": cell(row, "iqm", "low", "high", 100, ".0f"),
        "gain over its start, points": cell(row, "gain", "gain_low", "gain_high", 100, "+.0f"),
        "P(above its start)": cell(row, "p_start", "p_start_low", "p_start_high", 1, ".2f"),
        "P(above the decorator)": cell(row, "p_reference", "p_reference_low", "p_reference_high", 1, ".2f"),
        "at the last step, %": f"{100 * row.at_end:.0f}", "last evaluation, %": "-" if np.isnan(row.last) else f"{100 * row.last:.0f}",
        "minutes": f"{row.minutes:.1f}"} for row in standing.itertuples()])


def smoothness(table: pd.DataFrame, labels: Mapping[str, str] | None = None) -> pd.DataFrame:
    """How much rougher a method moves than the policy that it starts from: recipe, label, seeds, and the geometric mean over runs of
    final / start of mean jerk (jerk, jerk_low, jerk_high) and of action change (change, change_low, change_high).

    A method from scratch has no start of its own: it is held against the base policy that the loop was given.
    """
    rows = []
    for recipe, label in labelled(table, labels).items():
        row = {"recipe": recipe, "label": label, "seeds": int((table.recipe == recipe).sum())}
        for name, column in (("jerk", "jerk"), ("change", "action_change")):
            ratio = (_by_seed(table, recipe, f"decorated_{column}") / _by_seed(table, recipe, f"base_{column}")).dropna()
            if ratio.empty:
                continue
            few = ratio.index.get_level_values("seed").nunique() < LEAST_SEEDS
            interval = Interval(np.log(ratio).mean(), np.nan, np.nan) if few else mean_interval(np.log(ratio))
            row |= {name: np.exp(interval.value), f"{name}_low": np.exp(interval.low), f"{name}_high": np.exp(interval.high)}
        rows.append(row)
    return pd.DataFrame(rows, columns=["recipe", "label", "seeds", *(f"{n}{e}" for n in ("jerk", "change") for e in ("", "_low", "_high"))])


# ---- the grid of bound and schedule ----------------------------------------------------------------------------------

RECORDED_STEPS = 40_000  # of every run of ablations.toml and leaderboard.toml
CELL = re.compile(r"alpha=([\d.]+),H=(\d+)")


def cell_name(alpha: float, H: int) -> str:
    """What the sweep calls a cell of the grid."""
    return f"alpha={alpha},H={H}"


def cell_of(alpha: float, H: int, total_steps: int, critic_input: str = "sum", actor_input: str = "obs") -> str:
    """The recorded recipe that a run of another length corresponds to: H counts as a share of the steps, and inputs are named where
    they differ from the lesson's (alone, where alpha and H do not)."""
    cell = cell_name(alpha, round(RECORDED_STEPS * H / total_steps))
    usual = (("critic_input", critic_input, "sum"), ("actor_input", actor_input, "obs"))
    inputs = [f"{name}={value}" for name, value, lesson in usual if value != lesson]
    return ",".join(inputs if inputs and cell == GRID else [cell, *inputs])


def grid(table: pd.DataFrame, column: str = "decorated_success") -> pd.DataFrame:
    """Mean of `column` over seeds, alpha (rows) by H (columns); NaN where no such recipe is recorded. Raises PdkitError without any."""
    found = {recipe: CELL.fullmatch(recipe) for recipe in dict.fromkeys(table.recipe)}
    rows = [{"alpha": float(m[1]), "H": int(m[2]), "value": table.loc[table.recipe == r, column].mean()} for r, m in found.items() if m]
    if not rows:
        raise PdkitError("These results hold no recipe called alpha=...,H=..., so there is no grid.")
    return pd.DataFrame(rows).pivot(index="alpha", columns="H", values="value")


def action_scales(demos: Demos) -> dict[str, float]:
    """Two readings of "the action scale of the demonstrations" (appendix B.2), averaged over action dimensions and clipped to [-1, 1]:
    the size of an action, mean |a|, and of a step between two, mean |a_t - a_(t-1)| inside an episode."""
    episodes = [np.clip(episode["actions"], -1, 1) for episode in demos.episodes()]
    steps = np.concatenate([np.abs(np.diff(actions, axis=0)) for actions in episodes])
    return {"mean |a|": float(np.abs(np.concatenate(episodes)).mean()), "mean |a_t - a_(t-1)|": float(steps.mean())}


def alpha_works(table: pd.DataFrame, scale: float, H: int, enough: float = 0.1) -> tuple[str, Interval, str]:
    """Appendix B.2: does the bound of the grid that is closest to `scale` (in ratio) work?

    It works where its success is less than `enough` (ours: 10 points) behind the best bound's, seed by seed: "reproduced" with the
    whole interval, "partly" with the mean alone, else "not"; the best bound itself works. Returns the verdict, the difference to the
    best bound (0 for itself), and the recipe. Raises TooLittle below three seeds or two bounds at this H.
    """
    means = {}
    for recipe in dict.fromkeys(table.recipe):
        match = CELL.fullmatch(recipe)
        if match and int(match[2]) == H:
            means[recipe] = (float(match[1]), by_seed(table, recipe, "decorated_success"))
    if len(means) < 2:
        raise TooLittle(f"Fewer than two bounds are recorded with H={H}.")
    near = min(means, key=lambda recipe: abs(np.log(means[recipe][0] / scale)))
    best = max(means, key=lambda recipe: means[recipe][1].mean())
    interval = Interval(0.0, 0.0, 0.0) if near == best else difference(means[near][1], means[best][1])[0]
    verdict = "reproduced" if interval.low > -enough else "partly" if interval.value > -enough else "not"
    return verdict, interval, near


# ---- a run of the reader's own ---------------------------------------------------------------------------------------

def own_run(method: str, task: str, profile: str, seed: int, folder: Path, episodes: int, recipe: str = "", **changes: Any
            ) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Train one method once, below `folder`, and return its row and its curve in the form of recorded ones, as `recipe` (the method).

    A finished run with the same settings is read, an interrupted one goes on. Raises PdkitError for an unknown method or setting, and
    where the policy is missing that the method starts from.
    """
    config, start = method_config(method, task, profile, seed, **changes), base_folder(method, task)
    card = read_card(start)
    needed = config.demo_fraction or trainer_of(method).needs_demos
    demos = sources.bundled(task).first(card["info"]["demos"]) if needed else None
    settings = flat(config) | origin(card, demos)
    mark = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    run = Run(folder / f"{method}-seed{seed}-{mark}", "decorated", settings)
    if not run.finished or run.manifest["results"]["episodes"] != episodes:
        decorate(config, load_policy(start), demos, run.folder, episodes, origin(card, demos))
        run = Run(run.folder, "decorated", settings)
    labels = {"task": task, "recipe": recipe or method, "seed": seed}
    return pd.DataFrame([run.manifest["results"] | labels]), pd.read_csv(run.folder / "metrics.csv").assign(**labels)


def expected_share(table: pd.DataFrame, recipe: str, steps: int) -> float | None:
    """Minutes that `steps` of a recorded recipe took, in proportion to its recorded runs; None where there are none."""
    rows = table[table.recipe == recipe]
    return None if rows.empty else float((rows.train_minutes / rows.env_steps).mean() * steps)
