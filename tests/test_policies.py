"""Base policies: Behavior Transformer piece by piece, training, and the way to disk."""
import json
import shutil

import numpy as np
import pandas as pd
import pytest
import torch

from pdkit import train
from pdkit.demos.format import from_episodes
from pdkit.errors import PdkitError
from pdkit.gradient_steps import make_optimizer
from pdkit.imitate import Average, ImitateConfig, Windows, best_checkpoint, configured, imitate, untrained
from pdkit.policies import POLICIES, BeT, load_policy, save_policy
from pdkit.policies.base import Normalizer, share_weights
from pdkit.policies.bet import focal_loss
from pdkit.profiles import base_values
from pdkit.runs import Run
from pdkit.seeds import DEMOS, SELECT, TEST, TRAIN, reported_seeds, rollout_seeds, selection_seeds, training_seed
from pdkit.tasks import get_task

SMALL = dict(obs_dim=3, act_dim=2, window=4, bins=3, layers=2, heads=2, embed=16, features=16)


def bet(**changes):
    torch.manual_seed(0)
    return BeT(SMALL | changes)


def test_focal_loss_is_cross_entropy_weighted_by_one_minus_p_squared():
    logits, target = torch.tensor([[2.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), torch.tensor([0, 2])
    p = torch.softmax(logits, -1)[torch.arange(2), target]
    assert torch.allclose(focal_loss(logits, target, 2.0), (-((1 - p) ** 2) * p.log()).mean())
    assert torch.allclose(focal_loss(logits, target, 0.0), torch.nn.functional.cross_entropy(logits, target))


def test_attention_is_causal():
    policy = bet(dropout=0.0).eval()
    x = torch.randn(1, 4, 3)
    changed = x.clone()
    changed[0, 3] += 1
    one, other = policy.gpt(x), policy.gpt(changed)
    assert torch.allclose(one[0, :3], other[0, :3], atol=1e-6)
    assert not torch.allclose(one[0, 3], other[0, 3])


def test_the_last_position_alone_is_the_same():
    """Features and their gradients, for learners that read nothing else."""
    policy, x = bet(dropout=0.0, layers=2).eval(), torch.randn(5, 4, 3)
    grads = []
    for last in (False, True):
        features = policy.gpt(x, last=last)
        assert features.shape[1] == (1 if last else 4)
        policy.zero_grad()
        features[:, -1].square().sum().backward()
        grads.append([features[:, -1].detach(), *(p.grad.clone() for p in policy.gpt.parameters())])
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(*grads, strict=True))


def test_bins_are_the_k_means_centres():
    policy = bet()
    centres = np.array([[0.8, 0.8], [-0.8, 0.8], [0.0, -0.8]], np.float32)
    rng = np.random.default_rng(0)
    actions = (centres[rng.integers(3, size=300)] + 0.02 * rng.normal(size=(300, 2))).astype(np.float32)
    policy.fit_statistics(rng.normal(2, 5, (300, 3)).astype(np.float32), actions)
    distance = torch.cdist(policy.centres, torch.from_numpy(centres)).min(dim=1).values
    assert distance.max() < 0.02
    assert policy.normalizer.std.mean() == pytest.approx(5, rel=0.1)
    with pytest.raises(PdkitError, match="at least 3 actions"):
        policy.fit_statistics(np.zeros((2, 3), np.float32), np.zeros((2, 2), np.float32))


def test_bins_depend_on_the_seed():
    actions = np.random.default_rng(0).uniform(-1, 1, (300, 2)).astype(np.float32)
    one, same, other = (bet(bins=8) for _ in range(3))
    for policy, seed in ((one, 0), (same, 0), (other, 1)):
        policy.fit_statistics(np.zeros((300, 3), np.float32), actions, seed)
    assert torch.equal(one.centres, same.centres) and not torch.allclose(one.centres, other.centres, atol=1e-3)


def test_what_a_policy_acts_lies_within_the_action_space():
    policy = POLICIES["mlp"](dict(obs_dim=3, act_dim=2, hidden=8)).eval()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.fill_(5.0)
        beyond = policy(torch.ones(1, 1, 3))
    assert beyond.min() > 1 and policy.act(np.ones((1, 1, 3), np.float32)).tolist() == [[[1.0, 1.0]]]


def test_a_recurrent_policy_learns_at_every_position_of_a_window():
    policy = POLICIES["rnn"](dict(obs_dim=3, act_dim=2, window=4, hidden=8))
    windows, actions = torch.randn(5, 4, 3), torch.randn(5, 4, 2)
    loss = policy.loss(windows, actions)["loss"]
    assert torch.allclose(loss, (policy._actions(windows) - actions).square().mean())
    actions[:, 0] += 1
    assert not torch.allclose(policy.loss(windows, actions)["loss"], loss)


def test_offsets_are_learned_at_the_true_bin_only():
    policy = bet(dropout=0.0)
    policy.centres.copy_(torch.tensor([[0.0, 0.0], [5.0, 5.0], [-5.0, 5.0]]))
    windows, actions = torch.randn(6, 4, 3), torch.full((6, 4, 2), 0.1)  # all in bin 0
    policy.loss(windows, actions)["offset_mse"].backward()
    gradient = policy.head.bias.grad[3:].view(3, 2)
    assert (gradient[0] != 0).all() and (gradient[1:] == 0).all()
    terms = policy.loss(windows, actions)
    assert torch.allclose(terms["loss"], terms["focal"] + 1000 * terms["offset_mse"])


@pytest.mark.parametrize("gamma", [2.0, 0.5])
def test_every_position_of_a_window_is_an_example(gamma):
    policy = bet(dropout=0.0, focal_gamma=gamma)
    policy.centres.copy_(torch.tensor([[0.0, 0.0], [0.5, 0.5], [-0.5, 0.5]]))
    windows, true, off = torch.randn(6, 4, 3), torch.randint(3, (6, 4)), 0.1 * torch.rand(6, 4, 2)
    terms = policy.loss(windows, policy.centres[true] + off)
    with torch.no_grad():
        out = policy.head(policy.gpt(policy.normalizer(windows)))
    offsets = out[..., 3:].unflatten(-1, (3, 2)).gather(2, true[..., None, None].expand(6, 4, 1, 2))[:, :, 0]
    assert torch.allclose(terms["focal"], focal_loss(out[..., :3].flatten(0, 1), true.flatten(), gamma), atol=1e-6)
    assert torch.allclose(terms["offset_mse"], ((offsets - off) ** 2).mean(), atol=1e-6)


def test_a_dimension_that_never_varies_is_passed_through_however_many_rows_there_are():
    normalizer = Normalizer(3)
    observations = np.tile(np.float32([-0.615, 1.7, 0.0]), (40_000, 1))
    observations[::2, 2] = 2.0
    normalizer.fit(observations)
    assert normalizer.std.tolist() == [1.0, 1.0, 1.0] and torch.allclose(normalizer.mean, torch.tensor([-0.615, 1.7, 1.0]))


def test_bet_decays_the_weights_that_the_papers_code_does():
    policy = bet()
    groups = make_optimizer(policy, ImitateConfig(weight_decay=0.3, beta1=0.8)).param_groups
    decay = {id(p): group["weight_decay"] for group in groups for p in group["params"]}
    expected = {name: 0.01 if name.startswith("head") else 0.3 if p.dim() == 2 and name != "gpt.position" else 0.0
                for name, p in policy.named_parameters()}
    assert {name: decay[id(p)] for name, p in policy.named_parameters()} == expected
    assert set(expected.values()) == {0.01, 0.3, 0.0} and all(group["betas"] == (0.8, 0.999) for group in groups)


def test_acting_takes_the_likeliest_bin_and_its_offset_at_the_last_position():
    policy = bet(dropout=0.0).eval()
    policy.centres.copy_(torch.tensor([[0.0, 0.0], [0.5, 0.5], [-0.5, 0.5]]))
    with torch.no_grad():
        policy.head.weight.zero_()
        policy.head.bias.copy_(torch.tensor([0.0, 9.0, 0.0, 0.1, 0.1, 0.2, -0.2, 0.3, 0.3]))
    action = policy.act(np.random.randn(2, 4, 3).astype(np.float32))
    assert action.shape == (2, 1, 2) and np.allclose(action, [[[0.7, 0.3]]], atol=1e-6)


def test_dropout_stays_on_only_when_asked():
    x = np.random.default_rng(0).normal(size=(4, 4, 3)).astype(np.float32)
    for on in (False, True):
        policy = bet(act_dropout=on, dropout=0.5).eval()
        policy.reset(0)
        first, second = policy.act(x), policy.act(x)
        assert np.array_equal(first, second) != on
        policy.reset(0)
        assert np.array_equal(policy.act(x), first)


def line_demos(num=6, length=12, before=0):
    """On Door's shapes: the action's first entry is the sign of the first observation (so many steps `before`), the others are 0."""
    rng, episodes = np.random.default_rng(0), []
    for _ in range(num):
        observations = rng.normal(size=(length + 1, 39))
        actions = np.zeros((length, 28))
        actions[before:, 0] = 0.7 * np.sign(observations[:length - before, 0])
        episodes.append(dict(observations=observations, actions=actions, success=np.zeros(length, bool)))
    return from_episodes("Door", episodes, label="scripted", how="test", command="pytest")


def test_windows_pair_each_observation_with_the_action_taken_there():
    demos = line_demos()
    for pad, count in ((True, 6 * 12), (False, 6 * 9)):
        windows = Windows(demos, 4, pad)
        assert len(windows.index) == count
        observations, actions = windows.sample(200, torch.Generator().manual_seed(0))
        assert observations.shape == (200, 4, 39)
        assert torch.allclose(actions[..., 0], 0.7 * observations[..., 0].sign())
    with pytest.raises(PdkitError, match="shorter than the window"):
        Windows(demos, 50, False)


@pytest.mark.parametrize(("kind", "config", "lr"), [("bet", dict(window=4, bins=2, layers=1, heads=2, embed=32, features=32), 3e-3),
                                                    ("mlp", dict(hidden=64), 3e-3),
                                                    ("rnn", dict(window=4, hidden=32, layers=1), 3e-3),
                                                    ("cnn", dict(window=4, hidden=32, layers=2), 3e-3)])
def test_imitation_learns(kind, config, lr):
    demos = line_demos(20, 20)
    settings = ImitateConfig(iterations=400, batch=64, lr=lr, eval_episodes=0, eval_every=400, bf16=False)
    policy, history = imitate(kind, demos, settings, config)
    observations, actions = Windows(demos, policy.window, True).sample(200, torch.Generator().manual_seed(1))
    predicted = policy.act(observations.numpy())[:, 0, 0]
    assert (np.sign(predicted) == np.sign(actions[:, -1, 0].numpy())).mean() > 0.95
    assert len(history) == 1 and history[0]["loss"] < 5


@pytest.mark.parametrize("kind", ["rnn", "cnn"])
def test_a_policy_with_memory_tells_what_it_saw_before(kind):
    """And each episode for itself: what others see at the same time changes nothing."""
    demos = line_demos(20, 20, before=1)
    settings = ImitateConfig(iterations=600, batch=64, lr=3e-3, eval_episodes=0, eval_every=600, bf16=False)
    policy, _ = imitate(kind, demos, settings, dict(window=4, hidden=64, layers=2 if kind == "cnn" else 1))
    observations, actions = Windows(demos, policy.window, False).sample(200, torch.Generator().manual_seed(1))
    predicted = policy.act(observations.numpy())
    assert (np.sign(predicted[:, 0, 0]) == np.sign(actions[:, -1, 0].numpy())).mean() > 0.9
    np.testing.assert_allclose(policy.act(observations[:1].numpy()), predicted[:1], atol=1e-5)


def test_a_learning_rate_that_rises_from_0_moves_nothing_at_the_first_step():
    moved = []
    for warm in (0, 1):
        settings = ImitateConfig(iterations=1, batch=16, eval_episodes=0, eval_every=1, bf16=False, lr_warmup=warm)
        policy, _ = imitate("mlp", line_demos(), settings, dict(hidden=8))
        torch.manual_seed(0)
        fresh = untrained("mlp", get_task("Door"), dict(hidden=8))
        moved.append(any(not torch.equal(p, q) for p, q in zip(policy.parameters(), fresh.parameters(), strict=True)))
    assert moved == [True, False]


def test_the_best_of_the_evaluations_is_kept_and_training_goes_on_as_before(monkeypatch):
    """With its dropout on again after each, and not while it is evaluated."""
    scores, seen, modes = iter([0.25, 0.75, 0.5]), [], []

    def told(spec, policy, episodes, seed):
        seen.append({k: v.clone() for k, v in policy.state_dict().items()})
        modes.append(policy.training)
        return {"success_once": next(scores), "success_at_end": 0.0}

    loss = BeT.loss
    monkeypatch.setattr(BeT, "loss", lambda self, *batch: modes.append(self.training) or loss(self, *batch))
    monkeypatch.setattr("pdkit.imitate.selection_scores", told)
    settings = ImitateConfig(iterations=6, batch=16, lr=1e-2, eval_episodes=1, eval_every=2, bf16=False)
    policy, history = imitate("bet", line_demos(), settings, dict(window=4, bins=2, layers=1, heads=2, embed=16, features=16))
    assert [row["success_once"] for row in history] == [0.25, 0.75, 0.5]
    kept = policy.state_dict()
    assert all(torch.equal(kept[k], seen[1][k]) for k in kept) and not torch.equal(kept["head.weight"], seen[2]["head.weight"])
    assert modes == 3 * [True, True, False] and not policy.training


@pytest.mark.parametrize(("kind", "task", "visual", "wanted"), [  # facts.md 2.1, 2.2
    ("bet", "TurnFaucet", False, dict(
        iterations=200_000, batch=2_048, lr=1e-4, schedule="constant", weight_decay=2e-4, beta1=0.9, window=20, bins=8, layers=4, heads=4,
        embed=128, features=256, dropout=0.1, act_dropout=True, pad_start=False, eval_every=5_000, eval_episodes=100, focal_gamma=2.0,
        offset_weight=1_000.0)),
    ("bet", "StackCube", False, dict(batch=4_096, lr=1e-3, embed=128, bins=8)),
    ("bet", "PegInsertionSide", False, dict(embed=256, lr=1e-4)),
    ("bet", "PushChair", False, dict(bins=16, batch=2_048)), ("bet", "Door", False, dict(window=20, batch=2_048, bins=8)),
    ("diffusion", "TurnFaucet", False, dict(
        iterations=1_000_000, batch=1_024, lr=1e-4, beta1=0.95, weight_decay=1e-6, schedule="cosine", lr_warmup=500, ema_power=0.75,
        eval_every=10_000, eval_episodes=100, window=2, horizon=16, chunk=4, dims=[64, 128, 256], prediction="epsilon", spacing="leading",
        diffusion_steps=100)),
    ("diffusion", "PushChair", True, dict(iterations=300_000, batch=256))])
def test_the_papers_base_policies(kind, task, visual, wanted):
    config, architecture = configured(kind, base_values(kind, task, "paper", visual))
    policy = untrained(kind, get_task(task), architecture)
    assert wanted.items() <= (vars(config) | policy.config).items() and not config.bf16
    assert base_values(kind, task, "lesson") == {}


@pytest.mark.parametrize(("kind", "profile", "said"), [("mlp", "paper", "of kind mlp are not known"), ("bet", "smoke", "Unknown profile")])
def test_a_base_policy_of_unknown_scale_is_refused(kind, profile, said):
    with pytest.raises(PdkitError, match=said):
        base_values(kind, "Door", profile)


@pytest.mark.parametrize(("kind", "tiny"), [
    ("bet", dict(window=4, bins=2, layers=1, heads=2, embed=16, features=16)),  # with dropout
    ("diffusion", dict(horizon=4, chunk=1, dims=[16, 32], groups=4, embed=16))])  # with noise and an average
@pytest.mark.parametrize("scores", [(0.9, 0.1, 0.2, 0.3), (0.1, 0.2, 0.3, 0.4)], ids=["the first", "the last"])
def test_an_interrupted_imitation_goes_on_to_the_same_policy(kind, tiny, scores, tmp_path, monkeypatch):
    """Whichever checkpoint is the best, and making no gradient step twice."""
    settings = ImitateConfig(**POLICIES[kind].recipe | dict(iterations=12, batch=16, lr=1e-2, eval_every=3, lr_warmup=5, schedule="cosine"))
    steps, loss = [], POLICIES[kind].loss
    monkeypatch.setattr(POLICIES[kind], "loss", lambda *batch: steps.append(1) or loss(*batch))

    def train(left, run=None, progress=None):
        left = iter(left)
        monkeypatch.setattr("pdkit.imitate.selection_scores", lambda *_: {"success_once": next(left), "success_at_end": 0.0})
        return imitate(kind, line_demos(), settings, tiny, run=run, progress=progress)

    def interrupt(row):
        if row["iteration"] == 6:
            raise KeyboardInterrupt

    whole, history = train(scores)
    with pytest.raises(KeyboardInterrupt):
        train(scores, Run(tmp_path, "base", {}), interrupt)
    torch.manual_seed(99)
    steps.clear()
    again, rows = train(scores[2:], Run(tmp_path, "base", {}))
    assert len(steps) == 6 and [row["success_once"] for row in rows] == list(scores)
    assert [row["loss"] for row in rows] == [row["loss"] for row in history]
    seconds = [row["seconds"] for row in rows]
    assert seconds == sorted(set(seconds))  # the clock goes on, too
    assert all(torch.equal(value, whole.state_dict()[name]) for name, value in again.state_dict().items())


def test_every_gradient_step_has_the_rate_of_the_schedule():
    weight = torch.nn.Parameter(torch.zeros(()))
    settings = ImitateConfig(iterations=6, eval_every=6, lr=0.5, schedule="cosine", lr_warmup=2)
    optimizer, rates = torch.optim.SGD([weight], lr=settings.lr), []

    def step():
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        return {"loss": torch.zeros(())}

    best_checkpoint(settings, step, optimizer, Average([weight], 0.0), lambda: ({}, {}), None)
    assert rates == pytest.approx([0, 0.25, 0.5, 0.25 * (1 + 0.5**0.5), 0.25, 0.25 * (1 - 0.5**0.5)])


def test_of_equally_good_checkpoints_the_first_is_chosen():
    weight, scores = torch.nn.Parameter(torch.zeros(())), [0.2, 0.5, 0.5, 0.1]
    settings, met, optimizer = ImitateConfig(iterations=4, eval_every=1), [], torch.optim.SGD([weight], lr=1.0)

    def step():
        optimizer.step()
        return {"loss": torch.zeros(())}

    def candidate():
        met.append(len(met))
        return met[-1], {"success_once": scores[met[-1]]}

    chosen, _ = best_checkpoint(settings, step, optimizer, Average([weight], 0.0), candidate, None)
    assert chosen == 1 and met == [0, 1, 2, 3]


def test_policies_are_chosen_on_selection_episodes_and_reported_on_others(monkeypatch):
    asked, selection = [], [SELECT, SELECT + 1, SELECT + 2]

    def evaluate(spec, act, seeds, **others):
        asked.append(list(seeds))
        return pd.DataFrame({"success_once": [True], "success_at_end": [False]})

    monkeypatch.setattr("pdkit.evaluate.evaluate", evaluate)
    settings = ImitateConfig(iterations=2, batch=16, eval_episodes=3, eval_every=1, bf16=False)
    imitate("mlp", line_demos(), settings, dict(hidden=8))
    assert asked == [selection, selection] and selection_seeds(3) == selection
    assert DEMOS < TEST <= min(reported_seeds(1)) and max(reported_seeds(10_000)) < SELECT
    assert max(selection_seeds(10_000)) < min(rollout_seeds(1)) and max(rollout_seeds(10_000)) < TRAIN
    assert all(training_seed(0, lane, episode) >= TRAIN for lane in range(4) for episode in range(50))


BAD = [  # policy, setting as typed, what the sentence must name
    ("bet", "embed=30", "multiple of its heads"), ("bet", "heads=0", "at least 1"), ("bet", "window=0", "at least 1"),
    ("bet", "bins=0", "at least 1"), ("bet", "layers=0", "at least 1"), ("bet", "embed=-8", "at least 1"), ("bet", "dropout=1", "below 1"),
    ("bet", "dropout=-0.1", "at least 0"), ("bet", "window=2.0", "a whole number"), ("bet", "layers=True", "a whole number"),
    ("bet", "act_dropout=1", "True or False"), ("bet", "focal_gamma=none", "a number"), ("bet", "offset_weight=1e999", "a number"),
    ("bet-sac", "scale=[0.5]", "28 factors"), ("bet-sac", "scale=0.5", "a list"), ("bet-sac", "scale=['x']", "a list"),
    ("bet-sac", "lora=-1", "at least 0"), ("bet-sac", "lora=x", "a whole number"),
    ("diffusion", "kernel=4", "odd"), ("diffusion", "kernel=0", "at least 1"), ("diffusion", "groups=0", "at least 1"),
    ("diffusion", "embed=2", "at least 4"), ("diffusion", "embed=5", "even"), ("diffusion", "dims=[]", "a list"),
    ("diffusion", "dims=64", "a list"), ("diffusion", "dims=[64,0]", "at least 1"), ("diffusion", "dims=[64,1.5]", "a list"),
    ("diffusion", "dims=[64,'x']", "a list"), ("diffusion", "window=0", "at least 1"), ("diffusion", "horizon=0", "at least 1"),
    ("diffusion", "diffusion_steps=0", "at least 1"), ("diffusion", "sampler_steps=4.0", "a whole number"),
    ("diffusion", "sampler=3", "a word"), ("diffusion", "prediction=x", "Unknown prediction"),
    ("diffusion", "temperature=-1", "at least 0"), ("diffusion", "action_limits=1", "True or False"),
    ("diffusion", "late_steps=1", "Unknown field"), ("diffusion", "own_scale=True", "Unknown field"),
    ("mlp", "hidden=0", "at least 1"), ("mlp", "hidden=x", "a whole number"), ("mlp", "layers=-1", "at least 0"),
    ("mlp", "window=2", "one observation"), ("mlp", "std_floor=-1", "at least 0"),
    ("rnn", "window=0", "at least 1"), ("rnn", "layers=0", "at least 1"), ("rnn", "hidden=1.5", "a whole number"),
    ("cnn", "window=0", "at least 1"), ("cnn", "layers=0", "at least 1"), ("cnn", "kernel=2", "odd"), ("cnn", "hidden=-1", "at least 1"),
    ("vinn", "k=0", "at least 1"), ("vinn", "k=x", "a whole number"), ("vinn", "exclusion=-1", "at least 0"),
    ("vinn", "rows=3", "Unknown field 'rows'"), ("vinn", "tolerance=0", "at least 1"), ("vinn", "history=0", "at least 1"),
    ("vinn", "representation=3", "raw"), ("vinn", "representation={}", "raw"),
    ("zero", "chunk=0", "at least 1"), ("zero", "window=[]", "a whole number"),
]


@pytest.mark.parametrize(("kind", "setting", "message"), BAD)
def test_a_bad_setting_is_one_sentence_before_anything_is_trained(kind, setting, message, tmp_path):
    words = ["base", "Door", "--policy", kind, "--num-demos", "1", "--out", str(tmp_path / "p"), "--set", setting, "eval_episodes=0"]
    with pytest.raises(PdkitError, match=message) as error:
        train.main(words)
    assert "\n" not in str(error.value) and setting.partition("=")[0] in str(error.value) and not (tmp_path / "p").exists()


def test_the_policy_that_does_nothing_has_nothing_to_learn(tmp_path):
    assert train.main(["base", "Door", "--policy", "zero", "--num-demos", "1", "--out", str(tmp_path), "--set", "eval_episodes=0"]) == 0
    policy = load_policy(tmp_path)
    assert policy.kind == "zero" and not policy.act(np.ones((2, 1, 39), np.float32)).any()
    assert policy.normalizer.std.std() > 0  # fitted to the demonstrations


def test_every_policy_and_each_of_its_whole_numbers_is_among_the_bad_settings():
    assert {kind for kind, _, _ in BAD} == set(POLICIES)
    for kind, policy in POLICIES.items():
        for name in (name for name, value in policy.defaults.items() if type(value) is int):
            with pytest.raises(PdkitError, match=f"{kind}'s {name} must be"):
                policy({"obs_dim": 3, "act_dim": 2, name: -1})


@pytest.mark.parametrize(("kind", "settings", "expected"), [
    ("diffusion", dict(dims=(16, 32)), [16, 32]), ("bet", dict(offset_weight=10), 10), ("mlp", dict(layers=0), 0)])
def test_a_tuple_is_a_list_a_whole_number_a_number_and_no_hidden_layer_a_linear_policy(kind, settings, expected):
    policy = POLICIES[kind]({"obs_dim": 3, "act_dim": 2} | settings)
    assert policy.config[next(iter(settings))] == expected
    assert policy.eval().act(np.zeros((2, policy.window, 3), np.float32)).shape == (2, policy.chunk, 2)


@pytest.mark.parametrize("kind", [kind for kind, policy in POLICIES.items() if policy.learns and kind != "zero"])
def test_the_normaliser_has_a_floor_where_it_is_asked_for(kind):
    """Columns: never moves, moves by 0.01, moves by 2; mean 5 each."""
    observations = (5 + np.array([[0, 0.01, 2], [0, -0.01, -2]])).astype(np.float32)
    few = {"bins": 1} if "bet" in kind else {}
    for floor, expected in ((0.0, [1, 0.01, 2]), (0.5, [1, 0.5, 2])):
        policy = POLICIES[kind]({"obs_dim": 3, "act_dim": 1, "std_floor": floor} | few)
        policy.fit_statistics(observations, np.zeros((2, 1), np.float32))
        assert policy.normalizer.std.tolist() == pytest.approx(expected, rel=1e-3) and policy.normalizer.mean.tolist() == [5, 5, 5]
    assert policy.normalizer(torch.tensor([[5.0, 5.25, 9.0]])).tolist() == [pytest.approx([0, 0.5, 2])]


def test_a_copy_can_use_the_weights_beside_it(tmp_path):
    policy, other = bet(dropout=0.0).eval(), bet(dropout=0.0).eval()
    other.normalizer.mean += 1
    for name, one in (("base", policy), ("decorated/base", policy), ("another", other)):
        save_policy(one, tmp_path / name)
    copy = tmp_path / "decorated" / "base"
    with pytest.raises(PdkitError, match="only a copy"):
        share_weights(copy, tmp_path / "another")
    with pytest.raises(PdkitError, match="only a copy"):
        share_weights(copy, copy)
    share_weights(copy, tmp_path / "base")
    x = np.random.default_rng(1).normal(size=(2, 4, 3)).astype(np.float32)
    assert not (copy / "weights.safetensors").exists() and np.array_equal(load_policy(copy).act(x), policy.act(x))
    shutil.copytree(tmp_path / "another", tmp_path / "base", dirs_exist_ok=True)
    with pytest.raises(PdkitError, match="checksum"):  # what lies there now is something else
        load_policy(copy)
    shutil.rmtree(tmp_path / "base")
    with pytest.raises(PdkitError, match="is missing"):
        load_policy(copy)


def test_save_and_load(tmp_path):
    policy = bet(dropout=0.0).eval()
    policy.normalizer.fit(np.random.default_rng(0).normal(3, 2, (50, 3)).astype(np.float32))
    save_policy(policy, tmp_path / "p", {"success_once": 0.5})
    x = np.random.default_rng(1).normal(size=(2, 4, 3)).astype(np.float32)
    assert np.array_equal(load_policy(tmp_path / "p").act(x), policy.act(x))
    card = tmp_path / "p" / "policy.json"
    weights = tmp_path / "p" / "weights.safetensors"
    whole, text = weights.read_bytes(), card.read_text()
    for breakage in (lambda: weights.write_bytes(whole[:-20]), lambda: weights.unlink(), lambda: card.write_text("{"),
                     lambda: card.unlink(),
                     lambda: card.write_text(json.dumps(json.loads(text) | {"kind": "gan"})),
                     lambda: card.write_text(json.dumps(json.loads(text) | {"config": SMALL | {"embed": 32}})),
                     lambda: card.write_text('{"format": "other"}')):
        breakage()
        with pytest.raises(PdkitError) as error:
            load_policy(tmp_path / "p")
        assert "\n" not in str(error.value)
        weights.write_bytes(whole)
        card.write_text(text)
