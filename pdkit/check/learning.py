"""Exercises about learning online, and why it fails (notebooks 05 to 12)."""
from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from .judge import judge


def gate(answer: Callable, strict: bool = False) -> bool:
    """05: each environment's row kept with probability min(step / H, 1), else zero."""
    def complaints() -> Iterator[str]:
        residual = np.random.default_rng(1).uniform(-1, 1, (4000, 3)).astype(np.float32)
        rng = np.random.default_rng(0)
        out = np.asarray(answer(residual.copy(), 250, 1000, rng))
        if out.shape != residual.shape:
            yield f"it gives an array of shape {out.shape}, not {residual.shape}."
        on = out != 0
        if (on.any(axis=1) != on.all(axis=1)).any():
            yield "it switches single dimensions; a row is kept or zeroed as a whole."
        if not np.array_equal(out[on], residual[on]):
            yield "it scales or replaces the residuals; the gate only keeps them or sets them to zero."
        share = float(on[:, 0].mean())
        if share in (0.0, 1.0):
            yield "it switches all environments together; draw one number for each of them."
        if abs(share - 0.75) < 0.03:
            yield "at a quarter of H three quarters are on: the chance to be ON is step / H."
        if abs(share - 0.25) > 0.03:
            yield f"at a quarter of H a share of {share:.2f} is on, not 0.25."
        later, other = (np.asarray(answer(residual.copy(), 250, 1000, draws)) != 0 for draws in (rng, np.random.default_rng(2)))
        if np.array_equal(later, on) or np.array_equal(other, on):
            yield "it keeps the same environments at each call; draw from rng, which goes on from call to call."
        if (np.asarray(answer(residual.copy(), 5000, 1000, np.random.default_rng(0))) == 0).any():
            yield "beyond H something is still off; the probability stops at 1."
        with np.errstate(divide="ignore", invalid="ignore"):
            always = np.asarray(answer(residual.copy(), 0, 0, np.random.default_rng(0)))
        if not np.array_equal(always, residual):
            yield "with H = 0 the gate is always open, from step 0 on."

    return judge("gate", complaints, strict)


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
        first[2] = second[4] = 0
        got = np.asarray(answer(first, second))
        for row, where in ((2, "first"), (4, "second")):
            if got[row] != 0:
                yield f"for a row of zeros in {where} it gives {got[row]}, not 0."
            expected[row] = 0
        if not np.allclose(got, expected):
            yield "a row of zeros changes what the other rows give."

    return judge("cosines", complaints, strict)


def temperature_step(answer: Callable, strict: bool = False) -> bool:
    """07: log temperature after one step of plain gradient descent on log_temperature * (entropy - target)."""
    def complaints() -> Iterator[str]:
        for log_temperature, entropy, target in ((0.0, -40.0, -28.0), (-4.6, 3.0, -28.0)):
            got = float(answer(log_temperature, entropy, target, 1e-3))
            expected = log_temperature - 1e-3 * (entropy - target)
            if abs(got - expected) < 1e-5:
                continue
            if abs(got - (log_temperature + 1e-3 * (entropy - target))) < 1e-5:
                yield "the sign is wrong: an actor that is too sure of itself must be paid more for entropy, not less."
            elif abs(got - (log_temperature - 1e-3 * log_temperature * (entropy - target))) < 1e-5:
                yield "the gradient of x * c is c, not x * c."
            elif abs(got - (log_temperature - 1e-3 * (entropy + target))) < 1e-5:
                yield "the target is negative already: subtract it."
            else:
                yield f"from {log_temperature:g} with entropy {entropy:g} it gives {got:.4f}, not {expected:.4f}."

    return judge("temperature_step", complaints, strict)


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

    return judge("actors_value", complaints, strict)


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
        low = float(answer(data - 900, random - 900, policy - 900, log_pi, returns - 900, d))
        if not abs(low - term()) < 0.01:  # in float32, too, where numbers near 900 have four decimals
            yield (f"with all values and returns 900 lower it gives {low:.4f}, not {term():.4f} as before: take the largest out before the "
                   "exponential (np.logaddexp.reduce does).")

    return judge("conservative", complaints, strict)


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

    return judge("corridor_values", complaints, strict)


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

    return judge("lookup", complaints, strict)


def action_ascent(answer: Callable, strict: bool = False) -> bool:
    """12: a sequence (horizon, act_dim) whose `executed` part climbed a value by plain gradient steps, clamped to [-1, 1] after each."""
    def complaints() -> Iterator[str]:
        goal = torch.tensor([[0.3, 1.4], [-0.2, 0.6]])
        start, executed, count = torch.linspace(-0.8, 0.6, 10).view(5, 2), slice(1, 3), 5

        def value(actions: torch.Tensor) -> torch.Tensor:
            return -(actions - goal).square().sum() + actions.prod(dim=1).sum()  # one number's way depends on where the other is

        def climbed(steps: int, sign: float = 1.0, clamp: str = "each") -> torch.Tensor:
            moved = start.clone()
            for _ in range(steps):
                moved[executed] += sign * 0.2 * (-2 * (moved[executed] - goal) + moved[executed].flip(1))
                moved = moved.clamp(-1, 1) if clamp == "each" else moved
            return moved.clamp(-1, 1) if clamp == "last" else moved

        given = start.clone()
        got = torch.as_tensor(answer(value, given, executed, count, 0.2)).detach()
        if got.shape != start.shape:
            yield f"it gives shape {tuple(got.shape)}, not {tuple(start.shape)}: the whole sequence, with its executed part moved."
        if not torch.equal(given, start):
            yield "it changes the sequence that it was given; work on a copy (clone)."
        if not torch.equal(got[[0, 3, 4]], start[[0, 3, 4]]):
            yield "actions outside the executed part moved: the critic knows nothing of them."
        if torch.allclose(got, start):
            yield "nothing moves: is the gradient taken for the executed part, and added?"
        if not torch.allclose(got, climbed(count), atol=1e-5):
            mistakes = ((climbed(count, sign=-1.0), "it goes down: add the gradient."),
                        (climbed(count, clamp="no"), "actions leave [-1, 1]: clamp them."),
                        (climbed(count, clamp="last"), "it clamps at the end alone: in between the critic judges actions outside [-1, 1]."),
                        (climbed(1), "that is one step; take all of them, each with a new gradient."))
            first, right = float(got[1, 0]), float(climbed(count)[1, 0])
            yield next((said for wrong, said in mistakes if torch.allclose(got, wrong, atol=1e-5)),
                       f"after {count} steps of 0.2 the first executed number is {first:.3f}, not {right:.3f}.")

    return judge("action_ascent", complaints, strict)
