"""The rules by which recorded results are judged; pdkit/verdicts applies them to the paper's claims.

Every verdict follows one of few rules, so that no one is tempted to choose the rule that suits a result:

- a comparison is made seed by seed (the same seed is the same draw of networks and batches, the same training and test
  episodes); its value is the mean difference, its interval Student's t over seeds, 95 % (a bootstrap of three values covers the truth
  in about 75 % of cases); all seeds share their test episodes, whose choice the interval does not contain;
- **reproduced**: the whole interval lies on the side that the paper says; **not**: the mean lies on the other side, or the
  whole interval does; **partly**: the right side, but the interval reaches over zero;
- a claim of several parts is **reproduced** when all are, **not** when none is and one is "not", else **partly**; a statement with
  several conditions (such as "works") has the weakest verdict among them;
- runs of several tasks, from one record or from those of a comparison on Door and on others (recorded.record_of), are judged by the mean
  over the tasks; it is **partly** instead where a task by itself tells the contrary: of "reproduced" where its whole interval lies on the
  other side, of "not" where it lies on the side that the paper says (a single task's mean that chance explains counts neither way);
- where the claim names tasks, those of them that are recorded are judged alone, and the others told beside them; where it names more
  than were run, "reproduced" counts as **partly**;
- fewer than three seeds are no test, and neither are two sides that both solve hardly anything: the budget does not tell them apart (of
  several tasks, that one is left out and told beside the others).
"""
from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from .errors import PdkitError
from .files import DATA
from .recorded import load, record_of
from .stats import Interval

LEAST_SEEDS = 3
DECORATOR = "policy_decorator"
# The paper's baselines of both kinds. Fine-tuning by PPO (the paper has it in D.3 and F.5.1 alone) and the original RLPD are none of them.
FINE_TUNING = ("sac_finetune", "sac_finetune,actor_lr=1e-4", "rlpd_paper", "rot", "calql")  # the policy's own weights move
FISH = ("fish,features=GPT", "fish")  # by what the paper looks up with, and by raw observations
OTHERS = ("residual_rl", "jsrl", *FISH)  # baselines that leave it as it is
VERDICTS = ("not", "partly", "reproduced")  # from the weakest
NEARLY = 0.95  # success that counts as nearly all (ours; the paper's averages are 98 % and more)
FLOOR = 0.05  # success below which two sides are not told apart
RISES = 2.0  # times that a temperature must be what it is without a warm start, to count as risen massively (ours, as the next)
EXPLODES = 10.0  # times that the critic's loss must be what it is without one, to count as exploded
BETS = ("bet", "bet-sac")  # kinds of policy that are a Behavior Transformer: the paper's, and its form that SAC can tune (Table 10)
TASKS = {"adroit": ("Door", "Pen", "Hammer", "Relocate"), "maniskill": ("StackCube", "PegInsertionSide", "TurnFaucet", "PushChair")}


class TooLittle(PdkitError):
    """Not enough is recorded to judge."""


@dataclass(frozen=True)
class Finding:
    """What was measured of a claim: the columns of claims.csv after the claim and its section."""

    tasks: str
    seeds: str
    measured: str
    interval: str
    verdict: str
    command: str


# ---- measuring -------------------------------------------------------------------------------------------------------

def by_seed(table: pd.DataFrame, recipe: str, column: str) -> pd.Series:
    """`column` of one recipe by (task, seed), on the tasks with three seeds of it. Raises TooLittle where there is none."""
    if column not in table:
        raise TooLittle(f"No column {column} is recorded.")
    values = _of_enough_seeds(table[table.recipe == recipe].set_index(["task", "seed"])[column].dropna())
    if values.empty:
        where = " on an undisturbed machine" if column == "train_minutes" else ""  # see `undisturbed`
        raise TooLittle(f"Fewer than {LEAST_SEEDS} seeds of {recipe} are recorded{where}.")
    return values


def _of_enough_seeds(values: pd.Series) -> pd.Series:
    return values[values.groupby(level="task").transform("size") >= LEAST_SEEDS]


