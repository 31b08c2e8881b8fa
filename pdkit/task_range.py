"""All tasks in one table: demonstrations, base policy, decorated policy, beside the paper's averages (Fig. 1).

The paper gives averages over tasks only; what it has for a single task is not known, and none is invented here. The recorded runs are
those of the main job (data/results/main_job.csv): the decorator's best evaluation on selection episodes, tested on others. Where the main
job's own base is no BeT, as the paper's are, but one was decorated by the same recipe (bet_bases.csv, evaluated otherwise while it
learns), those runs stand for the task.
"""
from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping

import pandas as pd

from .claims import TASKS, mean_interval
from .demos import sources
from .errors import PdkitError
from .recorded import load
from .stats import wilson
from .tasks import get_task

PAPER = {  # percent, means over tasks (facts of Fig. 1): base policy, decorated; its eight tasks, ManiSkill's four, Adroit's four
    "all": (41.5, 98.95),
    "maniskill": (36.25, 98.325),
    "adroit": (46.75, 99.575),
}
SUITES = ("maniskill", "adroit")
# Records of methods over a Diffusion Policy, and the decorator's cell in each, chosen before it was run: on StackCube the paper's bound for
# it over a BeT, on Door the official script's default over a Diffusion Policy (the paper's own for either are not known), on the others
# each task's own in the lesson.
DIFFUSION = {"diffusion_finetuning": "policy_decorator,alpha=0.03", "diffusion_door": "policy_decorator",
             "diffusion_tasks": "policy_decorator"}
COLD = {"Relocate": 0.5}  # bases among them that start from this much of the noise (`temperature`): none of the paper's kind
PAPER_DIFFUSION = (52.55, 99.9)  # percent (Fig. 1), the mean over six tasks, as its axes let infer: base policy, decorated
COLUMNS = ["task", "suite", "policy", "demos", "label", "seeds", "episodes", "env_steps", "base", "base_low", "base_high", "decorated",
           "low", "high", "at_end"]
ENOUGH = 3  # seeds below which the interval is the test episodes' alone


def over_bets(jobs: pd.DataFrame, bets: pd.DataFrame) -> pd.DataFrame:
    """Rows of main_job.csv, but on the tasks of which bet_bases.csv has ENOUGH seeds, or that it alone has, that one's."""
    if not len(bets):
        return jobs
    known = bets[(bets.groupby("task").seed.transform("nunique") >= ENOUGH) | ~bets.task.isin(jobs.task)]
    return pd.concat([jobs[~jobs.task.isin(known.task)], known], ignore_index=True)


def by_task(table: pd.DataFrame) -> pd.DataFrame:
    """A row for each of the paper's tasks, ManiSkill's first, from recorded rows of the main job.

    Columns: task, suite, policy (kind of the base policy), demos (how many it learned from; where nothing is recorded, how many are
    bundled), label (who made them), seeds, episodes, env_steps, base, base_low, base_high (Wilson over test episodes), decorated (mean over
    seeds), low, high (Student's t over seeds from three on, else Wilson over the test episodes of the first seed), at_end (mean success at
    the last step). Not recorded: NaN.
    """
    rows = []
    for suite in SUITES:
        for task in TASKS[suite]:
            row = {"task": task, "suite": suite} | _demonstrations(task)
            mine = table[table.task == task]
            rows.append(row | (_results(mine) if len(mine) else {"seeds": 0}))
    return pd.DataFrame(rows).reindex(columns=COLUMNS)


def beside_imitation(jobs: pd.DataFrame, longer: pd.DataFrame, over: pd.DataFrame) -> pd.DataFrame:
    """For each task of longer_imitation.csv, what its decorated policies come to beside what imitation alone would have.

    Columns: task, base, base_low, base_high, decorated, low, high, seeds (of the main job: as in `by_task`); of the longer imitation
    imitated (mean over seeds), imitated_low, imitated_high (Student's t), imitated_seeds; and the same of over_longer_imitation.csv, the
    main job's recipe over one of these policies, as over_... (NaN where it has not ENOUGH seeds). Tasks that `jobs` has not, or of
    which the longer imitation has not ENOUGH seeds, are left out.
    """
    columns = ["task", "base", "base_low", "base_high", "decorated", "low", "high", "seeds",
               *(f"{what}{part}" for what in ("imitated", "over") for part in ("", "_low", "_high", "_seeds"))]
    rows = []
    for task in (task for suite in reversed(SUITES) for task in TASKS[suite]):
        job, alone, above = (table[table.task == task] for table in (jobs, longer, over[over.recipe == "lesson"]))
        if len(job) and len(alone) >= ENOUGH:
            rows.append({"task": task} | _results(job) | _over_seeds("imitated", alone, "base_success")
                        | (_over_seeds("over", above, "decorated_success") if len(above) >= ENOUGH else {}))
    return pd.DataFrame(rows).reindex(columns=columns)


