"""What notebooks 06 and 07 measure: pulls, drift, spreads, the gap that moves a temperature, and verdicts that follow the numbers."""
import math

import numpy as np
import pytest
import torch
from test_vector import COUNT
from worlds import clone, reach_demos

from pdkit import plots, plots_failures, unlearning
from pdkit.decorated import Decorated
from pdkit.demos import load_demos
from pdkit.errors import PdkitError
from pdkit.files import DATA
from pdkit.policies.bet_sac import BeTForSAC
from pdkit.probes import PROBES
from pdkit.stats import paired, wilson

TINY = dict(window=3, bins=4, layers=1, embed=16, heads=2, features=16, dropout=0.0)
REACH = dict(num_envs=4, hidden=32, batch=32, train_limit=20)
LOOP = dict(spec=PROBES["reach"], **REACH)


@pytest.fixture(scope="module")
def policy():
    return clone(BeTForSAC, reach_demos(10), TINY, iterations=60)


@pytest.fixture(scope="module")
def tuning(policy):
    return unlearning.starting_point("sac_finetune", "Door", policy, 160, lora=0, **LOOP)


@pytest.fixture(scope="module")
def residual(policy):
    return unlearning.starting_point("policy_decorator", "Door", policy, 160, alpha=0.1, **LOOP)


@pytest.fixture(scope="module")
def windows(policy):
    return unlearning.held_out(reach_demos(10), policy.window, 20, skip=2)


# ---- learner ---------------------------------------------------------------------------------------------------------

def test_a_starting_point_has_data_and_an_untouched_actor(policy, tuning, windows):
    assert tuning.replay.size > 100 and tuning.agent.updates == 0
    assert unlearning.drift(tuning.agent.actor.act(windows)[:, 0], policy.act(windows)[:, 0]) < 1e-6


@pytest.mark.parametrize("name", ["tuning", "residual"])
def test_a_fresh_learner_repeats_the_actor_and_varies_the_critic(name, request):
    tuning = request.getfixturevalue(name)
    first, again, other = unlearning.fresh(tuning, 0), unlearning.fresh(tuning, 0), unlearning.fresh(tuning, 1, init_temperature=0.5)
    weights = [torch.cat([p.flatten() for p in agent.critics.parameters()]) for agent in (first, again, other)]
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])
    for key, tensor in tuning.agent.actor.state_dict().items():
        assert torch.equal(other.actor.state_dict()[key], tensor)
    assert math.isclose(float(other.log_temperature.detach().exp()), 0.5, rel_tol=1e-5)
    with pytest.raises(PdkitError, match="settings of SAC"):
        unlearning.fresh(tuning, 0, lerning_rate=1.0)


@pytest.mark.parametrize("critics", [False, True])
def test_updates_move_the_critics_only_if_asked(tuning, windows, policy, critics):
    agent = unlearning.fresh(tuning, 0, actor_lr=1e-2)
    before = [p.detach().clone() for p in agent.critics.parameters()]
    rows = list(unlearning.updates(agent, tuning.replay, 5, batch=16, critics=critics))
    moved = any(not torch.equal(a, b) for a, b in zip(before, agent.critics.parameters(), strict=True))
    assert moved == critics and ("critic_loss" in rows[0]) == critics
    assert [row["update"] for row in rows] == [1, 2, 3, 4, 5]
    assert unlearning.drift(agent.actor.act(windows)[:, 0], policy.act(windows)[:, 0]) > 1e-3


def test_a_residual_drifts_no_further_than_its_bound(policy, residual, windows):
    """With actor steps that are far too large, and the fine-tuned policy beside it as a check that they are."""
    agent = unlearning.fresh(residual, 0, actor_lr=0.3)
    list(unlearning.updates(agent, residual.replay, 30, batch=16, critics=False))
    decorated = Decorated(policy, agent.actor, residual.config.decorator)
    drifted = unlearning.drift(decorated.act(windows)[:, 0], policy.act(windows)[:, 0])
    assert 0.01 < drifted <= 0.1 + 1e-6


