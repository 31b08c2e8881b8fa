"""SAC's targets and losses against numbers computed by hand: a wrong sign, a missing bootstrap or a detached term fails."""
import copy
import math
import pickle

import numpy as np
import pytest
import torch

from pdkit.decorator import DecoratorConfig
from pdkit.errors import PdkitError
from pdkit.machine import cpu_has_bf16
from pdkit.rl.networks import Actor, Critics
from pdkit.rl.replay import NStep, Replay
from pdkit.rl.sac import SAC, SACConfig


def make(decorator=None, **changes):
    torch.manual_seed(0)
    values = dict(hidden=16, bf16=False, actor_every=1, residual_penalty=0.0) | changes
    return SAC(3, 2, SACConfig(**values), decorator or DecoratorConfig(alpha=0.3))


def batch(count=8, discount=0.9):
    g = torch.Generator().manual_seed(1)
    r = lambda *shape: torch.randn(shape, generator=g)  # noqa: E731
    return dict(obs=r(count, 3), residual=r(count, 2).tanh(), base=r(count, 2).tanh(), reward=r(count), next_obs=r(count, 3),
                next_base=r(count, 2).tanh(), discount=torch.full((count,), discount))


def test_log_probability_is_that_of_the_tanh_gaussian():
    torch.manual_seed(0)
    actor = Actor(3, 2, 16, 2, False, (-5.0, 2.0))
    x, noise = torch.randn(4, 3), torch.randn(4, 2)
    action, log_prob = actor.sample(x, noise)
    mean, log_std = actor.heads(x)
    transforms = [torch.distributions.TanhTransform(cache_size=1)]
    reference = torch.distributions.TransformedDistribution(torch.distributions.Normal(mean, log_std.exp()), transforms)
    assert torch.allclose(log_prob, reference.log_prob(action).sum(-1), atol=1e-4)
    assert torch.allclose(actor.mean_action(x), torch.tanh(mean))


def test_initial_residual_is_near_zero_and_its_spread_follows_the_log_std_range():
    x = torch.randn(64, 3)
    for low, expected in ((-20.0, -9.0), (-5.0, -1.5)):
        mean, log_std = Actor(3, 2, 256, 3, False, (low, 2.0)).heads(x)
        assert mean.abs().max() < 0.05
        assert (log_std - expected).abs().max() < 0.4


def test_target_uses_reward_discount_minimum_and_entropy():
    agent, data = make(init_temperature=0.5), batch()
    noise, temperature = torch.randn(8, 2), torch.tensor(0.5)
    for p in agent.targets.parameters():  # targets of their own, so that using the wrong network shows
        p.data.add_(0.1 * torch.randn_like(p))
    y = agent.td_target(data, data["next_obs"], noise, temperature)
    residual, log_pi = agent.actor.sample(data["next_obs"], noise)
    values = agent.targets(torch.cat([data["next_obs"], data["next_base"] + 0.3 * residual], -1))
    assert torch.allclose(y, data["reward"] + 0.9 * (values.min(0).values - 0.5 * log_pi), atol=1e-5)
    assert not y.requires_grad
    without = make(init_temperature=0.5, entropy_backup=False)
    without.targets.load_state_dict(agent.targets.state_dict())
    y = without.td_target(data, data["next_obs"], noise, temperature)
    assert torch.allclose(y, data["reward"] + 0.9 * values.min(0).values, atol=1e-5)


def test_of_many_critics_the_target_takes_the_least_of_those_drawn():
    """RLPD: two of ten, drawn for each update (facts.md 3.2)."""
    agent, data, noise = make(num_critics=5, target_subset=2, entropy_backup=False), batch(), torch.randn(8, 2)
    for p in agent.targets.parameters():
        p.data.add_(0.3 * torch.randn_like(p))
    residual, _ = agent.actor.sample(data["next_obs"], noise)
    values = agent.targets(torch.cat([data["next_obs"], data["next_base"] + 0.3 * residual], -1))
    for members in ([0, 3], [4, 1]):
        y = agent.td_target(data, data["next_obs"], noise, torch.tensor(0.5), members)
        assert torch.allclose(y, data["reward"] + 0.9 * torch.minimum(*values[members]), atol=1e-5)
        assert (y > data["reward"] + 0.9 * values.min(0).values + 1e-3).any()  # not the least of all
    computed = []
    for member in agent.targets.members:
        member[0].register_forward_hook(lambda *_: computed.append(1))
    agent.td_target(data, data["next_obs"], noise, torch.tensor(0.5), [0, 3])
    assert len(computed) == 2  # the others would cost as much, and nobody asks for their values
    drawn, target = [], agent.td_target
    agent.td_target = lambda *given: drawn.append(tuple(sorted(given[-1]))) or target(*given)
    g = torch.Generator().manual_seed(0)
    for _ in range(40):
        agent.update(data, g)
    assert {len(set(members)) for members in drawn} == {2} and len(set(drawn)) >= 8  # of ten pairs


