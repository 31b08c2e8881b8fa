"""DPPO: the Gaussians of a chain, what of it is fine-tuned and how, and that it learns."""
import math

import numpy as np
import pytest
import torch
from test_dipo import ONE_LEVEL, SMALL, biased, policy, success  # noqa: F401 (biased is a fixture)
from test_ppo import moved
from worlds import reach_trainer

from pdkit import cli
from pdkit.decorator import DecoratorConfig
from pdkit.errors import PdkitError
from pdkit.methods.config import MethodConfig
from pdkit.policies import DiffusionPolicy, load_policy
from pdkit.policies.diffusion import _scheduler
from pdkit.probes import biased_base
from pdkit.profiles import flat
from pdkit.rl.dppo import DPPO, Steps, clip_ranges
from pdkit.rl.sac import SACConfig
from pdkit.runs import Run

FOUR = SMALL | dict(sampler_steps=4)  # 75, 50, 25, 0 of 100


def agent(late=2, base=FOUR, **own):
    torch.manual_seed(0)
    actor = policy(base).with_late(late).requires_grad_(False)
    actor.late.requires_grad_(True)
    config = MethodConfig(**dict(ppo_epochs=1, ppo_minibatches=2, ppo_grad_clip=1e6) | own)
    return DPPO(4, 4, config, SACConfig(hidden=8, layers=1, bf16=False), DecoratorConfig(alpha=1.0, H=0), actor=actor,
                value_view=lambda stored: stored[:, -4:])


def rollout(learner, rows=16):
    """A made-up rollout by this learner, in the columns of its replay."""
    torch.manual_seed(1)
    obs = torch.randn(rows, 8)
    actions, log_probs, chain = learner.act(obs, torch.randn(rows, 1 + len(learner.steps.times), 4, 2))
    zeros = torch.zeros(rows, 4)
    return {"obs": obs, "next_obs": torch.randn(rows, 8), "residual": actions, "base": zeros, "next_base": zeros,
            "reward": torch.randn(rows), "discount": torch.full((rows,), 0.9), "done": torch.zeros(rows), "open": torch.ones(rows),
            "log_prob": log_probs, "chain": chain.flatten(1)}


# ---- terms -----------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
@pytest.mark.parametrize(("sampler", "spacing"), [("ddim", "leading"), ("ddim", "trailing"), ("ddpm", "leading")])
def test_a_step_is_that_of_diffusers(sampler, spacing, prediction):
    """DDIM with eta = 1 and four steps, and DDPM with a hundred; predictions so large that x0 is clipped too."""
    scheduler = _scheduler(sampler, dict(diffusion_steps=100, prediction=prediction, spacing=spacing))
    scheduler.set_timesteps(4 if sampler == "ddim" else 100)
    steps, noise = Steps(scheduler), torch.randn(5, 4, 2)
    for number in range(0, len(steps.times), 1 if sampler == "ddim" else 33):
        x, predicted = torch.randn(5, 4, 2), 2 * torch.randn(5, 4, 2)
        if sampler == "ddim":
            expected = scheduler.step(predicted, steps.times[number], x, eta=1.0, use_clipped_model_output=True, variance_noise=noise)
        else:
            torch.manual_seed(3)
            expected = scheduler.step(predicted, steps.times[number], x)
            torch.manual_seed(3)
            noise = torch.randn(5, 4, 2)
        ours = steps.mean(torch.full((5,), number), x, predicted) + steps.sigma[number] * noise
        assert torch.allclose(ours, expected.prev_sample, atol=1e-4), number
    assert steps.sigma[-1] == 0 and (steps.sigma[:-1] > 0).all()


def test_clip_ranges_by_hand():
    """t = 0, 1/2, 1: 0.001, 0.001 + 0.009 * (e^1.5 - 1) / (e^3 - 1), 0.01."""
    expected = [0.001, 0.001 + 0.009 * (math.exp(1.5) - 1) / (math.exp(3) - 1), 0.01]
    assert clip_ranges(MethodConfig(), 3).tolist() == pytest.approx(expected)
    assert clip_ranges(MethodConfig(), 1).tolist() == pytest.approx([0.01])


