"""DPPO: PPO on the steps by which a Diffusion Policy denoises (Ren et al., 2024; appendix C.2, H.2; facts.md 3.8).

Two decision processes in one: the environment's, in which a chunk of actions is one decision, and within each decision the chain

    x_K ~ temperature * N(0, I),   x_{k-1} = mu_k + max(sigma_k, least) * noise,   ...,   x_0 the sequence whose chunk is executed

of which the last K_ft steps are fine-tuned, by a network of their own, and those before them go through the imitated one. With abar the
noise schedule at step k and abar' at the next step taken (k - 1, or further with DDIM; 1 after the last):

    x0       clip((x_k - sqrt(1 - abar) eps_theta(x_k, k, o)) / sqrt(abar), -1, 1),   e = (x_k - sqrt(abar) x0) / sqrt(1 - abar)
    sigma_k  sqrt((1 - abar') / (1 - abar) * (1 - abar / abar'))
    mu_k     sqrt(abar') x0 + sqrt(1 - abar' - sigma_k^2) e,    which is DDIM with eta = 1, and DDPM where no step is left out
    log pi   mean over the executed actions' numbers of clamp(log N(x_{k-1}; mu_k, max(sigma_k, least for log pi)), -5, 2)
    policy   -mean min(ratio * A_k, clip(ratio, 1 - c_k, 1 + c_k) * A_k),   ratio = exp(log pi - log pi_acted)
    A_k      gamma_denoise^k * A,   k = 0 at the last step, K_ft - 1 at the noisiest fine-tuned one; A by GAE over decisions
    c_k      first + (last - first) * (exp(rate * t) - 1) / (exp(rate) - 1),   t from 0 at the noisiest step to 1 at the last
    value    1/2 mean (V(s) - R)^2,   of the environment's state alone: one value for all steps of a decision

With the policy's action_limits a chain, the least noise and the clip are on the scale of these limits; x_0 is taken off it to be executed.

What learns is not quite what is evaluated: while it learns, a chain is sampled with eta = 1, and with noise of at least `least` in every
step, also in those before the fine-tuned ones; evaluated and saved is the policy with the sampler of its imitation, for DDIM eta = 0:
no noise in any step, and e as the network gives it, not made anew from the clipped x0 (executed actions differ by 0.001 to 0.01 by it).
"""
from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch.distributions import Normal

from ..methods.config import MethodConfig
from ..policies import DiffusionPolicy
from .ppo import PPO, clipped_surrogate

LOG_PROB_RANGE = (-5.0, 2.0)  # of each number's log probability (DPPO's code)
NOISE_LIMIT = 3.0  # of the noise that is added, in standard deviations (DPPO's code)


class Steps:
    """mu_k and sigma_k of every step of a diffusers sampler, the noisiest first."""

    def __init__(self, sampler, device: str = "cpu"):
        self.times = sampler.timesteps.to(device)
        bars = sampler.alphas_cumprod.to(device)
        ahead = self.times - sampler.config.num_train_timesteps // len(self.times)
        self.bar, self.bar_ahead = bars[self.times], torch.where(ahead >= 0, bars[ahead.clamp(min=0)], 1.0)
        self.clean_from_noise = sampler.config.prediction_type == "epsilon"
        self.sigma = ((1 - self.bar_ahead) / (1 - self.bar) * (1 - self.bar / self.bar_ahead)).sqrt()

    def mean(self, numbers: torch.Tensor, sequences: torch.Tensor, predicted: torch.Tensor) -> torch.Tensor:
        """mu (B, horizon, act_dim) from sequences before steps `numbers` (B,) and the noise (or v) predicted in them."""
        bar, ahead, sigma = (x[numbers, None, None] for x in (self.bar, self.bar_ahead, self.sigma))
        if self.clean_from_noise:
            clean = ((sequences - (1 - bar).sqrt() * predicted) / bar.sqrt()).clamp(-1, 1)
        else:
            clean = (bar.sqrt() * sequences - (1 - bar).sqrt() * predicted).clamp(-1, 1)
        noise = (sequences - bar.sqrt() * clean) / (1 - bar).sqrt()
        return ahead.sqrt() * clean + (1 - ahead - sigma.square()).clamp(min=0).sqrt() * noise


def clip_ranges(config: MethodConfig, steps: int) -> torch.Tensor:
    """c_k (steps,), the noisiest step first; a single step has the last one's."""
    t = torch.linspace(0, 1, steps) if steps > 1 else torch.ones(1)
    rise = (torch.exp(config.dppo_clip_rate * t) - 1) / (math.exp(config.dppo_clip_rate) - 1)
    return config.dppo_clip_first + (config.dppo_clip - config.dppo_clip_first) * rise


