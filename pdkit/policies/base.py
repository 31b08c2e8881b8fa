"""The policy protocol, observation normalisation, and files on disk (safetensors + json, never pickle)."""
from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ..errors import PdkitError, unknown
from ..files import atomic_folder, read_json, sha256, write_json
from ..tasks.spec import TaskSpec
from .settings import checked_settings

FORMAT = "pdkit-policy-1"
WEIGHTS = "weights.safetensors"


class Normalizer(nn.Module):
    """Observations to zero mean and unit variance, per dimension; part of every checkpoint."""

    def __init__(self, dim: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("std", torch.ones(dim))

    @torch.no_grad()
    def fit(self, observations: np.ndarray, floor: float = 0.0) -> None:
        """From observations (N, dim). A dimension that never varies is passed through unscaled.

        No deviation is taken to be below `floor`: joints that the demonstrations hardly move would otherwise be what a policy sees
        best, and lead it astray as soon as they move a little more.
        """
        mean, std = (of(observations, axis=0, dtype=np.float64) for of in (np.mean, np.std))  # sums in float32 would make constants vary
        self.mean.copy_(torch.from_numpy(mean))
        self.std.copy_(torch.from_numpy(np.where(std < 1e-4, 1.0, np.maximum(std, floor))))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return (observations - self.mean) / self.std


class Policy(nn.Module):
    """A policy over a window of observations: (N, window, obs_dim) -> an action chunk (N, chunk, act_dim) in [-1, 1].

    The window is kept by the vectorised environment, so a policy holds no state per episode; `reset(seed)` restarts
    its own random numbers (dropout, sampling). What it has of its own accord: `config`, and a `normalizer` for `fit_statistics` to fit,
    through which networks beside it (a residual, a critic) see observations as it does. A subclass that draws random numbers to act must
    say so in `samples`.
    """

    kind = ""  # its name in POLICIES
    window = 1  # observations it looks at
    chunk = 1  # primitive actions it returns
    horizon = 0  # actions it learns from the first observation of a window on; 0: one for each observation
    recipe: dict[str, Any] = {}  # how it is trained where that differs from the defaults of ImitateConfig
    samples = False  # whether acting draws random numbers: then success on the same episodes differs from one `reset(seed)` to another
    learns = True  # by gradient steps on `loss`; otherwise `remember` is all there is
    defaults: dict[str, Any] = {}  # of its settings; each must be of its default's type
    least: dict[str, float] = {}  # the least values of settings, where not the usual ones (settings.py)
    made: tuple[str, ...] = ()  # settings that the program makes as it needs them, and nobody gives to a training

    def __init__(self, config: dict[str, Any]):
        super().__init__()
        # Everything its constructor needs, JSON types only.
        self.config = checked_settings(self.kind, self.defaults | config, self.defaults, self.least)
        self.normalizer = Normalizer(self.config["obs_dim"])

    @classmethod
    def for_task(cls, spec: TaskSpec) -> dict[str, Any]:
        """What of the configuration follows from the task, unless it is given."""
        return {}

    def reset(self, seed: int) -> None:
        """Restart the random numbers that acting draws (dropout, sampling noise): torch's global generator."""
        torch.manual_seed(seed)

    def fit_statistics(self, observations: np.ndarray, actions: np.ndarray, seed: int = 0) -> None:
        """What is computed from the demonstrations rather than learned: normaliser, k-means bins."""
        raise NotImplementedError

    def remember(self, windows: torch.Tensor, actions: torch.Tensor) -> None:
        """Where nothing is learned: keep the demonstrations, as windows (N, window, obs_dim) and the actions (N, act_dim) taken at
        their last observation."""
        raise NotImplementedError

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        """Parameter groups for AdamW."""
        raise NotImplementedError

    def draw(self, shape: torch.Size) -> tuple[torch.Tensor, ...]:
        """The random numbers that `loss` takes besides, for actions of that shape: drawn on the CPU whatever the device, so that there is
        one generator to restore."""
        return ()

    def loss(self, windows: torch.Tensor, actions: torch.Tensor, *drawn: torch.Tensor) -> dict[str, torch.Tensor]:
        """Imitation loss for windows (B, window, obs_dim) and the actions from the first position on (B, horizon or window, act_dim);
        a dict of scalars of which `loss` is minimised. `drawn` is what `draw` gives, or drawn now."""
        raise NotImplementedError

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        """Actions (N, chunk, act_dim) for windows (N, window, obs_dim)."""
        raise NotImplementedError

    @torch.inference_mode()
    def act(self, windows: np.ndarray) -> np.ndarray:
        """The same with numpy arrays and the actions clipped to [-1, 1]: what every loop calls."""
        device = next(itertools.chain(self.parameters(), self.buffers())).device
        actions = self(torch.from_numpy(np.require(windows, np.float32, ["C", "W"])).to(device))
        return actions.clamp(-1, 1).float().cpu().numpy()


def save_policy(policy: Policy, folder: str | Path, info: dict[str, Any] | None = None) -> None:
    """Write `policy` to `folder`: weights.safetensors (float32 or bfloat16, as they are), and policy.json with its
    kind, configuration, the weights' checksum and `info` (how it was trained, how it scored)."""
    from safetensors.torch import save_file

    folder = Path(folder)
    with atomic_folder(folder) as temporary:
        save_file({name: tensor.detach().cpu().contiguous() for name, tensor in policy.state_dict().items()},
                  temporary / WEIGHTS)
        card = {"format": FORMAT, "kind": policy.kind, "config": policy.config,
                "weights_sha256": sha256(temporary / WEIGHTS), "info": info or {}}
        write_json(temporary / "policy.json", card)


def share_weights(folder: str | Path, other: str | Path) -> None:
    """Let the policy in `folder` use the weights file of the policy in `other`, which must be the same, and delete its own.

    Raises PdkitError when they differ.
    """
    folder, other = Path(folder), Path(other)
    card, theirs = read_card(folder), read_card(other)
    same = card["weights_sha256"] == theirs["weights_sha256"] and (other / WEIGHTS).exists()
    if folder.resolve() == other.resolve() or not same or sha256(other / WEIGHTS) != card["weights_sha256"]:
        raise PdkitError(f"{other} does not hold the weights of {folder}; only a copy can be replaced.")
    write_json(folder / "policy.json", card | {"weights_in": os.path.relpath(other, folder)})
    (folder / WEIGHTS).unlink(missing_ok=True)


def read_card(folder: str | Path) -> dict[str, Any]:
    """policy.json of a saved policy. Raises PdkitError when it is missing or not one of ours."""
    folder = Path(folder)
    if folder.is_file():
        raise PdkitError(f"{folder} is a file; name the folder that a policy was saved in.")
    if not (folder / "policy.json").exists():
        seen = "" if folder.is_absolute() else f" (looked for in {Path.cwd()})"
        raise PdkitError(f"{folder}/policy.json does not exist{seen}; name the folder that a policy was saved in.")
    card = read_json(folder / "policy.json")
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise PdkitError(f"{folder}/policy.json is not a {FORMAT} file; it was written by something else or another version.")
    return card


def load_policy(folder: str | Path, device: str | torch.device = "cpu") -> Policy:
    """The policy saved in `folder`, ready to act.

    Raises PdkitError when a file is missing, truncated, altered (checksum) or does not fit its configuration.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    from . import POLICIES

    folder = Path(folder)
    card = read_card(folder)
    if card.get("kind") not in POLICIES:
        raise unknown("policy", str(card.get("kind")), POLICIES)
    weights = folder / str(card.get("weights_in", ".")) / WEIGHTS
    if not weights.exists():
        raise PdkitError(f"{weights} is missing; copy the whole checkpoint folder or train it again with `pdkit train`.")
    if sha256(weights) != card.get("weights_sha256"):
        raise PdkitError(f"{weights} was truncated or altered (its checksum differs from policy.json); restore it or train it again.")
    try:
        policy = POLICIES[card["kind"]](card["config"])
        state = load_file(weights)
        policy.load_state_dict({name: tensor.float() for name, tensor in state.items()})
    except (SafetensorError, RuntimeError, TypeError, KeyError) as error:
        raise PdkitError(f"{folder} does not hold the {card['kind']} policy that its policy.json describes "
                         f"({type(error).__name__}); train it again.") from error
    return policy.to(device).eval()
