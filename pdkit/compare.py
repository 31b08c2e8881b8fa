"""Methods beside one another, over the seeds of recorded results: tables that pdkit/plots_compare.py draws (notebook 16).

A table of runs is one of data/results: a row a run with task, recipe (the method), seed, base_success, decorated_success, ...; its
curves have a row a logged step. Many methods are compared by interquartile mean and probability of improvement with a stratified
bootstrap (pdkit/stats.py), always on the same tasks and, over several tasks, on the seeds that all of these have; there is no
interval below three seeds.
"""
from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .ablations import differences
from .claims import DECORATOR
from .decorated import Decorated
from .demos import sources
from .errors import PdkitError
from .methods import METHODS
from .methods.jsrl import JumpStart
from .methods.ppo import OnPolicy
from .methods.registry import base_folder, get_method, method_config, trainer_of
from .methods.scratch import Scratch
from .pixels.pictures import encoded, pictures_of
from .pixels.task import encoder_of
from .plots_compare import labelled, over_seeds
from .policies import Policy, load_policy
from .policies.base import read_card
from .profiles import flat
from .recorded import load
from .runs import Run, origin
from .stats import Interval, iqm, mean, probability_of_improvement
from .tasks import get_task
from .tasks.partnet import object_set
from .train_decorated import decorate
from .transfer import load_any

SCRATCH, OTHERS = "from scratch", "others"
FAMILIES = {  # how the methods are told apart in a figure: by what learns
    "a small network on a frozen policy": ("policy_decorator", "residual_rl", "jsrl", "fish"),
    "fine-tuning the policy itself": ("sac_finetune", "rlpd_paper", "calql", "rot", "dipo"),
    "PPO instead of SAC": ("ppo_decorator", "ppo_residual_rl", "ppo_finetune", "dppo"),
    SCRATCH: ("sac_from_scratch", "rlpd", "calql_a", "calql_b", "calql_c", "calql_d"),
}
STARTS = {"base": "the base policy", "bet-sac": "a BeT for fine-tuning", "vinn": "nearest neighbours (VINN)",
          "diffusion": "a Diffusion Policy"}
DECORATED = {"StackCube": "bet-sac"}  # by task: the policy that comparisons decorate, where it is not the main job's; a BeT
FORMS = {"bet-sac": "the paper's", "bet-sac,arm": "arm scaled, too (ours)"}  # of a BeT for SAC, by recipe in bet_forms.csv
TUNABLE = "bet-sac"  # the kind of policy that SAC can fine-tune
LEAST_RATIO = 0.01  # of smoothness: recorded numbers are rounded, and a policy that stands still has none of it


# ---- recorded rows ---------------------------------------------------------------------------------------------------

def available(name: str, task: str | None = None) -> tuple[pd.DataFrame, pd.DataFrame]:
    """`recorded.load`, but where nothing is recorded two empty tables, and its sentence printed: which sweep makes them, or of which
    tasks they are."""
    try:
        return load(name, task)
    except PdkitError as error:
        print(error)
        return pd.DataFrame(columns=["task", "recipe", "seed"]), pd.DataFrame(columns=["task", "recipe", "seed", "step"])


def method_of(recipe: str) -> str:
    """The method of a recipe METHOD,NAME=VALUE. Raises PdkitError for an unknown one."""
    name = recipe.split(",")[0]
    get_method(name)
    return name


def titles(recipes: Sequence[str]) -> dict[str, str]:
    """Recipe -> what it is called, in the order of FAMILIES, a reader's own methods last; settings of a recipe METHOD,NAME=VALUE stay
    behind the title."""
    order = [name for family in FAMILIES.values() for name in family]
    order += [name for name in METHODS if name not in order]
    known = sorted(dict.fromkeys(recipes), key=lambda recipe: order.index(method_of(recipe)))
    return {r: ", ".join([METHODS[method_of(r)].title, *r.split(",")[1:]]) for r in known}


def families(recipes: Sequence[str]) -> dict[str, list[str]]:
    """Panels of a figure: family -> those of `recipes` that belong to it, in the order of `titles`, and those of none last; empty ones
    are left out."""
    others = set(METHODS).difference(*FAMILIES.values())
    found = {name: [r for r in titles(recipes) if method_of(r) in members] for name, members in (FAMILIES | {OTHERS: others}).items()}
    return {name: members for name, members in found.items() if members}


