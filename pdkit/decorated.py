"""A trained decorated policy: base, residual actor, and their way to disk."""
from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from .decorator import DecoratorConfig, actor_features, compose
from .errors import PdkitError
from .files import atomic_folder, read_json, sha256, write_json
from .policies import Policy, load_policy, save_policy
from .rl.networks import Actor
from .tasks.features import Sight

FORMAT = "pdkit-decorated-1"


def flat_actions(base: Policy, windows: np.ndarray) -> np.ndarray:
    """What `base` decides on for windows (N, window, obs_dim): (N, chunk * act_dim), the actions of a chunk one after the other."""
    return base.act(windows).reshape(len(windows), -1)


class Decorated:
    """Acts with a_base + alpha * tanh(mean residual): no gate, no sampling (facts.md 1.1, evaluation)."""

    def __init__(self, base: Policy, actor: nn.Module, config: DecoratorConfig, normalize: bool = True, features: str = ""):
        self.base, self.actor, self.config = base, actor, config
        self.sight = Sight(base.normalizer, normalize, features)  # what the actor sees of observations
        self.window, self.chunk = base.window, base.chunk

    def reset(self, seed: int) -> None:
        """Restart the base policy's random numbers."""
        self.base.reset(seed)

    @torch.inference_mode()
    def parts(self, windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Base actions and unscaled residuals, each (N, chunk * act_dim), for windows (N, window, obs_dim)."""
        base = flat_actions(self.base, windows)
        device = next(self.actor.parameters()).device
        obs = torch.from_numpy(np.ascontiguousarray(windows[:, -1], np.float32)).to(device)
        seen = actor_features(self.config, self.sight(obs), torch.from_numpy(base).to(device))
        return base, self.actor.mean_action(seen).cpu().numpy()

    def act(self, windows: np.ndarray) -> np.ndarray:
        """Action chunks (N, chunk, act_dim) for windows (N, window, obs_dim); the environment clips them."""
        base, residual = self.parts(windows)
        return compose(self.config, base, residual).reshape(len(base), self.chunk, -1)


def save_decorated(policy: Decorated, folder: str | Path, info: dict[str, Any] | None = None) -> None:
    """Write the base policy, the actor and both configurations to `folder`."""
    from safetensors.torch import save_file

    with atomic_folder(folder) as temporary:
        save_policy(policy.base, temporary / "base")
        save_file({k: v.contiguous() for k, v in policy.actor.state_dict().items()}, temporary / "actor.safetensors")
        write_json(temporary / "decorated.json", {
            "format": FORMAT, "decorator": asdict(policy.config), "actor": policy.actor.config, "normalize": policy.sight.normalize,
            "features": policy.sight.features, "actor_sha256": sha256(temporary / "actor.safetensors"), "info": info or {}})


def load_decorated(folder: str | Path) -> Decorated:
    """The policy saved in `folder`. Raises PdkitError when a part is missing, altered or does not fit."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    folder = Path(folder)
    card = read_json(folder / "decorated.json")
    weights = folder / "actor.safetensors"
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise PdkitError(f"{folder}/decorated.json is not a {FORMAT} file.")
    if not weights.exists() or sha256(weights) != card.get("actor_sha256"):
        raise PdkitError(f"{weights} is missing, truncated or altered; restore it or train it again with `pdkit run`.")
    try:
        actor = Actor(**card["actor"])
        actor.load_state_dict(load_file(weights))
        config = DecoratorConfig(**card["decorator"] | {"alpha_scale": tuple(card["decorator"].get("alpha_scale", ()))})
    except (SafetensorError, RuntimeError, TypeError, KeyError) as error:
        raise PdkitError(f"{folder} does not hold the actor that its decorated.json describes; train it again.") from error
    return Decorated(load_policy(folder / "base"), actor.eval(), config, bool(card["normalize"]),
                     str(card.get("features", "")))
