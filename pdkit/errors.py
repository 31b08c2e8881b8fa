"""The one exception that a user is meant to read."""
from __future__ import annotations


class PdkitError(Exception):
    """Bad input or a broken environment, told in one sentence: what was wrong and what to do.

    The command line prints the message alone and exits with code 2; a notebook shows it as the last line.
    """


def unknown(kind: str, name: object, known) -> PdkitError:
    """The error for a name that is not in a registry, listing what is (and the nearest match, if one is near)."""
    from difflib import get_close_matches

    known = sorted(str(k) for k in known)
    near = get_close_matches(str(name), known, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return PdkitError(f"Unknown {kind} {str(name)!r}; choose one of: {', '.join(known)}.{hint}")
