"""PPO: each term by hand, what the loop gives it, and that it learns."""
import copy

import numpy as np
import pytest
import torch
from test_probes import success
from worlds import clone, reach_demos

from pdkit.decorator import DecoratorConfig
from pdkit.errors import PdkitError
from pdkit.methods.config import MethodConfig
from pdkit.methods.ppo import OnPolicy, PPOFineTune
from pdkit.methods.registry import make_trainer, method_config
from pdkit.online_config import OnlineConfig
from pdkit.policies import BeTForSAC
from pdkit.probes import PROBES, biased_base, zero_base
from pdkit.profiles import flat
from pdkit.rl.ppo import PPO, clipped_surrogate, clipped_value_loss, gae, log_prob, standardised
from pdkit.rl.sac import SACConfig
from pdkit.runs import Run

SMALL = SACConfig(hidden=32, layers=2, bf16=False, log_std_range=(-3.0, 2.0))
PLAIN = DecoratorConfig(alpha=1.0, H=0)
TINY = dict(window=3, bins=4, layers=1, heads=2, embed=16, features=16, dropout=0.0)


def make(name, base, method="ppo_residual_rl", decorator=PLAIN, own=None, sac=SMALL, **changes):
    own = dict(ppo_rollout=16, ppo_epochs=6, ppo_minibatches=4, ppo_lr=3e-3) | (own or {})
    values = dict(task=name, method=method, total_steps=4000, num_envs=8, env_workers=0, warmup_steps=0, warmup="policy",
                  demo_fraction=0.0, on_success="terminate", success_tail=0, gamma=0.9, eval_every=0, log_every=0, checkpoint_every=0,
                  lr_decay_from=0.0)
    config = OnlineConfig(**(values | changes), sac=sac, decorator=decorator, method_config=MethodConfig(**own))
    return make_trainer(config, base, None, PROBES[name])


def train(*args, **changes):
    trainer = make(*args, **changes)
    return trainer, trainer.train()


@pytest.fixture(scope="module")
def bet_sac():
    """A bet-sac policy that aims a little too far beside the goal."""
    return clone(BeTForSAC, reach_demos(20, aim=(0.1, -0.1)), TINY | dict(scale=[0.5, 0.5]), iterations=200)


# ---- terms -----------------------------------------------------------------------------------------------------------

def test_gae_by_hand():
    """Three decisions in three environments: nothing ends; the second decision terminates; the second one is truncated."""
    reward = torch.tensor([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [3.0, 3.0, 3.0]])
    done = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    discount = torch.tensor([[0.5, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.5]])
    values = torch.tensor([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [4.0, 4.0, 4.0]])
    after = torch.tensor([[2.0, 2.0, 2.0], [4.0, 9.0, 6.0], [8.0, 8.0, 8.0]])  # the true successor's: 6 at the time limit
    # one-step errors, by hand: 1 + 1 - 1 = 1; 2 + 2 - 2 = 2, 2 - 2 = 0, 2 + 3 - 2 = 3; 3 + 4 - 4 = 3
    errors = torch.tensor([[1.0, 1.0, 1.0], [2.0, 0.0, 3.0], [3.0, 3.0, 3.0]])
    assert torch.equal(gae(reward, discount, done, values, after, 0.0), errors)
    # lambda 0.8, weight 0.4 a step: 2 + 0.4 * 3 = 3.2, then 1 + 0.4 * 3.2 = 2.28; across an episode's end nothing
    expected = torch.tensor([[2.28, 1.0, 2.2], [3.2, 0.0, 3.0], [3.0, 3.0, 3.0]])
    assert torch.allclose(gae(reward, discount, done, values, after, 0.8), expected)
    # lambda 1: advantage + value is the n-step return to the end of episode or rollout
    returns = gae(reward, discount, done, values, after, 1.0) + values
    assert torch.allclose(returns[0], torch.tensor([1 + 0.5 * (2 + 0.5 * (3 + 0.5 * 8)), 1 + 0.5 * 2, 1 + 0.5 * (2 + 0.5 * 6)]))


def test_clipped_surrogate_by_hand():
    """The four cases of Fig. 1 in the PPO paper, and where the gradient stops."""
    log_ratio = torch.log(torch.tensor([1.5, 0.5, 1.5, 0.5, 1.1])).requires_grad_()
    advantage = torch.tensor([2.0, 2.0, -2.0, -2.0, 2.0])
    surrogate = clipped_surrogate(log_ratio, advantage, 0.2)
    assert torch.allclose(surrogate, torch.tensor([2.4, 1.0, -3.0, -1.6, 2.2]))
    surrogate.sum().backward()
    assert (log_ratio.grad != 0).tolist() == [False, True, True, False, True]


