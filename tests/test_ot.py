"""The reward by optimal transport, ROT and FISH: terms by hand, rows only of finished episodes, learning, resuming."""
import dataclasses

import numpy as np
import ot
import pytest
import torch
from worlds import clone, reach_demos, reach_trainer

from pdkit.claims import TASKS
from pdkit.decorated import Decorated, load_decorated, save_decorated
from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.imitate import Windows
from pdkit.methods.registry import method_config
from pdkit.methods.transport import as_trained
from pdkit.online_config import OnlineConfig
from pdkit.policies import VINN, BeTForSAC
from pdkit.probes import PROBES, ReachSim, biased_base
from pdkit.profiles import flat
from pdkit.rl.ot import OTReturns, OTReward, cosine_cost, sinkhorn
from pdkit.runs import Run
from pdkit.seeds import reported_seeds


class OneGoal(ReachSim):
    """reach with one goal, as a manipulation task has one: a demonstration then shows what to do in every episode."""

    def reset(self, seed):
        super().reset(seed)
        self.goal = np.array([0.5, 0.5])
        return self._observation()


ONE = dataclasses.replace(PROBES["reach"], make=OneGoal)
TINY = dict(window=3, bins=4, layers=1, heads=2, embed=16, features=16, dropout=0.0)


def success(policy):
    return evaluate(ONE, policy.act, reported_seeds(100), window=policy.window, num_envs=20).success_once.mean()


def vinn(demos, **config):
    policy = VINN({"obs_dim": 4, "act_dim": 2} | config)
    policy.fit_statistics(demos.observations, demos.actions)
    policy.remember(*Windows(demos, policy.window, True).all())
    return policy.eval()


@pytest.fixture(scope="module")
def beside():
    """Demonstrations that miss the goal by 0.17, more than the 0.1 it may be missed by."""
    return reach_demos(20, aim=(0.12, -0.12), spec=ONE)


@pytest.fixture(scope="module")
def bet_sac():
    return clone(BeTForSAC, reach_demos(20, aim=(0.15, -0.15), spec=ONE), TINY | dict(scale=[0.5, 0.5]))


def trainer(method, base, demos=None, **changes):
    values = dict(ot_demos=2, ot_trunk=16, init_temperature=0.01, ot_renew_every=1000) | changes
    return reach_trainer(method, base, demos or reach_demos(3, spec=ONE), spec=ONE, **values)


# ---- the reward ------------------------------------------------------------------------------------------------------

def reward(demos, total=10.0, **changes):
    return OTReward(lambda observations: observations, demos, **dict(epsilon=0.01, iterations=100, total=total) | changes)


def arc(*degrees, length=1.0):
    """Points in these directions, a first one put before that no action has led to."""
    angles = np.radians([90.0, *degrees])
    return length * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def test_cost_is_one_minus_the_cosine():
    cost = cosine_cost(np.array([[2.0, 0.0], [0.0, 0.1]]), np.array([[5.0, 0.0], [-1.0, 0.0], [1.0, 1.0]]))
    assert np.allclose(cost, [[0, 2, 1 - 0.5**0.5], [1, 1, 1 - 0.5**0.5]])


def test_plan_is_near_the_exact_one():
    cost = np.random.default_rng(0).uniform(0, 2, (6, 6))
    exact = ot.emd(np.full(6, 1 / 6), np.full(6, 1 / 6), cost)
    plan = sinkhorn(cost, 0.01, 5000)
    assert np.allclose(plan.sum(axis=1), 1 / 6) and np.allclose(plan, exact, atol=0.01)
    assert (plan * cost).sum() == pytest.approx((exact * cost).sum(), abs=0.01)
    assert np.allclose(sinkhorn(np.array([[0.0, 1.0], [1.0, 0.0]]), 0.01, 100), np.eye(2) / 2)


def test_rewards_by_hand():
    """Two steps onto two: each carries half of the mass at its own cost."""
    values = reward([arc(0, 60)], total=1.0)
    values.scale = 3.0
    assert np.allclose(values(arc(10, 30)), -3 * 0.5 * (1 - np.cos(np.radians([10, 30]))), atol=1e-6)
    assert np.allclose(values(arc(10, 30, length=9.0)), values(arc(10, 30)))


