"""Recorded results: tidy files in data/results, a row a training seed, and the picture drawn from them."""
from __future__ import annotations

import contextlib
import fcntl
import hashlib
import itertools
import json
import shlex
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from .errors import PdkitError
from .files import DATA, atomic_file, read_json, write_json
from .runs import NO_MATTER, describe_machine
from .tasks import TASKS
from .tasks.partnet import object_set

KEYS = ["task", "recipe", "seed"]  # a row with the same ones is replaced
# Of a run's metrics.csv, what its recorded curve leaves out, so that the repository stays small: the clock of another machine, and what no
# figure or verdict reads.
UNRECORDED = ["seconds", "eval_seconds", "residual_abs", "target_mean", "train_length", "train_episodes", "actor_loss", "policy_loss",
              "value_loss", "kl", "clipped", "ot_error", "bc_share"]
TRAINING = "pdkit train decorated"  # how a command that makes a row of a training begins
SETTINGS = "settings"  # the column that tells rows of other settings apart: a `mark`, whose settings the manifest holds
UNTIED = {*NO_MATTER, "threads", "pictures", "strict"}  # what a row's settings do not tell, as its numbers do not depend on it
AS_WORDS = {"converters": {"recipe": str}}  # how pd.read_csv takes a recipe as it stands, such as 7 or None
OWN = ",partnet"  # behind the recipe of a row on the user's own objects


def record(name: str, rows: pd.DataFrame, curves: pd.DataFrame, settings: Mapping[str, dict[str, Any]] | None = None) -> None:
    """Add rows to data/results/NAME.csv and, where there are curves, NAME_curves.csv, and draw a picture a task of trainings.

    Numbers keep six significant digits, those of curves, which have no UNRECORDED columns, three: more than is drawn.

    `settings` are those of the rows by their mark (column SETTINGS); the manifest keeps them.

    The manifest tells how to make all of it again (the column `sweep` of rows that have one, else `command`) and which machines have
    recorded here, this one last; a row's `cores` hint at which of them made it, and its `commit` is that of its own run. On the user's
    own objects (PDKIT_PARTNET) a recipe is written as RECIPE,partnet, beside those of generated ones; `load` gives the rows of the
    objects that are set.
    """
    folder, tables = DATA / "results", []
    rows, curves = (table.assign(recipe=table.recipe.where(~_on_own_objects(table), table.recipe + OWN)) if len(table) else table
                    for table in (rows, curves.drop(columns=UNRECORDED, errors="ignore")))
    with _alone():
        for path, new, digits in ((folder / f"{name}.csv", rows, 6), (folder / f"{name}_curves.csv", curves, 3)):
            if new.empty:
                continue
            tables.append(_merged(path, new))
            if not tables[1:]:
                every = settings_of(name) | dict(settings or {})
                known = {of: told for of, told in every.items() if of in set(tables[0].get(SETTINGS, []))}
                print(*(f"{sentence}\n" for sentence in mixed(name, tables[0], known)), sep="", end="", flush=True)
            with atomic_file(path) as temporary:
                _whole(tables[-1]).to_csv(temporary, index=False, float_format=f"%.{digits}g")
        again = tables[0]["sweep"].fillna(tables[0].command) if "sweep" in tables[0] else tables[0].command
        path = folder / f"{name}_manifest.json"
        write_json(path, {"written": time.strftime("%Y-%m-%d"), "machines": _machines(path), "again": sorted(set(again))}
                   | ({SETTINGS: known} if known else {}))
        if len(tables) == 2:
            draw(name)


def draw(name: str) -> None:
    """Draw the pictures of a record of trainings, one a task (`picture_of`); none of another record."""
    from .plots import save_small  # matplotlib, which a training has no other need of
    from .plots_recorded import figure

    paths = [DATA / "results" / f"{name}{end}.csv" for end in ("", "_curves")]
    if not all(path.exists() for path in paths):
        return
    tables = [pd.read_csv(path, **AS_WORDS) for path in paths]
    if not {"base_success", "decorated_success"} <= set(tables[0]):
        return
    for task in dict.fromkeys(tables[0].task):  # all: which is the first may have changed
        with atomic_file(DATA / "results" / f"{picture_of(name, task, tables[0])}.png") as temporary:
            save_small(figure(*tables, task), temporary)


def picture_of(name: str, task: str, table: pd.DataFrame) -> str:
    """What the picture of a task is called: NAME of Door, or of the first task where Door is none of them, NAME-TASK of the others."""
    first = "Door" if "Door" in set(table.task) else table.task.iloc[0]
    return name if task == first else f"{name}-{task}"


