"""The denoising network of Diffusion Policy: a 1D convolutional U-Net over time, conditioned by FiLM (Chi et al., 2023; facts.md 2.2)."""
from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import nn


def step_embedding(steps: torch.Tensor, dim: int) -> torch.Tensor:
    """Sinusoidal embedding (B, dim) of diffusion steps (B,), with frequencies from 1 down to 1/10,000."""
    half = dim // 2
    frequencies = torch.exp(-math.log(10_000) / (half - 1) * torch.arange(half, device=steps.device))
    angles = steps.float()[:, None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Conv(nn.Module):
    """Convolution over time, group normalisation, Mish: (B, in, T) -> (B, out, T)."""

    def __init__(self, inputs: int, outputs: int, kernel: int, groups: int):
        super().__init__()
        self.conv = nn.Conv1d(inputs, outputs, kernel, padding=kernel // 2)
        self.norm = nn.GroupNorm(groups, outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.mish(self.norm(self.conv(x)))


class FiLMBlock(nn.Module):
    """Two convolutions with a shortcut; between them every channel is scaled and shifted as the condition says (FiLM, Perez et al., 2018).
    """

    def __init__(self, inputs: int, outputs: int, condition: int, kernel: int, groups: int):
        super().__init__()
        self.first, self.second = Conv(inputs, outputs, kernel, groups), Conv(outputs, outputs, kernel, groups)
        self.film = nn.Linear(condition, 2 * outputs)
        self.shortcut = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        scale, shift = self.film(F.mish(condition))[..., None].chunk(2, dim=1)
        return self.second(self.first(x) * scale + shift) + self.shortcut(x)


class UNet(nn.Module):
    """Predicts the noise in a sequence of actions: (B, T, act_dim), diffusion step (B,), condition (B, condition) -> (B, T, act_dim).

    Each level halves the time and has `dims[i]` channels; T must be a multiple of 2^(len(dims) - 1).
    """

    def __init__(self, act_dim: int, condition: int, dims: tuple[int, ...], kernel: int, groups: int, embed: int):
        super().__init__()
        self.embed = embed
        self.step = nn.Sequential(nn.Linear(embed, 4 * embed), nn.Mish(), nn.Linear(4 * embed, embed))
        condition += embed

        def pair(inputs: int, outputs: int) -> nn.ModuleList:
            sizes = ((inputs, outputs), (outputs, outputs))
            return nn.ModuleList(FiLMBlock(a, b, condition, kernel, groups) for a, b in sizes)

        widths = (act_dim, *dims)
        self.down = nn.ModuleList(pair(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.shrink = nn.ModuleList(nn.Conv1d(d, d, 3, stride=2, padding=1) for d in dims[:-1])
        self.middle = pair(dims[-1], dims[-1])
        # On the way up each level sees its own features from the way down beside what comes from below.
        self.up = nn.ModuleList(pair(2 * b, a) for a, b in zip(dims[-2::-1], dims[:0:-1], strict=True))
        self.grow = nn.ModuleList(nn.ConvTranspose1d(d, d, 4, stride=2, padding=1) for d in dims[-2::-1])
        self.out = nn.Sequential(Conv(dims[0], dims[0], kernel, groups), nn.Conv1d(dims[0], act_dim, 1))

    def film(self, condition: int) -> nn.Linear:
        """The FiLM layers of all blocks as one, (B, condition) -> (B, twice all channels), of an activated condition alone: every layer is
        linear in step and condition side by side, so the step adds a constant, which is left out, as is the bias."""
        weights = torch.cat([block.film.weight for block in self.modules() if isinstance(block, FiLMBlock)])[:, -condition:]
        layer = nn.Linear(condition, len(weights), bias=False)
        layer.weight.data.copy_(weights)
        return layer

    def forward(self, actions: torch.Tensor, steps: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        condition = torch.cat([self.step(step_embedding(steps, self.embed)), condition], dim=-1)
        x, kept = actions.transpose(1, 2), []
        for level, blocks in enumerate(self.down):
            for block in blocks:
                x = block(x, condition)
            kept.append(x)
            if level < len(self.shrink):
                x = self.shrink[level](x)
        for block in self.middle:
            x = block(x, condition)
        for blocks, grow in zip(self.up, self.grow, strict=True):
            x = torch.cat([x, kept.pop()], dim=1)
            for block in blocks:
                x = block(x, condition)
            x = grow(x)
        return self.out(x).transpose(1, 2)
