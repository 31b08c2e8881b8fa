"""The file that describes a sweep, read and checked.

SPEC is a TOML (or JSON) file:

    name = "ablations"        # folder runs/sweeps/NAME
    kind = "train"            # train: `pdkit train decorated`; base: `pdkit train base`; notebook: `pdkit nb`
    seeds = [0, 1, 2]         # every cell is run with each
    record = "ablations"      # optional: finished rows go to data/results/NAME.csv and NAME_curves.csv
    minutes = 4.0             # optional: what a job takes (kind train is estimated without it)
    [fixed]                   # values of every cell
    task = "Door"
    [grid]                    # every combination of these lists is a cell
    alpha = [0.1, 0.3]
    [[cells]]                 # further cells, over the fixed values
    critic_input = "concat"
    recipe = "critic-concat"  # optional: what a cell is called; by default the values in which it differs
    seeds = [0]               # optional: its own seeds
    [bases."runs/base/own"]   # optional: base policies that are not shipped, by the folder that cells name as `base`, with what
    task = "Door"             #   `kind = "base"` takes; a sweep that needs one that is not there makes it first
    policy = "diffusion"
    sha256 = "ab12..."        #   optional: its weights' checksum where the recorded rows were made; a sweep tells where yours differs

All cells run with the first seed, then all with the next: a sweep that is stopped early compares them on fewer seeds.

A training's values are the options of `pdkit train decorated` (task, method, profile, episodes, base, demos, num_demos) and
any field of its configuration; a base policy's are these options of `pdkit train base` (task, policy, episodes, demos, num_demos) and what
it takes by --set; a notebook's are `notebook` and its parameters. Paths are relative to the project's folder; so base policies that a
sweep makes lie in its runs/, even where PDKIT_RUNS has the results elsewhere.
"""
from __future__ import annotations

import itertools
import json
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import PdkitError, unknown
from .recorded import check_name

KINDS = ("train", "base", "notebook")
SHA256 = re.compile(r"[0-9a-f]{64}")
NAME = re.compile(r"\w[\w.-]*")  # of a sweep, and of what it records
OWN_BASE = re.compile(r"runs(/(?!\.)[\w.+-]+)+")
KEYS = ("name", "kind", "seeds", "record", "minutes", "fixed", "grid", "cells", "bases")


@dataclass(frozen=True)
class Spec:
    """A checked spec file."""

    path: Path
    name: str
    kind: str
    seeds: tuple[int, ...]
    cells: tuple[dict[str, Any], ...]  # every cell's values, `recipe` among them
    record: str = ""
    minutes: float | None = None
    bases: dict[str, dict[str, Any]] = field(default_factory=dict)  # by folder: what makes it
    checksums: dict[str, str] = field(default_factory=dict)  # by folder: the weights' where the recorded rows were made, if known


def check_names(record_as: str | None, recipe: str | None = None) -> None:
    """Raises PdkitError for a record's name that is no word or no table of runs, or a recipe that would leave its folder: before the work,
    not after."""
    if record_as is not None:
        if not NAME.fullmatch(record_as):
            raise PdkitError(f"--record takes a name of letters, digits, dots and dashes, not {record_as!r}.")
        check_name(record_as)
    if recipe is not None and ("/" in recipe or recipe.startswith(".") or not recipe):
        raise PdkitError(f"--recipe becomes part of a folder's name; {recipe!r} cannot.")