def test_log_probability_is_a_clamped_mean_over_what_is_executed():
    learner, last = agent(), torch.tensor([3])  # sigma 0 there: the least std, 0.1
    at_mean = -math.log(0.1) - 0.5 * math.log(2 * math.pi)
    mean, after = torch.zeros(1, 4, 2), torch.zeros(1, 4, 2)
    assert learner.log_prob(mean, last, after).item() == pytest.approx(at_mean, abs=1e-5)
    after[:, [0, 3]] = 7.0  # in the past, and beyond the chunk
    assert learner.log_prob(mean, last, after).item() == pytest.approx(at_mean, abs=1e-5)
    after[0, 1, 0], after[0, 2, 1] = 0.1, 9.0  # one standard deviation; impossible, so -5
    assert learner.log_prob(mean, last, after).item() == pytest.approx((2 * at_mean + at_mean - 0.5 - 5) / 4, abs=1e-5)
    narrow = agent(dppo_log_prob_std=0.01)
    assert narrow.log_prob(mean, last, torch.zeros(1, 4, 2)).item() == 2.0  # 3.7, clamped
    first = torch.tensor([0])
    sigma = learner.steps.sigma[0].item()
    assert sigma > 0.1 and learner.log_prob(mean, first, torch.zeros(1, 4, 2)).item() == pytest.approx(
        -math.log(sigma) - 0.5 * math.log(2 * math.pi), abs=1e-5)


def test_a_chain_takes_the_fine_tuned_network_for_its_last_steps_and_the_least_noise_everywhere():
    obs, noise = torch.randn(3, 8), torch.randn(3, 5, 4, 2)
    learner = agent(dppo_sample_std=0.2, dppo_log_prob_std=0.3)
    for p in learner.actor.late.parameters():
        p.data += 0.1 * torch.randn_like(p)
    actions, log_probs, chain = learner.act(obs, noise)
    assert log_probs.shape == (3, 2) and chain.shape == (3, 3, 4, 2)
    condition, x, seen = learner.actor.condition(obs.view(3, 2, 4)), noise[:, 0], []
    for number, network in enumerate([learner.actor.unet] * 2 + [learner.actor.late] * 2):
        seen.append(x)
        numbers = torch.full((3,), number)
        mean = learner.steps.mean(numbers, x, network(x, learner.steps.times[numbers], condition))
        x = mean + max(float(learner.steps.sigma[number]), 0.2) * noise[:, number + 1]
        if number >= 2:
            assert torch.allclose(log_probs[:, number - 2], learner.log_prob(mean, numbers, x), atol=1e-4)
    assert torch.allclose(chain, torch.stack([*seen[2:], x], 1), atol=1e-4) and torch.allclose(actions, x[:, 1:3].flatten(1), atol=1e-4)
    wild = torch.zeros(1, 5, 4, 2)
    wild[:, -1] = 10.0  # is cut at three standard deviations
    calm = torch.zeros(1, 5, 4, 2)
    assert torch.allclose(learner.act(obs[:1], wild)[0] - learner.act(obs[:1], calm)[0], torch.tensor(0.6), atol=1e-4)


def test_a_chain_on_the_scale_of_limits_is_executed_off_it():
    learner = agent(base=FOUR | {"action_limits": True})
    noise = torch.randn(16, 5, 4, 2)
    plain, _, chain = learner.act(torch.zeros(16, 8), noise)
    learner.actor.limits.fit(np.float32([[0.2, -0.5], [0.6, 0.1]]))
    actions, _, same = learner.act(torch.zeros(16, 8), noise)
    middle, half = torch.tensor([0.4, -0.2]).repeat(2), torch.tensor([0.2, 0.3]).repeat(2)
    assert torch.equal(chain, same) and torch.allclose(actions, middle + half * plain, atol=1e-6)


