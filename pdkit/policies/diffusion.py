"""Diffusion Policy (Chi et al., 2023) as Policy Decorator trains it (facts.md 2.2): denoise a sequence of actions.

    training   eps ~ N(0, I), step k uniform, a_k = sqrt(abar_k) a + sqrt(1 - abar_k) eps:  loss = |eps - eps_theta(a_k, k, o)|^2
    acting     from pure noise, DDIM (few steps, no noise added) or DDPM (all steps) down to a; of the `horizon` actions the `chunk`
               that begin at the latest observation are executed, then the policy looks again

With prediction="v_prediction" (Salimans and Ho, 2022; not in the paper) the network gives v = sqrt(abar_k) eps - sqrt(1 - abar_k) a
instead, from which both follow. Where all is noise that is the action itself, but for its sign; a network that must give the noise
there has to pass its own input on through every layer to a high accuracy, which should take it more gradient steps (lesson 03 lets one
compare).

With action_limits what is noised are actions that run from -1 to 1 between the least and the greatest that was demonstrated, for each
number by itself, as the original does it by default (Chi et al.'s LinearNormalizer); the official code takes them as they are. A number
that never varies stays what it was (there the network's error passes through). PushChair's demonstrations move 3 of 20 numbers, and
noise of unit size in the other 17 leaves errors that the robot feels. Such a policy, sampled as it is evaluated, keeps to what was
demonstrated, however it is fine-tuned; a residual need not.

With a temperature below 1 DDIM starts from less noise, at 0 from none, so that sampled actions scatter less (low-temperature sampling,
as in Ajay et al.'s code, 2023, which scales the noise of every DDPM step, too; not in the paper). That matters where the network does
not yet tell noise from actions well (data/results/sampling.csv).

With obs_encoder what FiLM sees of the observations goes through layers of their own first; the official code, on states, has none.
After 4,000 gradient steps one for PegInsertionSide solved 14 of 20 episodes so, without them none (data/RESULTS.md).

The official code trains on batches of 1,024 for a million steps (PushChair 300,000; `pdkit train base TASK --policy diffusion --profile
paper`), and tests base policies by DDPM's 100 steps; here they are chosen and tested by the DDIM that acts online.

The sequence begins with the oldest observation of the window, so its first `window - 1` actions lie in the past. The last steps of
sampling may have a network of their own: what DPPO fine-tunes (pdkit/rl/dppo.py), while the steps before them stay as imitated.
"""
from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..errors import PdkitError, unknown
from .base import Normalizer, Policy
from .unet import UNet

SAMPLERS = ("ddim", "ddpm")
SPACINGS = ("leading", "trailing")
PREDICTIONS = ("epsilon", "v_prediction")
NEVER = 1e-4  # a demonstrated number whose range is below this never varies


class Limits(nn.Module):
    """Actions on a scale from -1 to 1 between the least and the greatest demonstrated, per number; part of the checkpoint.

    A number that never varies is 0 on that scale, and what it was off it, whatever the network says. What lies beyond the limits, as
    actions can that keep still after a demonstration's end or that DIPO has moved, counts as the nearer limit.
    """

    def __init__(self, dim: int):
        super().__init__()
        self.register_buffer("middle", torch.zeros(dim))
        self.register_buffer("reach", torch.ones(dim))

    @torch.no_grad()
    def fit(self, actions: np.ndarray) -> None:
        """From actions (N, dim)."""
        least, greatest = actions.min(axis=0), actions.max(axis=0)
        self.middle.copy_(torch.from_numpy((least + greatest) / 2))
        self.reach.copy_(torch.from_numpy(np.where(greatest - least < NEVER, 0.0, (greatest - least) / 2)))

    def on(self, actions: torch.Tensor) -> torch.Tensor:
        """Actions (..., dim) on the scale."""
        return ((actions - self.middle) / self.reach.clamp(min=NEVER / 2)).clamp(-1, 1) * (self.reach > 0)

    def off(self, scaled: torch.Tensor) -> torch.Tensor:
        """Actions (..., dim) that are `scaled` on it."""
        return self.middle + self.reach * scaled