def test_target_is_the_reward_alone_where_discount_is_zero():
    agent, data = make(), batch(discount=0.0)
    assert torch.allclose(agent.td_target(data, data["next_obs"], torch.randn(8, 2), torch.tensor(1.0)), data["reward"])


def test_critic_learns_the_target_of_the_executed_action():
    agent, data = make(critic_lr=3e-3), batch(64, discount=0.0)
    g = torch.Generator().manual_seed(0)
    losses = [float(agent.update(data, g)["critic_loss"]) for _ in range(300)]
    assert losses[-1] < 0.1 * losses[0]


def test_actor_climbs_the_critic_through_the_residual_alone():
    """Q = first component of the executed action: the residual's first component must go to +1, whatever the base does."""
    agent = make(actor_lr=3e-3, init_temperature=1e-4, autotune=False)
    agent.critics.forward = lambda x: x[None, :, 3].expand(2, -1)
    data = batch(64)
    g = torch.Generator().manual_seed(0)
    for _ in range(150):
        agent._update_actor(data, data["obs"], torch.randn((64, 2), generator=g), torch.tensor(1e-4))
    residual = agent.actor.mean_action(data["obs"])
    assert residual[:, 0].min() > 0.8
    assert residual[:, 1].abs().mean() < 0.5


def test_actor_loss_against_numbers_computed_by_hand():
    agent, data = make(residual_penalty=0.3), batch()
    noise, temperature = torch.randn(8, 2), torch.tensor(0.5)
    with torch.no_grad():
        residual, log_pi = agent.actor.sample(data["obs"], noise)
        value = agent.critics(torch.cat([data["obs"], data["base"] + 0.3 * residual], -1)).min(0).values
        expected = (0.5 * log_pi - value).mean() + 0.3 * residual.square().mean()
    assert torch.allclose(agent._update_actor(data, data["obs"], noise, temperature)["actor_loss"], expected, atol=1e-5)


def test_target_entropy_is_minus_the_number_of_action_dimensions():
    assert make().target_entropy == -2 and make(target_entropy_scale=0.5).target_entropy == -1


def test_actor_takes_the_minimum_of_the_critics():
    agent = make(actor_lr=3e-3, autotune=False)
    # The minimum of a and -a/2 is highest at a = 0; following only the first critic (or their mean or maximum) runs to +1.
    agent.critics.forward = lambda x: torch.stack([x[:, 3], -x[:, 3] / 2])
    data = batch(64) | {"base": torch.zeros(64, 2)}
    g = torch.Generator().manual_seed(0)
    for _ in range(300):
        agent._update_actor(data, data["obs"], 0.01 * torch.randn((64, 2), generator=g), torch.tensor(0.0))
    assert agent.actor.mean_action(data["obs"])[:, 0].abs().max() < 0.3


def test_the_actor_may_climb_the_mean_of_the_critics():
    """RLPD's: where the least of two is highest at 0, their mean is highest at +1."""
    agent = make(actor_lr=3e-3, autotune=False, actor_value="mean")
    agent.critics.forward = lambda x: torch.stack([x[:, 3], -x[:, 3] / 2])
    data = batch(64) | {"base": torch.zeros(64, 2)}
    g = torch.Generator().manual_seed(0)
    for _ in range(300):
        agent._update_actor(data, data["obs"], 0.01 * torch.randn((64, 2), generator=g), torch.tensor(0.0))
    assert agent.actor.mean_action(data["obs"])[:, 0].min() > 0.8


def test_the_penalty_pulls_residuals_towards_zero_and_only_as_far_as_the_critic_lets_it():
    """Q = a_1 - penalty * mean a_res^2 over two dimensions has its top where alpha = penalty * a_res_1, at 0.3 / 0.6."""
    agent = make(actor_lr=3e-3, autotune=False, residual_penalty=0.6)
    agent.critics.forward = lambda x: x[None, :, 3].expand(2, -1)
    data, g = batch(64), torch.Generator().manual_seed(0)
    for _ in range(300):
        agent._update_actor(data, data["obs"], 0.01 * torch.randn((64, 2), generator=g), torch.tensor(0.0))
    residual = agent.actor.mean_action(data["obs"]).detach()
    assert residual[:, 0].mean() == pytest.approx(0.5, abs=0.1) and residual[:, 1].abs().mean() < 0.1


def test_the_actor_is_updated_every_so_many_critic_updates():
    agent, data, g = make(actor_every=3), batch(), torch.Generator().manual_seed(0)
    moved = []
    for _ in range(6):
        before = agent.actor.head.bias.clone()
        agent.update(data, g)
        moved.append(not torch.equal(before, agent.actor.head.bias))
    assert moved == [True, False, False, True, False, False]