def test_a_chain_starts_at_the_policys_temperature():
    noise = torch.randn(16, 5, 4, 2)
    _, _, chain = agent(late=4, base=FOUR | {"temperature": 0.5}).act(torch.zeros(16, 8), noise)
    assert torch.equal(chain[:, 0], 0.5 * noise[:, 0])


def test_rows_are_the_fine_tuned_steps_of_each_decision_with_a_discount_that_spares_the_last():
    learner = agent(late=3, dppo_gamma=0.5)
    data = rollout(learner)
    rows = learner._prepared(data, 4)
    plain = super(DPPO, learner)._prepared(data, 4)
    chain = data["chain"].view(16, 4, 4, 2)
    assert rows["step"].tolist() == [0, 1, 2] * 16
    assert torch.allclose(rows["advantage"].view(16, 3), plain["advantage"][:, None] * torch.tensor([0.25, 0.5, 1.0]))
    assert torch.equal(rows["before"].view(16, 3, 4, 2), chain[:, :3]) and torch.equal(rows["after"].view(16, 3, 4, 2), chain[:, 1:])
    assert torch.equal(rows["log_prob"].view(16, 3), data["log_prob"])
    for name in ("obs", "returns"):  # the value is one of the environment's state: the same for all steps
        assert torch.equal(rows[name].unflatten(0, (16, 3)), plain[name][:, None].expand(16, 3, *plain[name].shape[1:])), name


def minibatch(learner, step, advantage=1.0, log_ratio=0.0):
    """One row for each decision of a rollout, at one fine-tuned step, whose ratio is exp(log_ratio)."""
    rows = learner._prepared(rollout(learner), 4)
    rows = {k: v[rows["step"] == step] for k, v in rows.items()}
    return rows | {"advantage": torch.full_like(rows["advantage"], advantage), "log_prob": rows["log_prob"] - log_ratio}


def test_ratios_start_at_one_and_each_step_has_its_own_clip():
    """Ratio 1.005 with a positive advantage: beyond 0.001 at the noisiest step, within 0.01 at the last."""
    for step, limit, clipped in ((0, 1.001, 1.0), (1, 1.005, 0.0)):
        learner = agent(ppo_value_coef=0.0)
        before = learner.actor.late.state_dict()["out.1.weight"].clone()
        assert float(agent()._step(minibatch(learner, step), None)["policy_loss"]) == pytest.approx(-1, abs=1e-4)
        log = learner._step(minibatch(learner, step, log_ratio=math.log(1.005)), None)
        assert -float(log["policy_loss"]) == pytest.approx(limit, abs=1e-4) and float(log["clipped"]) == clipped
        assert torch.equal(before, learner.actor.late.out[1].weight) == bool(clipped)


def test_what_paid_becomes_likelier_and_what_cost_less_likely():
    for advantage in (1.0, -1.0):
        learner = agent(ppo_value_coef=0.0, ppo_lr=1e-3)
        rows = minibatch(learner, 1, advantage)
        learner._step(rows, None)
        log = learner._step(rows | {"advantage": torch.ones(16)}, None)  # minus the mean ratio, where not clipped
        assert (-float(log["policy_loss"]) - 1) * advantage > 1e-4


def test_only_the_last_steps_network_and_the_value_function_learn_each_at_its_rate():
    learner = agent(ppo_lr=1e-4, dppo_value_lr=1e-2)
    start, value = agent().actor, agent().value
    learner.update(rollout(learner), 4, torch.Generator().manual_seed(0))
    assert learner.updates == 2 and moved(learner.actor.unet, start.unet) == 0
    assert 1e-5 < moved(learner.actor.late, start.late) < 3e-4 and 3e-3 < moved(learner.value, value) < 3e-2
    learner.scale_lr(0.5)
    assert [g["lr"] for g in learner.optimizer.param_groups] == [5e-5, 5e-3]


