"""Rules by the claim that they judge, and what is found when they are applied."""
from __future__ import annotations

from collections.abc import Callable

import pandas as pd

from ..claims import TASKS, Finding, TooLittle

Measure = Callable[[], Finding]
MEASURES: dict[str, Measure] = {}  # first words of a claim -> how it is judged
EIGHT = TASKS["maniskill"] + TASKS["adroit"]
UNTESTED = Finding(tasks="", seeds="", measured="", interval="", verdict="untested", command="")


def measures(claim: str) -> Callable[[Measure], Measure]:
    """Register how the claim that begins so is judged."""
    def add(function: Measure) -> Measure:
        MEASURES[claim] = function
        return function

    return add


def _rule(claim: str) -> Measure | None:
    return next((measure for start, measure in MEASURES.items() if claim.startswith(start)), None)


def find(claim: str) -> Finding | None:
    """What is recorded of a claim (its whole sentence), or None where nothing, or too little, is."""
    try:
        return measure() if (measure := _rule(claim)) else None
    except TooLittle:
        return None


def updated(claims: pd.DataFrame) -> pd.DataFrame:
    """The table of claims with the verdict of every rule, "untested" where too little is recorded for it (now); rows without a rule as
    they are."""
    rows = [row | (vars(find(row["claim"]) or UNTESTED) if _rule(row["claim"]) else {}) for row in claims.to_dict("records")]
    return pd.DataFrame(rows, columns=claims.columns)


def shown(claims: pd.DataFrame, *sections: str) -> pd.DataFrame:
    """For a notebook: the claims of these sections (such as "E.1") with verdict, what was measured, its interval, and on which tasks."""
    chosen = claims[claims.section.map(lambda text: bool(set(text.split(", ")) & set(sections)))]
    return updated(chosen)[["section", "claim", "verdict", "measured", "interval", "tasks", "seeds"]].reset_index(drop=True)