def test_the_same_path_costs_nothing_and_the_mirrored_one_more():
    path = arc(0, 20, 40, 60, 80)
    values = reward([path])
    values.scale = 1.0
    near, slow, mirrored = values(path), values(arc(0, 10, 20, 30, 40, 50, 60, 80)), values(path * [1, -1])
    assert abs(near.sum()) < 0.01 and mirrored.sum() < slow.sum() < near.sum() + 1e-9 and mirrored.sum() < -0.1
    assert len(slow) == 8


def test_all_of_the_demonstration_must_be_covered():
    """Transport, not the nearest neighbour: one half of the episode may carry a third to its like and must carry a sixth elsewhere, at
    cost 1; standing still where the demonstration starts costs the mean distance to all of it."""
    values = reward([arc(0, 90, 90)], iterations=1000)
    values.scale = 1.0
    assert np.allclose(values(arc(0, 90)), [-1 / 6, 0], atol=1e-3) and values.error < 1e-3
    assert values(arc(0, 0, 0, 0)).sum() == pytest.approx(-2 / 3, abs=0.01)


def test_a_hundred_iterations_may_hide_what_an_episode_owes():
    """The trap of ROT's numbers, with the case above: the sixth is not yet moved, the reward is near 0, and `error` is what tells."""
    values = reward([arc(0, 90, 90)])
    values.scale = 1.0
    assert abs(values(arc(0, 90)).sum()) < 1e-3 and values.error > 0.4


def test_first_observations_do_not_count():
    """No action led to them."""
    path, values = arc(0, 20), reward([arc(0, 20)])
    values.scale = 1.0
    assert np.array_equal(values(np.concatenate([[[-1.0, 0.0]], path[1:]])), values(path))


def test_scale_is_set_by_the_first_episode_alone():
    values = reward([arc(0, 60)])
    assert values(arc(30, 60)).sum() == pytest.approx(-10)
    worse = values(arc(120, 160)).sum()
    unscaled = reward([arc(0, 60)], total=1.0)
    unscaled.scale = 1.0
    assert worse < -20 and worse == pytest.approx(10 * unscaled(arc(120, 160)).sum() / -unscaled(arc(30, 60)).sum())


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1]])
def test_the_best_demonstration_counts(order):
    demos = [arc(0, 20), arc(180, 200), arc(90, 110, 130)]
    values = reward([demos[i] for i in order])
    values.scale = 1.0
    rewards = values(arc(175, 205))
    assert order[values.chosen] == 1
    alone = reward([demos[1]])
    alone.scale = 1.0
    assert np.array_equal(rewards, alone(arc(175, 205)))


def test_unconverged_plans_move_the_whole_episode_and_are_told():
    rng = np.random.default_rng(3)
    cost = rng.uniform(0, 1.5, (12, 7))
    assert np.allclose(sinkhorn(cost, 0.01, 2).sum(axis=1), 1 / 12)
    demo, episode = arc(*rng.uniform(0, 120, 7)), arc(*rng.uniform(0, 120, 12))
    errors = []
    for iterations in (2, 20000):
        values = reward([demo], iterations=iterations)
        values(episode)
        errors.append(values.error)
    assert errors[0] > 0.1 and errors[1] < 1e-3
    with pytest.raises(PdkitError, match="ot_epsilon"):
        reward([demo], epsilon=1e-4)


def test_demonstrations_end_as_training_episodes_do():
    demos = reach_demos(1)  # one that goes on for four steps after it was solved
    longer = dataclasses.replace(
        demos, observations=np.concatenate([demos.observations, np.repeat(demos.observations[-1:], 4, axis=0)]),
        actions=np.concatenate([demos.actions, np.zeros((4, 2), np.float32)]), lengths=demos.lengths + 4,
        success=np.concatenate([demos.success, np.ones(4, bool)]))
    solved = int(demos.lengths[0])

    def length(**changes):
        return len(as_trained(longer, OnlineConfig(**changes))[0]) - 1

    assert length(on_success="terminate") == solved
    assert [length(on_success="continue", success_tail=tail) for tail in (0, 2, 20)] == [solved + 4, solved + 2, solved + 4]
    assert length(on_success="continue", success_tail=0, train_limit=2) == 2


@pytest.mark.parametrize("task", [task for tasks in TASKS.values() for task in tasks])
@pytest.mark.parametrize("method", ["rot", "fish"])
def test_a_solved_episode_of_a_lesson_is_as_long_as_any_other(method, task):
    """Its mass is 1, so a step of a shorter one would weigh more: success would be rewarded or punished."""
    config = method_config(method, task, "lesson", 0)
    assert (config.on_success, config.success_tail) == ("continue", 0)


