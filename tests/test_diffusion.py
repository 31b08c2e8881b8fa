"""Diffusion Policy: the noise schedule, the U-Net, sampling, training windows with a horizon, and what it is for: several ways at once."""
import math

import numpy as np
import pytest
import torch
from test_policies import line_demos
from worlds import clone, reach_demos

from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.imitate import Average, ImitateConfig, Windows, imitate
from pdkit.policies import DiffusionPolicy, load_policy, save_policy
from pdkit.policies.unet import UNet, step_embedding
from pdkit.probes import PROBES
from pdkit.tasks import TASKS, get_task

SMALL = dict(obs_dim=3, act_dim=2, window=2, horizon=8, chunk=3, dims=[16, 32], groups=4, embed=16)


def policy(**changes):
    torch.manual_seed(0)
    return DiffusionPolicy(SMALL | changes).eval()


def test_the_defaults_are_the_official_codes():
    """facts.md 2.2, the sampler that decorates included."""
    official = dict(window=2, chunk=4, horizon=16, dims=[64, 128, 256], kernel=5, groups=8, embed=64, diffusion_steps=100,
                    prediction="epsilon", sampler="ddim", sampler_steps=4)
    recipe = dict(lr=1e-4, weight_decay=1e-6, schedule="cosine", lr_warmup=500, ema_power=0.75)
    assert official.items() <= DiffusionPolicy.defaults.items() and recipe.items() <= DiffusionPolicy.recipe.items()


def alpha_bar(step, steps=100):
    """The squared-cosine schedule (Nichol and Dhariwal, 2021), by hand: the product of 1 - beta, betas at most 0.999."""
    def f(t):
        return math.cos((t / steps + 0.008) / 1.008 * math.pi / 2) ** 2
    return math.prod(1 - min(1 - f(k + 1) / f(k), 0.999) for k in range(step + 1))


class Oracle(torch.nn.Module):
    """Knows the clean actions, so it tells the noise (or v) exactly."""

    def __init__(self, clean, v=False):
        super().__init__()
        self.clean, self.v, self.asked = clean, v, []

    def forward(self, noisy, steps, condition):
        self.asked.append(int(steps[0]))
        bar = torch.tensor([alpha_bar(int(k)) for k in steps])[:, None, None]
        noise = (noisy - bar.sqrt() * self.clean) / (1 - bar).sqrt()
        return bar.sqrt() * noise - (1 - bar).sqrt() * self.clean if self.v else noise


def test_the_network_is_told_step_and_observations():
    torch.manual_seed(0)
    unet = UNet(2, 6, (16, 32), 5, 4, 16).eval()
    actions, steps, condition = torch.randn(3, 8, 2), torch.tensor([0, 5, 99]), torch.randn(3, 6)
    out = unet(actions, steps, condition)
    assert out.shape == (3, 8, 2)
    for changed in ((actions + 1, steps, condition), (actions, steps + 1, condition), (actions, steps, condition + 1)):
        assert not torch.allclose(out, unet(*changed), atol=1e-4)
    assert torch.allclose(unet(actions[1:2], steps[1:2], condition[1:2]), out[1:2], atol=1e-5)  # rows do not see each other


def test_step_embedding_has_fast_and_slow_waves():
    e = step_embedding(torch.tensor([0, 3]), 8)
    assert e.shape == (2, 8) and e[0].tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert e[1, 0] == pytest.approx(math.sin(3)) and e[1, 3] == pytest.approx(math.sin(3e-4)) and e[1, 4] == pytest.approx(math.cos(3))


class Silent(torch.nn.Module):
    def forward(self, noisy, steps, condition):
        return torch.zeros_like(noisy)


def test_the_loss_is_that_of_the_noise_which_was_added():
    clean = torch.rand(4, 8, 2) * 2 - 1
    for prediction, v in (("epsilon", False), ("v_prediction", True)):
        p = policy(prediction=prediction)
        p.unet = Oracle(clean, v)
        assert p.loss(torch.randn(4, 2, 3), clean)["loss"] < 1e-4
        p.unet = Oracle(clean, not v)
        assert p.loss(torch.randn(4, 2, 3), clean)["loss"] > 0.1
    p = policy()
    p.unet = Silent()
    torch.manual_seed(0)
    assert p.loss(torch.randn(500, 2, 3), torch.zeros(500, 8, 2))["loss"] == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