def test_clipped_value_loss_by_hand():
    values, old, returns = torch.tensor([1.0, 0.1, -1.0]), torch.zeros(3), torch.tensor([1.0, 1.0, 1.0])
    assert torch.allclose(clipped_value_loss(values, old, returns, 0.2), 0.5 * torch.tensor([0.8**2, 0.9**2, 4.0]))


def test_advantages_are_standardised_over_open_decisions():
    advantages, open_ = torch.tensor([1.0, 3.0, 100.0]), torch.tensor([1.0, 1.0, 0.0])
    assert torch.allclose(standardised(advantages, open_), torch.tensor([-1.0, 1.0, 0.0]) / 2**0.5)
    assert (standardised(advantages, torch.tensor([0.0, 1.0, 0.0])) == 0).all()  # no spread of one


@pytest.mark.parametrize("kind", ["small", "bet-sac"])
def test_log_probability_is_that_of_the_action_as_sac_has_it(kind, bet_sac):
    torch.manual_seed(0)
    policy = PPO(4, 2, MethodConfig(), SMALL, PLAIN, actor=None if kind == "small" else bet_sac)
    obs, base, noise = torch.randn(5, 4 if kind == "small" else 12), torch.zeros(5, 2), torch.randn(5, 2)
    action, u, acted = policy.act(obs, base, noise)
    sampled, expected = policy.actor.sample(obs, noise)
    assert torch.allclose(action, sampled) and torch.allclose(acted, expected, atol=1e-5)
    mean, log_std = policy.actor.heads(obs)
    squashed = torch.distributions.TransformedDistribution(torch.distributions.Normal(mean, log_std.exp()),
                                                           torch.distributions.TanhTransform(cache_size=1))
    assert torch.allclose(squashed.log_prob(torch.tanh(u)).sum(-1), acted, atol=1e-3)
    assert torch.isfinite(log_prob(torch.full((1, 2), 30.0), mean[:1], log_std[:1])).all()  # where atanh(tanh(u)) is infinite


# ---- the learner -----------------------------------------------------------------------------------------------------

def rollout(agent, rows=64, seed=0, open_=None):
    """A made-up rollout by this agent, in the columns of its replay."""
    torch.manual_seed(seed)
    obs, base = torch.randn(rows, 4), torch.zeros(rows, 2)
    _, u, acted = agent.act(obs, base, torch.randn(rows, 2))
    return {"obs": obs, "base": base, "residual": u, "log_prob": acted, "reward": torch.randn(rows), "next_obs": torch.randn(rows, 4),
            "next_base": base, "discount": torch.full((rows,), 0.9), "done": torch.zeros(rows),
            "open": torch.ones(rows) if open_ is None else open_}


def updated(data=None, sizes=SMALL, **own):
    """An agent before and after one update, and the log."""
    torch.manual_seed(0)
    agent = PPO(4, 2, MethodConfig(**(dict(ppo_epochs=3, ppo_minibatches=4, ppo_lr=1e-2) | own)), sizes, PLAIN)
    before = copy.deepcopy(agent)
    log = agent.update(rollout(agent) if data is None else data(agent), 8, torch.Generator().manual_seed(0))
    return before, agent, log


