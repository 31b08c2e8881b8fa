"""Checks of the exercises in the notebooks: each takes the student's function and names the likely mistake.

A check prints one line and returns whether the exercise is solved; it never raises, so that an unsolved notebook runs to
its end, unless `strict` is set (for grading): then what is wrong is a PdkitError.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
import torch
from scipy import stats as scipy_stats

from . import base_analysis, stats
from .errors import PdkitError
from .policies import bet


def _judge(name: str, complaints: Callable[[], Iterator[str]], strict: bool) -> bool:
    """Print the verdict of `complaints`, which yields sentences about what is wrong; True if there is none."""
    try:
        wrong = next(complaints(), None)
    except NotImplementedError:
        wrong = "it is still to be written."
    except Exception as error:  # whatever a student's code may raise
        wrong = f"it raised {type(error).__name__}: {error}"
    if wrong is None:
        print(f"[solved] {name}")
        return True
    if strict:
        raise PdkitError(f"The exercise {name} is not solved: {wrong}")
    print(f"[not yet] {name}: {wrong}")
    return False


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

    return _judge("first_success", complaints, strict)


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
        if not np.isfinite(extreme):
            yield "it is not finite for a very unlikely true bin; use log_softmax instead of log(softmax)."

    return _judge("focal_loss", complaints, strict)


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

    return _judge("ddim_step", complaints, strict)


def best_of(answer: Callable, strict: bool = False) -> bool:
    """04: what the best of m evaluations of n episodes shows on average, when every policy truly solves a share p: answer(p, n, m)."""
    def complaints() -> Iterator[str]:
        for p, n, m in ((0.5, 1, 2), (0.5, 50, 1), (0.3, 50, 10), (0.9, 20, 5)):
            got, expected = float(answer(p, n, m)), base_analysis.best_of(p, n, m)
            cdf = scipy_stats.binom.cdf(np.arange(n + 1), n, p)
            if abs(got - expected) < 0.01:  # a simulation of some thousand draws is as good
                continue
            mistakes = {
                p: "that is the truth itself: the best of several shows more, because its luck was chosen with it.",
                n * expected: "that is a number of episodes, not a share: divide by n.",
                float(np.sum(np.diff(cdf, prepend=0.0) ** m * np.arange(n + 1)) / n):
                    "the chance that the best is k is F(k)^m - F(k - 1)^m: take the difference after the power, not before.",
                float(1 - (1 - p) ** m): "that is the chance that one of m episodes is solved; an evaluation has n."}
            yield next((said for value, said in mistakes.items() if abs(got - value) < 0.01),
                       f"for p={p:g}, n={n} and m={m} it gives {got:.3f}, not {expected:.3f}.")

    return _judge("best_of", complaints, strict)


def gate(answer: Callable, strict: bool = False) -> bool:
    """05: each environment's row kept with probability min(step / H, 1), else zero."""
    def complaints() -> Iterator[str]:
        residual = np.ones((4000, 3), np.float32)
        out = np.asarray(answer(residual.copy(), 250, 1000, np.random.default_rng(0)))
        if out.shape != residual.shape:
            yield f"it gives an array of shape {out.shape}, not {residual.shape}."
        on = out != 0
        if (on.any(axis=1) != on.all(axis=1)).any():
            yield "it switches single dimensions; a row is kept or zeroed as a whole."
        if not np.isin(out, (0, 1)).all():
            yield "it scales the residuals; the gate only keeps them or sets them to zero."
        share = float(on[:, 0].mean())
        if share in (0.0, 1.0):
            yield "it switches all environments together; draw one number for each of them."
        if abs(share - 0.75) < 0.03:
            yield "at a quarter of H three quarters are on: the chance to be ON is step / H."
        if abs(share - 0.25) > 0.03:
            yield f"at a quarter of H a share of {share:.2f} is on, not 0.25."
        if (np.asarray(answer(residual.copy(), 5000, 1000, np.random.default_rng(0))) == 0).any():
            yield "beyond H something is still off; the probability stops at 1."

    return _judge("gate", complaints, strict)


