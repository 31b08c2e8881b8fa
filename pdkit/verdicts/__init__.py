"""Which recorded comparison speaks to which claim of the paper: `pdkit report --update` writes the verdicts into claims.csv.

A rule here is chosen before its data are seen wherever the paper says enough to choose one; numbers in a rule that are ours are named.

    methods.py     the comparison of methods, residual RL, FISH and VINN (Fig. 1, project page, C.1, D.3, F.1, G)
    diffusion.py   Diffusion Policy bases, decorated or fine-tuned (Fig. 1, C.2)
    recipe.py      the decorator's parts: bound, schedule, inputs; other base policies, a worse checkpoint (B.2, D.1, D.2, E, G.1)
    failures.py    why fine-tuning fails: Cal-QL, critics, a random critic, a warm start, the horizon (F)
"""
from . import diffusion, failures, methods, recipe  # noqa: F401  each registers its rules
from .registry import MEASURES, find, measures, shown, updated

__all__ = ["MEASURES", "find", "measures", "shown", "updated"]
