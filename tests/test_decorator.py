"""The decorator, line by line (facts.md 1.1)."""
from dataclasses import replace

import numpy as np
import pytest
import torch

from pdkit.decorator import DecoratorConfig, actor_features, compose, critic_features, gate, gate_probability
from pdkit.errors import PdkitError

OBS = torch.tensor([[1.0, 2.0, 3.0]])
BASE = torch.tensor([[0.5, -0.5]])
RESIDUAL = torch.tensor([[1.0, -1.0]])


def test_executed_action_is_base_plus_alpha_times_residual_and_is_not_clipped():
    action = compose(DecoratorConfig(alpha=0.6), BASE, RESIDUAL)
    assert torch.allclose(action, torch.tensor([[1.1, -1.1]]))


def test_alpha_can_differ_between_action_dimensions():
    config = DecoratorConfig(alpha=0.1, alpha_scale=(1.0, 8.0))
    assert config.mean_bound == pytest.approx(0.45) and DecoratorConfig(alpha=0.1).mean_bound == 0.1
    assert torch.allclose(compose(config, BASE, RESIDUAL), torch.tensor([[0.6, -1.3]]))
    assert np.allclose(compose(config, BASE.numpy(), RESIDUAL.numpy()), [[0.6, -1.3]])
    assert torch.allclose(critic_features(config, OBS, BASE, RESIDUAL), torch.tensor([[1, 2, 3, 0.6, -1.3]]))
    with pytest.raises(PdkitError, match="3 factors; the action has 2"):
        compose(DecoratorConfig(alpha_scale=(1.0, 1.0, 1.0)), BASE, RESIDUAL)


@pytest.mark.parametrize(("kind", "expected"), [
    ("sum", [1, 2, 3, 0.7, -0.7]),
    ("concat", [1, 2, 3, 0.5, -0.5, 0.2, -0.2]),
    ("residual", [1, 2, 3, 0.2, -0.2]),
])
def test_critic_inputs(kind, expected):
    config = DecoratorConfig(alpha=0.2, critic_input=kind)
    features = critic_features(config, OBS, BASE, RESIDUAL)
    assert torch.allclose(features, torch.tensor([expected], dtype=torch.float32))
    assert features.shape[1] == config.critic_dim(3, 2)
    official = critic_features(replace(config, residual_units="bound"), OBS, BASE, RESIDUAL)  # what stands by itself is not scaled
    assert torch.allclose(official, features if kind == "sum" else torch.cat([features[:, :-2], RESIDUAL], dim=1))


@pytest.mark.parametrize(("kind", "expected"), [("obs", [1, 2, 3]), ("obs+base", [1, 2, 3, 0.5, -0.5])])
def test_actor_inputs(kind, expected):
    config = DecoratorConfig(actor_input=kind)
    features = actor_features(config, OBS, BASE)
    assert features.tolist() == [expected]
    assert features.shape[1] == config.actor_dim(3, 2)


def test_gate_opens_linearly_to_one_at_H():
    config = DecoratorConfig(H=1000)
    assert [gate_probability(config, t) for t in (0, 250, 1000, 5000)] == [0.0, 0.25, 1.0, 1.0]
    assert gate_probability(DecoratorConfig(H=0), 0) == 1.0


def test_gate_is_drawn_per_environment_and_decision_and_stores_exact_zeros():
    config, rng = DecoratorConfig(H=1000), np.random.default_rng(0)
    residual = np.full((400, 3), 0.7, np.float32)
    first, second = gate(config, residual, 300, rng), gate(config, residual, 300, rng)
    on = first[:, 0] != 0
    assert 0.2 < on.mean() < 0.4  # some environments on, others off, at the same step
    assert ((first == 0) | (first == residual)).all()
    assert (on[:, None] == (first != 0)).all()  # a whole action is on or off
    assert (on != (second[:, 0] != 0)).any()  # and it is drawn afresh at the next decision
    assert (gate(config, residual, 0, rng) == 0).all()
    assert (gate(config, residual, 1000, rng) == residual).all()


@pytest.mark.parametrize("bad", [dict(alpha=0.0), dict(alpha=1.5), dict(alpha=-0.1), dict(H=-1), dict(critic_input="both"),
                                 dict(alpha_scale=(-1.0,)), dict(actor_input="x"), dict(residual_units="m")])
def test_bad_values_are_told_in_one_sentence(bad):
    with pytest.raises(PdkitError) as error:
        DecoratorConfig(**bad)
    assert "\n" not in str(error.value)