# ---- rows of whole episodes ------------------------------------------------------------------------------------------

class Judge(OTReward):
    """Rewards an episode of T steps with 1, 2, ... T, and remembers what it was shown."""

    def __init__(self):
        super().__init__(lambda observations: observations, [arc(0, 20)], epsilon=0.01, iterations=1, total=10.0,
                         frozen=torch.nn.Linear(2, 3))
        self.shown = []

    def __call__(self, observations):
        self.shown.append(observations)
        return np.arange(1.0, len(observations))


def step(returns, lane, t, done=False, stop=False):
    return returns.push(lane, np.array([t, lane], np.float32), np.array([0.1 * t], np.float32), np.array([0.2 * t], np.float32), 99.0,
                        np.array([t + 1, lane], np.float32), np.array([0.3 * t], np.float32), stop, done)


def test_rows_come_when_their_episode_is_over_and_not_before():
    returns = OTReturns(2, 1, 0.9, Judge())
    assert step(returns, 0, 0) == step(returns, 1, 0) == step(returns, 0, 1) == step(returns, 1, 1) == []
    rows = np.stack(step(returns, 0, 2, done=True, stop=True))
    assert np.allclose(rows[:, :2], [[0, 0], [1, 0], [2, 0]]) and np.allclose(rows[:, 2:4], [[0, 0], [0.1, 0.2], [0.2, 0.4]])
    assert rows[:, 4].tolist() == [1, 2, 3]  # the judge's; the sparse 99 is nowhere
    assert np.allclose(rows[:, 5:7], [[1, 0], [2, 0], [3, 0]]) and np.allclose(rows[:, 7], [0, 0.3, 0.6])
    assert np.allclose(rows[:, 8], [0.9, 0.9, 0.0])  # only the last one stopped
    assert np.allclose(returns.reward.shown[0], [[0, 0], [1, 0], [2, 0], [3, 0]])
    assert len(step(returns, 1, 2, done=True)) == 3 and len(step(returns, 0, 0, done=True)) == 1


def test_rewards_are_summed_over_n_steps():
    returns = OTReturns(1, 2, 0.9, Judge())
    step(returns, 0, 0), step(returns, 0, 1)
    rows = np.stack(step(returns, 0, 2, done=True))
    assert np.allclose(rows[:, 4], [1 + 0.9 * 2, 2 + 0.9 * 3, 3]) and np.allclose(rows[:, 8], [0.81, 0.81, 0.9])


def test_an_unfinished_episode_scale_and_features_survive():
    one, other = OTReturns(2, 2, 0.9, Judge()), OTReturns(2, 2, 0.9, Judge())
    step(one, 0, 0), step(one, 0, 1), one.push(1, *[np.zeros(2), np.zeros(1), np.zeros(1)], 0.0, np.zeros(2), np.zeros(1), True, True)
    one.reward.scale = 7.0
    other.load(one.state(), 2, 1)
    assert np.array_equal(step(one, 0, 2, done=True), step(other, 0, 2, done=True)) and len(other.reward.shown[0]) == 4
    assert other.reward.scale == 7.0 and torch.equal(one.reward.frozen.weight, other.reward.frozen.weight)


@pytest.mark.parametrize("method", ["fish", "rot"])
def test_what_training_stores(method, beside, bet_sac):
    base = vinn(beside, k=1) if method == "fish" else bet_sac
    t = trainer(method, base, total_steps=528, warmup_steps=100, utd=0.0, n_step=1)  # ends within episodes
    finished = []
    judge = t.reward.__class__.__call__
    t.reward.__class__ = type("Watched", (OTReward,), {"__call__": lambda self, o: finished.append((o, judge(self, o))) or finished[-1][1]})
    t.train()
    rows = t.replay.unpack(t.replay.rows[: t.replay.size])
    assert 0 < len(rows["reward"]) < 528 and len(rows["reward"]) == sum(len(r) for _, r in finished)
    assert np.allclose(rows["reward"], np.concatenate([r for _, r in finished]), atol=1e-5)
    assert np.allclose(rows["next_obs"], np.concatenate([o[1:] for o, _ in finished]))
    assert finished[0][1].sum() == pytest.approx(-10) and (rows["reward"] <= 1e-6).all() and t.log["ot_return"] < 0
    position, goal = rows["next_obs"][:, -4:-2], rows["next_obs"][:, -2:]
    assert ((rows["discount"] == 0) == ((position - goal).norm(dim=1) < 0.1)).all()  # success still ends an episode


