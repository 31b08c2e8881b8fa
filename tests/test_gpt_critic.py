"""Critics on a transformer: each statement of pdkit/rl/gpt_critic.py, and that they learn."""
import pytest
import torch
from test_methods import (
    TINY,
    bet_sac,  # noqa: F401 (a fixture)
)
from test_probes import success
from worlds import clone, reach_demos, reach_trainer

from pdkit.errors import PdkitError
from pdkit.policies import BeTForSAC
from pdkit.rl.gpt_critic import GPTSAC, Backbone, GPTCritics

KINDS = ("shared", "separate")
PPO = dict(ppo_rollout=32, ppo_minibatches=4, ppo_epochs=6, ppo_lr=3e-3, num_envs=8, warmup_steps=0, utd=0.0, lr_decay_from=0.0)


def start(bet, kind, method="sac_finetune", **changes):
    """A trainer before its first step, on the reach probe: window 3, 4 observations, 2 actions."""
    return reach_trainer(method, bet, critic_backbone=kind, **dict(lora=2) | changes)


def batch(rows=16, seed=0):
    g = torch.Generator().manual_seed(seed)
    return {"obs": torch.randn(rows, 12, generator=g), "next_obs": torch.randn(rows, 12, generator=g), "base": torch.zeros(rows, 2),
            "next_base": torch.zeros(rows, 2), "residual": torch.rand(rows, 2, generator=g) * 2 - 1, "reward": -torch.ones(rows),
            "discount": torch.full((rows,), 0.9)}


def trained(module):
    return {name for name, p in module.named_parameters() if p.requires_grad}


def copied(module):
    return {name: p.detach().clone() for name, p in module.named_parameters()}


def moved(module, before):
    return {name for name, p in module.named_parameters() if not torch.equal(p, before[name])}


def critic_step(agent, seed=0):
    """A step of the critics, and none of the actor."""
    data = batch(seed=seed)
    agent._update_critics(data, data["obs"], data["next_obs"], torch.randn(16, 2), torch.tensor(0.1), None)


# ---- what is what ----------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("kind", KINDS)
def test_features_are_those_that_the_actors_heads_read(bet_sac, kind):  # noqa: F811
    agent, windows = start(bet_sac, kind).agent, torch.randn(5, 3, 4)
    features = agent.critics.backbone(windows.flatten(1))
    expected = agent.actor.gpt(agent.actor.normalizer(windows))[:, -1]
    assert features.shape == (5, 16) and torch.allclose(features, expected, atol=1e-5)
    assert torch.equal(agent.actor.head(expected).argmax(-1), agent.actor.head(features).argmax(-1))
    assert isinstance(agent, GPTSAC) and (agent.critics.backbone.in_dim, agent.critics.backbone.out_dim) == (12, 16)


def test_shared_is_the_very_transformer_and_separate_another_that_starts_alike(bet_sac):  # noqa: F811
    shared, separate = (start(bet_sac, kind).agent for kind in KINDS)
    assert shared.critics.backbone.gpt is shared.actor.gpt and shared.critics.backbone.normalizer is shared.actor.normalizer
    actors = {id(p) for p in separate.actor.parameters()}
    assert not any(id(p) in actors for p in separate.critics.parameters())
    own = copied(separate.critics.backbone.gpt)
    assert all(torch.equal(p, own[name]) for name, p in separate.actor.gpt.named_parameters() if "lora_" not in name)


@pytest.mark.parametrize("kind", KINDS)
def test_both_critics_are_heads_on_one_transformer(bet_sac, kind):  # noqa: F811
    critics = start(bet_sac, kind).agent.critics
    assert len(critics.members) == 2 and sum(isinstance(m, Backbone) for m in critics.modules()) == 1
    x = torch.randn(5, 14)
    seen = torch.cat([critics.backbone(x[:, :12]), x[:, 12:]], dim=1)
    assert torch.allclose(critics(x), torch.stack([member(seen)[:, 0] for member in critics.members]))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lora", [2, 0])
def test_the_critics_transformer_trains_what_the_actors_does(bet_sac, kind, lora):  # noqa: F811
    agent = start(bet_sac, kind, lora=lora).agent
    theirs, mine = trained(agent.actor.gpt), trained(agent.critics.backbone.gpt)
    assert mine == theirs and (len(mine) == len(list(agent.actor.gpt.parameters()))) == (lora == 0)
    assert lora == 0 or all("lora_" in name for name in mine)
    opened = {id(p) for group in agent.critic_optimizer.param_groups for p in group["params"]}
    assert opened == {id(p) for p in agent.critics.parameters() if p.requires_grad}


