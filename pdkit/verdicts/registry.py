"""Rules by the claim that they judge, and what is found when they are applied."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

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


def _judged(claim: str) -> Finding | None:
    """What a claim's rule finds, or why it finds nothing (`measured` of an untested one); None where there is no rule."""
    try:
        return measure() if (measure := _rule(claim)) else None
    except TooLittle as why:
        return replace(UNTESTED, measured=str(why))


def find(claim: str) -> Finding | None:
    """What is recorded of a claim (its whole sentence), or None where nothing, or too little, is."""
    found = _judged(claim)
    return None if found is None or found.verdict == UNTESTED.verdict else found


def updated(claims: pd.DataFrame) -> pd.DataFrame:
    """The table of claims with the verdict of every rule, "untested" and the reason where too little is recorded for it (now); rows without
    a rule as they are."""
    rows = [row | (vars(found) if (found := _judged(row["claim"])) else {}) for row in claims.to_dict("records")]
    return pd.DataFrame(rows, columns=claims.columns)


def shown(claims: pd.DataFrame, *sections: str) -> pd.DataFrame:
    """For a notebook: the claims of these sections (such as "E.1") with verdict, what was measured, its interval, and on which tasks."""
    chosen = claims[claims.section.map(lambda text: bool(set(text.split(", ")) & set(sections)))]
    return updated(chosen)[["section", "claim", "verdict", "measured", "interval", "tasks", "seeds"]].reset_index(drop=True)