def test_the_gate_decides_how_often_a_residual_is_on(policy, residual, windows):
    agent = unlearning.fresh(residual, 0)
    torch.nn.init.constant_(agent.actor.head.bias, 5.0)
    decorated = Decorated(policy, agent.actor, residual.config.decorator)
    many = np.repeat(windows, 50, axis=0)
    difference = unlearning.Gated(decorated, residual.config.decorator.H // 4).act(many)[:, 0] - policy.act(many)[:, 0]
    on = np.abs(difference).max(axis=1) > 0.05
    assert abs(on.mean() - 0.25) < 0.05


# ---- measurements ----------------------------------------------------------------------------------------------------

def test_pull_is_the_gradient_of_the_least_critic(tuning, windows, policy):
    agent, seen, actions = unlearning.fresh(tuning, 0), tuning._view(windows), policy.act(windows)[:, 0]
    pull = unlearning.pull(agent, seen, actions)

    def value(a):
        obs = agent.critic_view(agent.normalize(torch.from_numpy(seen))).double()
        return agent.critics.double()(torch.cat([obs, torch.from_numpy(a)], -1)).min(dim=0).values.detach().numpy()

    a, step = actions.astype(np.float64), 1e-3
    for j in range(2):
        nudge = np.eye(2)[j] * step
        numeric = (value(a + nudge) - value(a - nudge)) / (2 * step)
        assert np.median(np.abs(numeric - pull[:, j])) < 0.02 * np.abs(pull[:, j]).mean()


def test_the_entropys_pull_is_autograds(policy):
    """-T log pi of a squashed Gaussian whose noise is 0, by the executed action."""
    actions, scale = np.array([[0.9, -0.4], [0.0, 0.2]], np.float32), np.array([0.5, 1.0], np.float32)
    u = torch.atanh(torch.from_numpy(actions * scale)).requires_grad_(True)
    log_pi = -(1 - torch.tanh(u) ** 2).log().sum()
    by_u = torch.autograd.grad(-0.3 * log_pi, u)[0].numpy()
    expected = by_u * scale / (1 - (actions * scale) ** 2)  # du/da
    np.testing.assert_allclose(unlearning.entropy_pull(0.3, actions, scale), expected, rtol=1e-4, atol=1e-7)


def test_drift_is_the_mean_size_of_the_change(policy, windows):
    reference = np.clip(policy.act(windows)[:, 0], -0.5, 0.5)
    actions = policy.act(windows)[:, 0]
    expected = np.abs(np.clip(actions, -1, 1) - reference).mean()
    assert unlearning.drift(actions, reference) == pytest.approx(expected)


def test_heading_is_towards_what_is_better_or_away_from_it():
    start, better = np.array([[0.5, 0.0], [0.0, 0.0]], np.float32), np.array([[0.0, 1.0], [1.0, 0.0]], np.float32)
    assert unlearning.heading(start, start, better) == 0
    assert unlearning.heading(start + 0.1 * better, start, better) == pytest.approx(1)
    assert unlearning.heading(start - 0.1 * better, start, better) == pytest.approx(-1)
    beyond = np.array([[9.0, 0.1], [0.1, 0.0]], np.float32)  # what is executed counts, and there the first action moved by 0.5 and 0.1
    assert unlearning.heading(beyond, start, better) == pytest.approx((0.1 / math.hypot(0.5, 0.1) + 1) / 2)


def test_cosines_of_parallel_opposite_and_zero_rows():
    first = np.array([[1.0, 0], [1, 0], [0, 0], [1, 0]])
    second = np.array([[2.0, 0], [-3, 0], [1, 1], [1, 1]])
    np.testing.assert_allclose(unlearning.cosines(first, second), [1, -1, 0, math.sqrt(0.5)])


def test_held_out_windows_are_not_those_of_the_first_demonstrations():
    demos = reach_demos(4)
    windows = unlearning.held_out(demos, 1, int(demos.lengths[3]), skip=3)
    mine = {tuple(w[-1]) for w in windows}
    last = list(demos.episodes())[3]["observations"][:-1]
    assert mine == {tuple(o) for o in last}
    with pytest.raises(PdkitError, match="were asked for"):
        unlearning.held_out(demos, 1, 10**6, skip=1)


# ---- entropy ---------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("log_std", [-4.5, -2.0, 0.5])
def test_the_spread_is_what_was_asked_for(tuning, residual, log_std):
    for trainer in (tuning, residual):
        agent = unlearning.fresh(trainer, 0)
        unlearning.set_spread(agent.actor, log_std)
        heads = agent.actor.heads(agent.normalize(trainer.replay.unpack(trainer.replay.rows[:8])["obs"]))
        torch.testing.assert_close(heads[1], torch.full_like(heads[1], log_std), atol=1e-4, rtol=0)
    with pytest.raises(PdkitError, match="lies between"):
        unlearning.set_spread(agent.actor, -30.0)


@pytest.mark.parametrize("offset", [-0.3, 0.3])
def test_a_frozen_actors_temperature_turns_at_the_threshold(residual, offset):
    agent = unlearning.fresh(residual, 0, critic_warmup=10**9, init_temperature=1.0, critic_lr=1e-2)
    unlearning.set_spread(agent.actor, unlearning.threshold(2, agent.target_entropy) + offset)
    rows = list(unlearning.updates(agent, residual.replay, 10, batch=64))
    assert (rows[-1]["temperature"] > 1) == (offset < 0) == (rows[0]["gap"] > 0)


def test_log_pi_is_clamped_only_inside(residual):
    agent, noise = unlearning.fresh(residual, 0), torch.zeros(4, 2)
    x = torch.zeros(4, 4)
    unlearning.set_spread(agent.actor, -4.5)
    free = agent.actor.sample(x, noise)[1]
    with unlearning.clamped_log_pi(agent.actor, 2.0):
        assert (agent.actor.sample(x, noise)[1] == 2.0).all()
    assert free.min() > 2 and torch.equal(agent.actor.sample(x, noise)[1], free)


# ---- verdicts and figures --------------------------------------------------------------------------------------------

def comparison(before, after, n=40):
    import pandas as pd

    tables = [pd.DataFrame({"seed": range(n), "success_once": np.arange(n) < k}) for k in (before, after)]
    return paired(*tables)


@pytest.mark.parametrize(("few", "many", "guarded", "expected"), [
    (30, 2, 38, "reproduced"), (38, 2, 38, "partly"), (38, 37, 38, "not"), (2, 30, 38, "not")])
def test_the_verdict_on_unlearning_follows_the_episodes(few, many, guarded, expected):
    verdict, reasons = unlearning.unlearning_verdict(*(comparison(38, k) for k in (few, many, guarded)))
    assert verdict == expected and len(reasons) == 3
    assert [reason.endswith("it falls") for reason in reasons[:2]] == [few < 35, many < 35]


def test_a_policy_that_solves_nothing_has_nothing_to_lose():
    assert unlearning.unlearning_verdict(*3 * [comparison(0, 0)])[0] == "untested"


def test_arms_have_the_colour_that_their_name_begins_with():
    colors = plots_failures.arm_colors(["random critic, 100", "decorated, no entropy, 200", "decorated, 200", "before"])
    assert list(colors.values()) == [plots_failures.ARMS["random critic"], plots_failures.ARMS["decorated, no entropy"],
                                     plots_failures.ARMS["decorated"], plots.COLORS["base"]]


def test_a_decorated_policy_that_falls_too_is_said_to():
    reasons = unlearning.unlearning_verdict(comparison(38, 20), comparison(38, 2), comparison(38, 10))[1]
    assert reasons[2].endswith("it falls too")


@pytest.mark.parametrize(("warm", "vanilla", "expected"), [
    ((5.0, 900.0), (1.0, 30.0), "reproduced"), ((5.0, 100.0), (1.0, 30.0), "partly"), ((5.0, 900.0), (4.0, 30.0), "partly"),
    ((1.5, 900.0), (1.0, 95.0), "not")])
def test_the_verdict_on_warm_starts_needs_both_halves(warm, vanilla, expected):
    runs = {name: dict(zip(("temperature", "loss"), values, strict=True), q=50.0) for name, values in
            {"warm": warm, "vanilla": vanilla, "fixed": (1.0, 100.0)}.items()}
    assert unlearning.warm_start_verdict(runs, 33.0)[0] == expected


def test_the_explanation_tells_size_from_side():
    def arm(gap, size, growth):
        return {"gap": gap, "size": size, "growth": growth}

    large, small, moved = arm(180, 200, 1.6), arm(-26, 2, 0.6), arm(-80, 200, 0.6)
    assert unlearning.explanation_verdict([large, small])[0] == "both"
    assert unlearning.explanation_verdict([large, small, moved])[0] == "side"
    assert unlearning.explanation_verdict([large, small, arm(-5, 150, 1.2)])[0] == "size"
    assert unlearning.explanation_verdict([large, arm(1, 90, 0.9), arm(-5, 50, 1.2)])[0] == "neither"
    assert unlearning.explanation_verdict([large])[0] == "neither"


def test_figures_are_drawn():
    import pandas as pd

    rng = np.random.default_rng(0)
    drifts = pd.DataFrame({"arm": ["decorated"] * 3, "update": [0, 1, 2], "drift": [0, 0.01, 0.02],
                           "heading": [0, -0.1, 0.2]})
    rows = pd.DataFrame({"arm": ["warm", "warm", "fixed", "fixed"], "update": [1, 2, 1, 2], "temperature": [1, 1.1, 1, 1],
                         "entropy": [-40.0] * 4, "q_mean": [0, -1.0, 0, -2]})
    arms = pd.DataFrame({"arm": ["-9", "cut"], "kind": ["spread", "clamp"], "gap": [9.0, -3], "size": [40.0, 2], "growth": [1.5, 0.7],
                         "loss": [50.0, 3]})
    for figure in (plots_failures.directions_figure([rng.uniform(-1, 1, 50)], 28, {"random critic": 1e-3, "entropy": 1e-2}),
                   plots_failures.drift_figure(drifts, bound=0.1, distance=0.2),
                   plots_failures.costs_figure({"before": wilson(9, 10), "decorated, 2": wilson(8, 10)}),
                   plots_failures.warm_figure(rows, warmup=1, bound=33.0, target=-28.0),
                   plots_failures.interventions_figure(arms)):
        assert figure.png()[:4] == b"\x89PNG"


def test_reached_looks_at_every_step_of_every_seed_until_its_end():
    """COUNT's observation is (seed, steps so far); its episodes have four steps."""
    class Still:
        window = 2

        def reset(self, seed): ...

        def act(self, windows):
            return np.zeros((len(windows), 1, 1), np.float32)

    def stage(observations):
        return (observations[:, 1] == 3) & (observations[:, 0] > 1)

    assert unlearning.reached(COUNT, Still(), [1, 2, 3], stage).tolist() == [False, True, True]
    assert unlearning.reached(COUNT, Still(), [1, 2, 3], stage, limit=2).tolist() == [False] * 3


def test_a_demonstration_lifts_the_red_cube_and_does_not_begin_so():
    episode = next(iter(load_demos(DATA / "demos" / "StackCube.safetensors").episodes()))
    off = unlearning.lifted(episode["observations"])
    assert not off[0] and off.any() and off[int(episode["success"].argmax())]