def from_scratch(recipe: str) -> bool:
    """Whether a method starts without a policy, so that its row's base_success is not where it started."""
    return method_of(recipe) in FAMILIES[SCRATCH] or issubclass(trainer_of(method_of(recipe)), Scratch)


def shared(table: pd.DataFrame) -> pd.DataFrame:
    """The rows of those recipes that are recorded on every task on which the decorator is: a comparison without it (PPO on Pen) is of
    its own kind."""
    theirs = table.task[table.recipe == DECORATOR]
    table = table[table.task.isin(theirs)] if len(theirs) else table
    count = table.groupby("recipe").task.nunique()
    return table[table.recipe.isin(count.index[count == table.task.nunique()])]


def own_starts(table: pd.DataFrame) -> pd.DataFrame:
    """The rows of runs from the policy that each method has by itself: without METHOD,base=bet-sac, which were given fine-tuning's."""
    return table[~table.recipe.str.endswith(f",base={TUNABLE}")]


def one_start(table: pd.DataFrame) -> pd.DataFrame:
    """The rows of runs that start from the policy that SAC can fine-tune, under the plain names of their recipes."""
    rows = table[table.policy == TUNABLE] if "policy" in table else table  # without a column: empty, nothing is recorded
    return rows.assign(recipe=rows.recipe.str.removesuffix(f",base={TUNABLE}"))


def scores(table: pd.DataFrame, recipe: str, column: str) -> np.ndarray:
    """`column` of one recipe as (runs x tasks of the table): the seeds that all tasks have. Raises PdkitError when there is none."""
    tasks = list(dict.fromkeys(table.task))
    wide = table[table.recipe == recipe].pivot(index="seed", columns="task", values=column).reindex(columns=tasks).dropna()
    if wide.empty:
        raise PdkitError(f"No seed of {recipe} is recorded with {column} on all of {', '.join(tasks)}: compare on fewer tasks.")
    return wide.to_numpy(float)


# ---- comparisons -----------------------------------------------------------------------------------------------------

def pairwise(table: pd.DataFrame, labels: Mapping[str, str] | None = None, column: str = "decorated_success") -> pd.DataFrame:
    """Probability that a run of the row's recipe ends above one of the column's; NaN on the diagonal."""
    names = labelled(table, labels)
    values = {recipe: scores(table, recipe, column) for recipe in names}
    rows = [[np.nan if a == b else probability_of_improvement(values[a], values[b]) for b in names] for a in names]
    return pd.DataFrame(rows, index=list(names.values()), columns=list(names.values()))


def league(table: pd.DataFrame, labels: Mapping[str, str] | None = None, reference: str = DECORATOR) -> pd.DataFrame:
    """The final table, a row a recipe, best interquartile mean first, over the table's tasks, which all its recipes must have.

    recipe, label, seeds; start (mean success of the policy it starts from, NaN from scratch); iqm, low, high of the final success;
    at_end (mean success at the last step); gain over the start, p (probability that a run ends above one of `reference`), each with
    _low and _high; minutes of training.
    """
    names, rows = labelled(table, labels), []
    theirs = scores(table, reference, "decorated_success") if reference in set(table.recipe) else None
    for recipe, label in names.items():
        final, start = scores(table, recipe, "decorated_success"), scores(table, recipe, "base_success")
        row = {"recipe": recipe, "label": label, "seeds": len(final), **vars(over_seeds(iqm, final)),
               "at_end": scores(table, recipe, "decorated_success_at_end").mean(), "minutes": scores(table, recipe, "train_minutes").mean()}
        row["iqm"] = row.pop("value")
        if not from_scratch(recipe):
            row |= {"start": start.mean()} | _named("gain", over_seeds(mean, final - start))
        if theirs is not None and recipe != reference:
            row |= _named("p", over_seeds(probability_of_improvement, final, theirs))
        rows.append(row)
    columns = ["recipe", "label", "seeds", "start", "iqm", "low", "high", "at_end", "gain", "gain_low", "gain_high", "p", "p_low", "p_high",
               "minutes"]
    return pd.DataFrame(rows, columns=columns).sort_values("iqm", ascending=False, ignore_index=True, kind="stable")


