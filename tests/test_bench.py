"""The benchmark's arithmetic, and that its reference computes the same update as the shipped path."""
import time

import numpy as np
import pytest
import torch

from pdkit import bench
from pdkit.bench import EagerSAC, imitator, main, paired, updater
from pdkit.decorator import DecoratorConfig
from pdkit.demos.sources import bundled
from pdkit.errors import PdkitError
from pdkit.files import read_json
from pdkit.gradient_steps import gradient_step, make_optimizer
from pdkit.imitate import ImitateConfig, Windows
from pdkit.policies import MLP
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


def test_imitation_is_timed_with_the_same_gradient_step_on_both_sides():
    demos, batch = bundled("StackCube").first(10), 32
    ends = []
    for one_kernel in (True, False):
        torch.manual_seed(0)
        policy = MLP(dict(obs_dim=55, act_dim=4, hidden=16)).train()
        policy.fit_statistics(demos.observations, demos.actions)
        groups = policy.parameter_groups(0.0)
        optimizer = make_optimizer(policy, ImitateConfig(weight_decay=0.0)) if one_kernel else \
            torch.optim.AdamW(groups, lr=ImitateConfig().lr, foreach=False)
        windows = Windows(demos, 1, True)
        before = torch.nn.utils.parameters_to_vector(policy.parameters()).detach().clone()
        gradient_step(policy.loss, optimizer, "cpu", False, *windows.sample(batch, torch.Generator().manual_seed(1)))
        ends.append(torch.nn.utils.parameters_to_vector(policy.parameters()).detach())
        assert not torch.equal(ends[-1], before)
    assert torch.allclose(*ends, atol=1e-6)
    for shipped in (True, False):
        assert imitator("mlp", demos, batch, "cpu", shipped)() == 1


def test_parts_of_the_benchmark_can_be_measured_alone(tmp_path, capsys):
    path = tmp_path / "it.json"
    assert main(["--only", "base", "--quick", "--device", "cpu", "--json", str(path)]) == 0
    assert list(read_json(path)["results"]) == ["base policy, BeT / MLP, 8 environments (decisions/s)"]
    with pytest.raises(PdkitError, match="invalid choice: 'nothing'"):
        main(["--only", "nothing"])


def test_pictures_are_timed_where_they_can_be_drawn_and_what_cannot_is_said(monkeypatch, capsys):
    monkeypatch.setattr(bench, "TASKS", {"some": ("Door", "StackCube")})
    monkeypatch.setattr(bench, "why_not", lambda task: None if task == "Door" else "There is no driver.")

    class Seen:
        """Draws nothing, at half the speed."""

        def __init__(self, spec):
            self._sims = spec.make(), spec.make()

        def reset(self, seed):
            return [sim.reset(seed) for sim in self._sims]

        def step(self, action):
            return [sim.step(action) for sim in self._sims]

        def close(self):
            for sim in self._sims:
                sim.close()

    monkeypatch.setattr(bench, "PixelSim", Seen)
    (name, values), = bench.bench_pictures(0.05).items()
    assert name.startswith("Door: simulated and drawn (") and 0.2 < values["ratio"] < 0.9
    assert "StackCube is not measured. There is no driver." in capsys.readouterr().out