def test_temperature_rises_when_entropy_is_below_target_and_falls_above():
    for scale, rises in ((-10.0, True), (10.0, False)):  # target entropy = -scale * 2
        agent, data = make(target_entropy_scale=scale, init_temperature=0.1, critic_lr=1e-2), batch()
        g = torch.Generator().manual_seed(0)
        for _ in range(5):
            agent.update(data, g)
        assert (agent.log_temperature.item() > math.log(0.1)) == rises


def test_targets_move_by_tau_and_are_not_trained():
    agent, data = make(tau=0.25), batch()
    before = [p.clone() for p in agent.targets.parameters()]
    agent.update(data, torch.Generator().manual_seed(0))
    for old, new, source in zip(before, agent.targets.parameters(), agent.critics.parameters(), strict=True):
        assert torch.allclose(new, old + 0.25 * (source - old), atol=1e-6)
    assert all(not p.requires_grad for p in agent.targets.parameters())
    assert all(p.requires_grad for p in agent.critics.parameters())


def test_gradient_norms_are_clipped_separately():
    agent, data = make(grad_clip=1e-3, critic_lr=1e-3), batch()
    agent.update(data, torch.Generator().manual_seed(0))
    for part in (*agent.critics.members, agent.actor):
        norm = torch.stack([p.grad.norm() for p in part.parameters() if p.grad is not None]).norm()
        assert norm == pytest.approx(1e-3, rel=0.02)


def test_averaged_actor_follows_and_is_what_evaluation_uses():
    agent, data = make(average=0.9, actor_lr=1e-2), batch()
    g = torch.Generator().manual_seed(0)
    for _ in range(30):
        agent.update(data, g)
    zeros = torch.zeros(8, 2)
    assert torch.allclose(agent.act(data["obs"], zeros), agent.average.mean_action(data["obs"]))
    assert not torch.allclose(agent.average.mean_action(data["obs"]), agent.actor.mean_action(data["obs"]))


def iterates(agent, count, update):
    """The actor's parameters, flat, after each of `count` updates in which it moved, and those of its average then."""
    flat = lambda module: torch.cat([p.detach().flatten().clone() for p in module.parameters()])  # noqa: E731
    seen = []
    for _ in range(count):
        before = flat(agent.actor)
        update()
        if not torch.equal(before, flat(agent.actor)):
            seen.append(flat(agent.actor))
    return torch.stack(seen), flat(agent.average)


@pytest.mark.parametrize("changes", [{}, {"critic_warmup": 40}, {"actor_every": 2, "critic_warmup": 41}])
def test_the_average_is_at_first_the_plain_mean_of_where_the_actors_steps_led(changes):
    """Updates in which the actor waits count for nothing: else the start would have a vote for each of them."""
    agent, data, g = make(actor_lr=1e-2, **changes), batch(), torch.Generator().manual_seed(0)
    steps, average = iterates(agent, 80, lambda: agent.update(data, g))
    assert len(steps) == agent.actor_steps == {0: 80, 40: 40, 41: 19}[agent.config.critic_warmup]
    assert torch.allclose(average, steps.mean(dim=0), atol=1e-5)
    again = make(actor_lr=1e-2, **changes)
    again.load(agent.state())
    assert again.actor_steps == agent.actor_steps


def test_xavier_starts_every_layer_of_its_own_networks_anew():
    """PushChair in the paper profile: the last layers are then not near zero."""
    usual, xavier = make(), make(xavier_init=True)
    for of in (lambda agent: agent.actor.head.weight, lambda agent: agent.critics.members[0][-1].weight):
        assert of(usual).abs().max() < 0.02 < 0.1 < of(xavier).abs().max() <= math.sqrt(6 / 17) + 1e-6
    assert all(torch.equal(p, q) for p, q in zip(xavier.critics.parameters(), xavier.targets.parameters(), strict=True))
    biases = [layer.bias for part in (xavier.actor, xavier.critics) for layer in part.modules() if isinstance(layer, torch.nn.Linear)]
    assert len(biases) > 4 and not any(bias.any() for bias in biases)
    given = Actor(3, 2, 16, 2, False, (-5.0, 2.0))
    before = given.head.weight.clone()
    SAC(3, 2, SACConfig(xavier_init=True), DecoratorConfig(), actor=given)
    assert torch.equal(given.head.weight, before)


def test_ensemble_members_are_independent():
    critics = Critics(4, 8, 2, 3, True)
    values = critics(torch.randn(5, 4))
    assert values.shape == (3, 5)
    assert not torch.allclose(values[0], values[1])


