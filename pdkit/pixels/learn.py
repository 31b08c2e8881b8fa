"""Imitation from pictures: an encoder and a policy behind it, trained together (facts.md 2.2: end to end, random shift).

The policy is one of the ordinary kinds; what it sees at each step is the robot's state and the encoder's features. Afterwards its
normaliser is fitted to the features as well, and the policy changed so that it computes what it did: the learner of online RL sees
observations through that normaliser.
"""
from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import nn

from ..demos.format import Demos
from ..errors import PdkitError
from ..evaluate import selection_scores
from ..gradient_steps import GradientSteps, make_optimizer
from ..imitate import Average, ImitateConfig, Saved, Windows, best_checkpoint, imitate
from ..policies import MLP, POLICIES, BeT, DiffusionPolicy, Policy
from ..rl.state import pack, unpack
from ..runs import Run
from ..tasks import get_task
from ..tasks.spec import TaskSpec
from .cameras import View, view_of
from .encoders import FEATURES, Encoder, check_square, random_shift
from .pictures import Pictures, encoded
from .task import pixel_spec

HEADS = ("mlp", "bet", "diffusion")  # trained together with an encoder


def imitate_pixels(kind: str, demos: Demos, pictures: Pictures, config: ImitateConfig, policy_config: dict | None = None, *,
                   shift: int | None = None, device: str = "cpu", progress: Callable[[dict], None] | None = None,
                   spec: TaskSpec | None = None, view: View | None = None, run: Run | None = None) -> tuple[Policy, Encoder, list[dict]]:
    """Train an encoder and a policy of `kind` on demonstrations and their pictures; in `run` as `imitate` does.

    `shift` is the random shift in pixels (the view's, if not given); `spec` and `view` are for worlds outside the registry.
    Returns the selected policy and encoder, on the CPU, in evaluation mode and with weights rounded to bfloat16 (as they are shipped),
    and one row a checkpoint as `imitate` does. Raises PdkitError for a kind of policy that is not one of HEADS, or a loss that is no
    number.
    """
    if kind not in HEADS:
        raise PdkitError(f"An encoder is trained together with {', '.join(HEADS[:-1])} or {HEADS[-1]}, not {kind}.")
    view, spec = view or view_of(demos.task), spec or get_task(demos.task)
    _check_shift(shift, view)
    shift = view.shift if shift is None else shift
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    policy = POLICIES[kind](visual_settings(kind, view, spec) | (policy_config or {}))
    encoder = Encoder(view)
    state = view.robot(demos.observations)
    unscaled = np.zeros((len(state), FEATURES), np.float32)  # a number that never varies is passed through by the normaliser
    policy.fit_statistics(np.concatenate([state, unscaled], axis=1), demos.actions, config.seed)
    policy.to(device).train()
    encoder.to(device)
    # A window of observations is told by the number of each frame, and the robot's state then.
    numbered = np.concatenate([np.arange(len(state), dtype=np.float32)[:, None], state], axis=1)
    windows = Windows(dataclasses.replace(demos, observations=numbered), policy.window, config.pad_start, policy.horizon, spec.resting,
                      config.hold_end).to(device)
    rgb, depth = (torch.from_numpy(x).to(device) for x in (pictures.rgb, pictures.depth.astype(np.int32)))
    optimizer = make_optimizer(policy, config, [{"params": list(encoder.parameters()), "weight_decay": config.weight_decay}], device)
    average = Average([*policy.parameters(), *encoder.parameters()], config.ema_power)

    def batch() -> tuple[torch.Tensor, ...]:
        observations, actions = windows.sample(config.batch, generator)
        frames = observations[..., 0].long().flatten()
        seen = torch.cat([rgb[frames].int(), depth[frames]], dim=1)
        if shift:
            seen = random_shift(seen, shift, generator)
        return seen, observations[..., 1:], actions, *(x.to(device) for x in policy.draw(actions.shape))

    def loss(seen: torch.Tensor, state: torch.Tensor, actions: torch.Tensor, *drawn: torch.Tensor) -> dict[str, torch.Tensor]:
        features = encoder(*seen.split([rgb.shape[1], depth.shape[1]], dim=1)).unflatten(0, state.shape[:2])
        return policy.loss(torch.cat([state, features.float()], dim=-1), actions, *drawn)

    def candidate() -> tuple[dict[str, torch.Tensor], dict[str, float]]:
        mine, eyes = _finished(policy, encoder, demos, pictures)
        scores = selection_scores(pixel_spec(spec, eyes), mine, config.eval_episodes, config.seed)
        return pack({"policy": mine, "encoder": eyes}, {}), scores

    step = GradientSteps(loss, optimizer, device, config.bf16)
    saved = run and Saved(run, {"policy": policy, "encoder": encoder}, optimizer, average, generator)
    chosen, history = best_checkpoint(config, lambda: step(*batch()), optimizer, average, candidate, progress, saved)
    unpack(chosen, {"policy": policy.cpu(), "encoder": encoder.cpu()}, {})
    return policy.eval(), encoder.eval().requires_grad_(False), history