def moved(one, other):
    return max((a - b).abs().max().item() for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_gated_decisions_teach_the_value_and_not_the_policy():
    before, after, log = updated(lambda agent: rollout(agent, open_=torch.zeros(64)), ppo_entropy_coef=1.0)
    assert moved(before.actor, after.actor) == 0 and moved(before.value, after.value) > 1e-3
    assert float(log["open"]) == 0 and all(torch.isfinite(v) for v in log.values())
    half = (torch.arange(64) % 2).float()

    def gated(agent, change):
        data = rollout(agent, open_=half)
        data["residual"] = torch.where(half[:, None] > 0, data["residual"], data["residual"] + change)  # drawn, never executed
        return data

    one, other = (updated(lambda agent, change=change: gated(agent, change))[1] for change in (0.0, 2.0))
    assert moved(before.actor, one.actor) > 1e-3 and moved(one.actor, other.actor) == 0


def test_rewards_of_gated_decisions_count_for_open_ones_before_them():
    """Of environment 0 only the first decision is open; the reward comes with the third, two gated ones on."""
    def told(reward):
        def data(agent):
            d = rollout(agent, open_=torch.zeros(64))
            d["open"][:2] = 1  # two, for a spread
            d["reward"] = torch.zeros(64)
            d["reward"][16] = reward
            return d
        return updated(data)[1]
    good, bad = told(5.0), told(-5.0)
    obs, base = rollout(good)["obs"][:1], torch.zeros(1, 2)
    u = rollout(updated()[0])["residual"][:1]
    likelihood = [log_prob(u, *agent.actor.heads(obs)).item() for agent in (good, bad)]
    assert likelihood[0] > likelihood[1] + 0.1 and torch.isfinite(good.values(obs, base)).all()


def test_an_open_decision_weighs_the_same_whatever_is_gated_beside_it():
    """The loss is divided by all decisions: a batch with a gated twin for each open decision has half the loss."""
    agent = updated()[0]
    data = rollout(agent, rows=8)
    batch = {k: data[k] for k in ("obs", "base", "residual", "log_prob", "open")}
    batch |= {"old": torch.zeros(8), "returns": torch.zeros(8), "advantage": torch.randn(8)}
    twice = {k: torch.cat([v, v]) for k, v in batch.items()}
    twice["open"][8:] = 0
    losses = [float(copy.deepcopy(agent)._step(b, torch.zeros(len(b["open"]), 2))["policy_loss"]) for b in (batch, twice)]
    assert losses[0] == pytest.approx(2 * losses[1]) and losses[0] == pytest.approx(-batch["advantage"].mean().item(), abs=1e-5)


def test_coefficients_and_limits():
    before, plain, _ = updated()
    assert plain.updates == 12 and moved(before.actor, plain.actor) > 1e-3
    assert moved(before.value, updated(ppo_value_coef=0.0)[1].value) == 0
    assert moved(before.actor, updated(ppo_grad_clip=1e-9)[1].actor) < 1e-4  # below Adam's eps nothing is rescaled
    spread = [agent.actor.heads(torch.zeros(1, 4))[1].mean().item() for agent in (plain, updated(ppo_entropy_coef=1.0)[1])]
    assert spread[1] > spread[0] + 0.02
    assert updated(ppo_target_kl=1e-9)[1].updates == 4  # one pass, then the policy has moved that far
    tight, wide = (updated(ppo_clip=clip, ppo_epochs=20)[2] for clip in (0.05, 0.5))
    assert float(wide["kl"]) > 2 * float(tight["kl"])


def test_all_networks_see_normalised_observations():
    """An agent that doubles what it sees learns from a rollout as a plain one does from the doubled rollout."""
    agents = []
    for normalize in (None, lambda x: 2 * x):
        torch.manual_seed(0)
        agents.append(PPO(4, 2, MethodConfig(ppo_epochs=2, ppo_minibatches=4), SMALL, PLAIN, normalize=normalize))
    plain, doubling = agents
    data = rollout(doubling)
    doubled = {k: v * (2 if k.endswith("obs") else 1) for k, v in data.items()}
    noise = torch.randn(64, 2)
    assert torch.equal(plain.act(doubled["obs"], data["base"], noise)[1], doubling.act(data["obs"], data["base"], noise)[1])
    plain.update(doubled, 8, torch.Generator().manual_seed(0))
    doubling.update(data, 8, torch.Generator().manual_seed(0))
    assert moved(plain.actor, doubling.actor) == 0 and moved(plain.value, doubling.value) == 0


# ---- on the loop -----------------------------------------------------------------------------------------------------

def watched(trainer):
    """Train, keeping each rollout with the actors that stood before and after its update."""
    seen, update = [], trainer.agent.update

    def keep(data, num_envs, generator):
        copied = {k: v.clone() for k, v in data.items()}
        actor = copy.deepcopy(trainer.agent.actor)
        log = update(data, num_envs, generator)
        seen.append((copied, actor))
        return log

    trainer.agent.update = keep
    trainer.train()
    return seen


def test_a_rollout_holds_what_was_executed_and_the_log_probabilities_of_the_policy_that_acted():
    base, decorator = biased_base((0.05, 0.0)), DecoratorConfig(alpha=0.6, H=1000)
    trainer = make("reach", base, "ppo_decorator", decorator, total_steps=1200, train_limit=6, own=dict(ppo_rollout=32))
    seen = watched(trainer)
    assert len(seen) == 4 and trainer.replay.size == 1200 - 4 * 256
    for i, (data, actor) in enumerate(seen):
        executed = data["base"] + 0.6 * data["open"][:, None] * torch.tanh(data["residual"])
        landed = (data["obs"][:, :2] + 0.2 * executed.clamp(-1, 1)).clamp(-1.5, 1.5)
        assert torch.allclose(data["next_obs"][:, :2], landed, atol=1e-5)  # the true successor, at an episode's end too
        assert torch.allclose(data["base"], torch.from_numpy(base.act(data["obs"].numpy()[:, None])[:, 0]), atol=1e-6)
        assert torch.allclose(data["next_base"], torch.from_numpy(base.act(data["next_obs"].numpy()[:, None])[:, 0]), atol=1e-6)
        solved = torch.linalg.norm(data["next_obs"][:, :2] - data["next_obs"][:, 2:], dim=1) < 0.1
        assert torch.allclose(data["reward"], torch.where(solved, 0.0, -0.1))  # (success - 1) * (1 - gamma)
        assert (data["discount"] == torch.where(solved, 0.0, 0.9)).all() and (data["done"][solved] == 1).all()
        assert solved.any() and ((data["done"] == 1) & ~solved).any()  # time limits: the episode is over, its last state has a value
        now = log_prob(data["residual"], *actor.heads(data["obs"]))
        assert torch.allclose(now[8:], data["log_prob"][8:], atol=1e-4)
        if i:  # the decision that was in flight during the update before
            then = log_prob(data["residual"], *seen[i - 1][1].heads(data["obs"]))
            assert torch.allclose(then[:8], data["log_prob"][:8], atol=1e-4)
            assert (now[:8] - data["log_prob"][:8]).abs().max() > 1e-3
    opened = [data["open"].mean().item() for data, _ in seen]
    assert opened[0] < 0.25 and 0.7 < opened[-1] < 1.0


@pytest.mark.parametrize(("bootstrap", "decay", "expected"), [("truncated", 0.95, -1.0), ("always", 0.95, -1.0),
                                                              ("never", 0.0, -0.1 / (1 - 0.9 * 0.8))])
def test_wait_values_follow_the_bootstrap_rule(bootstrap, decay, expected):
    """-1 a step for ever, times 1 - gamma, is -1 when time limits bootstrap; when they stop, v = -0.1 + 0.9 * 0.8 v over five
    positions that look alike, with one-step targets."""
    own = dict(ppo_gae_lambda=decay, ppo_rollout=32)
    trainer, _ = train("wait", zero_base(PROBES["wait"]), own=own, bootstrap=bootstrap, total_steps=3000)
    assert trainer.agent.values(torch.ones(1, 1), torch.zeros(1, 1)).item() == pytest.approx(expected, rel=0.1)


def test_killed_in_the_middle_of_a_rollout_and_resumed_gives_the_same_curve(tmp_path, bet_sac):
    for method, base in (("ppo_decorator", biased_base()), ("ppo_finetune", bet_sac)):
        def fresh(method=method, base=base):
            return make("reach", base, method, DecoratorConfig(alpha=0.6, H=600) if method == "ppo_decorator" else PLAIN,
                        own=dict(ppo_rollout=32, ppo_epochs=2), total_steps=900, checkpoint_every=400, log_every=200, eval_every=400,
                        eval_episodes=4, eval_workers=0)

        def killed(trainer):
            if trainer.step >= 600:
                raise KeyboardInterrupt

        whole, cut = fresh(), tmp_path / method
        whole.train(Run(tmp_path / f"{method}-whole", "online", flat(whole.config)))
        with pytest.raises(KeyboardInterrupt):
            fresh().train(Run(cut, "online", flat(whole.config)), killed)
        resumed = fresh()
        assert len(Run(cut, "online", flat(whole.config)).load_checkpoint()[0]["replay"]) == 400 - 256  # part of a rollout
        resumed.train(Run(cut, "online", flat(whole.config)))
        strip = [[{k: v for k, v in row.items() if "seconds" not in k} for row in t.rows] for t in (resumed, whole)]
        assert strip[0] == strip[1] and whole.agent.updates == 3 * 8
        one, other = whole.agent.state(), resumed.agent.state()
        assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
        assert torch.equal(whole.replay.rows, resumed.replay.rows)


def test_the_learning_rate_falls():
    trainer = make("lever", zero_base(PROBES["lever"]), total_steps=2560, own=dict(ppo_rollout=32, ppo_epochs=1))
    trainer.train()
    assert trainer.agent.optimizer.param_groups[0]["lr"] == pytest.approx(3e-3 * (1 - 0.9 * 0.9))  # last update at nine tenths


# ---- learning --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("name", "steps"), [("lever", 2500), ("corridor", 3500)])
def test_probes_are_solved(name, steps):
    _, policy = train(name, zero_base(PROBES[name]), total_steps=steps)
    assert success(name, policy) == 1.0


def test_the_decorator_lifts_a_biased_base():
    base = biased_base()
    trainer, policy = train("reach", base, "ppo_decorator", DecoratorConfig(alpha=0.8, H=2000), total_steps=6000)
    assert type(trainer) is OnPolicy and success("reach", base) < 0.35 and success("reach", policy) > 0.9


def test_fine_tuning_lifts_a_behavior_transformer_and_leaves_the_start_alone(bet_sac):
    before, start = {k: v.clone() for k, v in bet_sac.state_dict().items()}, success("reach", bet_sac)
    trainer, policy = train("reach", bet_sac, "ppo_finetune", total_steps=3000)
    assert isinstance(trainer, PPOFineTune) and start < 0.6 and success("reach", policy) > start + 0.3
    assert all(torch.equal(v, before[k]) for k, v in bet_sac.state_dict().items())
    adapted = policy.state_dict()
    assert torch.equal(adapted["head.weight"], before["head.weight"])
    assert torch.equal(adapted["regression.base_layer.weight"], before["regression.weight"])
    obs = trainer.replay.rows[:5, : trainer.stored_dim]
    assert torch.allclose(trainer.agent.value_view(obs), bet_sac.normalizer(obs.view(5, 3, 4)[:, -1]))


# ---- configuration ---------------------------------------------------------------------------------------------------

def test_methods_differ_in_what_they_say():
    one, other = (method_config(method, "Door") for method in ("ppo_decorator", "ppo_residual_rl"))
    assert (one.decorator.alpha, one.decorator.H) == (0.1, 30_000) and (other.decorator.alpha, other.decorator.H) == (1.0, 0)
    assert (one.warmup_steps, one.demo_fraction, one.method_config.ppo_rollout * one.num_envs) == (0, 0.0, 2048)
    paper = method_config("ppo_decorator", "Pen", "paper")
    assert paper.method_config.ppo_rollout * paper.num_envs == 2048 and paper.normalize_obs and paper.lr_decay_from == 0
    smoke = method_config("ppo_decorator", "Door", "smoke")
    assert smoke.method_config.ppo_rollout * smoke.num_envs < smoke.total_steps


def test_what_ppo_cannot_use_is_refused(bet_sac):
    base = biased_base()
    for bad, words in ((dict(warmup_steps=100), "warmup_steps=0"), (dict(demo_fraction=0.25), "demo_fraction=0"),
                       (dict(own=dict(ppo_rollout=500)), "total_steps"),
                       (dict(own=dict(ppo_rollout=1, ppo_minibatches=9)), "ppo_minibatches")):
        with pytest.raises(PdkitError, match=words):
            make("reach", base, **bad)
    for bad in (dict(ppo_clip=0.0), dict(ppo_epochs=0), dict(ppo_gae_lambda=1.1), dict(ppo_entropy_coef=-1.0)):
        with pytest.raises(PdkitError, match="PPO needs"):
            MethodConfig(**bad)
    noisy = BeTForSAC(bet_sac.config | dict(act_dropout=True, dropout=0.1))
    with pytest.raises(PdkitError, match="act_dropout=False"):
        make("reach", noisy, "ppo_finetune")
    with pytest.raises(PdkitError, match="bet-sac"):
        make("reach", base, "ppo_finetune")


def test_evaluation_uses_the_last_weights_and_no_gate():
    trainer, policy = train("reach", biased_base(), "ppo_decorator", DecoratorConfig(alpha=0.8, H=10**6), total_steps=600)
    windows = np.random.default_rng(0).normal(size=(6, 1, 4)).astype(np.float32)
    base, residual = policy.parts(windows)
    with torch.no_grad():
        expected = trainer.agent.actor.mean_action(torch.from_numpy(windows[:, 0])).numpy()
    assert np.allclose(residual, expected) and np.allclose(policy.act(windows)[:, 0], base + 0.8 * residual)
