"""Exercises about demonstrations and base policies (notebooks 01 to 04, 15)."""
from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from scipy import stats as scipy_stats

from .. import base_analysis, pixel_analysis
from ..policies import bet
from .judge import judge


def first_success(answer: Callable, strict: bool = False) -> bool:
    """01: the step, counted from 1, after which an episode was first solved; None if never."""
    def complaints() -> Iterator[str]:
        cases = (([0, 0, 1, 1], 3), ([1, 0, 0], 1), ([0, 1, 0], 2), ([0, 0, 0], None))
        for success, expected in cases:
            got = answer(np.array(success, bool))
            if got == expected and (got is None) == (expected is None):
                continue
            if expected is None:
                yield f"an episode that is never solved gives {got!r}, not None; argmax of all False is 0."
            elif got == expected - 1:
                yield f"for {success} it gives {got}: steps are counted from 1."
            else:
                yield f"for {success} it gives {got!r}, not {expected}."

    return judge("first_success", complaints, strict)


def focal_loss(answer: Callable, strict: bool = False) -> bool:
    """02: the mean of -(1 - p)^gamma log p for logits (B, K) and true classes (B,)."""
    def complaints() -> Iterator[str]:
        generator = torch.Generator().manual_seed(0)
        logits, target = torch.randn((16, 5), generator=generator), torch.arange(16) % 5
        for gamma in (0.0, 2.0):
            got, expected = float(answer(logits, target, gamma)), float(bet.focal_loss(logits, target, gamma))
            if abs(got - expected) < 1e-4 * expected:
                continue
            cross_entropy = float(bet.focal_loss(logits, target, 0.0))
            if gamma and abs(got - cross_entropy) < 1e-4:
                yield "gamma changes nothing: where is the factor (1 - p)^gamma?"
            elif abs(got + expected) < 1e-4:
                yield "the sign is wrong: log p is negative, a loss is positive."
            elif abs(got - 16 * expected) < 1e-3:
                yield "it is 16 times too large for a batch of 16: take the mean, not the sum."
            else:
                yield f"with gamma {gamma:g} it gives {got:.4f}, not {expected:.4f}."
        extreme = float(answer(torch.tensor([[-200.0, 200.0]]), torch.tensor([0]), 2.0))
        if not abs(extreme - 400) < 0.1:
            yield f"for a very unlikely true bin it gives {extreme:.1f}, not 400; use log_softmax instead of log(softmax)."

    return judge("focal_loss", complaints, strict)


def ddim_step(answer: Callable, strict: bool = False) -> bool:
    """03: from noisy actions x (T, act_dim), predicted noise, and abar here and at the next step: the actions at the next step."""
    def complaints() -> Iterator[str]:
        generator = torch.Generator().manual_seed(0)
        x, noise = torch.randn((2, 8, 2), generator=generator)
        for here, after in ((0.5, 0.9), (0.02, 0.3), (0.8, 1.0)):
            clean = ((x - (1 - here) ** 0.5 * noise) / here**0.5)
            expected = after**0.5 * clean.clamp(-1, 1) + (1 - after) ** 0.5 * noise
            got = torch.as_tensor(np.asarray(answer(x.clone(), noise.clone(), here, after), np.float32))
            if got.shape != expected.shape:
                yield f"it gives shape {tuple(got.shape)}, not {tuple(expected.shape)}."
            elif torch.allclose(got, expected, atol=1e-4):
                continue
            elif torch.allclose(got, after**0.5 * clean + (1 - after) ** 0.5 * noise, atol=1e-4):
                yield "the clean actions leave [-1, 1]: clip them first, or a small error in the noise explodes where abar is small."
            elif torch.allclose(got, clean.clamp(-1, 1), atol=1e-4):
                yield "these are the clean actions: put the noise of the next step back in."
            else:
                yield f"with abar {here:g} and then {after:g} the first number is {got[0, 0]:.3f}, not {expected[0, 0]:.3f}."

    return judge("ddim_step", complaints, strict)


def best_of(answer: Callable, strict: bool = False) -> bool:
    """04: what the best of m evaluations of n episodes shows on average, when every policy truly solves a share p: answer(p, n, m)."""
    def complaints() -> Iterator[str]:
        for p, n, m in ((0.5, 1, 2), (0.5, 50, 1), (0.3, 50, 10), (0.9, 20, 5)):
            got, expected = float(answer(p, n, m)), base_analysis.best_of(p, n, m)
            cdf = scipy_stats.binom.cdf(np.arange(n + 1), n, p)
            if abs(got - expected) < 0.01:  # a simulation of a hundred thousand draws is as good: its standard error is below 0.002
                continue
            mistakes = {
                p: "that is the truth itself: the best of several shows more, because its luck was chosen with it.",
                n * expected: "that is a number of episodes, not a share: divide by n.",
                float(np.sum(np.diff(cdf, prepend=0.0) ** m * np.arange(n + 1)) / n):
                    "the chance that the best is k is F(k)^m - F(k - 1)^m: take the difference after the power, not before.",
                float(1 - (1 - p) ** m): "that is the chance that one of m episodes is solved; an evaluation has n."}
            yield next((said for value, said in mistakes.items() if abs(got - value) < 0.01),
                       f"for p={p:g}, n={n} and m={m} it gives {got:.3f}, not {expected:.3f}.")

    return judge("best_of", complaints, strict)


def shift(answer: Callable, strict: bool = False) -> bool:
    """15: a picture (H, W, C) moved down and right by whole pixels, the bared edge repeating the nearest pixels."""
    def complaints() -> Iterator[str]:
        picture = np.random.default_rng(0).integers(0, 255, (6, 5, 3), np.uint8)
        for down, right in ((0, 0), (2, 0), (0, 1), (-1, -2), (2, -1)):
            got, expected = np.asarray(answer(picture.copy(), down, right)), pixel_analysis.shifted(picture, down, right)
            if got.shape != expected.shape:
                yield f"moving {picture.shape} by ({down}, {right}) gives {got.shape}: the size must stay."
            elif np.array_equal(got, expected):
                continue
            elif np.array_equal(got, np.roll(picture, (down, right), (0, 1))):
                yield "what leaves on one side comes back on the other (np.roll): the bared edge must repeat the nearest pixels."
            elif np.array_equal(got, pixel_analysis.shifted(picture, -down, -right)):
                yield "it moves the other way: row r of the result is row r - down of the picture."
            elif np.array_equal(got, pixel_analysis.shifted(picture, right, down)):
                yield "down and right are exchanged: rows are the first axis."
            else:
                yield f"moving by ({down}, {right}) is wrong in {(got != expected).mean():.0%} of the numbers."

    return judge("shift", complaints, strict)