def look_up(demos: Demos, pictures: Pictures, encoder: Encoder, config: ImitateConfig, policy_config: dict | None = None, *,
            progress: Callable[[dict], None] | None = None, spec: TaskSpec | None = None) -> tuple[Policy, list[dict]]:
    """Nearest neighbours (VINN) among demonstrations as an encoder shows them, which another policy was trained with (appendix G.2.1,
    Table 13): nothing is learned. The policy, and a row as `imitate` gives it; arguments as for `imitate_pixels`."""
    seen = encoded(demos, pictures, encoder)
    return imitate("vinn", seen, config, policy_config, progress=progress, spec=pixel_spec(spec or get_task(demos.task), encoder))


def check_pixels(kind: str, shift: Any, view: View, encoder: Any = None) -> None:
    """Raises PdkitError for a kind of policy that cannot see, a shift (None: the view's) that is no whole number from 0 on or that pictures
    of this view cannot have, and for an encoder (a folder) that is given to a policy which trains its own, or not to VINN, which has none.
    """
    if kind not in (*HEADS, "vinn"):
        raise PdkitError(f"Policies that see pictures are of the kinds {', '.join(HEADS)} and vinn, not {kind}.")
    if (kind == "vinn") != (encoder is not None):
        raise PdkitError("VINN sees through the encoder of a trained policy: name its folder with --set encoder=FOLDER." if kind == "vinn"
                         else f"A policy of kind {kind} trains its own encoder; encoder=FOLDER is for vinn.")
    if kind == "vinn" and shift is not None:
        raise PdkitError("VINN trains nothing that a random_shift could help; leave it out.")
    _check_shift(shift, view)


def _check_shift(shift: Any, view: View) -> None:
    if shift is not None and (type(shift) is not int or shift < 0):
        raise PdkitError(f"random_shift counts pixels: it must be a whole number from 0 on, not {shift!r}.")
    if shift:
        check_square(view.height, view.width)


def visual_settings(kind: str, view: View, spec: TaskSpec) -> dict[str, Any]:
    """The settings of a policy of `kind` that follow from what it sees and does."""
    own = {"own_scale": True} if kind == "diffusion" else {}
    return {"obs_dim": view.state_dim + FEATURES, "act_dim": spec.act_dim} | own


def _finished(policy: Policy, encoder: Encoder, demos: Demos, pictures: Pictures) -> tuple[Policy, Encoder]:
    """Copies as they will be used: weights rounded to bfloat16, the normaliser fitted to the features."""
    # Copying draws no random number: training goes on with the originals.
    encoder, policy = (copy.deepcopy(module).cpu().eval() for module in (encoder, policy))
    rounded(encoder)
    renormalise(policy, encoded(demos, pictures, encoder).observations)
    return rounded(policy), encoder.requires_grad_(False)


@torch.no_grad()
def rounded(module: nn.Module) -> nn.Module:
    """The module with its parameters (not its buffers) rounded to what bfloat16 can hold; they stay float32."""
    for parameter in module.parameters():
        parameter.copy_(parameter.bfloat16())
    return module


@torch.no_grad()
def renormalise(policy: Policy, observations: np.ndarray) -> None:
    """Fit the normaliser to observations (N, obs_dim), and change the first layer of an MLP or BeT so that the policy stays the same.

    With x = mean + std n the layer W (x - mean0) / std0 + b becomes W (std / std0) n + b + W (mean - mean0) / std0.
    """
    if isinstance(policy, DiffusionPolicy):
        policy.renormalise(observations)
        return
    layer = policy.net[0] if isinstance(policy, MLP) else policy.gpt.inp
    assert isinstance(policy, MLP | BeT)
    mean, std = policy.normalizer.mean.clone(), policy.normalizer.std.clone()
    policy.normalizer.fit(observations, policy.config["std_floor"])
    layer.bias += layer.weight @ ((policy.normalizer.mean - mean) / std)
    layer.weight *= policy.normalizer.std / std
