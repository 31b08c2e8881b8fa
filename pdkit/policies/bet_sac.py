"""The Behavior Transformer as an actor that SAC can fine-tune (facts.md 2.3; appendix B.4.1, Table 10).

    u = atanh(scale * bin) + offset,   a = tanh(u) / scale

Bins are k-means centres in the space of actions, as before; offsets live before the tanh, where SAC's Gaussian lives. `scale`
keeps actions at the edge of their range, such as a closed gripper, away from atanh's poles: 0.3 for a ManiSkill gripper, 0.5 for every
Adroit joint. Beyond 0.999 of the range (ours) atanh is cut off. StackCube's shipped policies scale the arm, too, by 0.4: its demonstrated
displacements reach that edge, and with the gripper's scale alone it solves next to nothing (data/results/bet_forms.csv). The mean is u at
the likeliest bin; the spread comes from a head of its own, which imitation leaves alone (the paper does not say how it is made).
"""
from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from ..errors import PdkitError
from ..tasks.spec import TaskSpec
from .bet import BeT, focal_loss
from .lora import merged

EDGE = 0.999  # actions are clipped to this share of their range before atanh (ours; the paper's is not known)
LOG_STD = (-5.0, 2.0)  # the range to which log_std is squashed, as the lesson's small actor does
FIRST_LOG_STD = -3.0  # before any learning: a spread of 0.05; unknown in the paper


class BeTForSAC(BeT):
    """Config: BeT's, and `scale` (a factor in (0, 1] per action dimension; empty: all 1) and `lora` (rank of the adapters on
    attention and regression head; 0: none, all weights train)."""

    kind = "bet-sac"
    defaults: dict[str, Any] = BeT.defaults | dict(scale=[], lora=0)
    least = dict(lora=0)

    def __init__(self, config: dict[str, Any]):
        super().__init__(config)
        c = self.config
        scale = c["scale"] or [1.0] * c["act_dim"]
        if len(scale) != c["act_dim"] or not all(0 < s <= 1 for s in scale):
            raise PdkitError(f"scale needs {c['act_dim']} factors in (0, 1], one an action dimension, not {scale}.")
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float32), persistent=False)
        self.head = nn.Linear(c["features"], c["bins"])  # logits
        self.regression = nn.Linear(c["features"], c["bins"] * c["act_dim"])  # offsets before the tanh
        self.spread = nn.Linear(c["features"], c["act_dim"])
        for layer in (self.head, self.regression, self.spread):
            nn.init.normal_(layer.weight, std=0.02)
            nn.init.zeros_(layer.bias)
        low, high = LOG_STD
        nn.init.constant_(self.spread.bias, math.atanh(2 * (FIRST_LOG_STD - low) / (high - low) - 1))
        if c["lora"]:
            self._add_lora(c["lora"])

    @classmethod
    def for_task(cls, spec: TaskSpec) -> dict[str, Any]:
        """The paper's scale: 0.5 for every Adroit joint, 0.3 for the last dimension on ManiSkill, a gripper's (PushChair's other one, 11,
        stays unscaled as there; give `scale` to change that)."""
        return {"scale": [0.5] * spec.act_dim if spec.suite == "adroit" else [1.0] * (spec.act_dim - 1) + [0.3]}

    def _add_lora(self, rank: int) -> None:
        """Freeze everything but low-rank adapters on attention and regression head, and the head of the spread."""
        from peft import LoraConfig, inject_adapter_in_model

        inject_adapter_in_model(LoraConfig(r=rank, lora_alpha=rank, target_modules=["qkv", "proj", "regression"]), self)
        for name, parameter in self.named_parameters():
            parameter.requires_grad_("lora_" in name or name.startswith("spread."))

    def with_lora(self, rank: int) -> BeTForSAC:
        """A copy with new adapters of this rank, which start at zero: it acts as this one does, whose own adapters, if it has any, become
        part of the plain weights. Rank 0: a plain copy, all of whose weights train."""
        plain = BeTForSAC(self.config | {"lora": 0})
        plain.load_state_dict((merged(self) if self.config["lora"] else self).state_dict())
        plain.config = self.config | {"lora": rank}
        if rank:
            plain._add_lora(rank)
        return plain.eval()

    def squashed(self, actions: torch.Tensor) -> torch.Tensor:
        """atanh(scale * action): where a demonstrated action lies before the tanh."""
        return torch.atanh((actions * self.scale).clamp(-EDGE, EDGE))

    def _heads(self, windows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits (B, T, K) and offsets (B, T, K, act_dim)."""
        features = self.gpt(self.normalizer(windows))
        return self.head(features), self.regression(features).unflatten(-1, (self.config["bins"], -1))

    def loss(self, windows: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        logits, offsets = self._heads(windows)
        logits, offsets, actions = logits.flatten(0, 1).float(), offsets.flatten(0, 1).float(), actions.flatten(0, 1)
        target = torch.cdist(actions, self.centres).argmin(dim=1)
        focal = focal_loss(logits, target, self.config["focal_gamma"])
        chosen = offsets[torch.arange(len(target), device=target.device), target]
        offset = F.mse_loss(chosen, self.squashed(actions) - self.squashed(self.centres[target]))
        return {"loss": focal + self.config["offset_weight"] * offset, "focal": focal, "offset_mse": offset,
                "bin_accuracy": (logits.argmax(-1) == target).float().mean()}

    def gaussian(self, windows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log_std (B, act_dim) before the tanh, at the last position, float32."""
        features = self.gpt(self.normalizer(windows), last=True)[:, 0]
        choice = self.head(features).argmax(dim=-1)
        offsets = self.regression(features).unflatten(-1, (self.config["bins"], -1))[torch.arange(len(choice)), choice]
        low, high = LOG_STD
        log_std = low + 0.5 * (high - low) * (torch.tanh(self.spread(features).float()) + 1)
        return self.squashed(self.centres[choice]) + offsets.float(), log_std

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        return self.squash(self.gaussian(windows)[0])[:, None]

    def squash(self, u: torch.Tensor) -> torch.Tensor:
        """From before the tanh to the action."""
        return torch.tanh(u) / self.scale

    def heads(self, stored: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log_std (B, act_dim) before the tanh for stored, flattened windows (B, window * obs_dim)."""
        return self.gaussian(stored.unflatten(-1, (self.window, -1)))

    def sample(self, stored: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions (B, act_dim) for stored, flattened windows (B, window * obs_dim) and standard normal noise (B, act_dim);
        and log pi (B,) of tanh(u), as SAC has it: the constant log(scale) is left out. So a target entropy is one of tanh(u): for the
        executed action it lies higher by the sum of -log(scale), on Door, where the scale is 0.5 throughout, at -8.6 instead of -28."""
        mean, log_std = self.heads(stored)
        u = mean + log_std.exp() * noise
        log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi) - 2 * (math.log(2) - u - F.softplus(-2 * u))
        return self.squash(u), log_prob.sum(dim=-1)

    def mean_action(self, stored: torch.Tensor) -> torch.Tensor:
        """The deterministic action (B, act_dim) for flattened windows."""
        return self(stored.unflatten(-1, (self.window, -1)))[:, 0]

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        *groups, _ = super().parameter_groups(weight_decay)
        heads = [*self.head.parameters(), *self.regression.parameters(), *self.spread.parameters()]
        return [*groups, {"params": heads, "weight_decay": 0.01}]
