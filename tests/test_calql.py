"""Cal-QL: the conservative loss number by number, returns, the offline stage, and setups A to E."""
import math

import numpy as np
import pytest
import torch
from test_methods import bet_sac  # noqa: F401 (a fixture)
from test_probes import success
from test_sac import iterates
from worlds import reach_demos, reach_trainer

from pdkit import methods, online
from pdkit.decorator import DecoratorConfig
from pdkit.demos import sources
from pdkit.errors import PdkitError
from pdkit.methods.config import MethodConfig
from pdkit.methods.registry import trainer_of
from pdkit.policies import BeTForSAC
from pdkit.probes import PROBES, biased_base
from pdkit.profiles import flat
from pdkit.rl.calql import CalQL, Conservative, WithReturns
from pdkit.rl.replay import Replay
from pdkit.rl.sac import SACConfig
from pdkit.runs import Run
from pdkit.seeds import rollout_seeds
from pdkit.unlearning import set_spread

SPEC = PROBES["reach"]
SETUPS = ("calql_a", "calql_b", "calql_c", "calql_d", "calql")


def start(method, bet=None, demos=True, **changes):
    """The trainer of one setup; `bet` is what D and E start from."""
    base = bet if method in ("calql_d", "calql") else biased_base()
    values = dict(calql_offline_updates=60, calql_rollouts=6, lora=2, total_steps=504, utd=0.0)
    return reach_trainer(method, base, reach_demos() if demos else None, **values | changes)


def run(method, bet=None, **changes):
    trainer = start(method, bet, **changes)
    return trainer, trainer.train()


# ---- returns ---------------------------------------------------------------------------------------------------------

def rows_of(rewards, stop, n=2, gamma=0.5):
    steps, rows = WithReturns(1, n, gamma), []
    for t, r in enumerate(rewards):
        last = t == len(rewards) - 1
        rows += steps.push(0, np.array([t]), np.zeros(1), np.array([10.0 * t]), r, np.array([t + 1]), np.array([10.0 * t + 10]),
                           stop and last, last)
        assert bool(rows) == last  # complete when the episode is
    replay = Replay(len(rows), 1, 1, extra=("mc",))
    replay.add(rows)
    return {k: v.squeeze().tolist() for k, v in replay.unpack(replay.rows).items()}


def test_returns_of_a_success_and_of_a_failure():
    solved, failed = rows_of([-1, -1, 0], stop=True), rows_of([-1, -1, -1], stop=False)
    assert solved["mc"] == [-1.5, -1.0, 0.0]
    assert failed["mc"] == [-2.0, -2.0, -2.0]  # r_neg / (1 - gamma), not the sum of three
    assert rows_of([-1, 1], stop=True)["mc"] == [-0.5, 1.0]  # nothing comes after a success, whatever it pays
    assert solved["reward"] == [-1.5, -1.0, 0.0] and failed["reward"] == [-1.5, -1.5, -1.0]
    assert solved["discount"] == [0.25, 0.0, 0.0] and failed["discount"] == [0.25, 0.25, 0.5]
    assert solved["next_obs"] == [2, 3, 3] and solved["next_base"] == [20, 30, 30]


def test_rows_are_those_of_the_plain_accumulator_in_every_episode():
    trainer, _ = run("calql_c", total_steps=1500, calql_offline_updates=0, n_step=1, warmup="uniform", warmup_steps=1400)
    data = trainer.replay.unpack(trainer.replay.rows[: trainer.replay.size])
    solved = data["discount"] == 0
    assert solved.any() and (data["mc"][solved] == 0).all()
    chained = (data["obs"][1:] == data["next_obs"][:-1]).all(dim=1)
    expected = data["reward"][:-1] + 0.9 * data["mc"][1:]
    assert chained.float().mean() > 0.8 and torch.allclose(data["mc"][:-1][chained], expected[chained], atol=1e-4)
    assert (data["mc"] == -10).any()


# ---- the loss --------------------------------------------------------------------------------------------------------

def agent(rule=None, offline=10**9, stays=False, **others):
    torch.manual_seed(0)
    return CalQL(1, 2, SACConfig(hidden=8, layers=1, bf16=False), DecoratorConfig(alpha=1.0, H=0),
                 rule=rule or Conservative(actions=1, scale=1.0), offline_updates=offline, stays=stays, **others)


def by_formula(learner, function):
    """Critics replaced by Q(s, a) = function(s, a1, a2), the second larger by 1."""
    critics = lambda x: torch.stack([function(*x.T), function(*x.T) + 1])  # noqa: E731
    learner.critics = learner.targets = critics
    return learner


