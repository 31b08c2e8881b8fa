"""`pdkit report`: the paper's claims with what was measured here, checked, as text and as one HTML page.

data/results/claims.csv has a row a claim:

    claim     a sentence                         seeds     of the training, such as "0 1 2 3 4"
    section   where the paper makes it           measured  what was found; of an untested one, why nothing was
    tasks     where it was tested; of an         interval  its interval, with the method
              untested one, the paper's tasks    verdict   reproduced, partly, not or untested
                                                 command   that makes the numbers again

`pdkit report --update` first computes every verdict anew for which there is a rule (pdkit/verdicts) and enough is recorded, and, where
nothing is wrong, draws the pictures of each record and the `pictures` of several.
A claim whose verdict is not "untested" has all of them. The recorded tables beside it (a row a run, with its command) are checked
too: a report on broken tables is refused.
"""
from __future__ import annotations

import re
import sys
import textwrap
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import pandas as pd

from . import page, plots_range, task_range, verdicts
from .claims import BETS
from .cli import Parser
from .errors import PdkitError
from .files import DATA, TEMPORARY, atomic_file, runs_root
from .plots import Picture, save_small
from .recorded import AS_WORDS, KEYS, draw, mixed, of_these_objects, picture_of, settings_of

COLUMNS = ["claim", "section", "tasks", "seeds", "measured", "interval", "verdict", "command"]
VERDICTS = {"reproduced": "what the paper says was found", "partly": "found in part, or not yet with certainty",
            "not": "something else was found, which `measured` tells", "untested": "nothing was run yet, or what was run does not tell"}
NEEDED = ("tasks", "seeds", "measured", "interval", "command")  # of a tested claim
RATES = ("base_success", "base_success_at_end", "decorated_success", "decorated_success_at_end")


def load_claims(path: str | Path) -> pd.DataFrame:
    """The table of claims, all words. Raises PdkitError when it is missing or has other columns."""
    table = _read(Path(path), dtype=str, keep_default_na=False)
    if list(table.columns) != COLUMNS:
        raise PdkitError(f"{path} must have the columns {', '.join(COLUMNS)}, not {', '.join(map(str, table.columns))}.")
    return table.apply(lambda column: column.str.strip())


def _read(path: Path, **options) -> pd.DataFrame:
    try:
        return pd.read_csv(path, **options)
    except OSError as error:
        raise PdkitError(f"Cannot read {path}: {error.strerror}.") from None
    except (ValueError, pd.errors.ParserError) as error:
        raise PdkitError(f"{path} is not a readable CSV file: {' '.join(str(error).split()).rstrip('.')}.") from None


def claim_problems(claims: pd.DataFrame) -> list[str]:
    """What is wrong with the claims, a sentence each; empty when nothing is."""
    found = []
    for number, row in enumerate(claims.itertuples(), 1):
        where = f"Claim {number} ({textwrap.shorten(row.claim, 60) or 'empty'})"
        if not row.claim or not row.section:
            found.append(f"{where} lacks its {'section' if row.claim else 'sentence'}.")
        if row.verdict not in VERDICTS:
            found.append(f"{where} has the verdict {row.verdict!r}; known are {', '.join(VERDICTS)}.")
            continue
        if row.verdict == "untested":
            given = [name for name in NEEDED if name not in ("tasks", "measured") and getattr(row, name)]
            found += [f"{where} is untested but has {', '.join(given)}; give it a verdict."] if given else []
            continue
        missing = [name for name in NEEDED if not getattr(row, name)]
        found += [f"{where} is {row.verdict!r} but lacks {', '.join(missing)}."] if missing else []
        if row.seeds and not re.fullmatch(r"\d+( \d+)*", row.seeds):
            found.append(f"{where} has the seeds {row.seeds!r}; write numbers with blanks between them.")
        for name in ("measured", "interval"):
            if (text := getattr(row, name)) and not re.search(r"\d", text):
                found.append(f"{where} has no number in {name}.")
        if row.command and not row.command.startswith(("pdkit ", "./pd ")):
            found.append(f"{where} has a command that is none of pdkit's: {row.command!r}.")
    found += [f"A claim is listed {count} times: {claim!r}." for claim, count in Counter(claims.claim).items() if count > 1]
    return found


