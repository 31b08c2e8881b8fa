"""What the networks of a residual may see beside the observation: quantities that success hangs on, worked out from the observation alone.

    networks see   (o - mean) / std,   and with features=True behind it   phi(o)

The paper's networks see the observation; this is ours, for tasks where success hangs on differences of places and rotations that an
observation holds as raw poses, and a lesson's budget (a 75th to a 170th of the paper's) is short. The base policy is not touched. Lengths
and angles come at two scales each: as they are, and through tanh, which tells apart what is near zero. The decorator's networks see
them, and those of residual RL, SAC from scratch, RLPD and JSRL; the other methods' see the observation alone, and so do those over a
policy that sees pictures.
"""
from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn

from ..errors import PdkitError

MOST = 5.0  # size beyond which a feature does not grow


def seen(x: torch.Tensor, near: float, far: float) -> torch.Tensor:
    """Lengths or angles (B, n) at two scales, (B, 2 n): in units of `far`, and tanh in units of `near`."""
    return torch.cat([(x / far).clamp(-MOST, MOST), torch.tanh(x / near)], dim=-1)


# ---- rotations: quaternions (B, 4) as (w, x, y, z) ------------------------------------------------------------------

def rotated(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Vectors (B, 3) turned by unit quaternions (B, 4)."""
    w, u = q[:, :1], q[:, 1:]
    across = 2 * torch.linalg.cross(u, v)
    return v + w * across + torch.linalg.cross(u, across)


def turn_between(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """The rotation vector (B, 3), radians, that turns `a` into `b`, both (B, 4)."""
    w = (a * b).sum(dim=1, keepdim=True)
    u = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - torch.linalg.cross(b[:, 1:], a[:, 1:])  # of b times the inverse of a
    sine = u.norm(dim=1, keepdim=True)
    angle = 2 * torch.atan2(sine, w.abs())
    return torch.sign(torch.where(w == 0, 1, w)) * u * angle / sine.clamp(min=1e-9)


# ---- features by task -----------------------------------------------------------------------------------------------

def peg(obs: torch.Tensor) -> torch.Tensor:
    """PegInsertionSide, (B, 50) -> (B, 20), in the robot's frame: how far the peg's head lies beside the hole's axis and how far the peg is
    askew (the hole's radius is 3 mm more than the peg's), how far the head is past the box's face, and where the peg lies from the tool."""
    tool, peg, peg_turn, half, hole, hole_turn = (obs[:, part] for part in (
        slice(25, 28), slice(32, 35), slice(35, 39), slice(39, 40), slice(42, 45), slice(45, 49)))
    along = torch.zeros_like(peg)
    along[:, 0] = 1
    axis, head = rotated(hole_turn, along), peg + half * rotated(peg_turn, along)
    inwards = ((head - hole) * axis).sum(dim=1, keepdim=True)
    beside = head - hole - inwards * axis
    return torch.cat([seen(beside, 0.008, 0.05), seen(turn_between(peg_turn, hole_turn), 0.03, 0.2), seen(inwards + half, 0.01, 0.1),
                      seen(peg - tool, 0.02, 0.1)], dim=1)


def chair(obs: torch.Tensor) -> torch.Tensor:
    """PushChair, (B, 131) -> (B, 18), in the frame of the robot's base, where its velocities are commanded: where the chair is, where from
    there its target is, how the chair moves, how far the robot is from behind it, and both distances."""
    base, heading, chair, motion = obs[:, 38:40], obs[:, 40], obs[:, 44:46], obs[:, 51:53]
    cosine, sine = torch.cos(heading), torch.sin(heading)

    def inward(v: torch.Tensor) -> torch.Tensor:
        return torch.stack([cosine * v[:, 0] + sine * v[:, 1], cosine * v[:, 1] - sine * v[:, 0]], dim=1)

    away = base - chair  # places are told from the target
    around = torch.atan2(away[:, 0] * chair[:, 1] - away[:, 1] * chair[:, 0], (away * chair).sum(dim=1))
    lengths = torch.stack([away.norm(dim=1), chair.norm(dim=1)], dim=1)
    return torch.cat([seen(inward(-away), 0.1, 0.5), seen(inward(-chair), 0.1, 0.5), seen(inward(motion), 0.05, 0.3),
                      seen(around[:, None], 0.2, 1.0), seen(lengths, 0.1, 0.5)], dim=1)


FEATURES: dict[str, tuple[int, Callable[[torch.Tensor], torch.Tensor]]] = {  # task: how many, and which
    "PegInsertionSide": (20, peg),
    "PushChair": (18, chair), "PushChairSource": (18, chair),
}


class Sight(nn.Module):
    """What a residual's networks see of observations (B, obs_dim): through the base policy's normaliser or raw, then the task's features.

    Args:
        normalizer: the base policy's.
        normalize: whether it is used.
        features: the task whose features follow; "": none.
    """

    def __init__(self, normalizer: nn.Module, normalize: bool = True, features: str = ""):
        super().__init__()
        if features and features not in FEATURES:
            raise PdkitError(f"No features are known for {features} (only for {', '.join(FEATURES)}); set features=False.")
        self.normalizer, self.normalize, self.features = normalizer, normalize, features

    @property
    def more(self) -> int:
        """How many numbers are seen beside the observation."""
        return FEATURES[self.features][0] if self.features else 0

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        shown = self.normalizer(obs) if self.normalize else obs
        return torch.cat([shown, FEATURES[self.features][1](obs)], dim=-1) if self.features else shown
