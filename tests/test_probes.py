"""Learning is tested: each probe fails when one component is wrong (wrong sign, missing bootstrap, missing sum, closed gate)."""
import numpy as np
import pytest
import torch

from pdkit.decorator import DecoratorConfig
from pdkit.evaluate import evaluate
from pdkit.online import Trainer
from pdkit.online_config import OnlineConfig
from pdkit.probes import PROBES, biased_base, zero_base
from pdkit.rl.sac import SACConfig
from pdkit.seeds import reported_seeds

SMALL = SACConfig(hidden=32, layers=2, actor_lr=3e-3, critic_lr=3e-3, tau=0.05, average=0.95, bf16=False, init_temperature=0.01,
                  actor_every=1, residual_penalty=0.0)


def train(name, base, decorator=None, sac=SMALL, **changes):
    values = dict(task=name, total_steps=2000, num_envs=4, env_workers=0, warmup_steps=200, warmup="uniform", utd=0.5, batch=64,
                  demo_fraction=0.0, n_step=1, on_success="terminate", success_tail=0, gamma=0.9, eval_every=0, log_every=0,
                  checkpoint_every=0, normalize_obs=False)
    config = OnlineConfig(**(values | changes), sac=sac, decorator=decorator or DecoratorConfig(alpha=1.0, H=0))
    trainer = Trainer(config, base, spec=PROBES[name])
    return trainer, trainer.train()


def success(name, policy):
    return evaluate(PROBES[name], policy.act, reported_seeds(100), window=policy.window, num_envs=20).success_once.mean()


@pytest.mark.parametrize(("bootstrap", "expected"), [("truncated", -10.0), ("always", -10.0), ("never", -1 / (1 - 0.9 * 0.8))])
def test_wait_values_follow_the_bootstrap_rule(bootstrap, expected):
    """-1 a step for ever is -1 / (1 - 0.9) when time limits bootstrap; when they stop, the mean over 5 positions that look
    alike solves q = -1 + 0.9 * 0.8 q, that is -1 / 0.28 = -3.6 with uniform sampling of one-step transitions."""
    sac = SACConfig(hidden=32, layers=2, critic_lr=3e-3, tau=0.1, bf16=False, autotune=False, init_temperature=1e-6)
    trainer, _ = train("wait", zero_base(PROBES["wait"]), sac=sac, utd=1.0, bootstrap=bootstrap)
    value = trainer.agent.critics(torch.tensor([[1.0, 0.0]])).mean().item()
    assert value == pytest.approx(expected, rel=0.1)


def test_lever_is_pulled_the_right_way():
    _, policy = train("lever", zero_base(PROBES["lever"]), total_steps=1200)
    assert success("lever", policy) == 1.0


@pytest.mark.parametrize("n_step", [1, 3])
def test_corridor_values_are_discounted_distances(n_step):
    trainer, policy = train("corridor", zero_base(PROBES["corridor"]), total_steps=2500, n_step=n_step)
    assert success("corridor", policy) == 1.0
    right = torch.tensor([[0.0, 1.0], [0.25, 1.0], [0.5, 1.0], [0.75, 1.0]])
    values = trainer.agent.critics(right).min(0).values.detach().numpy()
    assert (np.diff(values) > 0.5).all()  # nearer is better
    assert values[-1] > -1.0  # the solving step earns 1 - 1 = 0 and stops
    assert values[0] == pytest.approx(-1 - 0.9 - 0.81, abs=0.6)  # three steps at -1 before it


@pytest.mark.parametrize("critic_input", ["sum", "concat", "residual"])
def test_reach_needs_the_decorator(critic_input):
    base = biased_base()
    before = evaluate(PROBES["reach"], base.act, reported_seeds(100), num_envs=20).success_once.mean()
    decorator = DecoratorConfig(alpha=0.8, H=1000, critic_input=critic_input)
    _, policy = train("reach", base, decorator, total_steps=3000, warmup_steps=500, n_step=3)
    after = success("reach", policy)
    assert before < 0.35
    assert after > 0.9


def test_a_bound_smaller_than_the_error_cannot_close_it():
    """The bound is real: with alpha 0.05 the same training must not solve what needs 0.5."""
    _, policy = train("reach", biased_base(), DecoratorConfig(alpha=0.05, H=1000), total_steps=2000, n_step=3)
    assert success("reach", policy) < 0.6


def test_plain_sac_reaches_without_a_base():
    _, policy = train("reach", zero_base(PROBES["reach"]), total_steps=5000, n_step=3, warmup_steps=1000)
    assert success("reach", policy) > 0.9