def recorded_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """The recorded tables of a row a run, by name (without the claims, the curves, and what is just being written)."""
    return {path.stem: _read(path, **AS_WORDS) for path in sorted(folder.glob("*.csv"))
            if path.stem != "claims" and not path.stem.endswith("_curves") and TEMPORARY not in path.name}


def table_problems(name: str, table: pd.DataFrame, folder: Path) -> list[str]:
    """What is wrong with a recorded table, a sentence each."""
    if "command" not in table:
        return [f"{name}.csv has no column of commands that make its rows again."]
    if table.command.isna().any():
        line = int(table.command.isna().to_numpy().argmax()) + 2
        return [f"{name}.csv has a row without the command that makes it again (line {line}); was the file cut off?"]
    if not set(KEYS) <= set(table):
        return []
    found = []
    if (count := int(table.duplicated(KEYS).sum())):
        found.append(f"{name}.csv has {count} rows more than once (same {', '.join(KEYS)}).")
    found += mixed(name, table, settings_of(name, folder))
    for column in RATES:
        if column in table and not table[column].between(0, 1).all():
            found.append(f"{name}.csv has a {column} that is no rate between 0 and 1.")
    curves = folder / f"{name}_curves.csv"
    if curves.exists():
        known = set(_read(curves, **AS_WORDS)[KEYS].drop_duplicates().itertuples(index=False, name=None))
        lost = [key for key in table[KEYS].itertuples(index=False, name=None) if key not in known]
        found += [f"{name}_curves.csv has no curve of {' '.join(map(str, key))}." for key in lost]
    return found


def absent_tables(claims: pd.DataFrame, tables: dict[str, pd.DataFrame]) -> list[str]:
    """A sentence for each recorded table that a verdict rests on by the sweep in its command, and that is not there."""
    found: dict[str, str] = {}
    for command in claims.command[claims.verdict != "untested"]:
        for spec in re.findall(r"data/sweeps/\w+\.toml", command):
            if (path := DATA / "sweeps" / Path(spec).name).exists():
                found.setdefault(tomllib.loads(path.read_text()).get("record") or path.stem, spec)
    return [f"{name}.csv is missing, on which verdicts rest; `pdkit sweep {spec}` makes it." for name, spec in found.items()
            if name not in tables]


def counts(claims: pd.DataFrame) -> dict[str, int]:
    """How many claims have which verdict, in the order of VERDICTS."""
    return {verdict: int((claims.verdict == verdict).sum()) for verdict in VERDICTS}


def lines(claims: pd.DataFrame) -> list[str]:
    """The claims as text, the tested ones with what was measured."""
    told = []
    for row in claims.itertuples():
        told += textwrap.wrap(f"{row.verdict:11} {row.section:17} {row.claim}", 118, subsequent_indent=" " * 30)
        found = (f"{row.measured}; {row.interval}", f"{row.tasks}, seeds {row.seeds}", row.command)
        for text in (row.measured,) if row.verdict == "untested" else found:
            told += textwrap.wrap(text, 118, initial_indent=" " * 30, subsequent_indent=" " * 32, break_on_hyphens=False)
    return told