def average(values: pd.Series) -> float:
    """Mean over tasks of the means of their runs, by (task, seed): a task counts once, however many seeds it has."""
    return float(values.groupby(level="task").mean().mean())


def mean_interval(values: pd.Series) -> Interval:
    """`average`, and its 95 % interval by Student's t; the spread is that within tasks, taken to be the same in all."""
    task, names = pd.factorize(values.index.get_level_values("task"))
    runs, free = np.bincount(task), len(values) - len(names)
    means = np.bincount(task, values) / runs
    variance = ((values.to_numpy() - means[task]) ** 2).sum() / free
    half = float(stats.t.ppf(0.975, free) * np.sqrt(variance * (1 / runs).sum()) / len(names))
    return Interval(float(means.mean()), float(means.mean() - half), float(means.mean() + half))


def task_by_task(values: pd.Series, show: Callable[[float], str]) -> str:
    """What stands behind a mean over several tasks: each task's own, in brackets; nothing for one task."""
    means = values.groupby(level="task").mean()
    return f" ({', '.join(f'{task} {show(mean)}' for task, mean in means.items())})" if len(means) > 1 else ""


def difference(first: pd.Series, second: pd.Series) -> tuple[Interval, pd.Series]:
    """Mean of first - second over the seeds that both have, with its interval; and the differences. Raises TooLittle."""
    values = _of_enough_seeds((first - second).dropna())
    if values.empty:
        raise TooLittle(f"Fewer than {LEAST_SEEDS} seeds are recorded on both sides.")
    return mean_interval(values), values


def matched(*runs: pd.Series) -> tuple[pd.Series, ...]:
    """The same runs without the seeds that not all of them have: means that stand beside a difference must be of what it compares."""
    both = pd.concat(runs, axis=1, join="inner", keys=range(len(runs))).dropna()
    return tuple(both[number] for number in both)


def turned(interval: Interval) -> Interval:
    """Of the opposite difference."""
    return Interval(-interval.value, -interval.high, -interval.low)


def judged(interval: Interval, enough: float = 0.0) -> str:
    """The rule above, for a claim that the value lies above `enough`."""
    if interval.low > enough:
        return "reproduced"
    return "not" if interval.value <= enough or interval.high < enough else "partly"


def judged_over_tasks(values: pd.Series, enough: float = 0.0) -> str:
    """The rule above for values by (task, seed): that of their mean over tasks, but for what single tasks tell against it."""
    verdict, own = judged(mean_interval(values), enough), [mean_interval(mine) for _, mine in values.groupby(level="task")]
    if verdict == "reproduced" and any(interval.high < enough for interval in own):
        return "partly"
    return "partly" if verdict == "not" and any(interval.low > enough for interval in own) else verdict


def on_tasks(values: pd.Series, tasks: Sequence[str]) -> pd.Series:
    """The values, by (task, seed), of some tasks."""
    return values[values.index.get_level_values("task").isin(tasks)]


def named_by(paper: Sequence[str], values: pd.Series) -> tuple[pd.Series, pd.Series]:
    """Of values by (task, seed) those to judge, on tasks that the claim names (all, where it names none of them), and the others."""
    tasks = set(values.index.get_level_values("task"))
    chosen = tasks & set(paper) or tasks
    return on_tasks(values, chosen), on_tasks(values, tasks - chosen)


def weakest(*verdicts: str) -> str:
    """The verdict of a statement with several conditions, or capped by one."""
    return min(verdicts, key=VERDICTS.index)


def jointly(*verdicts: str) -> str:
    """The verdict of a claim of several parts."""
    if "reproduced" in verdicts:
        return "reproduced" if set(verdicts) == {"reproduced"} else "partly"
    return weakest(*verdicts)


def undisturbed(table: pd.DataFrame) -> pd.DataFrame:
    """The runs whose minutes count: those beside other work (a load average of more than one above the cores) would compare that work."""
    return table[table.load_average <= table.cores + 1]