def test_values_a_residual_apart_differ_in_bfloat16_too():
    """A value of -25 has neighbours 0.125 away there."""
    torch.manual_seed(0)
    critics = Critics(6, 64, 2, 2, layer_norm=True)
    for member in critics.members:
        torch.nn.init.constant_(member[-1].bias, -25.0)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        values = critics(torch.randn(256, 6))
    assert values.dtype == torch.float32 and all(len(row.unique()) > 128 for row in values)


@pytest.mark.parametrize("bf16", [False, pytest.param(True, marks=pytest.mark.skipif(not cpu_has_bf16(), reason="no bfloat16 here"))])
def test_bfloat16_learns_like_float32(bf16):
    """Equal learning, not equal numbers: a quadratic bandit solved by both to the same place."""
    settings = SACConfig(hidden=64, bf16=bf16, critic_lr=3e-3, actor_lr=3e-3, residual_penalty=0.0, average=0.95)
    agent = SAC(3, 2, settings, DecoratorConfig(alpha=1.0, H=0))
    g = torch.Generator().manual_seed(0)
    for _ in range(400):
        action = torch.rand((128, 2), generator=g) * 2 - 1
        reward = -((action - torch.tensor([0.5, -0.25])) ** 2).sum(-1)
        zeros = torch.zeros(128, 2)
        agent.update(dict(obs=torch.zeros(128, 3), residual=action, base=zeros, reward=reward, next_obs=torch.zeros(128, 3),
                          next_base=zeros, discount=torch.zeros(128)), g)
    found = agent.act(torch.zeros(1, 3), torch.zeros(1, 2))[0]
    assert torch.allclose(found, torch.tensor([0.5, -0.25]), atol=0.15), (bf16, found)


def transition(queue, t, stop=False, done=False):
    one = np.ones(1, np.float32)
    return queue.push(0, t * one, t * one, t * one, float(t), (t + 1) * one, (t + 1) * one, stop, done)


def test_n_step_returns_and_discounts():
    queue, rows = NStep(1, 3, 0.5), []
    for t in range(1, 5):
        rows += transition(queue, t, done=t == 4, stop=t == 4)
    # rows: obs, residual, base, reward, next_obs, next_base, discount
    assert [row[0] for row in rows] == [1, 2, 3, 4]
    assert [row[3] for row in rows] == [1 + 1 + 0.75, 2 + 1.5 + 1, 3 + 2, 4]
    assert [row[4] for row in rows] == [4, 5, 5, 5]
    assert [row[6] for row in rows] == [0.125, 0, 0, 0]  # the first bootstraps from its third successor, the rest end in a stop


def test_n_step_bootstraps_at_a_time_limit_with_the_steps_it_has():
    queue, rows = NStep(1, 3, 0.5), []
    for t in range(1, 3):
        rows += transition(queue, t, done=t == 2)
    assert [row[6] for row in rows] == [0.25, 0.5]
    assert not queue.waiting[0]


def test_replay_overwrites_the_oldest_and_names_its_columns():
    replay = Replay(3, 2, 1)
    for t in range(4):
        replay.add([np.array([t, t, 10 + t, 20 + t, 30 + t, 40 + t, 40 + t, 50 + t, 60 + t], np.float32)])
    columns = replay.unpack(replay.rows)
    assert replay.size == 3 and sorted(columns["reward"].tolist()) == [31, 32, 33]
    assert columns["residual"].shape == (3, 1) and columns["discount"].tolist() == [63, 61, 62]
    assert (columns["next_base"][:, 0] - columns["base"][:, 0]).tolist() == [30, 30, 30]


def test_a_copy_of_a_compiled_actor_has_weights_of_its_own():
    """What evaluation and the result of a run are made of, where nothing is averaged."""
    agent, x = make(compile=True, average=0.0), torch.randn(4, 3)
    other = copy.deepcopy(agent.actor)
    with torch.no_grad():
        other.head.bias.fill_(0.5)
        other.net[0].weight.zero_()
    with torch.compiler.set_stance("force_eager"):
        plain = Actor(3, 2, 16, 2, False, (-5.0, 2.0))
        plain.load_state_dict(other.state_dict())
        assert torch.equal(other.mean_action(x), plain.mean_action(x))
        assert not torch.allclose(agent.actor.mean_action(x), other.mean_action(x), atol=0.1)
        assert torch.equal(pickle.loads(pickle.dumps(other)).mean_action(x), plain.mean_action(x))


@pytest.mark.parametrize("changes", [{"init_temperature": 0.0}, {"actor_every": 0}, {"layers": 0}, {"hidden": 0}, {"grad_clip": -1.0},
                                     {"log_std_range": (2.0, -5.0)}, {"residual_penalty": -1.0}])
def test_settings_that_cannot_work_are_refused(changes):
    with pytest.raises(PdkitError, match="SAC needs"):
        SACConfig(**changes)