@pytest.mark.parametrize(("sampler", "steps", "asked"), [("ddim", 4, [75, 50, 25, 0]), ("ddpm", 4, list(range(99, -1, -1)))])
def test_sampling_removes_the_noise_that_the_network_tells(sampler, steps, asked, prediction):
    p, clean = policy(sampler=sampler, sampler_steps=steps, prediction=prediction), torch.rand(2, 8, 2) * 1.8 - 0.9
    p.unet = Oracle(clean, prediction == "v_prediction")
    actions = p.denoise(torch.randn(2, 2, 3), torch.randn(2, 8, 2))
    assert torch.allclose(actions, clean, atol=1e-3) and p.unet.asked == asked


def test_no_more_steps_have_a_network_of_their_own_than_there_are():
    with pytest.raises(PdkitError, match="from 0 to all 4"):
        policy(late_steps=9)


def test_with_limits_noise_is_added_between_what_was_demonstrated_and_a_still_number_is_told_exactly():
    """The first number runs from 0.2 to 0.6, the second is always -0.5."""
    p, scaled = policy(action_limits=True), torch.rand(2, 8, 2) * 1.8 - 0.9
    p.fit_statistics(np.zeros((3, 3), np.float32), np.array([[0.2, -0.5], [0.6, -0.5], [0.3, -0.5]], np.float32))
    clean = torch.stack([0.4 + 0.2 * scaled[..., 0], torch.full((2, 8), -0.5)], dim=-1)
    assert torch.allclose(p.noisable(clean)[..., 0], scaled[..., 0], atol=1e-6) and not p.noisable(clean)[..., 1].any()
    p.unet = Oracle(p.noisable(clean))
    assert p.loss(torch.randn(2, 2, 3), clean)["loss"] < 1e-4
    assert torch.allclose(p.denoise(torch.randn(2, 2, 3), torch.randn(2, 8, 2)), clean, atol=1e-3)
    p.unet = Silent()
    assert torch.equal(p.denoise(torch.randn(2, 2, 3), torch.randn(2, 8, 2))[..., 1], clean[..., 1])
    beyond = p.noisable(torch.tensor([[1.0, 1.0], [-1.0, -1.0]]))  # as when DIPO has moved actions to where no demonstration goes
    assert beyond.tolist() == [[1, 0], [-1, 0]]


def test_a_range_of_next_to_nothing_is_none():
    p = policy(action_limits=True)
    p.fit_statistics(np.zeros((2, 3), np.float32), np.array([[0.2, 0.5], [0.2 + 5e-5, 0.5 + 3e-4]], np.float32))
    assert p.limits.reach[0] == 0 and p.limits.reach[1] == pytest.approx(1.5e-4, rel=1e-3)
    assert torch.allclose(p.noisable(torch.tensor([[0.9, 0.5 + 3e-4]])), torch.tensor([[0.0, 1.0]]), atol=1e-3)


def test_a_late_network_keeps_limits_and_temperature():
    p = policy(action_limits=True, temperature=0.5)
    p.fit_statistics(np.zeros((2, 3), np.float32), np.array([[0.2, -0.5], [0.6, 0.1]], np.float32))
    noise, windows = torch.randn(2, 8, 2), torch.randn(2, 2, 3)
    assert torch.equal(p.with_late(2).denoise(windows, noise), p.denoise(windows, noise))


def test_without_limits_actions_are_noised_as_they_are():
    p, actions = policy(), torch.rand(2, 8, 2)
    p.fit_statistics(np.zeros((3, 3), np.float32), np.full((3, 2), 0.5, np.float32))
    assert torch.equal(p.noisable(actions), actions) and torch.equal(p.executable(actions), actions)
    assert not any("limits" in name for name in p.state_dict())  # so that older files still load