# ---- who moves whom --------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("kind", ["mlp", *KINDS])
def test_the_critics_loss_moves_the_actors_transformer_only_if_shared(bet_sac, kind):  # noqa: F811
    agent = start(bet_sac, kind).agent
    weights, windows = copied(agent.actor), torch.randn(5, 12)
    with torch.no_grad():
        before = agent.actor.mean_action(windows)
    for seed in range(3):  # an adapter starts with one factor zero, so the other moves from the second step on
        critic_step(agent, seed)
    changed, after = moved(agent.actor, weights), agent.actor.mean_action(windows)
    if kind == "shared":
        assert changed == {name for name in weights if name.startswith("gpt.") and "lora_" in name}
        assert not torch.allclose(before, after, atol=1e-5)
    else:
        assert not changed and torch.equal(before, after)
    if kind == "separate":
        assert not torch.allclose(agent.critics.backbone(windows), agent.actor.gpt(agent.actor.normalizer(windows.view(5, 3, 4)))[:, -1],
                                  atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_held_critics_pass_gradients_to_the_action_only(bet_sac, kind):  # noqa: F811
    critics = start(bet_sac, kind).agent.critics
    x, action = torch.randn(5, 12, requires_grad=True), torch.randn(5, 2, requires_grad=True)
    free = critics(torch.cat([x, action], dim=1))
    critics.hold(True)
    held = critics(torch.cat([x, action], dim=1))
    assert torch.equal(held, free) and not any(p.requires_grad for p in critics.members.parameters())
    held.sum().backward()
    assert action.grad.abs().min() > 0 and (x.grad == 0).all() and all(p.grad is None for p in critics.parameters())
    critics.hold(False)
    assert all(p.requires_grad for p in critics.members.parameters())
    critics(torch.cat([x, action], dim=1)).sum().backward()
    assert (x.grad != 0).any() and any(p.grad is not None for p in critics.backbone.parameters())


@pytest.mark.parametrize("kind", KINDS)
def test_the_actors_loss_trains_the_transformer_through_the_actors_heads_alone(bet_sac, kind):  # noqa: F811
    """Its step equals that of a loss in which Q reads a constant in place of the features."""
    agent, data, noise = start(bet_sac, kind, lora=0).agent, batch(), torch.randn(16, 2)
    constant = agent.critics.backbone(data["obs"]).detach()
    action, log_pi = agent.actor.sample(data["obs"], noise)
    agent.critics.hold(True)
    value = torch.stack([m(torch.cat([constant, action], 1))[:, 0] for m in agent.critics.members]).min(dim=0).values
    loss = (0.1 * log_pi - value).mean() + agent.config.residual_penalty * action.square().mean()
    expected = torch.autograd.grad(loss, list(agent.actor.gpt.parameters()), allow_unused=True)
    agent.critics.hold(False)
    before, heads = copied(agent.actor), copied(agent.critics.members)
    agent._update_actor(data, data["obs"], noise, torch.tensor(0.1))
    found = [p.grad for p in agent.actor.gpt.parameters()]
    assert any(g is not None and g.abs().max() > 0 for g in expected)
    assert all((f is None or (f == 0).all()) if e is None else torch.allclose(f, e, rtol=1e-3, atol=1e-6)
               for f, e in zip(found, expected, strict=True))
    assert "gpt.inp.weight" in moved(agent.actor, before) and not moved(agent.critics.members, heads) and not agent.critics.held


def test_two_optimisers_have_the_shared_transformer_and_one_of_ppo_once(bet_sac):  # noqa: F811
    def of(optimizer):
        return [id(p) for group in optimizer.param_groups for p in group["params"]]

    for kind in KINDS:
        agent = start(bet_sac, kind).agent
        both = set(of(agent.actor_optimizer)) & set(of(agent.critic_optimizer))
        assert both == ({id(p) for p in agent.actor.gpt.parameters() if p.requires_grad} if kind == "shared" else set())
        assert any(part is agent.critics.backbone for part in agent._clipped()) and len(agent._clipped()) == 3
        single = of(start(bet_sac, kind, "ppo_finetune", **PPO).agent.optimizer)
        assert len(single) == len(set(single))


@pytest.mark.parametrize("kind", KINDS)
def test_the_target_is_a_slow_copy_of_heads_and_transformer(bet_sac, kind):  # noqa: F811
    agent = start(bet_sac, kind, tau=0.25).agent
    assert agent.targets.backbone.gpt is not agent.critics.backbone.gpt and agent.targets.backbone.gpt is not agent.actor.gpt
    old, x = copied(agent.targets), torch.randn(5, 14)
    with torch.no_grad():
        assert torch.equal(agent.targets(x), agent.critics(x))
    agent.update(batch(), torch.Generator().manual_seed(0))
    new = copied(agent.critics)
    assert all(torch.allclose(p, old[name] + 0.25 * (new[name] - old[name]), atol=1e-6) for name, p in agent.targets.named_parameters())
    assert any(name.startswith("backbone.gpt.") for name in moved(agent.targets, old)) and not trained(agent.targets)


def test_the_average_is_of_the_whole_actor_whoever_moved_it(bet_sac):  # noqa: F811
    agent = start(bet_sac, "shared").agent
    before = copied(agent.average)
    agent.config = type(agent.config)(**vars(agent.config) | {"critic_warmup": 10**9})  # now only the critics' loss moves the actor
    agent.update(batch(), torch.Generator().manual_seed(0))
    changed = moved(agent.average, before)
    assert changed and all(name.startswith("gpt.") for name in changed)
    mine = dict(agent.actor.named_parameters())
    assert all(torch.allclose(p, mine[name]) for name, p in agent.average.named_parameters())  # the mean of one


# ---- PPO -------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("kind", KINDS)
def test_ppos_value_has_no_action_and_adds_to_the_loss_of_the_policy(bet_sac, kind):  # noqa: F811
    agent, stored = start(bet_sac, kind, "ppo_finetune", **PPO).agent, torch.randn(5, 12)
    assert isinstance(agent.value, GPTCritics) and len(agent.value.members) == 1
    assert agent.value.members[0][0][0].in_features == 16 and agent.values(stored, torch.zeros(5, 2)).shape == (5,)
    assert (agent.value.backbone.gpt is agent.actor.gpt) == (kind == "shared")
    gradients = torch.autograd.grad(agent.values(stored, torch.zeros(5, 2)).sum(),
                                    [p for p in agent.actor.parameters() if p.requires_grad], allow_unused=True)
    assert any(g is not None for g in gradients) == (kind == "shared")
    trained_here = {id(p) for p in agent.parameters}
    assert trained_here == {id(p) for part in (agent.actor, agent.value) for p in part.parameters() if p.requires_grad}


# ---- errors, checkpoints, learning -----------------------------------------------------------------------------------

def test_a_warm_up_of_the_critic_alone_is_refused_for_a_shared_transformer_only(bet_sac):  # noqa: F811
    with pytest.raises(PdkitError, match="cannot be warmed up alone"):
        start(bet_sac, "shared", critic_warmup=10)
    assert start(bet_sac, "separate", critic_warmup=10).agent.config.critic_warmup == 10
    with pytest.raises(PdkitError, match="critic_backbone"):
        start(bet_sac, "sharde")


def test_a_checkpoint_brings_back_both_and_they_are_still_one(bet_sac):  # noqa: F811
    first, second = start(bet_sac, "shared").agent, start(bet_sac, "shared", seed=1).agent
    generator = torch.Generator().manual_seed(0)
    for seed in range(3):
        first.update(batch(seed=seed), generator)
    second.load(first.state())
    assert second.critics.backbone.gpt is second.actor.gpt
    logs = [agent.update(batch(seed=9), torch.Generator().manual_seed(1)) for agent in (first, second)]
    assert all(torch.equal(logs[0][name], logs[1][name]) for name in logs[0])
    one, other = first.state(), second.state()
    assert all(torch.equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def near():
    """A policy that aims a little beside the goal, so that it is seconds from being right."""
    return clone(BeTForSAC, reach_demos(20, aim=(0.1, -0.1)), TINY | dict(scale=[0.5, 0.5]), iterations=200)


@pytest.mark.parametrize("kind", KINDS)
def test_sac_learns_with_a_critic_on_a_transformer(near, kind):
    policy = start(near, kind, total_steps=2600, actor_lr=1e-3, lr_decay_from=1.0).train()
    assert success("reach", policy) > success("reach", near) + 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_ppo_learns_with_a_value_on_a_transformer(near, kind):
    policy = start(near, kind, "ppo_finetune", total_steps=3000, **PPO).train()
    assert success("reach", policy) > success("reach", near) + 0.3
