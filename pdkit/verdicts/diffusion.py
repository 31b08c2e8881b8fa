"""Diffusion Policy bases: decorated, or fine-tuned by DIPO and DPPO (data/sweeps/diffusion_finetuning.toml).

Fig. 1 gives means over three ManiSkill and three Adroit tasks (facts.md 4.1); StackCube alone is recorded, so nothing is more than partly
reproduced by the first three rules. DPPO was compared on Square and Transport only (appendix C.2), which the kit does not have.
"""
from __future__ import annotations

from ..claims import (
    NEARLY,
    TASKS,
    Finding,
    ahead,
    best,
    by_seed,
    compared,
    difference,
    finding,
    jointly,
    judged,
    mean_interval,
    percent,
    points,
    recorded,
)
from .registry import EIGHT, measures

RECORD = "diffusion_finetuning"
OWN = "policy_decorator,alpha=0.03"  # the official bound for StackCube
TUNED, KEPT = ("dipo",), ("residual_rl", "jsrl")  # the paper's baselines over Diffusion Policy; DPPO is none of Fig. 1's


@measures("Policy Decorator lifts Diffusion Policy bases")
def _() -> Finding:
    """Above the base policy, and nearly all on average: the rule for a BeT."""
    table, _ = recorded(RECORD)
    end, start = (by_seed(table, OWN, column) for column in ("decorated_success", "base_success"))
    gain, values = difference(end, start)
    return finding(RECORD, values, f"{percent(start.mean())} to {percent(end.mean())}: {100 * gain.value:+.1f} points", points(gain),
                   jointly(judged(gain), judged(mean_interval(end), NEARLY)), EIGHT)


@measures("With Diffusion Policy bases, Policy Decorator")
def _() -> Finding:
    """Ahead of the best of both kinds; the interval is that of the smaller lead."""
    table, _ = recorded(RECORD)
    return ahead(RECORD, table, OWN, {"no fine-tuning": KEPT, "fine-tuning": TUNED}, EIGHT)


@measures("The best baseline that fine-tunes Diffusion Policy")
def _() -> Finding:
    """None of its seeds solves a test episode."""
    table, _ = recorded(RECORD)
    rival = best(table, TUNED)
    values = by_seed(table, rival, "decorated_success")
    return finding(RECORD, values, f"{rival} {percent(values.mean())}; largest of its seeds {percent(values.max())}",
                   points(mean_interval(values)), "reproduced" if values.max() == 0 else "not", TASKS["maniskill"] + TASKS["adroit"])


@measures("Policy Decorator on DPPO's own diffusion checkpoints")
def _() -> Finding:
    """Significantly: the whole interval of the lead lies above 0. On StackCube, so partly at most."""
    return compared(RECORD, OWN, "dppo", paper=("Square", "Transport"))