def test_the_value_sees_the_last_observation_alone_and_is_not_clipped():
    learner, rows = agent(), minibatch(agent(), 1)
    assert all(p.shape[1] == 4 for n, p in learner.value.named_parameters() if n.endswith("0.0.weight"))
    with torch.no_grad():
        expected = 0.5 * (learner.value(rows["obs"][:, -4:])[0] - rows["returns"]).square().mean()
    assert float(learner._step(rows, None)["value_loss"]) == pytest.approx(float(expected), rel=1e-5)


# ---- the policy ------------------------------------------------------------------------------------------------------

def test_a_late_network_starts_as_the_other_and_goes_to_disk(tmp_path):
    from pdkit.policies import save_policy

    start, windows, noise = policy(FOUR), torch.randn(3, 2, 4), torch.randn(3, 4, 2)
    two = start.with_late(2)
    assert torch.equal(two.denoise(windows, noise), start.denoise(windows, noise))
    two.late.out[1].bias.data += 0.3
    save_policy(two, tmp_path / "p")
    again = load_policy(tmp_path / "p")
    assert torch.equal(again.denoise(windows, noise), two.denoise(windows, noise))
    assert not torch.allclose(again.denoise(windows, noise), start.denoise(windows, noise), atol=1e-2)
    asked = []
    for name in ("unet", "late"):
        getattr(two, name).register_forward_hook(lambda module, inputs, out, name=name: asked.append((name, int(inputs[1][0]))))
    two.denoise(windows, noise)
    assert asked == [("unet", 75), ("unet", 50), ("late", 25), ("late", 0)]


# ---- on the loop -----------------------------------------------------------------------------------------------------

def start(base, **changes):
    values = dict(total_steps=600, warmup_steps=0, utd=0.0, lr_decay_from=0.0, dppo_steps=2, ppo_rollout=16, ppo_epochs=2,
                  ppo_minibatches=2)
    return reach_trainer("dppo", base, **values | changes)


@pytest.mark.parametrize("rank", [0, 2])
def test_all_weights_of_the_late_network_train_or_its_adapters(rank):
    actor = start(policy(ONE_LEVEL), lora=rank).agent.actor
    assert {n for n, p in actor.named_parameters() if p.requires_grad} == {
        n for n, _ in actor.named_parameters() if n.startswith("late.") and ("lora_" in n or not rank)}


def test_a_rollout_holds_the_chains_of_what_was_executed(monkeypatch):
    trainer, seen = start(policy(ONE_LEVEL), dppo_steps=1), []
    update = trainer.agent.update

    def keep(data, *others):
        seen.append({k: v.clone() for k, v in data.items()})
        return update(data, *others)

    monkeypatch.setattr(trainer.agent, "update", keep)
    trainer.train()
    data = seen[0]
    chain = data["chain"].view(64, 2, 4, 2)
    assert torch.equal(chain[:, -1, 1:3].flatten(1), data["residual"]) and data["log_prob"].shape == (64, 1)
    learner, numbers = agent(1, ONE_LEVEL), torch.ones(64, dtype=torch.int64)  # as imitated: the policy that acted
    with torch.no_grad():
        predicted = learner.actor.predicted(1, chain[:, 0], trainer.base.normalizer(data["obs"].view(64, 2, 4)).flatten(1))
        expected = learner.log_prob(learner.steps.mean(numbers, chain[:, 0], predicted), numbers, chain[:, 1])
    assert torch.allclose(data["log_prob"][:, 0], expected, atol=1e-4)
    first, then = data["residual"].clamp(-1, 1).view(64, 2, 2).unbind(1)
    landed = ((data["obs"][:, 4:6] + 0.2 * first).clamp(-1.5, 1.5) + 0.2 * then).clamp(-1.5, 1.5)
    assert ((landed - data["next_obs"][:, 4:6]).abs().amax(1) < 1e-5).float().mean() > 0.8
    assert (data["open"] == 1).all() and torch.isin(data["reward"], torch.tensor([0.0, -0.1])).all()