def test_what_film_sees_goes_through_the_layers_of_the_observations(tmp_path):
    """By hand; they are trained with the rest, a late network shares them, and the policy comes back from disk."""
    p = policy(obs_encoder=[10, 6])
    p.fit_statistics(np.random.default_rng(0).normal(2, 3, (50, 3)).astype(np.float32), np.zeros((50, 2), np.float32))
    windows, noise = torch.randn(4, 2, 3), torch.randn(4, 8, 2)
    first, mish, second = p.obs_encoder
    flat = ((windows - p.normalizer.mean) / p.normalizer.std).flatten(1)
    wanted = torch.tanh(torch.log1p(torch.exp(flat @ first.weight.T + first.bias))) * (flat @ first.weight.T + first.bias)
    assert isinstance(mish, torch.nn.Mish) and torch.allclose(p.condition(windows), wanted @ second.weight.T + second.bias, atol=1e-5)
    assert p.film().in_features == 6
    p.loss(windows, torch.rand(4, 8, 2))["loss"].backward()
    assert all(layer.weight.grad.abs().max() > 0 for layer in (first, second))
    assert any(x is first.weight for x in p.parameter_groups(0.0)[0]["params"])
    with torch.no_grad():
        assert torch.equal(p.with_late(2).denoise(windows, noise), p.denoise(windows, noise))
        save_policy(p, tmp_path / "p")
        assert torch.equal(load_policy(tmp_path / "p").denoise(windows, noise), p.denoise(windows, noise))
    assert not any("obs_encoder" in name for name in policy().state_dict())  # so that older files still load


def test_a_temperature_scales_the_noise_that_sampling_starts_from():
    noise, windows = torch.randn(2, 8, 2), torch.randn(2, 2, 3)
    cold, warm = policy(temperature=0.5), policy()
    assert torch.equal(cold.denoise(windows, noise), warm.denoise(windows, 0.5 * noise))
    still = policy(temperature=0.0)
    windows = np.zeros((2, 2, 3), np.float32)
    assert np.array_equal(still.act(windows), still.act(windows)) and not np.array_equal(cold.act(windows), cold.act(windows))
    with pytest.raises(PdkitError, match="with ddpm set temperature=1"):
        policy(temperature=0.5, sampler="ddpm")
    with pytest.raises(PdkitError, match="Unknown sampler"):
        policy(temperature=0.5, sampler="x")


def test_limits_go_to_disk(tmp_path):
    p, windows = policy(action_limits=True), np.zeros((2, 2, 3), np.float32)
    p.fit_statistics(np.eye(3, dtype=np.float32), np.array([[0.2, -0.5], [0.6, 0.1]], np.float32))
    save_policy(p, tmp_path / "p")
    again = load_policy(tmp_path / "p")
    p.reset(1)
    actions = p.act(windows)
    again.reset(1)
    assert np.array_equal(again.act(windows), actions)
    assert (actions >= np.float32([0.2, -0.5]) - 1e-6).all() and (actions <= np.float32([0.6, 0.1]) + 1e-6).all()


def test_a_chunk_begins_at_the_latest_observation():
    p, clean = policy(), torch.arange(16.0).view(1, 8, 2) / 20
    p.unet = Oracle(clean)
    assert np.allclose(p.act(np.zeros((1, 2, 3), np.float32)), clean[:, 1:4], atol=1e-3)


def test_reset_repeats_the_noise_and_disk_keeps_the_policy(tmp_path):
    p, windows = policy(), np.random.default_rng(0).normal(size=(2, 2, 3)).astype(np.float32)
    p.normalizer.fit(np.random.default_rng(1).normal(3, 2, (50, 3)).astype(np.float32))
    p.reset(1)
    first, second = p.act(windows), p.act(windows)
    assert first.shape == (2, 3, 2) and not np.array_equal(first, second)
    save_policy(p, tmp_path / "p")
    again = load_policy(tmp_path / "p")
    again.reset(1)
    assert np.array_equal(again.act(windows), first)


def test_the_samplers_own_noise_comes_from_the_cpus_generator(monkeypatch):
    """The one that a checkpoint holds; and the sampler is not asked for any elsewhere."""
    from diffusers.schedulers import scheduling_ddpm

    p, drawn, draw = policy(sampler="ddpm", diffusion_steps=5, sampler_steps=5), [], scheduling_ddpm.randn_tensor
    monkeypatch.setattr(scheduling_ddpm, "randn_tensor", lambda *a, **k: drawn.append(k["generator"]) or draw(*a, **k))
    p.reset(3)
    windows = np.zeros((1, 2, 3), np.float32)
    first = p.act(windows)
    assert len(drawn) == 4 and all(g is torch.default_generator for g in drawn)  # the last step adds none
    torch.set_rng_state(torch.Generator().manual_seed(3).get_state())
    assert np.array_equal(p.act(windows), first)


