"""What lesson 03 measures and draws."""
import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex
from worlds import clone, reach_demos

from pdkit import check, plots, plots_diffusion, stats
from pdkit import diffusion_analysis as analysis
from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.policies import DiffusionPolicy
from pdkit.probes import PROBES, ForkSim
from pdkit.seeds import reported_seeds

SMALL = dict(horizon=4, chunk=2, window=2, dims=[16, 32], groups=4, embed=16)


@pytest.fixture(scope="module")
def policy():
    return clone(DiffusionPolicy, reach_demos(10), SMALL, iterations=20)


def test_the_obstacle_stops_whoever_touches_it():
    sim = ForkSim()
    sim.reset(0)
    flags = [sim.step(np.array([1.0, 0.0]))[1] for _ in range(10)]
    assert sim.crashed and not any(flags) and np.linalg.norm(sim.position - [1, 0]) < 0.4
    sim.reset(0)
    assert not sim.crashed
    for action in [(1, 0.7)] * 4 + [(1, -0.4)] * 4:
        solved = sim.step(np.array(action))[1]
    assert solved and not sim.crashed


def test_demonstrations_pass_on_either_side_from_the_same_observations():
    demos = analysis.fork_demos(20, noise=0.1, seed=3)
    above = []
    for episode in demos.episodes():
        at = episode["observations"]
        assert episode["success"][-1] and (np.linalg.norm(at - ForkSim.CENTRE, axis=1) >= ForkSim.RADIUS).all()
        assert np.abs(at[0]).max() <= 0.05
        above.append(at[np.argmax(at[:, 0] > 0.9), 1] > 0)
    assert above == [bool(k % 2) for k in range(20)]
    assert np.array_equal(analysis.fork_demos(20, 0.1, 3).actions, demos.actions)


class Detour:
    """Goes past the obstacle above where it starts above the line, else straight into it (`sides`: below instead)."""

    window = chunk = 1

    def __init__(self, sides=False):
        self.sides = sides

    def reset(self, seed):
        self.seed = seed

    def act(self, windows):
        x, y = windows[:, -1, 0], windows[:, -1, 1]
        up = np.where(y > 0, 1.0, -1.0 if self.sides else 0.0)
        return np.stack([np.ones_like(x), np.where(x < 0.9, 0.7, -0.4) * up], axis=1)[:, None].astype(np.float32)


def test_at_the_fork_a_crash_has_no_side():
    rate, ways, above = analysis.at_fork(Detour())
    assert rate.value == pytest.approx(np.mean([path[0, 1] > 0 for path in analysis.paths(Detour(), reported_seeds(100))]))
    assert len(ways) == 30 and above == 1
    rate, ways, above = analysis.at_fork(Detour(sides=True))
    assert rate.value == 1 and above == pytest.approx(np.mean([path[0, 1] > 0 for path in ways])) and 0 < above < 1


def test_noising_and_denoising_are_the_policys_own(policy):
    clean = np.linspace(-0.8, 0.8, 8, dtype=np.float32).reshape(4, 2)
    steps = analysis.noised(policy, clean, [0, 99])
    assert np.abs(steps[0] - clean).max() < 0.1
    assert np.allclose(steps[1], torch.randn(4, 2, generator=torch.Generator().manual_seed(0)), atol=0.05)
    window = np.zeros((2, 4), np.float32)
    asked, sequences = analysis.denoising(policy, window, seed=1)
    noise = torch.randn(1, 4, 2, generator=torch.Generator().manual_seed(1))
    assert asked == [75, 50, 25, 0] and sequences.shape == (5, 4, 2) and np.array_equal(sequences[0], noise[0])
    assert np.array_equal(sequences[-1], policy.denoise(torch.from_numpy(window)[None], noise).detach()[0])


def test_what_is_drawn_of_a_policy_with_limits_are_actions():
    limited = clone(DiffusionPolicy, reach_demos(10), SMALL | {"action_limits": True}, iterations=2)
    limited.limits.fit(np.float32([[0.2, -0.5], [0.6, 0.1]]))
    clean = np.stack([np.linspace(0.25, 0.55, 4), np.linspace(-0.4, 0.05, 4)], axis=1).astype(np.float32)  # within the limits
    middle, half = np.float32([0.4, -0.2]), np.float32([0.2, 0.3])
    steps = analysis.noised(limited, clean, [0, 99])
    assert np.abs(steps[0] - clean).max() < 0.05
    assert np.allclose(steps[1], middle + half * torch.randn(4, 2, generator=torch.Generator().manual_seed(0)).numpy(), atol=0.05)
    noise = torch.randn(1, 4, 2, generator=torch.Generator().manual_seed(1))
    _, sequences = analysis.denoising(limited, np.zeros((2, 4), np.float32), seed=1)
    assert np.allclose(sequences[0], middle + half * noise[0].numpy(), atol=1e-6)
    assert np.array_equal(sequences[-1], limited.denoise(torch.zeros(1, 2, 4), noise).detach()[0])