class DiffusionPolicy(Policy):
    """Config: obs_dim, act_dim, window (observations), horizon (actions predicted), chunk (of them executed), dims, kernel, groups and
    embed of the U-Net, diffusion_steps of training, prediction ("epsilon", "v_prediction"), sampler ("ddim", "ddpm"), sampler_steps,
    spacing (of DDIM's steps: "leading", "trailing"), late_steps (the last so many steps of sampling have a network of their own; 0: one
    for all), own_scale (the network's scale of observations is kept apart from the normaliser's: see `renormalise`), temperature (of the
    noise that DDIM starts from), std_floor (of the normaliser), action_limits (what is noised runs from -1 to 1 between the limits of
    the demonstrated actions), and obs_encoder (widths of the layers between the observations and FiLM; [] for none)."""

    kind = "diffusion"
    defaults: dict[str, Any] = dict(window=2, horizon=16, chunk=4, dims=[64, 128, 256], kernel=5, groups=8, embed=64, diffusion_steps=100,
                                    prediction="epsilon", sampler="ddim", sampler_steps=4, spacing="leading", late_steps=0,
                                    own_scale=False, temperature=1.0, std_floor=0.0, action_limits=False, obs_encoder=[])
    least = dict(embed=4, late_steps=0)
    made = ("late_steps", "own_scale")  # by DPPO, and by imitation from pictures
    recipe: dict[str, Any] = dict(lr=1e-4, beta1=0.95, weight_decay=1e-6, schedule="cosine", lr_warmup=500, ema_power=0.75)

    def __init__(self, config: dict[str, Any]):
        super().__init__(config)
        c = self.config
        self.window, self.chunk, self.horizon = c["window"], c["chunk"], c["horizon"]
        shortest = 2 ** (len(c["dims"]) - 1)
        if self.horizon % shortest:
            raise PdkitError(f"Diffusion Policy's horizon ({self.horizon}) must be a multiple of {shortest}: its U-Net halves the time "
                             f"{len(c['dims']) - 1} times.")
        if not 1 <= self.chunk <= self.horizon - self.window + 1:
            raise PdkitError(f"Diffusion Policy's chunk ({self.chunk}) must be 1 to {self.horizon - self.window + 1} here, from the latest "
                             f"of {self.window} observations to the end of the horizon ({self.horizon}); a longer horizon, or window=1, "
                             "leaves room for more.")
        if c["kernel"] % 2 != 1 or c["embed"] % 2:
            raise PdkitError(f"Diffusion Policy's kernel must be odd, so that its U-Net keeps the time's length, and embed even, for sines "
                             f"and cosines, not {c['kernel']} and {c['embed']}.")
        if any(d % c["groups"] for d in c["dims"]):
            raise PdkitError(f"Diffusion Policy's dims {c['dims']} must be multiples of its groups ({c['groups']}).")
        if any(type(width) is not int or width < 1 for width in c["obs_encoder"]):
            raise PdkitError("Diffusion Policy's obs_encoder must be [] or a list of whole numbers of at least 1, not "
                             f"{c['obs_encoder']}.")
        if not 1 <= c["sampler_steps"] <= c["diffusion_steps"]:
            raise PdkitError(f"sampler_steps must be from 1 to diffusion_steps ({c['diffusion_steps']}), not {c['sampler_steps']}.")
        self.scale = Normalizer(c["obs_dim"]) if c["own_scale"] else None
        self.limits = Limits(c["act_dim"]) if c["action_limits"] else None
        self.obs_encoder = obs_layers(c["obs_dim"] * self.window, c["obs_encoder"])
        self.unet = UNet(c["act_dim"], self.condition_dim, tuple(c["dims"]), c["kernel"], c["groups"], c["embed"])
        self.noise = _scheduler("ddpm", c)
        self.sampler = _scheduler(c["sampler"], c)
        if c["temperature"] != 1 and c["sampler"] != "ddim":
            raise PdkitError(f"A temperature (here {c['temperature']:g}) is for sampler=\"ddim\" alone, which has no noise but the "
                             f"first; with {c['sampler']} set temperature=1.")
        self.sampler.set_timesteps(c["sampler_steps"] if c["sampler"] == "ddim" else c["diffusion_steps"])
        if not 0 <= c["late_steps"] <= self.sampling_steps:
            raise PdkitError(f"late_steps, the steps with a network of their own, must be from 0 to all {self.sampling_steps} of the "
                             f"sampler's, not {c['late_steps']}.")
        self.late = copy.deepcopy(self.unet) if c["late_steps"] else None

    @property
    def samples(self) -> bool:
        return self.config["sampler"] != "ddim" or self.config["temperature"] > 0

    @property
    def condition_dim(self) -> int:
        """How many numbers FiLM sees of the observations."""
        return (self.config["obs_dim"] * self.window, *self.config["obs_encoder"])[-1]

    @property
    def sampling_steps(self) -> int:
        """How many steps lead from noise to actions."""
        return len(self.sampler.timesteps)

    def with_late(self, steps: int) -> DiffusionPolicy:
        """A copy of a policy with one network whose last `steps` steps of sampling go through a copy of it: it acts as this one does."""
        policy = DiffusionPolicy(self.config | {"late_steps": steps})
        policy.load_state_dict(self.state_dict() | {f"late.{name}": tensor for name, tensor in self.unet.state_dict().items()})
        return policy.eval()

    def fit_statistics(self, observations: np.ndarray, actions: np.ndarray, seed: int = 0) -> None:
        self.normalizer.fit(observations, self.config["std_floor"])
        if self.limits is not None:
            self.limits.fit(actions)

    def noisable(self, actions: torch.Tensor) -> torch.Tensor:
        """Actions (..., act_dim) on the scale on which noise is added to them."""
        return actions if self.limits is None else self.limits.on(actions)

    def executable(self, sequences: torch.Tensor) -> torch.Tensor:
        """What the network works on (..., act_dim), on any step of sampling, as actions of the environment."""
        return sequences if self.limits is None else self.limits.off(sequences)

    def condition(self, windows: torch.Tensor) -> torch.Tensor:
        """What the U-Net sees of windows (N, window, obs_dim): (N, condition_dim)."""
        seen = self.normalizer(windows)
        return self.obs_encoder((seen if self.scale is None else self.scale(seen)).flatten(1))

    def seen_scale(self) -> Normalizer:
        """How the networks see observations, as one: the normaliser, with their own scale on top where there is one."""
        if self.scale is None:
            return self.normalizer
        both = Normalizer(self.config["obs_dim"]).to(self.normalizer.mean.device)
        both.mean, both.std = self.normalizer.mean + self.normalizer.std * self.scale.mean, self.normalizer.std * self.scale.std
        return both

    @torch.no_grad()
    def renormalise(self, observations: np.ndarray) -> None:
        """Fit the normaliser to observations (N, obs_dim) while the network goes on to see what it saw: its own scale undoes the change.

        No layer could take the change in, as an MLP's first does: the condition goes through Mish first.
        """
        seen = self.seen_scale()
        self.normalizer.fit(observations, self.config["std_floor"])
        self.scale.mean.copy_((seen.mean - self.normalizer.mean) / self.normalizer.std)
        self.scale.std.copy_(seen.std / self.normalizer.std)

    def film(self) -> nn.Linear:
        """A copy of what turns an activated condition (N, condition_dim) into the scales and shifts of all blocks of the U-Net, as far
        as they depend on the observations: what the diffusion step adds is the same for all."""
        return self.unet.film(self.condition_dim)

    def draw(self, shape: torch.Size) -> tuple[torch.Tensor, ...]:
        """Noise for the actions, and how many steps each sequence is noised by (B,)."""
        return torch.randn(shape), torch.randint(self.config["diffusion_steps"], (shape[0],))

    def loss(self, windows: torch.Tensor, actions: torch.Tensor, *drawn: torch.Tensor) -> dict[str, torch.Tensor]:
        actions = self.noisable(actions)
        noise, steps = drawn or (x.to(actions.device) for x in self.draw(actions.shape))
        predicted = self.unet(self.noise.add_noise(actions, noise, steps), steps, self.condition(windows))
        wanted = noise if self.config["prediction"] == "epsilon" else self.noise.get_velocity(actions, noise, steps)
        return {"loss": F.mse_loss(predicted.float(), wanted)}

    def start(self, noise: torch.Tensor) -> torch.Tensor:
        """What sampling starts from, made of standard normal noise."""
        return self.config["temperature"] * noise

    def denoise(self, windows: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """All actions (N, horizon, act_dim) that standard normal noise of that shape becomes."""
        sequences, condition = self.start(noise), self.condition(windows)
        for number, step in enumerate(self.sampler.timesteps):
            # DDPM's fresh noise, too, comes from torch's generator on the CPU, on whichever device: checkpoints hold that one alone.
            sequences = self.sampler.step(self.predicted(number, sequences, condition), step, sequences,
                                          generator=torch.default_generator).prev_sample
        return self.executable(sequences)

    def predicted(self, number: int, sequences: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """The noise (or v) in sequences (N, horizon, act_dim), by the network in charge of step `number` of sampling (the first is 0)."""
        network = self.late if number >= self.sampling_steps - self.config["late_steps"] else self.unet
        return network(sequences, self.sampler.timesteps[number].expand(len(sequences)).to(sequences.device), condition).float()

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        noise = torch.randn(len(windows), self.horizon, self.config["act_dim"]).to(windows.device)
        return self.denoise(windows, noise)[:, self.window - 1: self.window - 1 + self.chunk]

    def parameter_groups(self, weight_decay: float) -> list[dict[str, Any]]:
        return [{"params": list(self.parameters()), "weight_decay": weight_decay}]


def obs_layers(inputs: int, widths: Sequence[int]) -> nn.Sequential:
    """Linear layers of these widths with Mish between them: (N, inputs) -> (N, widths[-1]); without widths what is given. The blocks of
    the U-Net activate the last."""
    sizes = itertools.pairwise((inputs, *widths))
    return nn.Sequential(*[part for size in sizes for part in (nn.Linear(*size), nn.Mish())][:-1])


def _scheduler(name: str, config: dict[str, Any]):
    """The noise schedule of diffusers with the paper's settings. Raises PdkitError for an unknown sampler or prediction."""
    from diffusers.schedulers.scheduling_ddim import DDIMScheduler
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

    for field, value, known in (("sampler", name, SAMPLERS), ("prediction", config["prediction"], PREDICTIONS),
                                ("spacing", config["spacing"], SPACINGS)):
        if value not in known:
            raise unknown(field, value, known)
    settings = dict(num_train_timesteps=config["diffusion_steps"], beta_schedule="squaredcos_cap_v2", clip_sample=True,
                    prediction_type=config["prediction"])
    # "leading" steps begin a step's width below the last (4 of 100: 75, 50, 25, 0), not at the last itself: there next to nothing is left
    # of the actions, and what they were, told from the predicted noise, would be a coin toss for each number. A network that gives v tells
    # the actions there, too: "trailing" steps (99, 74, 49, 24; Lin et al., 2023) then spare it noise that it would take for actions.
    return DDIMScheduler(**settings, timestep_spacing=config["spacing"]) if name == "ddim" else DDPMScheduler(**settings)