def batch(mc=0.0):
    one = torch.ones(1, 1)
    return {"obs": 2 * one, "next_obs": 5 * one, "base": torch.zeros(1, 2), "next_base": torch.zeros(1, 2), "residual": torch.zeros(1, 2),
            "reward": -torch.ones(1), "discount": torch.full((1,), 0.9), "mc": torch.full((1,), mc),
            "random": torch.tensor([[[0.5, 0.0]]]), "here": torch.tensor([[[-1.0, 0.0]]]), "ahead": torch.tensor([[[1.0, 0.0]]]),
            "log_here": torch.tensor([[0.3]]), "log_ahead": torch.tensor([[-0.7]])}


def test_the_max_compares_state_by_state():
    """Two states with three actions of each kind: V lies above every action of one and below every one of the other. The bound of one
    state does not reach the other, and every action is valued where it was drawn."""
    parts = [batch(mc) | {"obs": torch.full((1, 1), s)} for mc, s in ((10.0, 2.0), (-10.0, 4.0))]
    both = {name: torch.cat([p[name] for p in parts], dim=1 if name in ("random", "here", "ahead", "log_here", "log_ahead") else 0)
            for name in parts[0]}
    many = lambda p: p | {name: torch.cat([p[name], p[name] * 0.5, p[name] * 0.2])  # noqa: E731
                          for name in ("random", "here", "ahead", "log_here", "log_ahead")}
    learner = by_formula(agent(Conservative(actions=3, scale=1.0)), lambda s, a, _: s + a)
    alone = [learner._critic_penalty(many(p), p["obs"], torch.zeros(2, 1)).item() for p in parts]
    together = learner._critic_penalty(many(both), both["obs"], torch.zeros(2, 2)).item()
    assert together == pytest.approx(sum(alone) / 2, rel=1e-5) and abs(alone[0] - alone[1]) > 1
    pushes = torch.zeros(2, requires_grad=True)
    learner = by_formula(agent(), lambda s, a, _: (pushes[0] * (s == 2) + pushes[1] * (s == 4)) * (a < 0))
    learner._critic_penalty(both, both["obs"], torch.zeros(2, 2)).backward()
    assert pushes.grad[0] == 0 and pushes.grad[1] > 0.1


def penalty(mc, **rule):
    learner = by_formula(agent(Conservative(**dict(actions=1, scale=1.0) | rule)), lambda s, a, _: s + a)
    values = torch.tensor([[2.0], [3.0]])
    return learner._critic_penalty(batch(mc), batch()["obs"], values).item()


def test_the_conservative_term_by_hand():
    """At s = 2 the critics give 2 + a and 3 + a: 2.5, 1, 3 and 1 more. All are valued at s, not at s' = 5."""
    def term(parts, data):
        return math.log(sum(math.exp(x) for x in parts)) - data

    unbounded = [term([q + 2.5 + 2 * math.log(2), q + 1 - 0.3, q + 3 + 0.7], q + 2) for q in (0, 1)]
    assert penalty(-100.0) == pytest.approx(sum(unbounded), rel=1e-5)
    # V = 2.75 lifts the policy's action at s (1 and 2), and that of s' not; the random one (2.5) stays: it is not bounded
    bounded = [term([q + 2.5 + 2 * math.log(2), 2.75 - 0.3, q + 3 + 0.7], q + 2) for q in (0, 1)]
    assert penalty(2.75) == pytest.approx(sum(bounded), rel=1e-5)
    # V = 10 lifts every action of the policy
    high = [term([q + 2.5 + 2 * math.log(2), 10 - 0.3, 10 + 0.7], q + 2) for q in (0, 1)]
    assert penalty(10.0) == pytest.approx(sum(high), rel=1e-5)
    scaled = [term([10 * (q + 2.5) + 2 * math.log(2), 27.5 - 0.3, 10 * (q + 3) + 0.7], 10 * (q + 2)) / 100 for q in (0, 1)]
    assert penalty(2.75, scale=10.0) == pytest.approx(sum(scaled), rel=1e-5)
    assert penalty(2.75, weight=3.0) == pytest.approx(3 * sum(bounded), rel=1e-5)


def test_policy_values_below_the_return_are_not_pushed_down():
    """The gradient of a policy action's value is 0 where the return is higher, and positive (it is lowered) where not."""
    for mc, pushed in ((10.0, False), (-10.0, True)):
        value = torch.zeros((), requires_grad=True)
        learner = by_formula(agent(), lambda s, a, _, value=value: value * (a < 0))  # only the action at s, -1, is affected
        learner._critic_penalty(batch(mc), batch()["obs"], torch.zeros(2, 1)).backward()
        assert (value.grad.item() > 0.1) == pushed and (value.grad.item() == 0) != pushed


