"""Exercises about results and what they say (notebooks 13, 14, 16)."""
from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from .. import stats
from .judge import judge


def ranking(answer: Callable, recorded: Mapping[str, float], strict: bool = False) -> bool:
    """13: the recipes of `recorded` (recipe -> mean success) in the order predicted, best first; those in a list of their own are
    predicted to end alike, each within 10 points of the next. A complete prediction is a solution; how it came out is told beside it."""
    groups: list[list[str]] = []

    def complaints() -> Iterator[str]:
        if not recorded:
            yield "nothing is recorded here that could be ranked."
            return
        groups.extend([entry] if isinstance(entry, str) else list(entry) for entry in answer())
        got = [name for group in groups for name in group]
        if sorted(got) != sorted(recorded):
            yield f"it must name each of {', '.join(recorded)} once, and gives {got}."

    def came_out() -> Iterator[str]:
        if any(np.isnan(value) for value in recorded.values()):
            yield "nothing is recorded to hold it against: keep your prediction, and run the sweep that is named above."
            return
        pairs = [(a, b) for i, group in enumerate(groups) for other in groups[i + 1:] for a in group for b in other]
        wrong = [(recorded[b] - recorded[a], a, b) for a, b in pairs if recorded[b] - recorded[a] > 0.1]
        if wrong:
            gap, first, second = max(wrong)
            yield (f"{len(wrong)} of {len(pairs)} pairs came out the other way round, most clearly {first} before "
                   f"{second}, by {100 * gap:.0f} points. Which of your reasons was wrong?")
        for group in groups:
            for worse, better in itertools.pairwise(sorted(group, key=recorded.__getitem__)):
                if (gap := recorded[better] - recorded[worse]) > 0.1:
                    yield f"{better} and {worse} do not end alike: {100 * gap:.0f} points lie between them."
        for first, second in pairs:
            if recorded[first] - recorded[second] <= 0.1:
                yield (f"{first} and {second} end within 10 points of each other: put them into one list. Which of your reasons made you "
                       "expect more?")

    if not judge("ranking", complaints, strict):
        return False
    print(f"  held against the records: {next(came_out(), 'it came out as you predicted.')}")
    return True


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

    return judge("object_mean", complaints, strict)


def interquartile_mean(answer: Callable, strict: bool = False) -> bool:
    """16: the mean of the middle half of all numbers of a (runs x tasks) array."""
    def complaints() -> Iterator[str]:
        rng = np.random.default_rng(0)
        for shape in ((8, 1), (5, 1), (4, 3), (5, 2), (3, 1)):  # 3 seeds, and 5 on two tasks, are the kit's own sizes
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

    return judge("interquartile_mean", complaints, strict)
