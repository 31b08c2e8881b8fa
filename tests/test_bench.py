"""The benchmark's arithmetic, and that its reference computes the same update as the shipped path."""
import time

import numpy as np
import pytest
import torch

from pdkit.bench import EagerSAC, paired, updater
from pdkit.decorator import DecoratorConfig
from pdkit.rl.sac import SAC, SACConfig


def test_ratios_are_those_of_the_work_done():
    def work(milliseconds):
        def one():
            time.sleep(milliseconds / 1000)
            return 1
        return one

    result = paired(work(2), work(8), seconds=0.05, rounds=3)
    assert 1.5 < result["ratio"] < 8 and result["ratio_min"] <= result["ratio"] <= result["ratio_max"]
    assert result["first_per_s"] > result["second_per_s"]


def test_the_eager_reference_and_the_shipped_path_make_the_same_update():
    config = SACConfig(hidden=32, bf16=False, residual_penalty=0.0, actor_every=1, average=0.99)
    agents = []
    for kind in (SAC, EagerSAC):
        torch.manual_seed(0)
        agents.append(kind(39, 28, config, DecoratorConfig()))
        torch.manual_seed(1)  # the same random transitions
        updater(agents[-1], 64, "cpu")()
    for part in ("actor", "critics", "targets"):
        ours, theirs = (torch.nn.utils.parameters_to_vector(getattr(agent, part).parameters()) for agent in agents)
        assert torch.allclose(ours, theirs, atol=2e-5), part
    assert agents[0].log_temperature.item() == pytest.approx(agents[1].log_temperature.item(), abs=1e-5)
    assert np.isfinite(agents[0].log_temperature.item())