def told_apart(*sides: pd.Series) -> tuple[tuple[pd.Series, ...], list[str]]:
    """The runs by (task, seed) that all sides have, on tasks with three of them on which at least one side solves something to speak of;
    and the tasks on which all are near 0: the budget does not tell them apart. Raises TooLittle where no task is left."""
    sides = tuple(_of_enough_seeds(side) for side in matched(*sides))
    if sides[0].empty:
        raise TooLittle(f"Fewer than {LEAST_SEEDS} seeds are recorded on all sides.")
    best_of = pd.concat([side.groupby(level="task").mean() for side in sides], axis=1).max(axis=1)
    able = best_of.index[best_of >= FLOOR]
    if able.empty:
        raise TooLittle("All sides end near 0: this budget does not tell them apart.")
    return tuple(on_tasks(side, able) for side in sides), list(best_of.index.difference(able))


def not_judged(near_0: Sequence[str], others: Mapping[str, float] | None = None) -> str:
    """What is told behind a finding of tasks that do not count: `others` with their differences, and those where all sides are near 0."""
    told = [f"{task} {signed(mean)}" for task, mean in (others or {}).items()] + [f"{task} (all sides near 0)" for task in near_0]
    return f"; not judged: {', '.join(told)}" if told else ""


def best(table: pd.DataFrame, recipes: Sequence[str], column: str = "decorated_success") -> str:
    """The recipe with the largest mean of those with enough seeds on the most tasks: a mean over an easy task alone is no rival's to one
    over all. Raises TooLittle when none has enough."""
    found = {}
    for recipe in recipes:
        with contextlib.suppress(TooLittle):
            found[recipe] = by_seed(table, recipe, column)
    if not found:
        raise TooLittle(f"None of {', '.join(recipes)} is recorded with {LEAST_SEEDS} seeds.")
    return max(found, key=lambda recipe: (found[recipe].index.get_level_values("task").nunique(), average(found[recipe])))


def evaluations(curves: pd.DataFrame, recipe: str) -> pd.DataFrame:
    """The evaluations of a recipe after its first environment step, by time. Raises TooLittle without any.

    At step 0 stands what the online stage starts from (of Cal-QL's setup E the imitated policy once more), or nothing.
    """
    rows = curves[(curves.recipe == recipe) & (curves.step > 0)]
    if "success_once" not in rows or rows.success_once.isna().all():
        raise TooLittle(f"No evaluations of {recipe} are recorded.")
    return rows[rows.success_once.notna()].sort_values("step")


def first_evaluation(curves: pd.DataFrame, recipe: str) -> pd.Series:
    """Success at the first evaluation during training, by (task, seed)."""
    return by_seed(evaluations(curves, recipe).groupby(["task", "seed"], as_index=False).first(), recipe, "success_once")


def efficiency(curves: pd.DataFrame, recipe: str) -> pd.Series:
    """Mean success over all evaluations, by (task, seed): how early, and how well, a recipe learns."""
    rows = evaluations(curves, recipe).groupby(["task", "seed"], as_index=False).success_once.mean()
    return by_seed(rows.assign(recipe=recipe), recipe, "success_once")


# ---- wording ---------------------------------------------------------------------------------------------------------

METHOD = "Student's t over seeds, 95 %"


def percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def not_counted(runs: pd.DataFrame) -> str:
    """What is told behind a finding of the main job's rows that are too few, or of another kind, to be judged."""
    told = [f"{task} ({kind}, {len(rows)} seed{'s' * (len(rows) > 1)}) {percent(rows.base_success.mean())} to "
            f"{percent(rows.decorated_success.mean())}" for (task, kind), rows in runs.groupby(["task", "policy"])]
    return f"; not counted: {', '.join(told)}" if told else ""


def besides(table: pd.DataFrame, recipes: Sequence[str]) -> str:
    """What is told behind a finding of methods that are none of the paper's baselines: how their runs end, where there are any."""
    ends = {recipe: table.decorated_success[table.recipe == recipe] for recipe in recipes}
    return "".join(f"; beside them {recipe} {percent(runs.mean())} ({len(runs)} runs)" for recipe, runs in ends.items() if len(runs))


def signed(value: float) -> str:
    """A difference of shares in points, without the word."""
    return f"{100 * value:+.1f}"