def _over_seeds(name: str, rows: pd.DataFrame, column: str) -> dict[str, float]:
    interval = mean_interval(rows.set_index(["task", "seed"])[column])
    return {name: interval.value, f"{name}_low": max(interval.low, 0.0), f"{name}_high": min(interval.high, 1.0),
            f"{name}_seeds": len(rows)}


def over_diffusion(tables: Mapping[str, pd.DataFrame] | None = None) -> pd.DataFrame:
    """The same for the tasks on which a Diffusion Policy was decorated: there it is the *last* policy that is tested, after fewer steps.

    `tables` are the records by name (None: those of data/results). Empty where nothing is recorded.
    """
    rows = []
    for record, cell in DIFFUSION.items():
        with contextlib.suppress(PdkitError):
            table = load(record)[0] if tables is None else tables.get(record, pd.DataFrame(columns=["recipe"]))
            for task, mine in table[table.recipe == cell].groupby("task"):
                suite = next(name for name in SUITES if task in TASKS[name])
                rows.append({"task": task, "suite": suite} | _demonstrations(task) | _results(mine))
    return pd.DataFrame(rows).reindex(columns=COLUMNS)


def by_temperature() -> pd.DataFrame:
    """What `pdkit evaluate FOLDER --sampling temperature=T --record sampling` recorded of Diffusion Policies: task, temperature (the
    highest first), episodes, success with Wilson's 95 % interval (low, high) and success_at_end; the task that gains most by a lower one
    comes first. Empty where nothing is recorded."""
    columns = ["task", "temperature", "episodes", "success", "low", "high", "success_at_end"]
    try:
        rows = load("sampling")[0]
    except PdkitError:
        return pd.DataFrame(columns=columns)
    found = rows.recipe.str.extract(r"^base,temperature=([\d.]+)$")[0].astype(float)
    rows = rows.assign(temperature=found).dropna(subset="temperature").sort_values("temperature", ascending=False)
    gains = rows.groupby("task").success.agg(lambda rates: rates.iloc[-1] - rates.iloc[0])
    return rows.assign(gain=rows.task.map(gains)).sort_values(["gain", "task", "temperature"], ascending=[False, True, False],
                                                              ignore_index=True)[columns]


def _demonstrations(task: str) -> dict[str, object]:
    try:
        demos = sources.bundled(task)
    except PdkitError:
        return {}
    return {"demos": demos.num, "label": demos.label + (", other objects" if get_task(task).demo_task else "")}


def _results(rows: pd.DataFrame) -> dict[str, object]:
    first = rows.sort_values("seed").iloc[0]
    episodes = int(first.episodes)
    # One that samples was tested on random numbers of each run.
    tests = rows if first.policy == "diffusion" and rows.base_success.nunique() > 1 else rows[rows.seed == first.seed]
    base = wilson(round((tests.base_success * tests.episodes).sum()), int(tests.episodes.sum()))
    values = rows.set_index(["task", "seed"]).decorated_success
    interval = mean_interval(values) if len(rows) >= ENOUGH else wilson(round(first.decorated_success * episodes), episodes)
    named = re.search(r"--num-demos (\d+)", str(first.get("command", "")))
    own = {"demos": int(named[1])} if named else {}
    return own | {"policy": first.policy, "seeds": len(rows), "episodes": episodes, "env_steps": int(rows.env_steps.max()),
            "base": base.value, "base_low": base.low, "base_high": base.high, "decorated": values.mean(), "low": max(interval.low, 0.0),
            "high": min(interval.high, 1.0), "at_end": rows.decorated_success_at_end.mean()}


def averages(tasks: pd.DataFrame, paper: Mapping[str, tuple[float, float]] = PAPER) -> pd.DataFrame:
    """Means over the tasks of `by_task` that are recorded, beside the paper's: a row for each name in `paper` ("all" tasks, or a suite):
    over, tasks (how many of how many), base, decorated, at_end, paper_base, paper_decorated; all shares from 0 to 1."""
    rows = []
    for over, (base, decorated) in paper.items():
        mine = tasks if over == "all" else tasks[tasks.suite == over]
        known = mine.dropna(subset=["decorated"])
        rows.append({"over": over, "tasks": f"{len(known)} of {len(mine)}", "base": known.base.mean(), "decorated": known.decorated.mean(),
                     "at_end": known.at_end.mean(), "paper_base": base / 100, "paper_decorated": decorated / 100})
    return pd.DataFrame(rows)