@pytest.mark.parametrize(("changes", "message"), [
    (dict(horizon=7), "multiple of 2"), (dict(chunk=8), r"must be 1 to \d+ here, from the latest"), (dict(chunk=0), "at least 1"),
    (dict(dims=[10, 32]), "multiples of"), (dict(sampler="euler"), "Unknown sampler"), (dict(prediction="x"), "Unknown prediction"),
    (dict(spacing="x"), "Unknown spacing"), (dict(obs_encoder=[8, 0]), "at least"), (dict(obs_encoder=[0.5]), "whole numbers"),
    (dict(obs_encoder=8), "a list"),
    (dict(sampler_steps=0), "at least 1"), (dict(sampler_steps=101), "from 1 to")])
def test_settings_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(PdkitError, match=message):
        policy(**changes)


def test_windows_reach_beyond_the_end_with_actions_that_keep_still():
    demos, door = line_demos(3, 12), get_task("Door")
    windows = Windows(demos, 2, True, 8, door.resting)
    assert len(windows.index) == 3 * 12  # every observation is the latest of one window
    for number, start in enumerate(windows.index.tolist()):
        episode, t = demos.episode(number // 12), number % 12
        observations, actions = windows.observations[start + windows.span], windows.actions[start + windows.ahead]
        assert np.array_equal(observations, episode["observations"][[max(t - 1, 0), t]])
        assert np.array_equal(actions, episode["actions"][np.clip(np.arange(t - 1, t + 7), 0, 11)])  # targets: the last one goes on
    assert [x.shape for x in windows.sample(5, torch.Generator())] == [(5, 2, 39), (5, 8, 28)]


@pytest.mark.parametrize("task", TASKS)
def test_nothing_moves_on_after_the_end(task):
    """The same targets where actions are targets; else no displacement, and fingers stay as they are."""
    spec = get_task(task)
    action = np.linspace(-0.9, 0.9, spec.act_dim, dtype=np.float32)
    fingers = {"StackCube": [3], "PegInsertionSide": [6], "TurnFaucet": [6], "PushChair": [11, 19]}
    held = fingers.get(task.removesuffix("Source"), range(spec.act_dim))
    assert spec.absolute_actions == (len(held) == spec.act_dim)
    assert np.array_equal(spec.resting(action), [x if i in held else 0 for i, x in enumerate(action)])


def test_keeping_still_at_the_end_is_imitated_when_asked():
    demos = line_demos(2, 6)
    plain, held = (Windows(demos, 2, True, 4, lambda action: np.full_like(action, 9), hold) for hold in (False, True))
    assert len(held.index) == len(plain.index) + 2
    for number, start in enumerate(plain.index.tolist()):  # all windows of before are there, with the same actions
        mine = held.index.tolist()[number + number // 6]
        assert torch.equal(plain.actions[start + plain.ahead], held.actions[mine + held.ahead])
        assert torch.equal(plain.observations[start + plain.span], held.observations[mine + held.span])
    for number in (6, 13):
        start, episode = held.index.tolist()[number], demos.episode(number // 7)
        actions = held.actions[start + held.ahead]
        assert np.array_equal(held.observations[start + held.span], episode["observations"][-2:])
        assert np.array_equal(actions[0], episode["actions"][-1]) and (actions[1:] == 9).all()
    settings = dict(iterations=1, batch=8, eval_episodes=0, eval_every=1, bf16=False)
    small = dict(horizon=4, chunk=1, dims=[16, 32], groups=4, embed=16)
    losses = [imitate("diffusion", demos, ImitateConfig(**settings, hold_end=hold), small)[1][0]["loss"] for hold in (False, True)]
    assert losses[0] != losses[1]


def test_trailing_steps_begin_in_pure_noise_and_end_at_the_actions():
    """A network that knows the actions gives them back whatever the noise; what few steps make of a constant v tells the two apart."""
    p, clean = policy(prediction="v_prediction", spacing="trailing"), torch.arange(16.0).view(1, 8, 2) / 20
    assert p.sampler.timesteps.tolist() == [99, 74, 49, 24] and policy().sampler.timesteps.tolist() == [75, 50, 25, 0]
    bars = p.noise.alphas_cumprod

    class Knows(torch.nn.Module):
        def forward(self, x, k, condition):
            bar = bars[k][:, None, None]
            noise = (x - bar.sqrt() * clean) / (1 - bar).sqrt()
            return bar.sqrt() * noise - (1 - bar).sqrt() * clean

    p.unet = Knows()
    assert np.allclose(p.act(np.zeros((1, 2, 3), np.float32)), clean[:, 1:4], atol=1e-4)


def test_learning_rate_warms_up_and_falls_like_a_cosine():
    config = ImitateConfig(iterations=110, lr_warmup=10, schedule="cosine")
    assert [config.lr_factor(i) for i in (0, 5, 10, 60, 110)] == pytest.approx([0, 0.5, 1, 0.5, 0])
    assert ImitateConfig().lr_factor(0) == ImitateConfig().lr_factor(1499) == 1
    for bad in (dict(schedule="linear"), dict(lr_warmup=-1), dict(beta1=1.0), dict(ema_power=-0.5)):
        with pytest.raises(PdkitError):
            ImitateConfig(**bad)


def test_averaged_weights_are_in_place_only_while_asked():
    p = policy()
    with torch.no_grad():
        for parameter in p.parameters():
            parameter.zero_()
    average, expected = Average(p.parameters(), 0.75), 0.0
    for step in range(1, 5):
        with torch.no_grad():
            for parameter in p.parameters():
                parameter.fill_(float(step))
        average.step()
        decay = 1 - step ** -0.75 if step > 1 else 0.0  # 1 - (1 + k)^-power with k, the steps before this one
        expected = decay * expected + (1 - decay) * step
    with average.in_place():
        assert all(torch.allclose(x, torch.tensor(expected), atol=1e-5) for x in p.parameters())
    assert all((x == 4).all() for x in p.parameters())


def test_it_learns_two_ways_where_a_mean_would_be_neither():
    """Half of the demonstrations go left, half right, from the same observations: sequences stay whole and on one side."""
    demos = reach_demos(40)
    demos.observations[:] = 0
    demos.actions[:] = np.repeat(np.where(np.arange(40) % 2, 0.7, -0.7), demos.lengths)[:, None]
    learned = clone(DiffusionPolicy, demos, dict(horizon=4, chunk=3, dims=[16, 32], groups=4, embed=16, sampler_steps=10), iterations=400)
    actions = learned.act(np.zeros((200, 2, 4), np.float32))[..., 0]
    assert (np.abs(actions) < 0.35).mean() < 0.1  # hardly anything in the middle
    assert 0.2 < (actions[:, 0] > 0).mean() < 0.8  # both sides
    assert (np.sign(actions) == np.sign(actions[:, :1])).all(axis=1).mean() > 0.9  # a sequence does not change its mind


@pytest.mark.parametrize("widths", [[], [32, 32]])
def test_it_goes_where_the_observation_says(widths):
    """On the reach probe, from demonstrations that go straight to the goal, in chunks of two actions."""
    settings = dict(horizon=4, chunk=2, dims=[16, 32], groups=4, embed=16, obs_encoder=widths)
    learned = clone(DiffusionPolicy, reach_demos(60), settings, iterations=300)
    learned.reset(0)
    assert evaluate(PROBES["reach"], learned.act, range(500, 550), window=2, chunk=2).success_once.mean() > 0.4


def test_the_averaged_weights_are_what_imitation_keeps():
    """With a rate that moves weights far at each step, the kept weights are not the last ones but their average."""
    demos, settings = line_demos(4, 12), dict(iterations=3, batch=16, lr=0.1, eval_episodes=0, eval_every=3, bf16=False)
    small = dict(horizon=4, chunk=1, dims=[16, 32], groups=4, embed=16)
    last, averaged = (imitate("diffusion", demos, ImitateConfig(**settings, ema_power=power), small)[0] for power in (0.0, 0.75))
    assert (last.unet.out[1].bias - averaged.unet.out[1].bias).abs().max() > 0.01