def cosines(answer: Callable, strict: bool = False) -> bool:
    """06: the cosine between rows of two arrays (N, d), 0 where a row is zero."""
    def complaints() -> Iterator[str]:
        rng = np.random.default_rng(0)
        first, second = rng.standard_normal((2, 6, 4))
        expected = [a @ b / np.sqrt(a @ a * (b @ b)) for a, b in zip(first, second, strict=True)]
        got = np.asarray(answer(first, second))
        if got.shape != (6,):
            yield f"it gives an array of shape {got.shape}, not (6,): sum over the last axis only."
        if np.allclose(got, (first * second).sum(axis=1)):
            yield "it is the dot product: where is the division by both norms?"
        if not np.allclose(got, expected):
            yield f"the first cosine is {got[0]:.3f}, not {expected[0]:.3f}."
        first[2] = 0
        got = np.asarray(answer(first, second))
        if not np.isfinite(got).all() or got[2] != 0:
            yield f"for a row of zeros it gives {got[2]}, not 0."

    return _judge("cosines", complaints, strict)


def temperature_step(answer: Callable, strict: bool = False) -> bool:
    """07: log temperature after one step of plain gradient descent on log_temperature * (entropy - target)."""
    def complaints() -> Iterator[str]:
        for log_temperature, entropy, target in ((0.0, -40.0, -28.0), (-4.6, 3.0, -28.0)):
            got = float(answer(log_temperature, entropy, target, 1e-3))
            expected = log_temperature - 1e-3 * (entropy - target)
            if abs(got - expected) < 1e-9:
                continue
            if abs(got - (log_temperature + 1e-3 * (entropy - target))) < 1e-9:
                yield "the sign is wrong: an actor that is too sure of itself must be paid more for entropy, not less."
            elif abs(got - (log_temperature - 1e-3 * log_temperature * (entropy - target))) < 1e-9:
                yield "the gradient of x * c is c, not x * c."
            elif abs(got - (log_temperature - 1e-3 * (entropy + target))) < 1e-9:
                yield "the target is negative already: subtract it."
            else:
                yield f"from {log_temperature:g} with entropy {entropy:g} it gives {got:.4f}, not {expected:.4f}."

    return _judge("temperature_step", complaints, strict)


def actors_value(answer: Callable, strict: bool = False) -> bool:
    """08: Q(f(w), a) (B,) whose gradient reaches the action and not what makes the features."""
    def complaints() -> Iterator[str]:
        generator = torch.Generator().manual_seed(0)
        weight = torch.randn((4, 3), generator=generator).requires_grad_(True)
        head = torch.randn((5, 1), generator=generator)
        windows, action = torch.randn((6, 4), generator=generator), torch.randn((6, 2), generator=generator).requires_grad_(True)
        expected = (torch.cat([windows @ weight, action], dim=1).tanh() @ head)[:, 0]
        got = answer(lambda w: w @ weight, lambda x: x.tanh() @ head, windows, action)
        if tuple(got.shape) != (6,):
            yield f"it gives a tensor of shape {tuple(got.shape)}, not (6,)."
        if not torch.allclose(got, expected, atol=1e-5):
            yield "the values differ from those of the head on features and action: only the backward pass may differ."
        if not got.requires_grad:
            yield "no gradient reaches anything: cut off the features, not the whole value."
        mine = torch.autograd.grad(got.sum(), [action, weight], allow_unused=True)
        if mine[0] is None:
            yield "no gradient reaches the action: the actor could not learn."
        if mine[1] is not None and bool((mine[1] != 0).any()):
            yield "the gradient reaches what makes the features: the actor could change what the critic sees."
        if not torch.allclose(mine[0], torch.autograd.grad(expected.sum(), action)[0], atol=1e-5):
            yield "the gradient on the action is not that of the head."

    return _judge("actors_value", complaints, strict)


def conservative(answer: Callable, strict: bool = False) -> bool:
    """09: Cal-QL's conservative term: mean over states of log sum exp of valued actions, less the data's value."""
    def complaints() -> Iterator[str]:
        rng, d = np.random.default_rng(0), 3
        data, returns = rng.normal(-5, 1, 6), np.array([-9.0, -1.0, -8.0, -2.0, -5.0, -9.0])
        random, policy, log_pi = rng.normal(-5, 1, (4, 6)), rng.normal(-5, 1, (4, 6)), rng.normal(1, 1, (4, 6))

        def term(lifted: bool = True, both: bool = False, volume: int = 1, sign: int = 1, total: bool = False) -> float:
            parts = [(np.maximum(random, returns) if both else random) + volume * d * np.log(2),
                     (np.maximum(policy, returns) if lifted else policy) - sign * log_pi]
            each = np.log(np.exp(np.concatenate(parts)).sum(axis=0)) - data
            return float(each.sum() if total else each.mean())

        mistakes = {
            term(lifted=False): "that is CQL: where is the max with the returns?",
            term(both=True): "random actions are not lifted to the returns, the policy's alone.",
            term(volume=0): "random actions have a density too: 0.5 in each of d dimensions.",
            term(volume=-1): "a value is divided by its density: subtract the logarithm of 0.5^d, which is negative.",
            term(sign=-1): "a value is divided by its density: subtract log pi.",
            term(total=True): "take the mean over states, not the sum."}
        got = float(answer(data, random, policy, log_pi, returns, d))
        if abs(got - term()) > 1e-6:
            yield next((said for value, said in mistakes.items() if abs(got - value) < 1e-6), f"it gives {got:.4f}, not {term():.4f}.")
        if not np.isfinite(answer(data - 900, random - 900, policy - 900, log_pi, returns - 900, d)):
            yield "it is not finite for values near -900: take the largest out before the exponential (np.logaddexp.reduce does)."

    return _judge("conservative", complaints, strict)