# ---- Q-filter --------------------------------------------------------------------------------------------------------

class Known(torch.nn.Module):
    """Two critics: the sum over actions of `sign` times their square, and 1 more; features end with the action."""

    def __init__(self, sign):
        super().__init__()
        self.sign, self.members = sign, torch.nn.ModuleList()

    def forward(self, x):
        value = self.sign * x[..., -2:].square().sum(-1)
        return torch.stack([value + 1, value])


def batch_for(t, num=8):
    generator = torch.Generator().manual_seed(0)
    obs, base = torch.randn(num, t.stored_dim, generator=generator), torch.zeros(num, 2)
    return {"obs": obs, "base": base}


@pytest.mark.parametrize("method", ["fish", "rot"])
@pytest.mark.parametrize(("better", "weight"), [("imitation", 1.0), ("actor", 0.0), ("half", 0.5)])
def test_q_filter_weight_and_loss(method, better, weight, beside, bet_sac, monkeypatch):
    t = trainer(method, vinn(beside, k=1) if method == "fish" else bet_sac, bc_weight=0.03)
    agent, batch = t.agent, batch_for(t)
    imitated = torch.full((8, 2), 0.3)
    monkeypatch.setattr(agent, "reference", lambda batch: imitated)
    agent.critics = Known(1.0)
    at_reference = agent.critics(torch.cat([batch["obs"], imitated * t.config.decorator.alpha], -1))[1]
    value = at_reference + {"imitation": -0.1, "actor": 0.1, "half": torch.tensor([-0.1, 0.1] * 4)}[better]
    assert agent.filter_weight(batch, agent.normalize(batch["obs"]), value).item() == weight
    monkeypatch.setattr(agent, "imitation_loss", lambda generator: torch.tensor(50.0))
    agent._generator = None
    loss = agent._actor_loss(torch.tensor(4.0), batch, agent.normalize(batch["obs"]), value)
    assert loss.item() == pytest.approx((1 - weight) * 4 + weight * 0.03 * 50)


def test_the_filter_compares_with_the_least_critic_of_the_imitated_action(beside):
    """A critic that wants no residual is on imitation's side; one that wants any, on the actor's."""
    for sign, weight in ((-1.0, 1.0), (1.0, 0.0)):
        t = trainer("fish", vinn(beside, k=1))
        t.agent.critics = Known(sign)
        value = t.agent.critics(torch.full((8, 2), 0.1))[1]
        assert t.agent.filter_weight(batch_for(t), batch_for(t)["obs"], value).item() == weight


# ---- ROT -------------------------------------------------------------------------------------------------------------

def test_rot_imitates_whole_windows_and_filters_by_the_policy_it_started_from(bet_sac):
    demos = reach_demos(3, spec=ONE)
    t = trainer("rot", bet_sac, demos)
    windows, actions = Windows(demos, 3, True).sample(32, torch.Generator().manual_seed(5))
    assert t.agent.imitation_loss(torch.Generator().manual_seed(5)).item() == pytest.approx(
        t.agent.actor.loss(windows, actions)["loss"].item())
    stored = torch.randn(6, 12)
    with torch.no_grad():
        for p in t.agent.actor.parameters():
            p.add_(0.1 * torch.randn_like(p))
    assert torch.equal(t.agent.reference({"obs": stored}), bet_sac.mean_action(stored))
    assert not torch.allclose(t.agent.reference({"obs": stored}), t.agent.actor.mean_action(stored), atol=1e-3)


def test_rot_critics_see_observations_through_the_trunk_and_actions_beside_it(bet_sac):
    t = trainer("rot", bet_sac)
    x = torch.randn(5, 6)
    critics = t.agent.critics
    by_hand = torch.cat([torch.tanh(critics.trunk[1](critics.trunk[0](x[:, :4]))), x[:, 4:]], -1)
    assert by_hand.shape == (5, 18)
    assert torch.allclose(critics(x), torch.stack([member(by_hand)[:, 0] for member in critics.members]))
    assert any(p is critics.trunk[0].weight for group in t.agent.critic_optimizer.param_groups for p in group["params"])