def points(interval: Interval) -> str:
    """An interval of a difference of shares in words: within what is possible, and none where all seeds say the same, whose spread tells
    nothing."""
    low, high = (100 * min(max(limit, -1.0), 1.0) for limit in (interval.low, interval.high))
    if high - low < 0.05:
        return f"{low:+.1f} points by every seed, whose spread gives no interval"
    return f"{low:+.1f} to {high:+.1f} points ({METHOD})"


def shares(interval: Interval) -> str:
    """An interval of a share in words, within what is possible."""
    return f"{percent(max(interval.low, 0.0))} to {percent(min(interval.high, 1.0))}"


def times(interval: Interval, digits: int = 2) -> str:
    """An interval of logarithms as factors."""
    low, high = np.exp([interval.low, interval.high])
    return f"{low:.{digits}f} to {high:.{digits}f} times ({METHOD})"


def compared(record: str, first: str, second: str = "", *, column: str = "decorated_success", second_column: str = "", sign: int = 1,
             enough: float = 0.0, paper: Sequence[str] = (), names: tuple[str, str] = ("", "")) -> Finding:
    """A finding of the kind "first is better than second" by `column`.

    Args:
        record: the name of the recorded results.
        second: another recipe; left out: the same one, with `second_column` (such as its base policy's success).
        sign: -1 for "worse than".
        enough: what the difference must exceed.
        paper: the claim's tasks, where it names some.
        names: what both are called, if not by their recipes.
    """
    table, _ = recorded(record)
    one, two = by_seed(table, first, column), by_seed(table, second or first, second_column or column)
    names = names[0] or first, names[1] or second or "its base policy"
    return set_against(record, one, two, names, sign=sign, enough=enough, paper=paper)


def set_against(record: str | Sequence[str], one: pd.Series, two: pd.Series, names: tuple[str, str], *, sign: int = 1, enough: float = 0.0,
                paper: Sequence[str] = (), recipes: Collection[str] = ()) -> Finding:
    """The same for runs by (task, seed), from wherever; `names` says what both are called, `recipes` which of the record were looked at."""
    interval, values, (first, second), told = set_apart(one, two, paper)
    told = f"{names[0]} {percent(first)}, {names[1]} {percent(second)}: {signed(interval.value)} points{told}"
    return finding(record, values, told, points(interval), judged_over_tasks(sign * values, enough), paper, recipes=recipes)


def set_apart(one: pd.Series, two: pd.Series, paper: Sequence[str] = ()) -> tuple[Interval, pd.Series, tuple[float, float], str]:
    """The differences of runs by (task, seed) on the tasks that are judged and their interval, what both are on average, and in words the
    differences on each task, those included that are not judged."""
    one, two = matched(one, two)
    chosen, others = named_by(paper, _of_enough_seeds(one))
    rest = (one - two).loc[others.index]
    (one, two), near_0 = told_apart(one.loc[chosen.index], two.loc[chosen.index])
    interval, values = difference(one, two)
    told = f"{task_by_task(values, signed)}{not_judged(near_0, rest.groupby(level='task').mean().to_dict())}"
    return interval, values, (average(one), average(two)), told


def ahead(record: str | Sequence[str], table: pd.DataFrame, own: str, kinds: Mapping[str, Sequence[str]], paper: Sequence[str],
          beside: str = "") -> Finding:
    """A finding of the kind "`own` beats the best recipe of every kind": the interval is that of the smallest lead, the verdict that of the
    weakest. A lead over rivals that were run on some of the tasks says on which. `beside` is told behind what was measured."""
    mine, leads = by_seed(table, own, "decorated_success"), []
    for kind, recipes in kinds.items():
        rival = best(table, recipes)
        interval, values = difference(mine, by_seed(table, rival, "decorated_success"))
        leads.append((interval, values, f"{signed(interval.value)} points against {rival} (best of {kind})"))
    every = pd.concat([values for _, values, _ in leads])
    several = every.index.get_level_values("task").nunique() > 1
    told = [text + (task_by_task(values, signed) or (f" ({values.index[0][0]})" if several else "")) for _, values, text in leads]
    level, least = average(mine.loc[every.index.unique()]), min((interval for interval, _, _ in leads), key=lambda lead: lead.value)
    return finding(record, every, f"{percent(level)}: {', '.join(told)}{beside}", points(least),
                   weakest(*(_on_all(judged_over_tasks(values), values, paper) for _, values, _ in leads)), paper)


