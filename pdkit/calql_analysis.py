"""Cal-QL between its original setting and the paper's (appendix F.3): the measurements of notebook 09.

    setups       what A to E change, read off the configurations that are run
    contents     the offline data, made here: demonstrations, and for A rollouts of the base policy with their failures
    losses       one offline stage with three losses: temporal differences alone, with the conservative term (CQL), with its max (Cal-QL)
    seconds      what an update costs
    joined       recorded runs: on Door A to D of data/sweeps/calql.toml, E of leaderboard.toml; on StackCube all of calql_stackcube.toml
"""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import torch

from . import unlearning
from .compare import available, start_of
from .decorator import critic_features
from .demos import sources
from .errors import PdkitError
from .methods.registry import make_trainer, method_config
from .online import Trainer
from .online_rows import demo_rows
from .policies import load_policy
from .policies.base import read_card
from .recorded import record_of

SETUPS = {"A": "calql_a", "B": "calql_b", "C": "calql_c", "D": "calql_d", "E": "calql"}
LOSSES = ("TD alone", "CQL", "Cal-QL")
WITHOUT = -1e9  # a return that lifts no value: with it the max does nothing, and Cal-QL is CQL
SAME_BUDGET = 0.02  # runs end with the episode step that crosses the budget, so lengths differ by a few steps


def labels() -> dict[str, str]:
    """Recipe -> what figures call it."""
    tail = {"A": "the original", "B": "no rollouts", "C": "online SAC", "D": "random GPT", "E": "imitated BeT"}
    return {method: f"{letter}: {tail[letter]}" for letter, method in SETUPS.items()}


def setups(task: str = "Door", profile: str = "lesson") -> pd.DataFrame:
    """One row a setup: setup, method, actor, offline data, online loss, offline share of online batches, offline updates, batch, updates a
    step, steps of reward in a target."""
    rows = []
    for letter, method in SETUPS.items():
        c = method_config(method, task, profile)
        m, small = c.method_config, method in ("calql_a", "calql_b", "calql_c")
        rows.append({
            "setup": letter, "method": method,
            "actor": f"MLP, {c.sac.layers} x {c.sac.hidden}" if small else "BeT, imitated" if m.calql_pretrained else "GPT, random weights",
            "offline data": "demonstrations" + (f" and {m.calql_rollouts} rollouts" if m.calql_data == "mixed" else ""),
            "online": "Cal-QL" if m.calql_online == "calql" else "SAC", "offline share online": c.demo_fraction,
            "offline updates": m.calql_offline_updates, "batch": c.batch, "updates a step": c.utd, "steps in a target": c.n_step})
    return pd.DataFrame(rows)


def method_of(letter: str) -> str:
    """The method that runs a setup. Raises PdkitError for an unknown letter."""
    if letter not in SETUPS:
        raise PdkitError(f"There is no setup {letter!r} of Cal-QL; there are {', '.join(SETUPS)}.")
    return SETUPS[letter]


def trainer_of_setup(letter: str, task: str = "Door", profile: str = "lesson", seed: int = 0, **changes: Any) -> Trainer:
    """The trainer of a setup on the shipped policy and demonstrations, before any update. Raises PdkitError for an unknown letter."""
    method = method_of(letter)
    start = start_of(method, task)
    demos = sources.bundled(task).first(read_card(start)["info"]["demos"])
    return make_trainer(method_config(method, task, profile, seed, **changes), load_policy(start), demos)


# ---- the offline data ------------------------------------------------------------------------------------------------