def load_spec(path: str | Path) -> Spec:
    """The spec at `path`. Raises PdkitError for a file that is no spec, an unknown key or a value of the wrong kind."""
    path = Path(path)
    values = _read(path)
    for key in values:
        if key not in KEYS:
            raise unknown(f"key of {path.name}", key, KEYS)
    for key in ("name", "record"):
        if not (isinstance(values.get(key, "x"), str) and NAME.fullmatch(values.get(key, "x"))):
            raise PdkitError(f"{path.name}: {key} must be a word of letters, digits, dots and dashes, not {values[key]!r}.")
    if "record" in values:
        check_name(values["record"])
    for key, kind in (("fixed", dict), ("grid", dict), ("cells", list), ("seeds", list), ("bases", dict)):
        if not isinstance(values.get(key, kind()), kind):
            raise PdkitError(f"{path.name}: {key} must be a {'table' if kind is dict else 'list'}, not {values[key]!r}.")
    if values.get("kind") not in KINDS:
        raise unknown(f"kind in {path.name}", values.get("kind", ""), KINDS)
    seeds, minutes = values.get("seeds", [0]), values.get("minutes")
    if minutes is not None and (isinstance(minutes, bool) or not isinstance(minutes, int | float) or minutes <= 0):
        raise PdkitError(f"{path.name}: minutes must be a number above 0, not {minutes!r}.")
    name = values.get("name", path.stem)
    cells = _cells(path.name, name, values.get("fixed", {}), values.get("grid", {}), values.get("cells", []))
    for given in (seeds, *(cell["seeds"] for cell in cells if "seeds" in cell)):
        if not isinstance(given, list) or not given or any(type(s) is not int or s < 0 for s in given) or len(set(given)) < len(given):
            raise PdkitError(f"{path.name}: seeds must be different whole numbers of 0 or more, not {given!r}.")
    bases, checksums = values.get("bases", {}), {}
    for folder, base in bases.items():
        if values["kind"] != "train":
            raise PdkitError(f'{path.name}: bases are for kind = "train", not for {values["kind"]!r}; leave them out.')
        if not OWN_BASE.fullmatch(folder):
            raise PdkitError(f'{path.name}: a base policy that a sweep makes lies below runs/, such as "runs/base/own", not in {folder!r}.')
        if not isinstance(base, dict) or "task" not in base or "recipe" in base:
            raise PdkitError(f"{path.name}: what makes {folder} is a table with a task, such as task = \"Door\", and without a recipe.")
        if "sha256" in base:
            checksums[folder] = base["sha256"]
            if not isinstance(base["sha256"], str) or not SHA256.fullmatch(base["sha256"]):
                raise PdkitError(f"{path.name}: the sha256 of {folder} must be 64 hexadecimal digits, not {base['sha256']!r}.")
    made = {folder: {key: value for key, value in base.items() if key != "sha256"} for folder, base in bases.items()}
    return Spec(path, name, values["kind"], tuple(seeds), cells, values.get("record", ""), minutes, made, checksums)


def _read(path: Path) -> dict[str, Any]:
    if path.suffix not in (".toml", ".json"):
        raise PdkitError(f"A sweep is described by a .toml or .json file, not by {path.name!r}.")
    try:
        values = tomllib.loads(path.read_text()) if path.suffix == ".toml" else json.loads(path.read_text())
    except OSError as error:
        raise PdkitError(f"Cannot read {path}: {error.strerror}.") from None
    except ValueError as error:  # TOMLDecodeError, JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise PdkitError(f"{path} is not a readable {path.suffix[1:].upper()} file: {str(error).rstrip('.')}.") from None
    if not isinstance(values, dict):
        raise PdkitError(f"{path} must hold a table with name, kind, fixed and grid.")
    return values


def _cells(file: str, name: str, fixed: dict[str, Any], grid: dict[str, Any], further: list[Any]) -> tuple[dict[str, Any], ...]:
    for key, values in grid.items():
        if key in fixed:
            raise PdkitError(f"{file}: {key} is given in fixed and in grid; give it once.")
        if not isinstance(values, list) or not values:
            raise PdkitError(f"{file}: grid holds lists of at least one value; {key} is {values!r}.")
    if not all(isinstance(cell, dict) for cell in further):
        raise PdkitError(f"{file}: cells must be a list of tables.")
    varied = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())] if grid else []
    varied += further or ([] if grid else [{}])
    for values in (fixed, grid, *varied):
        if "seed" in values or (values in (fixed, grid) and "seeds" in values):
            raise PdkitError(f"{file}: give seeds at the top (seeds = [0, 1]), not seed among the values.")
    return tuple({"recipe": _recipe(cell, name)} | fixed | cell for cell in varied)


def _recipe(cell: dict[str, Any], name: str) -> str:
    """What a cell is called: the values in which it differs, of lists and paths what may stand in a folder's name."""
    parts = [_word(value) if key == "method" else f"{key}={_word(value)}" for key, value in cell.items()
             if key not in ("task", "notebook", "seeds")]
    return ",".join(parts) or name


def _word(value: Any) -> str:
    return re.sub(r"[^\w.+=-]", "", str(value).replace(", ", "+").replace(": ", "=").replace("/", "-"))