def finding(record: str | Sequence[str], values: pd.Series, measured: str, interval: str, verdict: str, paper: Sequence[str] = (), *,
            recipes: Collection[str] = ()) -> Finding:
    """A finding from values by (task, seed), of one record or several; "reproduced" counts as partly where tasks of the claim are
    missing. `recipes` are those that were looked at, where not all of the records are: their commands alone are given."""
    tasks = list(dict.fromkeys(values.index.get_level_values("task")))
    verdict = _on_all(verdict, values, paper)
    seeds = _listed(values.index)
    own = {task: _listed(mine.index) for task, mine in values.groupby(level="task")}
    if len(set(own.values())) > 1:
        told = {mine: " ".join(task for task in tasks if own[task] == mine) for mine in sorted(set(own.values()), reverse=True)}
        measured += "; seeds " + ", ".join(f"{mine} on {where}" for mine, where in told.items())
    records = [part for name in ([record] if isinstance(record, str) else record) for part, (table, _) in _records(name).items()
               if set(table.task) & set(tasks)]
    made = [command for part in records for command in commands(part, tasks, recipes)]
    return Finding(" ".join(tasks), seeds, measured, interval, verdict, "; ".join(dict.fromkeys(made)))


def _on_all(verdict: str, values: pd.Series, paper: Sequence[str]) -> str:
    """The verdict on values by (task, seed): at most "partly" where one of the claim's tasks is missing."""
    return "partly" if verdict == "reproduced" and not set(paper) <= set(values.index.get_level_values("task")) else verdict


def _listed(index: pd.MultiIndex) -> str:
    """The seeds of an index of tasks and seeds, in order."""
    return " ".join(str(seed) for seed in sorted(set(index.get_level_values("seed"))))


def commands(record: str, tasks: Sequence[str], recipes: Collection[str] = ()) -> list[str]:
    """What makes the rows of these tasks (and recipes): the column `sweep` where it is recorded, else a sweep of that name, else the rows'
    commands."""
    table, _ = load(record)
    mine, spec = table[table.task.isin(tasks)], DATA / "sweeps" / f"{record}.toml"
    if recipes and (mine := mine[mine.recipe.isin(recipes)]).empty:
        return []
    known = mine.sweep.dropna() if "sweep" in mine else []
    if len(known) or spec.exists() or "command" not in mine:
        return sorted(set(known)) or [f"pdkit sweep data/sweeps/{spec.name}"]
    seeds: dict[str, list[str]] = {}  # by what commands that differ in their seed alone have in common
    for command in dict.fromkeys(mine.command):
        before, _, rest = command.partition(" --seeds ")
        seed, _, after = rest.partition(" ")
        seeds.setdefault(f"{before} --seeds {{}} {after}" if rest else command, []).append(seed)
    return [command.replace("{}", " ".join(numbers), 1) for command, numbers in seeds.items()]


def recorded(name: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows and curves of a comparison: those on Door, or in a record of all tasks, and those of its records on other tasks
    (recorded.record_of). Raises TooLittle where nothing is recorded."""
    tables, curves = zip(*_records(name).values(), strict=True)
    return pd.concat(tables, ignore_index=True), pd.concat(curves, ignore_index=True)


def _records(name: str) -> dict[str, tuple[pd.DataFrame, pd.DataFrame]]:
    """The same, record by record. Rows of a notebook that names no task are Door's."""
    found, missing = {}, []
    for part in (name, *(record_of(name, task) for tasks in TASKS.values() for task in tasks if task != "Door")):
        try:
            table, curves = load(part)
        except PdkitError as error:
            missing.append(error)
            continue
        if part == name:
            table["task"] = table.task.where(~table.task.astype(str).str.match(r"\d"), "Door")
        found[part] = table, curves
    if not found:
        raise TooLittle(str(missing[0])) from None
    return found