def _named(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


def formatted(standing: pd.DataFrame, reference: str = METHODS[DECORATOR].title) -> pd.DataFrame:
    """`league` as text for a notebook: percent and points with their 95 % intervals; what is not known is a dash."""
    return pd.DataFrame([{
        "method": row.label, "seeds": row.seeds,
        "starts at, %": _text(row.start, scale=100), "final success, IQM, %": _text(row.iqm, row.low, row.high, scale=100),
        "gain over its start, points": _text(row.gain, row.gain_low, row.gain_high, scale=100, form="+.0f"),
        f"P(above {reference})": _text(row.p, row.p_low, row.p_high, form=".2f"),
        "at the last step, %": _text(row.at_end, scale=100), "minutes": f"{row.minutes:.1f}"} for row in standing.itertuples()])


def _text(value: float, low: float = np.nan, high: float = np.nan, scale: float = 1.0, form: str = ".0f") -> str:
    if np.isnan(value):
        return "-"
    return f"{scale * value:{form}}" + ("" if np.isnan(low) else f" ({scale * low:{form}} to {scale * high:{form}})")


def forms(table: pd.DataFrame) -> pd.DataFrame:
    """The paper's Table 10 from rows of data/results/bet_forms.csv, as text, a row a task, a number of gradient steps and a modified form:
    how often the original Behavior Transformer (recipe bet) succeeds and the one that SAC can fine-tune (bet-sac, or with a scale of the
    kit's own), and the difference seed by seed, over the seeds of both. Raises PdkitError without any."""
    rows = []
    for (task, steps), part in table.assign(recipe=table.recipe.str.removesuffix(",short")).groupby(["task", "iteration"]):
        for form in sorted(set(part.recipe) - {"bet"}):
            pairs = part.pivot(index="seed", columns="recipe", values="base_success").reindex(columns=["bet", form]).dropna()
            both = part[part.seed.isin(pairs.index)]
            original, modified = (_text(pairs[name].mean(), scale=100) for name in pairs)
            rows += [{"task": task, "demonstrations": both.demos.iloc[0], "gradient steps": f"{steps:,}", "seeds": row.seeds,
                      "original, %": original, "form": FORMS.get(form, form), "modified, %": modified,
                      "modified less original, points": _text(row.value, row.low, row.high, scale=100, form="+.0f")}
                     for row in differences(both, {form: ""}, "bet", "base_success").itertuples()]
    if not rows:
        raise PdkitError("No seed of both forms is recorded; `pdkit sweep data/sweeps/bet_forms.toml` makes them.")
    return pd.DataFrame(rows)


def smoothness(table: pd.DataFrame, labels: Mapping[str, str] | None = None) -> pd.DataFrame:
    """How much rougher a method moves than the policy that its run was given: recipe, label, seeds, success, and the geometric mean
    over runs of final / start of mean jerk (jerk, jerk_low, jerk_high) and of action change (change, change_low, change_high).

    A method from scratch does not use that policy; the ratio is the same yardstick, no change that it made.
    """
    rows = []
    for recipe, label in labelled(table, labels).items():
        success = scores(table, recipe, "decorated_success")
        row = {"recipe": recipe, "label": label, "seeds": len(success), "success": success.mean()}
        for name, column in (("jerk", "jerk"), ("change", "action_change")):
            ratio = scores(table, recipe, f"decorated_{column}") / scores(table, recipe, f"base_{column}")
            logs = over_seeds(mean, np.log(np.maximum(ratio, LEAST_RATIO)))
            row |= {key: float(np.exp(value)) for key, value in _named(name, logs).items()}
        rows.append(row)
    return pd.DataFrame(rows)


def starting_points(table: pd.DataFrame, labels: Mapping[str, str], x: str = "jerk", y: str = "success") -> list[tuple[str, float, float]]:
    """The policies that the recipes of one task start from, those from scratch left out: name, mean base_X and base_Y. One from which a
    single recipe starts is called by that."""
    rows = table[~table.recipe.map(from_scratch)].dropna(subset=[f"base_{x}", f"base_{y}"])
    points = []
    for (kind, _), mine in rows.groupby(["policy", rows[f"base_{y}"].round(4)]):
        whose = list(dict.fromkeys(mine.recipe))
        name = f"that of {labels.get(whose[0], whose[0])}" if len(whose) == 1 else STARTS.get(kind, STARTS["base"])
        points.append((name, mine[f"base_{x}"].mean(), mine[f"base_{y}"].mean()))
    return points


def budgets(table: pd.DataFrame, labels: Mapping[str, str]) -> pd.DataFrame:
    """What the comparison does *not* hold equal, as text, a row a method: where it starts, demonstrations, recorded gradient updates
    (mean over runs), transitions an update in the lesson profile, and minutes."""
    rows, task = [], table.task.iloc[0]
    for recipe, label in labelled(table, labels).items():
        method, mine = method_of(recipe), table[table.recipe == recipe]
        config = method_config(method, task, "lesson")
        m, on_policy = config.method_config, issubclass(trainer_of(method), OnPolicy)
        batch = m.ppo_rollout * config.num_envs // m.ppo_minibatches if on_policy else config.batch
        demos = f"{config.demo_fraction:.0%} of a batch" if config.demo_fraction else \
            "yes, not in batches" if trainer_of(method).needs_demos else "none"
        start = "nothing" if from_scratch(recipe) else STARTS[start_name(method, task)]
        rows.append({"method": label, "starts from": start, "demonstrations": demos,
                     "environment steps": f"{mine.env_steps.mean():,.0f}", "updates": f"{mine.updates.mean():,.0f}",
                     "transitions an update": f"{batch:,}", "minutes": f"{mine.train_minutes.mean():.1f}"})
    return pd.DataFrame(rows)


# ---- a run of the reader's own ---------------------------------------------------------------------------------------

def start_name(method: str, task: str) -> str:
    """What the policy is called that the comparisons give to a method: the method's own (pdkit/methods/registry.py), but where that is the
    task's base policy that of DECORATED. Of the methods from scratch that holds for Cal-QL's setups A to C, which learn from its episodes;
    to the others it is a yardstick alone."""
    name = get_method(method).base
    uses = not from_scratch(method) or method.startswith("calql")
    return DECORATED.get(task, name) if name == "base" and uses else name


def start_of(method: str, task: str) -> Path:
    """Where the policy of `start_name` lies that comes with the kit. Raises PdkitError for an unknown method, and where there is none."""
    folder = base_folder(method, task)
    return folder.with_name(start_name(method, task))


def own_run(method: str, task: str, profile: str, seed: int, folder: Path, episodes: int, recipe: str = "", base: Path | None = None,
            **changes: Any) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Train one method once, below `folder`, and return its row and its curve in the form of recorded ones, as `recipe` (the method).
    It starts from the policy in `base`, or from that of `start_of`. Two columns more than a recorded row has:
    start and folder, where the policy lies that it started from, and the run (see `before_and_after`).

    A finished run with the same settings is read (and that is told), an interrupted one goes on. Raises PdkitError for an unknown
    method or setting, and where the policy is missing that the method starts from.
    """
    start = base or start_of(method, task)
    card, policy = read_card(start), load_policy(start)
    config = method_config(method, task, profile, seed, policy=policy, **changes)
    needed = config.demo_fraction or trainer_of(method).needs_demos
    demos = sources.learned_from(sources.bundled(task), card) if needed else None
    encoder = encoder_of(start)
    started_from = origin(card, demos, encoder, object_set(get_task(task)))
    settings = flat(config) | started_from
    mark = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    run = Run(folder / f"{method}-seed{seed}-{mark}", "decorated", settings)
    if run.finished and run.manifest["results"]["episodes"] == episodes:
        print(run.already())
    else:
        seen = encoded(demos, pictures_of(demos), encoder) if encoder and demos else demos
        decorate(config, policy, seen, run.folder, episodes, started_from, encoder=encoder)
        run = Run(run.folder, "decorated", settings)
    labels = {"task": task, "recipe": recipe or method, "seed": seed, "start": str(start), "folder": str(run.folder)}
    return pd.DataFrame([run.manifest["results"] | labels]), pd.read_csv(run.folder / "metrics.csv").assign(**labels)


def before_and_after(row: pd.DataFrame) -> tuple[Policy, Policy | Decorated | JumpStart, int]:
    """Of a run by `own_run`: the policy that it was given, the one it ended with, and the seed of a test episode to look at: the first
    whose outcome they do not share, or the first of all."""
    folder = Path(row.folder.item())
    tables = [pd.read_csv(folder / f"{name}_episodes.csv") for name in ("base", "decorated")]
    differ = (tables[0].success_once != tables[1].success_once).to_numpy()
    return load_policy(Path(row.start.item())), load_any(folder / "decorated")[1], int(tables[0].seed[differ.argmax()])


def expected_minutes(table: pd.DataFrame, recipe: str, steps: int) -> float | None:
    """Minutes that `steps` environment steps of a recipe took on average where it is recorded; None where it is not."""
    rows = table[table.recipe == recipe]
    return None if rows.empty else float((rows.train_minutes / rows.env_steps).mean() * steps)
