"""The policy decorator: a frozen base policy plus a bounded residual that is switched on gradually (facts.md 1.1).

    executed action   a = a_base(o) + alpha * a_res(o),   a_res in [-1, 1]^d
    gate at step t    per environment and decision, with probability 1 - min(t / H, 1): a_res := 0
    critic sees       the sum a (by default); the actor sees the observation (by default)

Everything here is a pure function of tensors or arrays, so that each line can be tested alone.
"""
from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch

from .errors import PdkitError, unknown

CRITIC_INPUTS = ("sum", "concat", "residual")  # appendix E.2
RESIDUAL_UNITS = ("action", "bound")
ACTOR_INPUTS = ("obs", "obs+base")  # appendix E.1


@dataclass(frozen=True)
class DecoratorConfig:
    """What bounds the residual and what the networks see."""

    alpha: float = 0.1  # bound of the residual per action dimension; the official commands' are 0.03 to 0.3
    alpha_scale: tuple[float, ...] = ()  # factors on alpha, one an action dimension (a gripper's, say); empty: all 1
    H: int = 30_000  # primitive steps over which the gate opens; 0 means always open
    critic_input: str = "sum"  # sum: a_base + alpha * a_res; concat: a_base and the residual; residual: the residual alone
    residual_units: str = "action"  # of a residual that critics see by itself. action: alpha * a_res; bound: a_res, as in the official code
    actor_input: str = "obs"  # obs: the current observation; obs+base: with the base action

    def __post_init__(self):
        if not 0 < self.alpha <= 1:
            raise PdkitError(f"alpha bounds the residual and must be in (0, 1], not {self.alpha}.")
        if any(factor < 0 for factor in self.alpha_scale):
            raise PdkitError(f"alpha_scale holds factors of 0 or more, not {self.alpha_scale}.")
        if self.H < 0:
            raise PdkitError(f"H counts environment steps and must be 0 or more, not {self.H}.")
        if self.critic_input not in CRITIC_INPUTS:
            raise unknown("critic_input", self.critic_input, CRITIC_INPUTS)
        if self.residual_units not in RESIDUAL_UNITS:
            raise unknown("residual_units", self.residual_units, RESIDUAL_UNITS)
        if self.actor_input not in ACTOR_INPUTS:
            raise unknown("actor_input", self.actor_input, ACTOR_INPUTS)

    @property
    def mean_bound(self) -> float:
        """The bound of |alpha * a_res|, averaged over the action dimensions."""
        return self.alpha * (sum(self.alpha_scale) / len(self.alpha_scale) if self.alpha_scale else 1.0)

    def critic_dim(self, obs_dim: int, act_dim: int) -> int:
        return obs_dim + act_dim * (2 if self.critic_input == "concat" else 1)

    def actor_dim(self, obs_dim: int, act_dim: int) -> int:
        return obs_dim + act_dim * (1 if self.actor_input == "obs+base" else 0)


def check_scale(config: DecoratorConfig, act_dim: int) -> None:
    """Raises PdkitError when alpha_scale does not fit an action of so many dimensions."""
    if len(config.alpha_scale) not in (0, act_dim):
        raise PdkitError(f"alpha_scale has {len(config.alpha_scale)} factors; the action has {act_dim} dimensions.")


def scaled(config: DecoratorConfig, residual):
    """alpha * a_res: what is added to the base action. A tensor or an array (..., act_dim), as the residual is.

    Raises PdkitError when alpha_scale does not fit the action.
    """
    if not config.alpha_scale:
        return config.alpha * residual
    check_scale(config, residual.shape[-1])
    if isinstance(residual, torch.Tensor):
        return residual * _factors(config, residual.device, residual.dtype)
    return residual * _factors(config, None, residual.dtype)


@functools.lru_cache(maxsize=16)
def _factors(config: DecoratorConfig, device: torch.device | None, dtype):
    values = config.alpha * np.array(config.alpha_scale)
    return values.astype(dtype) if device is None else torch.tensor(values, device=device, dtype=dtype)


def compose(config: DecoratorConfig, base, residual):
    """The executed action, before the environment clips it. The critic sees this unclipped sum too.

    The base action is within [-1, 1] (`Policy.act` clips it, the official code does not), so that a residual that points inwards is felt
    where the base policy asks for more than the most.
    """
    return base + scaled(config, residual)


def critic_features(config: DecoratorConfig, obs: torch.Tensor, base: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    """What the critic sees, (B, critic_dim).

    A residual in units of its bound is what the official code shows beside the base action, or alone. In units of actions it is alpha times
    smaller, and so is its weight in a new critic; but a demonstrated action may lie many bounds away from the base policy's.
    """
    if config.critic_input == "sum":
        return torch.cat([obs, compose(config, base, residual)], dim=-1)
    seen = residual if config.residual_units == "bound" else scaled(config, residual)
    return torch.cat([obs, base, seen] if config.critic_input == "concat" else [obs, seen], dim=-1)


def actor_features(config: DecoratorConfig, obs: torch.Tensor, base: torch.Tensor) -> torch.Tensor:
    """What the residual policy sees, (B, actor_dim)."""
    return obs if config.actor_input == "obs" else torch.cat([obs, base], dim=-1)


def gate_probability(config: DecoratorConfig, step: int) -> float:
    """Probability that the residual is on at environment step `step`: min(step / H, 1)."""
    return 1.0 if config.H == 0 else min(step / config.H, 1.0)


def gate(config: DecoratorConfig, residual: np.ndarray, step: int, rng: np.random.Generator) -> np.ndarray:
    """Residuals (N, act_dim) with each environment's row set to zero independently with probability 1 - gate_probability.

    The zero is what is executed and what is stored, so the critic sees the base action it led to.
    """
    on = rng.random(len(residual)) < gate_probability(config, step)
    return residual * on[:, None].astype(residual.dtype)