def test_killed_and_resumed_gives_the_same_curve(tmp_path):
    def fresh():
        return start(policy(ONE_LEVEL), log_every=100, checkpoint_every=200, eval_every=200, eval_episodes=2)

    whole, config = fresh(), flat(fresh().config)
    whole.train(Run(tmp_path / "whole", "online", config))

    def killed(trainer):
        if trainer.step >= 300:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fresh().train(Run(tmp_path / "cut", "online", config), killed)
    resumed = fresh()
    resumed.train(Run(tmp_path / "cut", "online", config))
    strip = lambda rows: [{k: v for k, v in row.items() if "seconds" not in k} for row in rows]  # noqa: E731
    assert strip(resumed.rows) == strip(whole.rows) and whole.agent.updates == 16
    one, other = whole.agent.state(), resumed.agent.state()
    assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
    assert torch.equal(whole.replay.rows, resumed.replay.rows)


@pytest.mark.parametrize("rank, lr, seeds", [(0, 1e-3, 2), (4, 5e-3, 1)])
def test_it_improves_a_biased_policy_and_leaves_the_start_alone(biased, tmp_path, rank, lr, seeds):  # noqa: F811
    """By DPPO's own clip, discount and least stds; all weights, or adapters."""
    before, ends = {k: v.clone() for k, v in biased.state_dict().items()}, []
    for seed in range(seeds):
        trainer = start(biased, seed=seed, num_envs=16, total_steps=14_000, gamma=0.8, ppo_epochs=8, ppo_minibatches=4, ppo_lr=lr,
                        dppo_value_lr=3e-3, hidden=64, lora=rank)
        ends.append(success(learned := trainer.train()))
    assert success(biased) < 0.45 and min(ends) > success(biased) + 0.15, ends
    assert all(torch.equal(v, before[k]) for k, v in biased.state_dict().items())
    assert all(torch.equal(v, before[k]) for k, v in learned.state_dict().items() if not k.startswith("late."))
    trainer.save_policy(learned, tmp_path / "p")
    again, windows = load_policy(tmp_path / "p"), np.random.default_rng(0).normal(size=(5, 2, 4)).astype(np.float32)
    actions = []
    for p in (learned, again):
        p.reset(0)
        actions.append(p.act(windows))
    assert type(again) is DiffusionPolicy and again.config["late_steps"] == 2
    assert np.allclose(*actions, atol=1e-5 if rank else 0, rtol=0)  # adapters are added up when saved


def test_what_dppo_cannot_use_is_refused(tmp_path):
    with pytest.raises(PdkitError, match="kind diffusion, not probe"):
        start(biased_base())
    with pytest.raises(PdkitError, match="320 decisions, 640 steps: take fewer"):
        start(policy(ONE_LEVEL), ppo_rollout=80)
    with pytest.raises(PdkitError, match="from 0 to all 2 of the sampler's"):
        start(policy(ONE_LEVEL), dppo_steps=3)
    with pytest.raises(PdkitError, match="one that was only imitated"):
        start(policy(ONE_LEVEL).with_late(1))
    for bad in (dict(dppo_steps=0), dict(dppo_gamma=1.1), dict(dppo_clip=1e-4), dict(dppo_sample_std=0.0), dict(dppo_value_lr=-1.0)):
        with pytest.raises(PdkitError, match="DPPO needs"):
            MethodConfig(**bad)


def test_a_task_without_a_diffusion_policy_is_told_what_to_give(capsys):
    assert cli.main(["train", "decorated", "Pen", "--method", "dppo"]) == 2
    said = capsys.readouterr().err
    assert "`pdkit train base Pen --policy diffusion`" in said and "--base" in said and len(said.strip().splitlines()) == 1
