"""How an exercise is judged: the first complaint about an answer, or none."""
from __future__ import annotations

from collections.abc import Callable, Iterator

from ..errors import PdkitError


def judge(name: str, complaints: Callable[[], Iterator[str]], strict: bool) -> bool:
    """Print the verdict of `complaints`, which yields sentences about what is wrong; True if there is none."""
    try:
        wrong = next(complaints(), None)
    except NotImplementedError:
        wrong = "it is still to be written."
    except (Exception, SystemExit) as error:  # whatever a student's code may raise
        wrong = f"it raised {type(error).__name__}: {error}"
    if wrong is None:
        print(f"[solved] {name}")
        return True
    if strict:
        raise PdkitError(f"The exercise {name} is not solved: {wrong}")
    print(f"[not yet] {name}: {wrong}")
    return False