def contents(trainer: Trainer, demos: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """What setup A learns from. A row a source: source, episodes, solved, steps (until success, or all), worst (share of its steps with the
    lowest possible return). And a row a step: source, mc.

    `demos` is how many of the bundled demonstrations were used.
    """
    parts = {"demonstrations": sources.bundled(trainer.config.task).first(demos)}
    if trainer._rollouts is not None:
        parts["rollouts"] = trainer._rollouts
    told, steps, lowest = [], [], trainer.config.reward_shift / (1 - trainer.config.gamma)
    for name, part in parts.items():
        rows = np.stack(demo_rows(part, trainer.base, trainer.config, trainer._view, trainer._make_nstep(1)))
        mc = rows[:, trainer.demos.slices["mc"].start]
        told.append({"source": name, "episodes": part.num, "solved": sum(bool(e["success"].any()) for e in part.episodes()),
                     "steps": len(mc), "worst": float((mc < 0.999 * lowest).mean())})
        steps.append(pd.DataFrame({"source": name, "mc": mc}))
    return pd.DataFrame(told), pd.concat(steps, ignore_index=True)


# ---- what the max does -----------------------------------------------------------------------------------------------

def losses(letter: str, count: int, every: int, weight: float = 1.0, **changes: Any) -> Iterator[dict[str, Any]]:
    """The offline stage of a setup with each of LOSSES, from the same first weights and batches, measured every so many updates.

    loss, update; mean Q of the data's actions, of the policy's and of random ones (data, policy, random), on fixed steps of the data;
    lifted: the share of the policy's values that lie below the return, which the max therefore leaves alone; short: how far, on average
    (0 for those that lie above).
    """
    for loss in LOSSES:
        trainer = trainer_of_setup(letter, calql_offline_updates=count + 1, calql_weight=weight * (loss != "TD alone"), **changes)
        agent, drawn = trainer.agent, torch.Generator().manual_seed(trainer.config.seed)
        fixed = trainer.demos.unpack(trainer.demos.draw(512, drawn))
        for update in range(count + 1):
            if update % every == 0 or update == count:
                yield {"loss": loss, "update": update, **_values(agent, fixed)}
            batch = trainer.demos.unpack(trainer.demos.draw(trainer.config.batch, drawn))
            if loss == "CQL":
                batch["mc"] = torch.full_like(batch["mc"], WITHOUT)
            agent.update(batch, drawn)


@torch.no_grad()
def _values(agent, rows: dict[str, torch.Tensor]) -> dict[str, float]:
    """Mean Q of three kinds of actions at the same states; a generator of its own, so that measuring changes nothing."""
    sampled = agent._sampled(rows, torch.Generator().manual_seed(0))
    obs = agent.normalize(rows["obs"])
    data = agent.critics(critic_features(agent.decorator, agent.critic_view(obs), rows["base"], rows["residual"]))
    policy, random = (agent._values(agent.critics, obs, rows["base"], sampled[name]) for name in ("here", "random"))
    return {"data": float(data.mean()), "policy": float(policy.mean()), "random": float(random.mean()),
            "lifted": float((policy < rows["mc"]).float().mean()), "short": float((rows["mc"] - policy).clamp(min=0).mean())}


def calibration_verdict(rows: pd.DataFrame, margin: float = 0.5) -> tuple[str, list[str]]:
    """What the max did, by how far the policy's values lie below the returns in the last row of each loss (`margin`, in rewards, is ours).

    "no gap": without the max they do not lie below by more than `margin`, so there is nothing to mend; "calibrated": with it they lie below
    by at most half of that; "not": by more.
    """
    short = rows.groupby("loss").last().short
    verdict = "no gap" if short["CQL"] <= margin else "calibrated" if short["Cal-QL"] <= short["CQL"] / 2 else "not"
    return verdict, [f"{loss}: the policy's values lie below the returns by {short[loss]:.2f} on average" for loss in ("CQL", "Cal-QL")]


# ---- what an update costs --------------------------------------------------------------------------------------------

def seconds(letter: str, online: str, count: int = 5, **changes: Any) -> float:
    """Median seconds of an update of a setup's networks with the online loss `online` ("sac" or "calql"), on its offline data."""
    trainer = trainer_of_setup(letter, calql_offline_updates=0, calql_online=online, calql_data="demos", **changes)
    return unlearning.seconds(trainer.agent, trainer.demos, count, trainer.config.batch)


# ---- recorded runs ---------------------------------------------------------------------------------------------------

def joined(task: str = "Door") -> tuple[pd.DataFrame, pd.DataFrame]:
    """Recorded runs and curves of all setups that there are, on Door E from the comparison of methods; a printed sentence for each record
    that is missing. Raises PdkitError where E had another budget, offline stage or number of test episodes than A to D."""
    if task != "Door":
        return available(record_of("calql", task), task)
    return _joined(*available("calql"), *available("leaderboard"), task)


def _joined(table: pd.DataFrame, curves: pd.DataFrame, others: pd.DataFrame, lines: pd.DataFrame, task: str
            ) -> tuple[pd.DataFrame, pd.DataFrame]:
    own = list(SETUPS.values())[:-1]
    parts = [t[(t.task == task) & t.recipe.isin(names)] for t, names in ((table, own), (others, [SETUPS["E"]]))]
    rest = [t[(t.task == task) & t.recipe.isin(names)] for t, names in ((curves, own), (lines, [SETUPS["E"]]))]
    if all(map(len, parts)):
        first, second = (part.env_steps.mean() for part in parts)
        offline = [set(t[t.step == 0].groupby(["recipe", "seed"])["updates"].max()) if "updates" in t else set() for t in rest]
        if abs(second / first - 1) > SAME_BUDGET or set(parts[0].episodes) != set(parts[1].episodes) or offline[0] != offline[1]:
            raise PdkitError(f"Setup E was recorded with another budget ({second:,.0f} steps), offline stage or number of test episodes "
                             f"than A to D ({first:,.0f} steps); they cannot stand in one figure.")
    kept = [[t for t in group if len(t)] or group[:1] for group in (parts, rest)]
    return tuple(pd.concat(group, ignore_index=True) for group in kept)


def late(curves: pd.DataFrame) -> pd.DataFrame:
    """How steady each recorded setup is within its budget, and whatever else is recorded behind them, means over seeds: recipe, seeds, best
    and last evaluation, and the largest fall from one evaluation to the next. The best of several is flattered by chance, in all alike."""
    rows = []
    evaluated = curves[(curves.step > 0) & curves.success_once.notna()] if "success_once" in curves else curves[:0]
    for recipe in dict.fromkeys([*SETUPS.values(), *evaluated.recipe]):
        mine = evaluated[evaluated.recipe == recipe].sort_values("step")
        if mine.empty:
            continue
        by = [run.success_once.to_numpy() for _, run in mine.groupby(["task", "seed"])]
        rows.append({"recipe": recipe, "seeds": len(by), "best": np.mean([v.max() for v in by]), "last": np.mean([v[-1] for v in by]),
                     "largest fall": np.mean([max(0.0, *-np.diff(v)) if len(v) > 1 else 0.0 for v in by])})
    return pd.DataFrame(rows, columns=["recipe", "seeds", "best", "last", "largest fall"])