def test_the_reward_of_rot_uses_a_copy_of_the_trunk_that_is_renewed_at_times(bet_sac):
    every = 501  # steps, which no number of steps that four lanes take is a multiple of
    t = trainer("rot", bet_sac, total_steps=700, warmup_steps=200, ot_renew_every=every, log_every=100)
    first, seen = t._phi[0].weight.clone(), {}
    targets = t.reward.targets[0].copy()

    def note(now):
        seen[now.step] = (torch.equal(now._phi[0].weight, first), np.array_equal(now.reward.targets[0], targets))

    t.train(progress=note)
    assert {step: same for step, same in seen.items()} == {s: (s < every, s < every) for s in seen} and min(seen) < every < max(seen)
    assert not torch.equal(t._phi[0].weight, t.agent.critics.trunk[0].weight)  # frozen since
    with torch.no_grad():
        observations = torch.from_numpy(as_trained(reach_demos(3, spec=ONE), t.config)[0])
        expected = t._phi(bet_sac.normalizer(observations))[1:]
    assert np.allclose(t.reward.targets[0], expected, atol=1e-5)
    shown = as_trained(reach_demos(3, spec=ONE), t.config)[0]
    t.reward.scale = 1.0
    like, unlike = (t.reward(episode).sum() for episode in (shown, shown + np.float32([0.5, -0.5, 0, 0])))
    assert like > unlike  # to act like a demonstration pays, in the trunk's features, too


# ---- FISH ------------------------------------------------------------------------------------------------------------

def test_fish_adds_a_fifth_of_its_residual_to_vinn(beside):
    base = vinn(beside, k=1)
    t = trainer("fish", base, total_steps=600, n_step=1)
    assert t.agent.expert_batch == t.config.batch // 2 and len(t.reward.targets) == 2  # `ot_demos` of the three demonstrations
    policy = t.train()
    rows = t.replay.unpack(t.replay.rows[: t.replay.size])
    assert np.allclose(rows["base"], base.act(rows["obs"].numpy()[:, None])[:, 0])
    executed = (rows["base"] + 0.2 * rows["residual"]).clamp(-1, 1)
    assert torch.allclose(rows["next_obs"][:, :2], (rows["obs"][:, :2] + 0.2 * executed).clamp(-1.5, 1.5), atol=1e-5)
    assert rows["residual"][:300].abs().mean() > 0.3  # random ones at first, at once
    assert t.agent.actor.config["in_dim"] == 4 + 2 and t.agent.critics.members[0][0][0].in_features == 4 + 2 + 2
    assert isinstance(policy, Decorated) and policy.base is base


def test_fish_keeps_its_residual_small_on_demonstrations(beside):
    """-log of a Gaussian of width 0.1 at 0, without its constant, at demonstrated observations with VINN's actions there."""
    base, demos = vinn(beside, k=1), reach_demos(3, spec=ONE)
    t = trainer("fish", base, demos)
    torch.nn.init.normal_(t.agent.actor.head.weight)
    observations, _ = Windows(demos, 1, True).all()
    actions = torch.from_numpy(base.act(observations.numpy())[:, 0])
    with torch.no_grad():
        means = t.agent.actor.mean_action(torch.cat([base.normalizer(observations[:, 0]), actions], -1))
        t.agent.expert_batch = 20_000
        assert t.agent.imitation_loss(torch.Generator().manual_seed(0)).item() == pytest.approx(
            50 * means.square().sum(1).mean().item(), rel=0.05)
    assert (t.agent.reference({"base": actions}) == 0).all()


def test_fish_compares_in_the_features_of_the_lookup(beside, bet_sac):
    t = trainer("fish", vinn(beside, k=1))
    episode = reach_demos(1, spec=ONE).observations
    assert np.allclose(t._features(episode), t.base.normalizer(torch.from_numpy(episode)), atol=1e-6)


def test_fish_over_gpt_features_sees_the_windows_of_the_policy(beside):
    from pdkit.policies import BeT

    bet = clone(BeT, beside, TINY, iterations=5)
    base = VINN({"obs_dim": 4, "act_dim": 2, "k": 1, "representation": {"kind": "bet"} | bet.config})
    base.gpt.load_state_dict(bet.gpt.state_dict())
    windows, actions = Windows(beside.first(2), 3, True).all()
    base.remember(windows, actions)
    t = trainer("fish", base)
    lengths = beside.lengths[:2]
    features = np.concatenate([t._features(e["observations"])[:-1] for e in beside.first(2).episodes()])
    assert len(features) == lengths.sum() and np.allclose(features, base.library, atol=1e-5)