def test_the_target_takes_the_best_of_the_samples_by_the_lower_critic_without_entropy():
    data = batch() | {"ahead": torch.tensor([[[0.1, 0.0]], [[0.4, 0.0]], [[0.2, 0.0]]])}
    for best, expected in ((True, 5.4), (False, 5.1)):  # s' = 5; the lower critic is s + a
        learner = by_formula(agent(Conservative(max_target=best)), lambda s, a, _: s + a)
        target = learner.td_target(data, data["next_obs"], torch.randn(1, 2), temperature=torch.tensor(100.0))
        assert target.item() == pytest.approx(-1 + 0.9 * expected, rel=1e-5)
        drawn = learner.td_target(data, data["next_obs"], torch.randn(1, 2), torch.tensor(100.0), members=[1])  # the higher one alone
        assert drawn.item() == pytest.approx(-1 + 0.9 * (expected + 1), rel=1e-5)


def test_samples_come_with_the_densities_of_their_actions(bet_sac):  # noqa: F811
    """Importance weights are ratios of densities over actions: for tanh(u) / scale the log density has log(scale) more."""
    learner = CalQL(4, 2, SACConfig(bf16=False), DecoratorConfig(alpha=1.0, H=0), actor=bet_sac.with_lora(0),
                    critic_view=lambda x: x[:, -4:], rule=Conservative(actions=3), offline_updates=1, stays=False,
                    log_volume=float(bet_sac.scale.log().sum()))
    stored = torch.randn(5, 12)
    data = {"obs": stored, "next_obs": stored + 1, "base": torch.zeros(5, 2), "next_base": torch.zeros(5, 2)}
    drawn = learner._sampled(data, torch.Generator().manual_seed(0))
    assert drawn["random"].shape == drawn["here"].shape == (3, 5, 2) and drawn["random"].abs().max() <= 1
    assert abs(drawn["random"].mean()) < 0.35 and drawn["random"].min() < -0.3
    for name, obs in (("here", stored), ("ahead", stored + 1)):
        mean, log_std = bet_sac.heads(obs)
        parts = [torch.distributions.TanhTransform(cache_size=1), torch.distributions.AffineTransform(0, 1 / bet_sac.scale)]
        exact = torch.distributions.TransformedDistribution(torch.distributions.Normal(mean, log_std.exp()), parts)
        assert torch.allclose(exact.log_prob(drawn[name]).sum(-1), drawn[f"log_{name}"], atol=1e-2)


# ---- the offline stage -----------------------------------------------------------------------------------------------

def test_offline_values_of_random_actions_fall_below_those_of_the_data():
    gaps = {}
    for weight in (0.0, 1.0):
        trainer, _ = run("calql_c", calql_offline_updates=200, calql_weight=weight, log_every=504)
        data = trainer.demos.unpack(trainer.demos.rows)
        random = torch.rand(data["residual"].shape, generator=torch.Generator().manual_seed(1)) * 2 - 1
        with torch.no_grad():
            obs = trainer.agent.normalize(data["obs"])
            values = [trainer.agent.critics(torch.cat([obs, a], 1)).mean() for a in (data["residual"], random)]
        gaps[weight] = float(values[0] - values[1])
        assert trainer.agent.updates == 200
    assert gaps[1.0] > 0.5 and gaps[1.0] > gaps[0.0] + 0.3
    offline = [row for row in trainer.rows if row["step"] == 0]
    assert [row["updates"] for row in offline] == list(range(20, 201, 20)) and offline[-1]["conservative"] < offline[0]["conservative"]
    assert all("conservative" in row for row in offline) and "conservative" not in trainer.rows[-1]  # online it is plain SAC


def test_updates_of_the_loop_come_on_top_of_the_offline_ones():
    trainer, _ = run("calql_c", total_steps=1000, utd=0.25)
    assert trainer.agent.updates == 60 + int((1000 - 4 - 500) * 0.25)


def test_the_offline_stage_is_evaluated_but_not_selected(monkeypatch):
    from pdkit import online_eval

    given = iter([1.0, 0.2])
    monkeypatch.setattr(online_eval, "_score", lambda *_: {"success_once": next(given), "success_at_end": 0.0})
    trainer, _ = run("calql_c", total_steps=600, eval_every=600, eval_episodes=3, utd=0.5)
    offline = [row for row in trainer.rows if row["step"] == 0]
    assert "success_once" in offline[-1] and not any("success_once" in row for row in offline[:-1])
    assert offline[-1]["success_once"] == 1.0 and 0 < trainer.best_score <= 0.2