def corridor_values(answer: Callable, strict: bool = False) -> bool:
    """10: exact values of a corridor's cells when only the step out of the last one is rewarded, with 1."""
    def complaints() -> Iterator[str]:
        for length, gamma in ((5, 0.9), (1, 0.5), (40, 0.97)):
            expected = gamma ** np.arange(length - 1, -1, -1.0)
            got = np.asarray(answer(length, gamma), float)
            if got.shape != (length,):
                yield f"for {length} cells it gives an array of shape {got.shape}, not {(length,)}."
            if np.allclose(got, gamma * expected):
                yield "the step out of the last cell brings its reward at once: no discount lies before it."
            if length > 1 and np.allclose(got, expected[::-1]):
                yield "it is the wrong way round: cell 0 is the farthest from the reward."
            if not np.allclose(got, expected):
                yield f"with gamma {gamma:g} the first of {length} cells is worth {expected[0]:.4f}, not {got[0]:.4f}."

    return _judge("corridor_values", complaints, strict)


def lookup(answer: Callable, strict: bool = False) -> bool:
    """11: VINN's action (act_dim,) from all distances (N,), actions (N, act_dim) and k: softmax of minus the k smallest distances."""
    def complaints() -> Iterator[str]:
        distances, actions = np.array([0.5, 2.0, 0.1, 1.0]), np.array([[0.2, 1.0], [-1.0, 0.0], [0.6, -0.4], [0.0, 0.8]])

        def weighted(rows, sign=-1.0):
            weights = np.exp(sign * distances[rows])
            return weights @ actions[rows] / weights.sum()

        for k, rows in ((1, [2]), (3, [2, 0, 3]), (4, [2, 0, 3, 1])):
            got, expected = np.asarray(answer(distances.copy(), actions.copy(), k), float), weighted(rows)
            if got.shape != (2,):
                yield f"with k={k} it gives an array of shape {got.shape}, not (2,): one action."
            elif np.allclose(got, expected):
                continue
            elif np.allclose(got, weighted(rows, 1.0)):
                yield "the farther a neighbour, the more it counts: softmax is taken of MINUS the distances."
            elif np.allclose(got, weighted([0, 1, 2, 3])):
                yield f"with k={k} all demonstrated steps are averaged; only the k nearest may count."
            elif np.allclose(got, actions[rows].mean(axis=0)):
                yield "all k neighbours count the same; weight them by the softmax of minus their distances."
            elif np.allclose(got, np.exp(-distances[rows]) @ actions[rows]):
                yield "the weights do not sum to 1: divide by their sum, or the action shrinks."
            else:
                yield f"with k={k} the first number is {got[0]:.3f}, not {expected[0]:.3f}."

    return _judge("lookup", complaints, strict)


