"""Which seed is used for what. No policy is chosen on the episodes that are reported: no other range meets theirs. (Variants of Door's
recipe once were, a run each of training seed 0: data/results/recipe_search.csv.)"""
from __future__ import annotations

from contextlib import AbstractContextManager

import numpy as np

TEST = 1_000_000  # + i: the episodes of every reported comparison
SELECT = 2_000_000  # + i: choosing a checkpoint
TRAIN = 10_000_000  # and above: online training
DEMOS = 0  # + i: scripted experts (below 1,000,000)
ROLLOUT = 3_000_000  # + i: episodes recorded from agents, the kit's Adroit demonstrations among them


def reported_seeds(num: int) -> list[int]:
    """Of the first `num` test episodes: the same ones for every policy, so that two are compared episode by episode."""
    return list(range(TEST, TEST + num))


def selection_seeds(num: int) -> list[int]:
    """Of the first `num` episodes on which checkpoints are chosen."""
    return list(range(SELECT, SELECT + num))


def rollout_seeds(num: int) -> list[int]:
    """Of the first `num` episodes that are recorded from an agent."""
    return list(range(ROLLOUT, ROLLOUT + num))


def own_random_numbers() -> AbstractContextManager:
    """Within this block torch's global generators, the GPUs' too where they are in use already, may be seeded and drawn from; afterwards
    they go on as if it had not been: policies draw while they act, and training draws from the same generators."""
    import torch

    return torch.random.fork_rng(devices=range(torch.cuda.device_count()) if torch.cuda.is_initialized() else [])


def training_seed(run_seed: int, lane: int, episode: int) -> int:
    """The seed of one training episode, well spread over [10^7, 2^31)."""
    word = np.random.SeedSequence([run_seed, lane, episode]).generate_state(1)[0]
    return TRAIN + int(word) % (2**31 - TRAIN)