def test_rollouts_keep_failures():
    played = sources.rollouts(biased_base(), SPEC, list(range(20)))
    assert played.label == "agent" and played.num == 20 and played.seeds.tolist() == list(range(20))
    solved = [bool(e["success"].any()) for e in played.episodes()]
    assert 0 < sum(solved) < 10 and set(played.lengths) == {25}
    for e in played.episodes():
        assert np.allclose(e["observations"][1:, :2], np.clip(e["observations"][:-1, :2] + 0.2 * e["actions"], -1.5, 1.5), atol=1e-5)


def test_mixed_data_are_demonstrations_and_rollouts():
    sizes = {}
    for method in ("calql_a", "calql_b"):
        trainer = start(method)
        data = trainer.demos.unpack(trainer.demos.rows)
        sizes[method] = len(data["mc"]), float((data["mc"] == -10).float().mean())
        if method == "calql_a":
            assert trainer._rollouts.seeds.tolist() == list(rollout_seeds(6))  # none that a demonstration or a test has
    assert sizes["calql_b"][1] == 0 and sizes["calql_a"][1] > 0.3 and sizes["calql_a"][0] > sizes["calql_b"][0] + 100


# ---- setups A to E ---------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("method", SETUPS)
def test_setups_are_what_appendix_f3_lists(method, bet_sac):  # noqa: F811
    trainer, policy = run(method, bet_sac, total_steps=520, utd=0.5)
    learner = trainer.agent
    assert (trainer._rollouts is not None) == (method == "calql_a")
    assert learner.conservative == (method in ("calql_a", "calql_b")) and trainer.config.on_success == "terminate"
    assert trainer.config.demo_fraction == (0.5 if learner.conservative else 0.0)
    assert isinstance(learner.actor, BeTForSAC) == (method in ("calql_d", "calql"))
    opened = {n for n, p in learner.actor.named_parameters() if p.requires_grad}
    assert (len(opened) == len(list(learner.actor.parameters()))) == (method != "calql")
    assert trainer_of(method).needs_demos and 0 <= success("reach", policy) <= 1
    assert learner.log_volume == pytest.approx(2 * math.log(0.5) if method == "calql" else 0.0)  # of tanh(u) / scale


def test_in_setup_e_the_actor_starts_over_and_the_critics_go_on(bet_sac):  # noqa: F811
    before = {k: v.clone() for k, v in bet_sac.state_dict().items()}
    trainer, policy = run("calql", bet_sac)
    windows = torch.randn(6, 12)
    with torch.no_grad():
        assert torch.allclose(policy.mean_action(windows), bet_sac.mean_action(windows), atol=1e-6)
        assert torch.allclose(trainer.agent.actor.mean_action(windows), bet_sac.mean_action(windows), atol=1e-6)
    trained = [p for group in trainer.agent.actor_optimizer.param_groups for p in group["params"]]
    assert {n for n, p in trainer.agent.actor.named_parameters() if any(p is q for q in trained)} == \
        {n for n, _ in trainer.agent.actor.named_parameters() if "lora_" in n or n.startswith("spread.")}
    assert all(torch.equal(v, before[k]) for k, v in bet_sac.state_dict().items())
    assert trainer.agent.critic_optimizer.state  # not made anew
    assert trainer.agent.log_temperature.item() == pytest.approx(math.log(trainer.config.sac.init_temperature), abs=1e-6)
    assert not trainer.agent.temperature_optimizer.state  # the temperature is the actor's, and starts over with it
    offline = [r for r in trainer.rows if r["step"] == 0]
    assert len(offline) == 10 and offline[-1]["actor_loss"] != offline[0]["actor_loss"]
    assert offline[-1]["temperature"] != pytest.approx(trainer.config.sac.init_temperature, rel=1e-3)  # it had moved


def test_the_average_of_setup_e_forgets_the_offline_stage(bet_sac):  # noqa: F811
    """What is evaluated online is the plain mean of the actor's own online steps, not of hundreds of offline ones at the start."""
    trainer, _ = run("calql", bet_sac)
    agent = trainer.agent
    assert agent.actor_steps == 0 < agent.updates
    draw = lambda: agent.update(trainer.demos.unpack(trainer.demos.draw(32, trainer.generator)), trainer.generator)  # noqa: E731
    steps, average = iterates(agent, 12, draw)
    assert len(steps) == agent.actor_steps and torch.allclose(average, steps.mean(dim=0), atol=1e-5)