def test_fish_survives_the_disk(beside, tmp_path):
    t = trainer("fish", vinn(beside, k=2))
    torch.nn.init.normal_(t.agent.average.head.weight)
    save_decorated(t.policy, tmp_path / "f")
    x = np.random.default_rng(0).normal(size=(9, 1, 4)).astype(np.float32)
    assert np.array_equal(load_decorated(tmp_path / "f").act(x), t.policy.act(x))


# ---- learning, resuming, errors --------------------------------------------------------------------------------------

def test_fish_learns_from_demonstrations_what_nearest_neighbours_miss(beside):
    """The base misses by more than is allowed and the residual may correct just enough. Success neither is rewarded nor ends episodes
    here: where it does end them, a constant negative reward teaches as well (tried: 100 % instead of 14 %)."""
    base = vinn(beside, k=3)
    assert success(base) < 0.3
    policy = trainer("fish", base, total_steps=1600, on_success="continue").train()
    assert success(policy) > 0.8


def test_the_reward_alone_teaches_rot_to_move_like_the_demonstrations(bet_sac):
    """Without imitation, the transport's cost of whole episodes falls from 0.42 to 0.19 within fifty; by a constant reward it rises to
    0.63, by the reward with its sign turned to 0.82."""
    t, costs = trainer("rot", bet_sac, total_steps=1600, on_success="continue", bc_weight=0.0), []
    judge = OTReward.__call__
    t.reward.__class__ = type("Watched", (OTReward,), {
        "__call__": lambda self, o: (rewards := judge(self, o), costs.append(abs(rewards.sum()) / self.scale))[0]})
    t.train()
    assert np.mean(costs[-20:]) < 0.7 * np.mean(costs[:20])


def test_rot_learns_what_the_base_policy_misses(bet_sac):
    """By reward and imitation together, episodes going on after success as in the lesson. Imitation has the larger part (the test above is
    the one about the reward), and a larger weight than the usual one, with which chance decides: three seeds ended at 42, 21 and 27 % here
    and the first at 83 % on another processor; with a weight of 1 at 75, 65 and 49 %."""
    assert success(bet_sac) < 0.2
    assert success(trainer("rot", bet_sac, total_steps=3000, on_success="continue", bc_weight=1.0).train()) > 0.35


@pytest.mark.parametrize("method", ["fish", "rot"])
def test_killed_and_resumed_gives_the_same_curve(tmp_path, method, beside, bet_sac):
    """The checkpoint lies in the middle of episodes, and behind a renewal of the trunk."""
    def make():
        return trainer(method, vinn(beside, k=1) if method == "fish" else bet_sac, total_steps=400, warmup_steps=100, batch=32,
                       ot_renew_every=150, log_every=100, checkpoint_every=200, eval_every=200, eval_episodes=4)

    def killed(t):
        if t.step >= 280:
            raise KeyboardInterrupt

    whole, cut, resumed = make(), make(), make()
    run = Run(tmp_path / "cut", "online", flat(whole.config))
    whole.train(Run(tmp_path / "whole", "online", flat(whole.config)))
    with pytest.raises(KeyboardInterrupt):
        cut.train(run, killed)
    assert run.load_checkpoint()[0]["nstep.counts"].sum() > 4 and run.load_checkpoint()[1]["step"] == 200
    resumed.train(run)

    def curve(t):
        return [{k: v for k, v in row.items() if k not in ("seconds", "eval_seconds")} for row in t.rows]

    assert curve(resumed) == curve(whole) and torch.equal(whole.replay.rows, resumed.replay.rows)
    one, other = whole.agent.state(), resumed.agent.state()
    assert all(torch.equal(one[k], other[k]) for k in one) and "ot_return" in whole.rows[-1] and "bc_share" in whole.rows[-1]
    ends = [{k: v.tobytes() for k, v in t.nstep.state().items()} for t in (whole, resumed)]
    assert ends[0] == ends[1]


def test_what_they_need_is_told(bet_sac, beside):
    with pytest.raises(PdkitError, match="kind vinn, not probe"):
        trainer("fish", biased_base())
    with pytest.raises(PdkitError, match="bet-sac"):
        trainer("rot", biased_base())
    for changes in (dict(demo_fraction=0.5), dict(ot_epsilon=1e-4)):
        with pytest.raises(PdkitError, match="demo_fraction=0|ot_epsilon"):
            trainer("rot", bet_sac, **changes)
    with pytest.raises(PdkitError, match="demonstrations"):
        reach_trainer("fish", vinn(beside, k=1), spec=ONE)
    with pytest.raises(PdkitError, match="ot_iterations"):
        trainer("rot", bet_sac, ot_iterations=0)