def test_variants_have_the_same_weights(policy):
    table = analysis.compare_sampling(policy, PROBES["reach"], {"as it is": {}, "one by one": dict(chunk=1)}, list(range(8)), lanes=4)
    other = analysis.resampled(policy, chunk=1)
    assert other.chunk == 1 and policy.chunk == 2
    assert all(torch.equal(a, b) for a, b in zip(policy.state_dict().values(), other.state_dict().values(), strict=True))
    other.reset(0)
    expected = evaluate(PROBES["reach"], other.act, range(8), window=2, chunk=1, num_envs=4)
    assert table.successes[1] == expected.success_once.sum() and table.action_change[1] == pytest.approx(expected.action_change.mean())
    assert table.episodes.tolist() == [8, 8] and (table.ms_per_step > 0).all()
    policy.reset(0)
    first = evaluate(PROBES["reach"], policy.act, range(8), window=2, chunk=2, num_envs=4)
    pair = stats.paired(first, expected)
    assert table.difference.tolist() == [0, pair.difference] and (table.low[1], table.high[1]) == (pair.low, pair.high)


def test_paths_end_at_success_or_the_limit(policy):
    ways = analysis.paths(policy, range(4), PROBES["reach"])
    assert all(way.shape[1] == 4 and 2 <= len(way) <= PROBES["reach"].max_episode_steps + 1 for way in ways)


def test_figures_show_what_they_are_given(policy):
    crash, past = np.array([[0, 0], [0.7, 0]]), np.array([[0, 0], [1, 0.7], [2, 0]])
    figure = plots_diffusion.fork_figure({"demonstrations": [past], "MLP": [crash, past]}, {"MLP": stats.wilson(1, 2)})
    colours = [line.get_color() for line in figure.axes[1].lines]
    assert len(figure.axes) == 2 and colours == [plots.COLORS["lost"]] * 2 + [plots.COLORS["decorated"]] * 2
    assert "50% pass" in figure.axes[1].get_title(loc="left")
    bars = policy.noise.alphas_cumprod.numpy()
    lines = plots_diffusion.schedule_figure(bars, {"DDIM": [75, 50]}).axes[0].lines
    assert np.allclose(lines[0].get_ydata() ** 2 + lines[1].get_ydata() ** 2, 1, atol=1e-5) and lines[2].get_xdata().tolist() == [75, 50]
    rows = {"to noise": ([0, 99], np.zeros((2, 4, 2))), "back": ([75, 0, "actions"], np.ones((3, 4, 2)))}
    axes = plots_diffusion.sequences_figure(rows, chunk=slice(1, 3)).axes
    assert [len(ax.lines) for ax in axes] == [2, 2, 0, 2, 2, 2] and len(axes[5].patches) == 1 and not axes[4].patches
    bars = plots_diffusion.chunks_figure(2, 3, 8, 2).axes[0].patches
    executed = [bar.get_x() + 0.45 for bar in bars if to_hex(bar.get_facecolor()) == to_hex(plots.COLORS["decorated"])]
    assert np.allclose(executed, [0, 1, 2, 3, 4, 5])


def test_the_exercise_names_the_likely_mistakes(capsys):
    def step(x, noise, here, after, clip=True, back=True):
        clean = (x - (1 - here) ** 0.5 * noise) / here**0.5
        clean = clean.clamp(-1, 1) if clip else clean
        return after**0.5 * clean + (1 - after) ** 0.5 * noise if back else clean

    assert check.ddim_step(step)
    for wrong, words in ((lambda *a: step(*a, clip=False), "clip them"), (lambda *a: step(*a, back=False), "put the noise"),
                         (lambda x, *a: x, "the first number"), (lambda *a: step(*a)[:3], "shape")):
        assert not check.ddim_step(wrong)
        assert words in capsys.readouterr().out
    with pytest.raises(PdkitError, match="ddim_step"):
        check.ddim_step(lambda *a: step(*a)[:3], strict=True)