def told_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Of a run's settings those that its row tells: all but the seed and what does not matter, as JSON gives them back."""
    return json.loads(json.dumps({name: value for name, value in settings.items() if name not in (*UNTIED, "seed")}))


def mark(settings: Mapping[str, Any]) -> str:
    """What a row calls its settings: s and twelve digits of their checksum."""
    return f"s{hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]}"


def settings_of(name: str, folder: Path | None = None) -> dict[str, dict[str, Any]]:
    """The settings of the rows of data/results/NAME by their marks, as its manifest has them."""
    path = (folder or DATA / "results") / f"{name}_manifest.json"
    return read_json(path).get(SETTINGS, {}) if path.exists() else {}


def unlike(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """The settings, of those that both have, in which they differ: a field that one has not is newer than the run, and was not there."""
    return sorted(name for name in one.keys() & other.keys() if one[name] != other[name])


def mixed(name: str, table: pd.DataFrame, settings: Mapping[str, dict[str, Any]]) -> list[str]:
    """A sentence for each recipe of the table NAME whose rows, seeds aside, were not made alike: no mean over them says anything. Rows that
    tell no settings (by their mark) are held to their commands."""
    def differ(rows: pd.DataFrame) -> bool:
        marked = [settings[each] for each in rows[SETTINGS].dropna().unique() if each in settings] if SETTINGS in rows else []
        silent = rows[rows[SETTINGS].isna()] if SETTINGS in rows else rows
        ways = {tuple(part for part in essence(command) if not part.startswith(("seeds ", "num-demos ")))
                for command in silent.command if command.startswith(TRAINING)}
        return len(ways) > 1 or any(unlike(one, other) for one, other in itertools.combinations(marked, 2))

    found = [key for key, rows in table.groupby(["task", "recipe"]) if differ(rows)]
    return [f"{name}.csv: the rows of {task} {recipe} were run with different settings; run the older ones again "
            "(`pdkit sweep SPEC --missing` tells which), or record under another name." for task, recipe in found]


def essence(command: str) -> tuple[str, ...]:
    """The parts of a command on which its row depends, sorted; a command other than `pdkit train decorated` counts as it stands."""
    head, *options = command.split(" --")
    if not head.startswith(TRAINING):
        return (command,)
    parts = {head}
    for name, _, value in (option.partition(" ") for option in options):
        if name == "set":
            parts |= {f"set {word}" for word in shlex.split(value) if word.partition("=")[0] not in NO_MATTER}
        elif name not in ("record", "threads") and (name, value) != ("method", "policy_decorator"):  # the usual one
            parts.add(f"{name} {value}")
    return tuple(sorted(parts))


def check_name(name: str) -> None:
    """Raises PdkitError where data/results/NAME.csv is, or would be, no table of runs."""
    path = DATA / "results" / f"{name}.csv"
    try:
        others = path.exists() and not set(KEYS) <= set(pd.read_csv(path, nrows=0))
    except ValueError:  # empty, or no table at all
        others = True
    if others or name.endswith("_curves"):
        raise PdkitError(f"Nothing can be recorded as {name}: data/results/{name}.csv is no table of runs; choose another name.")


def _on_own_objects(table: pd.DataFrame) -> pd.Series:
    """Of each row, whether its task has the user's own objects now."""
    return table.task.isin([name for name, spec in TASKS.items() if object_set(spec)])


def of_these_objects(table: pd.DataFrame) -> pd.DataFrame:
    """The rows on the objects that are set now, by the recipes' own names."""
    if table.empty or "recipe" not in table:
        return table
    theirs = table.recipe.astype(str).str.endswith(OWN)
    named = table.assign(recipe=table.recipe.where(~theirs, table.recipe.astype(str).str.removesuffix(OWN)))
    return named[theirs == _on_own_objects(table)]


def load(name: str, task: str | None = None) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Recorded rows (one a run) and learning curves (empty where there are none) of data/results/NAME, of all tasks or one.

    Raises PdkitError when nothing is recorded.
    """
    path, curves = DATA / "results" / f"{name}.csv", DATA / "results" / f"{name}_curves.csv"
    every = of_these_objects(pd.read_csv(path, **AS_WORDS)) if path.exists() else pd.DataFrame(columns=KEYS)
    table = every if task is None else every[every.task == task]
    if table.empty:
        known, spec = ", ".join(dict.fromkeys(every.task)), DATA / "sweeps" / f"{name}.toml"
        sweep = f"; `pdkit sweep data/sweeps/{spec.name}` makes them." if spec.exists() else ", and no sweep in data/sweeps makes them."
        others = f", only of {known}." if known else sweep
        raise PdkitError(f"No results {name!r}{f' of {task}' if task else ''} are recorded in data/results{others}")
    lines = of_these_objects(pd.read_csv(curves, **AS_WORDS)) if curves.exists() else pd.DataFrame(columns=[*KEYS, "step"])
    return table.reset_index(drop=True), lines[lines.task.isin(table.task)].reset_index(drop=True)


def record_of(name: str, task: str) -> str:
    """What the results of a comparison that Door's sweep `name` makes are called on a task: those of another have a sweep of their own."""
    return name if task == "Door" else f"{name}_{task.lower()}"


def by_arm(table: pd.DataFrame, group: str, field: str, name: str) -> pd.DataFrame:
    """A notebook's recorded rows, whose columns are called GROUP.ARM.FIELD (GROUP.ARM for an empty field), as one row an arm and seed:
    recipe (the arm), seed, `name`.

    Raises PdkitError when there is no such column.
    """
    end = f".{field}" if field else ""
    arms = {column: column.removeprefix(f"{group}.").removesuffix(end) for column in table
            if column.startswith(f"{group}.") and column.endswith(end)}
    if not arms:
        raise PdkitError(f"These results have no columns {group}.ARM{end}; they come from another notebook.")
    rows = table.set_index("seed")[list(arms)].rename(columns=arms).stack()
    return rows.rename_axis(["seed", "recipe"]).rename(name).reset_index()[["recipe", "seed", name]]


def by_number(table: pd.DataFrame, group: str, arm: str, number: str, name: str) -> pd.DataFrame:
    """The same for columns called GROUP.ARM.NUMBER, such as met.random actions.0.25: rows `arm`, `number` (a float), seed, `name`.

    Raises PdkitError when there is no such column.
    """
    columns = {column: column.removeprefix(f"{group}.").partition(".")[::2] for column in table if column.startswith(f"{group}.")}
    if not columns:
        raise PdkitError(f"These results have no columns {group}.ARM.NUMBER; they come from another notebook.")
    return pd.DataFrame([{arm: who, number: float(where), "seed": row.seed, name: row[column]}
                         for _, row in table.iterrows() for column, (who, where) in columns.items()]).dropna()


def _machines(path: Path) -> list[dict[str, Any]]:
    """The machines of a manifest and this one, last; of the same machine only the newest commit and threads."""
    this, old = describe_machine(), read_json(path) if path.exists() else {}
    earlier = old.get("machines") or [old[key] for key in ("machine",) if key in old]
    newer = {name: this.get(name) for name in ("git", "torch_threads")}
    unknown = {"cpu_bf16": this.get("cpu_bf16")}  # which older manifests do not tell
    return [machine for machine in earlier if unknown | machine | newer != unknown | this] + [this]


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """Wait until no other process records: two trainings that end together must not lose each other's rows."""
    folder = DATA / "results"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = open(folder / ".lock", "a")
    except OSError as error:
        raise PdkitError(f"Cannot record in {folder}: {error.strerror}.") from None
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError as error:
            raise PdkitError(f"Cannot record in {folder}, which cannot be locked: {error.strerror}.") from None
        yield


def _whole(table: pd.DataFrame) -> pd.DataFrame:
    """The table with its counts as whole numbers: a count that some rows lack is a float to pandas, and would be rounded to six digits."""
    floats = table.select_dtypes("float")
    counts = [name for name in floats if (floats[name].dropna() % 1 == 0).all()]
    return table.astype(dict.fromkeys(counts, "Int64"))


def _merged(path: Path, new: pd.DataFrame) -> pd.DataFrame:
    """The file's rows without those that `new` replaces, then `new`, sorted."""
    if path.exists():
        old = pd.read_csv(path, **AS_WORDS)
        mine = new[KEYS].drop_duplicates()
        old = old.merge(mine, on=KEYS, how="left", indicator=True).query("_merge == 'left_only'").drop(columns="_merge")
        columns = list(dict.fromkeys([*old, *new]))
        # Columns without a value say nothing of their type, and pandas is about to let them decide it.
        parts = [part.dropna(axis=1, how="all") for part in (old, new) if len(part)]
        new = pd.concat(parts, ignore_index=True).reindex(columns=columns)
    return new.sort_values([*KEYS, *(["step"] if "step" in new else [])], ignore_index=True)