def test_rollouts_start_and_end_where_training_episodes_do(monkeypatch):
    """From a share of the way on, with the limit that is left (the probe has no way: its starts stay)."""
    asked = []
    for module in (methods.calql, online):
        monkeypatch.setattr(module, "horizon_spec", lambda spec, fraction: asked.append(fraction) or spec)
    whole, late = (start("calql_a", start_fraction=fraction, train_limit=20)._rollouts for fraction in (0.0, 0.5))
    assert asked == [0.0, 0.0, 0.5, 0.5] and whole.lengths.max() == 20 and late.lengths.max() == 10


def test_offline_all_weights_of_the_transformer_learn(bet_sac):  # noqa: F811
    made = start("calql", bet_sac)
    assert all(p.requires_grad for p in made.agent.actor.parameters())
    before = made.agent.actor.gpt.inp.weight.clone()
    made.agent.update(made.demos.unpack(made.demos.draw(32, made.generator)), made.generator)
    assert not torch.equal(before, made.agent.actor.gpt.inp.weight)


def test_setup_d_knows_nothing_of_the_imitated_policy_but_its_normaliser(bet_sac):  # noqa: F811
    actor = start("calql_d", bet_sac).agent.actor
    assert torch.equal(actor.normalizer.mean, bet_sac.normalizer.mean) and actor.config["bins"] == 1 and (actor.centres == 0).all()
    assert not torch.allclose(actor.gpt.inp.weight, bet_sac.gpt.inp.weight)
    assert actor.heads(torch.zeros(1, 12))[1].mean().item() == pytest.approx(-1.5, abs=0.2)


@pytest.mark.parametrize(("method", "offline", "steps"), [("calql_a", 300, 2500), ("calql_b", 300, 2500), ("calql_c", 200, 3500)])
def test_cal_ql_learns(method, offline, steps):
    _, policy = run(method, calql_offline_updates=offline, calql_rollouts=20, total_steps=steps, utd=0.5)
    assert success("reach", policy) > 0.9


def test_a_random_transformer_learns(bet_sac):  # noqa: F811
    """Setup D: it starts from nothing but the policy's normaliser."""
    _, policy = run("calql_d", bet_sac, lora=0, calql_offline_updates=100, total_steps=6000, utd=0.5, init_temperature=0.05)
    assert success("reach", policy) > 0.9


def test_cal_ql_mends_an_imitated_transformer(bet_sac):  # noqa: F811
    """Setup E, the paper's baseline: from a policy that aims beside the goal, with the spread that small actors start with."""
    beside = bet_sac.with_lora(0)
    set_spread(beside, -1.5)
    _, policy = run("calql", beside, lora=0, calql_offline_updates=100, total_steps=3000, utd=0.5)
    assert success("reach", policy) > 0.7 > 0.3 > success("reach", beside)


@pytest.mark.parametrize("method", ["calql_a", "calql"])
@pytest.mark.parametrize("where", [30, 600])
def test_killed_and_resumed_gives_the_same_curve(tmp_path, method, where, bet_sac):  # noqa: F811
    """Killed in the offline stage (30 updates) or online (600 steps)."""
    def fresh():
        return start(method, bet_sac, total_steps=800, utd=0.1, log_every=200, checkpoint_every=200, eval_every=400, eval_episodes=2)

    whole, config = fresh(), flat(fresh().config)
    whole.train(Run(tmp_path / "whole", "online", config))

    def killed(trainer):
        if (trainer.agent.updates if where < 60 else trainer.step) >= where:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fresh().train(Run(tmp_path / "cut", "online", config), killed)
    assert Run(tmp_path / "cut", "online", config).has_checkpoint  # of the offline stage too
    resumed = fresh()
    resumed.train(Run(tmp_path / "cut", "online", config))
    strip = lambda rows: [{k: v for k, v in row.items() if "seconds" not in k} for row in rows]  # noqa: E731
    assert strip(resumed.rows) == strip(whole.rows)
    one, other = whole.agent.state(), resumed.agent.state()
    assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
    assert torch.equal(whole.replay.rows, resumed.replay.rows)


def test_bad_input_is_told():
    with pytest.raises(PdkitError, match="pass demonstrations"):
        start("calql_c", demos=False)
    with pytest.raises(PdkitError, match="gamma below 1"):
        start("calql_b", gamma=1.0)
    with pytest.raises(PdkitError, match="calql_data"):
        MethodConfig(calql_data="x")
    with pytest.raises(PdkitError, match="calql_actions"):
        MethodConfig(calql_actions=0)