def sections(claims: pd.DataFrame, tables: dict[str, pd.DataFrame], folder: Path) -> list[page.Section]:
    """The page: counts, tested claims, untested ones, and the recorded tables."""
    tested, rest = claims[claims.verdict != "untested"], claims[claims.verdict == "untested"]
    parts = [page.Section("Verdicts", [page.numbers([(str(n), verdict, VERDICTS[verdict]) for verdict, n in counts(claims).items()])])]
    if "main_job" in tables:
        parts.append(page.Section("All tasks", [page.figure(_range(tables), "base and decorated policies of the main job")]))
    parts.append(page.Section("Tested", [page.table(tested.to_dict("records")) if len(tested) else "Nothing yet."]))
    if len(rest):
        why = rest[["claim", "section", "tasks", "measured"]].rename(columns={"measured": "why"})
        parts.append(page.Section("Untested", [page.table(why.to_dict("records"))]))
    for name, table in tables.items():
        again = sorted(set(table["sweep"].dropna() if "sweep" in table else table.command))
        rows = table.drop(columns=["command", "sweep"], errors="ignore").to_dict("records")
        shown = [page.details(f"{len(table)} rows", page.table(rows)),
                 page.details("How to make them again", page.code("\n".join(again)))]
        tasks = dict.fromkeys(table["task"]) if "task" in table else ()
        paths = [(folder / f"{picture_of(name, task, table)}.png", task) for task in tasks]
        drawn = [page.figure(path, f"{name}.csv, {task}") for path, task in paths if path.exists()]
        parts.append(page.Section(f"Recorded: {name}", drawn + shown))
    return parts


def _rows(tables: Mapping[str, pd.DataFrame], *names: str) -> list[pd.DataFrame]:
    """The records of these names, on the objects that are set now; an empty one for each that is not there."""
    return [of_these_objects(tables.get(name, pd.DataFrame(columns=["task", "recipe"]))) for name in names]


def _range(tables: Mapping[str, pd.DataFrame]) -> Picture:
    tasks = task_range.by_task(task_range.over_bets(*_rows(tables, "main_job", "bet_bases")))
    bases = "Behavior Transformers" if tasks.policy.dropna().isin(BETS).all() else "base policies"
    return plots_range.range_figure(tasks, task_range.averages(tasks), f"Over {bases}, the best evaluation of a run")


def pictures(tables: Mapping[str, pd.DataFrame]) -> Iterator[tuple[str, Picture]]:
    """The pictures of several records, by their names in data/results; those of which nothing is recorded are left out."""
    if "main_job" in tables:
        yield "all_tasks", _range(tables)
    beside = task_range.beside_imitation(*_rows(tables, "main_job", "longer_imitation", "over_longer_imitation"))
    if len(beside):
        yield "beside_imitation", plots_range.beside_imitation_figure(beside, "What imitation alone comes to, and what decoration does")
    sampled = task_range.over_diffusion(dict(zip(task_range.DIFFUSION, _rows(tables, *task_range.DIFFUSION), strict=True)))
    if len(sampled):
        yield "over_diffusion", plots_range.over_diffusion_figure(sampled)


def main(argv: list[str]) -> int:
    """`pdkit report [--update] [--out FILE]`; 1 when something in the claims or the tables is wrong, which is then listed."""
    parser = Parser(prog="pdkit report", description="List the paper's claims with what was measured, and write a page.")
    parser.add_argument("--out", help="the page (default: runs/report.html)")
    parser.add_argument("--update", action="store_true", help="write the verdicts that data/results supports into its claims.csv, and draw "
                                                               "its pictures")
    args = parser.parse_args(argv)
    folder = DATA / "results"
    if args.update:
        claims = verdicts.updated(load_claims(folder / "claims.csv"))
        with atomic_file(folder / "claims.csv") as temporary:
            claims.to_csv(temporary, index=False)
    claims, tables = load_claims(folder / "claims.csv"), recorded_tables(folder)
    problems = claim_problems(claims) + absent_tables(claims, tables)
    for name, table in tables.items():
        problems += table_problems(name, table, folder)
    if problems:
        print(*problems, sep="\n", file=sys.stderr)
        return 1
    if args.update:
        for name in tables:
            draw(name)
        for name, picture in pictures(tables):
            with atomic_file(folder / f"{name}.png") as temporary:
                save_small(picture, temporary)
    out = page.write_page(args.out or runs_root() / "report.html", "Claims of the paper, and what was measured",
                          sections(claims, tables, folder))
    print(*lines(claims), "", sep="\n")
    print(", ".join(f"{n} {verdict}" for verdict, n in counts(claims).items()) + f"; {sum(map(len, tables.values()))} rows in "
          f"{len(tables)} recorded tables\npage        {out}")
    return 0