def action_ascent(answer: Callable, strict: bool = False) -> bool:
    """12: a sequence (horizon, act_dim) whose `executed` part climbed a value by plain gradient steps, clamped to [-1, 1] after each."""
    def complaints() -> Iterator[str]:
        goal = torch.tensor([[0.3, 1.4], [-0.2, 0.6]])
        start, executed = torch.linspace(-0.8, 0.6, 10).view(5, 2), slice(1, 3)

        def value(actions: torch.Tensor) -> torch.Tensor:
            return -(actions - goal).square().sum()

        def climbed(steps: int, sign: float = 1.0, clamp: str = "each") -> torch.Tensor:
            moved = start.clone()
            for _ in range(steps):
                moved[executed] += sign * 0.2 * -2 * (moved[executed] - goal)
                moved = moved.clamp(-1, 1) if clamp == "each" else moved
            return moved.clamp(-1, 1) if clamp == "last" else moved

        given = start.clone()
        got = torch.as_tensor(answer(value, given, executed, 3, 0.2)).detach()
        if got.shape != start.shape:
            yield f"it gives shape {tuple(got.shape)}, not {tuple(start.shape)}: the whole sequence, with its executed part moved."
        if not torch.equal(given, start):
            yield "it changes the sequence that it was given; work on a copy (clone)."
        if not torch.equal(got[[0, 3, 4]], start[[0, 3, 4]]):
            yield "actions outside the executed part moved: the critic knows nothing of them."
        if torch.allclose(got, start):
            yield "nothing moves: is the gradient taken for the executed part, and added?"
        if not torch.allclose(got, climbed(3), atol=1e-5):
            mistakes = ((climbed(3, sign=-1.0), "it goes down: add the gradient."),
                        (climbed(3, clamp="no"), "actions leave [-1, 1]: clamp them."),
                        (climbed(1), "that is one step; take all of them, each with a new gradient."))
            yield next((said for wrong, said in mistakes if torch.allclose(got, wrong, atol=1e-5)),
                       f"after 3 steps of 0.2 the first executed number is {float(got[1, 0]):.3f}, not {float(climbed(3)[1, 0]):.3f}.")

    return _judge("action_ascent", complaints, strict)


def ranking(answer: Callable, recorded: Mapping[str, float], strict: bool = False) -> bool:
    """13: the recipes of `recorded` (recipe -> mean success) in the order predicted, best first; pairs closer than 10 points are ties."""
    def complaints() -> Iterator[str]:
        got = list(answer())
        if sorted(got) != sorted(recorded):
            yield f"it must name each of {', '.join(recorded)} once, and gives {got}."
        if any(np.isnan(value) for value in recorded.values()):
            yield "nothing is recorded to hold it against: keep your prediction, and run the sweep that is named above."
        wrong = [(recorded[b] - recorded[a], a, b) for i, a in enumerate(got) for b in got[i + 1:] if recorded[b] - recorded[a] > 0.1]
        if wrong:
            gap, first, second = max(wrong)
            yield (f"{len(wrong)} of {len(got) * (len(got) - 1) // 2} pairs came out the other way round, most clearly {first} before "
                   f"{second}, by {100 * gap:.0f} points. Which of your reasons was wrong?")

    return _judge("ranking", complaints, strict)


def interquartile_mean(answer: Callable, strict: bool = False) -> bool:
    """16: the mean of the middle half of all numbers of a (runs x tasks) array."""
    def complaints() -> Iterator[str]:
        rng = np.random.default_rng(0)
        for shape in ((8, 1), (5, 1), (4, 3)):
            scores = rng.random(shape) ** 3
            got, expected = float(answer(scores.copy())), stats.iqm(scores)
            if abs(got - expected) < 1e-9:
                continue
            for other, what in ((scores.mean(), "it is the mean: a single run at 0 % moves it."),
                                (np.median(scores), "it is the median: that throws away all but one or two runs."),
                                (np.sort(scores, axis=0)[len(scores) // 4: len(scores) - len(scores) // 4].mean(),
                                 "it cuts each task by itself: sort all numbers together.")):
                if abs(got - other) < 1e-9:
                    yield what
            yield f"for {shape[0]} runs on {shape[1]} tasks it gives {got:.4f}, not {expected:.4f}; floor(n / 4) are cut at either side."

    return _judge("interquartile_mean", complaints, strict)


def object_mean(answer: Callable, strict: bool = False) -> bool:
    """14: mean success over objects, each counted once, from outcomes (N,) of episodes and the name of each one's object (N,)."""
    def complaints() -> Iterator[str]:
        cases = (([1, 1, 1, 0, 0], list("aaabb"), 0.5), ([1, 0, 0, 0, 1, 1], list("abbbbb"), 0.7), ([1, 0, 1], list("aab"), 0.75))
        for successes, objects, expected in cases:
            got = float(answer(np.array(successes, float), np.array(objects)))
            if abs(got - expected) < 1e-9:
                continue
            if abs(got - np.mean(successes)) < 1e-9:
                yield "it is the mean over episodes: an object that comes up more often counts more."
            yield f"for outcomes {successes} of objects {''.join(objects)} it gives {got:.3f}, not {expected:.3f}."

    return _judge("object_mean", complaints, strict)
