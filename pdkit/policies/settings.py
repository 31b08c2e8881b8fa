"""Checks of a policy's settings before its networks are built: each of its default's type, and large enough."""
from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ..errors import PdkitError

NAMES = {bool: "True or False", int: "a whole number", float: "a number", str: "a word", list: "a list of such numbers"}


def checked_settings(kind: str, values: Mapping[str, Any], defaults: Mapping[str, Any], least: Mapping[str, float]) -> dict[str, Any]:
    """`values` as JSON types: those that `defaults` names are of the default's type and not below `least` (not named there: 1 for whole
    numbers and the entries of lists of them, 0 for other numbers); the others as they are.

    A tuple counts as a list, a whole number as a number. Raises PdkitError for the first value that does not fit.
    """
    found = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
    for name, default in defaults.items():
        value = found.get(name, default)
        if not _fits(value, default):
            raise PdkitError(f"{kind}'s {name} must be {NAMES[type(default)]}, as {default!r} is, not {value!r}.")
        entries = value if isinstance(value, list) else [] if isinstance(value, str | bool) else [value]
        floor = least.get(name, int(_whole(default)))
        if any(entry < floor for entry in entries):
            raise PdkitError(f"{kind}'s {name} must be at least {floor:g}, not {value!r}.")
    return found


def _fits(value: Any, default: Any) -> bool:
    if isinstance(default, list):
        wanted = int if _whole(default) else float
        return isinstance(value, list) and bool(value or not default) and all(_number(entry, wanted) for entry in value)
    return _number(value, type(default)) if type(default) in (int, float) else type(value) is type(default)


def _whole(default: Any) -> bool:
    return type(default) is int or isinstance(default, list) and bool(default) and all(type(entry) is int for entry in default)


def _number(value: Any, wanted: type) -> bool:
    """Whether it is a finite number of this type; True is none."""
    return (type(value) is int or type(value) is wanted) and math.isfinite(value)
