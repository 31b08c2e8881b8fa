"""Cal-QL: critics learned offline before the first step, then online learning from them (facts.md 3.3; appendix B.5, F.3).

The loss is in pdkit/rl/calql.py. Offline, batches come from data alone; then the loop goes on with those critics. Appendix F.3
goes from the original (A) to the paper's baseline (E); each is one entry of METHODS:

    calql_a   small MLP, demonstrations and rollouts, online Cal-QL      (the original's setting)
    calql_b   small MLP, demonstrations, online Cal-QL
    calql_c   small MLP, demonstrations, online SAC
    calql_d   GPT from random weights, demonstrations, online SAC
    calql     the imitated transformer, demonstrations, online SAC       (E)

Online Cal-QL draws half of each batch from the offline data (the original's mixing ratio); online SAC draws none, because appendix B.5
says that the rest follows SAC. Its target is SAC's as well, one action and its entropy; the switch in the original's code drops the
conservative term alone, and keeps the largest value of several actions, without entropy. In E all weights learn offline; online it is the
imitated policy again, with adapters, beside the critics learned offline. Rollouts are those of the base policy, failures kept; how many
is ours (the paper gives no number), and so are fewer offline updates (3,000 instead of 20,000) and sampled actions (4 instead of 10 of
each kind) in the lesson profile. Paper profile of A to C: batches of 256, rates 1e-4 and 3e-4, tau 0.005, gamma 0.99, an update a step,
networks of width 512. Success ends an episode, as in the original, so that a return is what the critics are asked for. Rows enter the
replay when their episode is over: only then is its return known.

Not as in the original: demonstrations are cut at their first success (there: the last), unsolved ones are kept as failures (its code
drops offline trajectories without a reward, of experts and of the cloned policy alike; F.3 counts on them), and both networks have the
same size. The lesson profile is what the other methods' is, and no setup's the original's: targets of five steps of reward, uncorrected
for who took them (there one; calql.toml has A and B with one, too), a gamma of 0.97 or 0.98, critics with LayerNorm, an averaged actor,
other learning rates, and 0.01 as the first temperature.
"""
from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from torch import nn

from ..demos import Demos
from ..demos.sources import rollouts
from ..errors import PdkitError
from ..online_rows import demo_rows
from ..policies.bet_sac import BeTForSAC
from ..rl.calql import CalQL, Conservative, WithReturns
from ..rl.replay import Replay
from ..seeds import rollout_seeds
from ..tasks import get_task
from ..tasks.horizon import horizon_spec, shortened
from .finetune import FineTune
from .scratch import Scratch

OFFLINE_ROWS = 10  # rows, and checkpoints, of the offline stage


class OfflineFirst:
    """What both trainers below add to theirs: returns in every row, and the offline stage."""

    needs_demos = True
    sees_features = False
    reads = ("calql_",)

    def __init__(self, config, base, demos=None, spec=None):
        own = config.method_config
        if demos is None:
            raise PdkitError("Cal-QL learns from data before it acts: pass demonstrations.")
        if config.gamma == 1:
            raise PdkitError("Cal-QL needs gamma below 1: an unsolved episode is worth r_neg / (1 - gamma).")
        self.offline_updates = own.calql_offline_updates
        self._rollouts = None
        if own.calql_data == "mixed":
            task = horizon_spec(spec or get_task(config.task), config.start_fraction)
            self._rollouts = rollouts(base.eval().to(config.device), task, rollout_seeds(own.calql_rollouts),
                                      shortened(config.train_limit, config.start_fraction) or None)
        super().__init__(config, base, demos, spec)

    def _make_replay(self, capacity: int) -> Replay:
        return Replay(capacity, self.stored_dim, self.spec.act_dim, device=self.config.device, extra=("mc",))

    def _make_nstep(self, lanes: int) -> WithReturns:
        return WithReturns(lanes, self.config.n_step, self.config.gamma)

    def _demo_rows(self, demos: Demos) -> list[np.ndarray]:
        parts = [demos] if self._rollouts is None else [demos, self._rollouts]
        return [row for part in parts for row in demo_rows(part, self.base, self.config, self._view, self._make_nstep(1))]

    def _learner(self, actor: nn.Module | None = None, **others) -> CalQL:
        c, own = self.config, self.config.method_config
        rule = Conservative(own.calql_actions, own.calql_weight, own.calql_scale, own.calql_max_target)
        return CalQL(self.spec.obs_dim, self.spec.act_dim, c.sac, c.decorator, device=c.device, actor=actor, rule=rule,
                     offline_updates=self.offline_updates, stays=own.calql_online == "calql", **others)

    def _offline(self, evaluations) -> Iterator[None]:
        c, total = self.config, self.offline_updates
        while self.agent.updates < total:
            for _ in range(min(math.ceil(total / OFFLINE_ROWS), total - self.agent.updates)):
                self.log |= self.agent.update(self.demos.unpack(self.demos.draw(c.batch, self.generator)), self.generator)
            if self.agent.updates == total and c.eval_every and c.eval_episodes:
                evaluations.submit(0, self._actor.state_dict())  # shown; not a result that can be selected
            yield
        if self.step == 0:
            self.log = {}  # what only the offline stage measures must not be repeated in the rows to come


class SmallCalQL(OfflineFirst, Scratch):
    """Setups A to C: the small actor that SAC from scratch has."""

    unread = frozenset({"calql_pretrained"})

    def _make_agent(self) -> CalQL:
        return self._learner(normalize=self.base.normalizer if self.config.normalize_obs else None)


class TransformerCalQL(OfflineFirst, FineTune):
    """Setups D and E: a transformer as actor, critics on the last observation, as in fine-tuning."""

    reads = (*OfflineFirst.reads, "lora")

    def _make_agent(self) -> CalQL:
        start, own = self._start_policy, self.config.method_config
        if own.calql_pretrained:
            actor = start.with_lora(own.lora)
        else:
            # Nothing imitated: one bin at zero, so that the offsets alone decide, and the spread of SAC's untrained small actor.
            actor = BeTForSAC(start.config | dict(bins=1, scale=[], lora=0)).eval()
            actor.normalizer.load_state_dict(start.normalizer.state_dict())
            nn.init.zeros_(actor.spread.bias)
        return self._learner(actor, critic_view=self._last_observation, restart=own.calql_pretrained,
                             log_volume=float(actor.scale.log().sum()))
