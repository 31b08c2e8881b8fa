"""Diffusion Policy bases: decorated (data/sweeps/diffusion_tasks.toml), or also fine-tuned by DIPO and DPPO (diffusion_finetuning.toml on
StackCube, diffusion_door.toml).

Fig. 1 gives means over three ManiSkill and three Adroit tasks, it is not known which (facts.md 4.1); so "reproduced" takes all eight here.
DPPO was compared on Square and Transport only (appendix C.2), which the kit does not have; that it tunes a Diffusion Policy at all is
judged on the kit's tasks.
"""
from __future__ import annotations

import contextlib
from dataclasses import replace

import pandas as pd

from ..claims import (
    DECORATOR,
    LEAST_SEEDS,
    NEARLY,
    TASKS,
    Finding,
    TooLittle,
    ahead,
    average,
    besides,
    best,
    by_seed,
    difference,
    finding,
    jointly,
    judged,
    judged_over_tasks,
    mean_interval,
    percent,
    points,
    recorded,
    set_against,
    signed,
    task_by_task,
)
from ..methods import METHODS
from ..task_range import COLD, DIFFUSION
from .registry import EIGHT, measures

# The paper's baselines over Diffusion Policy, but for JSRL, whose guide acts in single steps here (methods/jsrl.py).
TUNED, KEPT = ("dipo",), ("residual_rl", "fish")
BESIDES = ("dppo", "dppo,lora=8")  # fine-tunes, too, but is none of Fig. 1's; with all weights, and with adapters
COLUMNS = ["task", "recipe", "seed", "base_success", "decorated_success"]


def _recorded() -> tuple[list[str], pd.DataFrame, str]:
    """The records that tell anything; of the tasks on which the decorator has three seeds the rows of all methods that have as many
    there, the decorator's cell under one name; and in words which cells these are. Raises TooLittle where there are none.
    """
    tables, cells = {}, ""
    for record, own in DIFFUSION.items():
        with contextlib.suppress(TooLittle):
            table = recorded(record)[0][COLUMNS]
            others = table.recipe.str.startswith(DECORATOR) & (table.recipe != own)
            table = table[~others].assign(recipe=table.recipe.replace(own, DECORATOR))
            table = table[table.groupby(["task", "recipe"]).seed.transform("nunique") >= LEAST_SEEDS]
            if len(table := table[table.task.isin(table.task[table.recipe == DECORATOR])]):
                tables[record] = table
                cells += f"; on {' '.join(table.task.unique())} the decorator is {own}" * (own != DECORATOR)
    if not tables:
        raise TooLittle(f"Fewer than {LEAST_SEEDS} seeds of the decorator over a Diffusion Policy are recorded.")
    return list(tables), pd.concat(tables.values(), ignore_index=True), cells


def _cold(found: Finding) -> Finding:
    """With what is told of those of its bases that are none of the paper's kind."""
    told = "".join(f"; {task}'s base starts from {share:g} of the noise" for task, share in COLD.items() if task in found.tasks.split())
    return replace(found, measured=found.measured + told)


@measures("Policy Decorator lifts Diffusion Policy bases")
def _() -> Finding:
    """Above the base policy, and nearly all on average: the rule for a BeT."""
    records, table, cells = _recorded()
    end, start = (by_seed(table, DECORATOR, column) for column in ("decorated_success", "base_success"))
    gain, values = difference(end, start)
    told = f"{percent(average(start))} to {percent(average(end))}: {signed(gain.value)} points{task_by_task(values, signed)}{cells}"
    verdict = jointly(judged_over_tasks(values), judged(mean_interval(end), NEARLY))
    return _cold(finding(records, values, told, points(gain), verdict, EIGHT))


@measures("With Diffusion Policy bases, Policy Decorator")
def _() -> Finding:
    """Ahead of the best of both kinds; the interval is that of the smaller lead. What was not run is told."""
    records, table, cells = _recorded()
    absent = [METHODS[method].title for method in (*KEPT, "jsrl") if method not in set(table.recipe)]
    told = f"{cells}{besides(table, BESIDES)}" + f"; not run over a Diffusion Policy: {', '.join(absent)}" * bool(absent)
    return _cold(ahead(records, table, DECORATOR, {"no fine-tuning": KEPT, "fine-tuning": TUNED}, EIGHT, told))


@measures("The best baseline that fine-tunes Diffusion Policy")
def _() -> Finding:
    """None of its seeds solves a test episode."""
    records, table, _ = _recorded()
    rival = best(table, TUNED)
    values = by_seed(table, rival, "decorated_success")
    told = f"{rival} {percent(values.mean())}; largest of its seeds {percent(values.max())}{besides(table, BESIDES)}"
    return finding(records, values, told,
                   points(mean_interval(values)), "reproduced" if values.max() == 0 else "not", TASKS["maniskill"] + TASKS["adroit"])


@measures("Policy Decorator on DPPO's own diffusion checkpoints")
def _() -> Finding:
    """Nothing was run from those checkpoints, so nothing is judged. (At first the kit's own stood for them, and the verdict was "partly",
    then "not".) What was found over the kit's own is told, against the better of DPPO's recorded settings on each task, as the paper's was
    carefully tuned."""
    records, table, cells = _recorded()
    runs, name, others = _dppo(table)
    mine, theirs = (by_seed(rows, recipe, "decorated_success") for rows, recipe in ((table, DECORATOR), (runs, "dppo")))
    found = set_against(records, mine, theirs, (DECORATOR, name))
    raise TooLittle(f"The kit has neither these checkpoints nor these tasks. Over its own Diffusion Policies ({found.tasks}): "
                    f"{found.measured}, {found.interval}{cells}{others}.")


@measures("DPPO successfully fine-tunes")
def _() -> Finding:
    """Above the policy that it started from, at the better of its recorded settings on each task. Not the paper's tasks, nor their
    budget."""
    records, table, _ = _recorded()
    runs, name, others = _dppo(table)
    end, start = (by_seed(runs, "dppo", column) for column in ("decorated_success", "base_success"))
    found = set_against(records, end, start, (name, "its start"), paper=("Square", "Transport"))
    return replace(found, measured=found.measured + others)


def _dppo(table: pd.DataFrame) -> tuple[pd.DataFrame, str, str]:
    """DPPO's runs at the better of its recorded settings on each task, as one recipe "dppo"; which these are, and what is told of the
    others. Raises TooLittle where there are none."""
    runs = table[table.recipe.isin(BESIDES)]
    better = {task: best(rows, BESIDES) for task, rows in runs.groupby("task", sort=False)}
    if not better:
        raise TooLittle(f"None of {', '.join(BESIDES)} is recorded with {LEAST_SEEDS} seeds.")
    chosen, names = runs.recipe == runs.task.map(better), set(better.values())
    name = names.pop() if len(names) == 1 else ", ".join(f"{recipe} on {task}" for task, recipe in better.items())
    return runs[chosen].assign(recipe="dppo"), name, besides(runs[~chosen], BESIDES)