class DPPO(PPO):
    """The learner. `actor` has a network of its own for its last steps, which alone trains; the other arguments are PPO's.

    A rollout holds, beside PPO's columns, `chain` (B, (K_ft + 1) * horizon * act_dim): the sequences before and after each fine-tuned
    step; its `log_prob` is (B, K_ft), of the policy that acted.
    """

    def __init__(self, obs_dim: int, act_dim: int, config: MethodConfig, sizes, decorator, *, actor: DiffusionPolicy, value_view,
                 device: str = "cpu"):
        super().__init__(obs_dim, act_dim, config, sizes, decorator, actor=actor, value_view=value_view, value_lr=config.dppo_value_lr,
                         device=device)
        self.steps, self.late = Steps(actor.sampler, device), actor.config["late_steps"]
        self.clips = clip_ranges(config, self.late).to(device)
        self.shape = actor.horizon, actor.config["act_dim"]  # of a sequence
        self.executed = slice(actor.window - 1, actor.window - 1 + actor.chunk)

    def _condition(self, obs: torch.Tensor) -> torch.Tensor:
        return self.actor.condition(obs.unflatten(-1, (self.actor.window, -1)))

    def log_prob(self, mean: torch.Tensor, numbers: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """log pi (B,) of the sequences after steps `numbers` (B,)."""
        std = self.steps.sigma[numbers].clamp(min=self.config.dppo_log_prob_std)[:, None, None]
        each = Normal(mean, std).log_prob(after).clamp(*LOG_PROB_RANGE)
        return each[:, self.executed].mean(dim=(1, 2))

    @torch.no_grad()
    def act(self, obs: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Executed actions (B, act_dim), log pi (B, K_ft) and chains (B, K_ft + 1, horizon, act_dim) for stored windows (B, stored) and
        standard normal noise (B, 1 + steps, horizon, act_dim)."""
        x, condition, total = self.actor.start(noise[:, 0]), self._condition(obs), len(self.steps.times)
        chain, log_probs = [], []
        for number in range(total):
            numbers = torch.full((len(x),), number, device=x.device)
            mean = self.steps.mean(numbers, x, self.actor.predicted(number, x, condition))
            std = self.steps.sigma[number].clamp(min=self.config.dppo_sample_std)
            before, x = x, mean + std * noise[:, number + 1].clamp(-NOISE_LIMIT, NOISE_LIMIT)
            if number >= total - self.late:
                chain.append(before)
                log_probs.append(self.log_prob(mean, numbers, x))
        return self.actor.executable(x[:, self.executed]).flatten(1), torch.stack(log_probs, dim=1), torch.stack([*chain, x], dim=1)

    @torch.no_grad()
    def _prepared(self, rollout, num_envs):
        """A row for each fine-tuned step of each decision."""
        data, count, late = super()._prepared(rollout, num_envs), len(rollout["obs"]), self.late
        decisions, steps = torch.arange(count).repeat_interleave(late), torch.arange(late).repeat(count)
        chain = rollout["chain"].view(count, late + 1, *self.shape)
        discount = self.config.dppo_gamma ** (late - 1 - steps).to(self.device)
        return {k: data[k][decisions] for k in ("obs", "base", "returns")} | {
            "advantage": data["advantage"][decisions] * discount, "log_prob": rollout["log_prob"].flatten(),
            "step": steps.to(self.device), "before": chain[:, :-1].flatten(0, 1), "after": chain[:, 1:].flatten(0, 1)}

    def _step(self, batch, noise):
        c, numbers = self.config, batch["step"] + len(self.steps.times) - self.late
        predicted = self.actor.late(batch["before"], self.steps.times[numbers], self._condition(batch["obs"])).float()
        log_ratio = self.log_prob(self.steps.mean(numbers, batch["before"], predicted), numbers, batch["after"]) - batch["log_prob"]
        clip = self.clips[batch["step"]]
        surrogate = clipped_surrogate(log_ratio, batch["advantage"], clip).mean()
        value_loss = 0.5 * F.mse_loss(self.values(batch["obs"], batch["base"]), batch["returns"])
        self._descend(c.ppo_value_coef * value_loss - surrogate)
        with torch.no_grad():
            ratio = log_ratio.exp()
            return {"policy_loss": -surrogate.detach(), "value_loss": value_loss.detach(), "kl": (ratio - 1 - log_ratio).mean(),
                    "clipped": ((ratio - 1).abs() > clip).float().mean()}
