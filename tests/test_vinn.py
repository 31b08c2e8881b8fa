"""VINN: the lookup by hand, FISH's exclusion buffer, features of a trained Behavior Transformer, training and the way to disk."""
import json
import shutil

import numpy as np
import pytest
import torch
from test_policies import line_demos
from test_probes import success
from worlds import clone, reach_demos

from pdkit import train
from pdkit.demos.sources import bundled
from pdkit.errors import PdkitError
from pdkit.imitate import ImitateConfig, Windows, imitate
from pdkit.policies import MLP, VINN, BeT, DiffusionPolicy, load_policy, save_policy
from pdkit.policies.unet import FiLMBlock

UNET = dict(horizon=4, chunk=2, window=2, dims=[8, 16], groups=4, embed=8)
TINY = dict(window=3, bins=4, layers=1, heads=2, embed=16, features=8, dropout=0.3)


def lookup(**config):
    """Three remembered points on a line (raw, unscaled): at 0, 1 and 3, with actions 0, 0.5 and -1."""
    policy = VINN({"obs_dim": 1, "act_dim": 1} | config)
    policy.remember(torch.tensor([0.0, 1.0, 3.0])[:, None, None].expand(-1, policy.window, 1), torch.tensor([[0.0], [0.5], [-1.0]]))
    return policy.eval()


def act(policy, *points):
    return policy.act(np.array(points, np.float32)[:, None, None])[:, 0, 0]


def test_one_neighbour_copies_its_action():
    assert act(lookup(k=1), 0.1, 0.6, 1.9, 2.1, 9.0).tolist() == [0.0, 0.5, 0.5, -1.0, -1.0]


def test_more_neighbours_are_weighted_by_the_softmax_of_minus_their_distances():
    w = np.exp(-0.25) / (np.exp(-0.25) + np.exp(-0.75))
    assert act(lookup(k=2), 0.25) == pytest.approx([(1 - w) * 0.5])
    far, near = np.exp(-1.5), np.exp(-0.5)  # of 2.5: the points at 1 and 3
    assert act(lookup(k=2), 2.5) == pytest.approx([(far * 0.5 - near) / (far + near)])
    weights = np.exp(-np.array([0.5, 0.5, 2.5]))
    assert act(lookup(k=3), 0.5) == pytest.approx([weights @ [0.0, 0.5, -1.0] / weights.sum()])


def test_it_solves_the_more_the_more_demonstrations_it_looks_up():
    """The reach probe, where any start and goal may come: with 200 demonstrations some near neighbour goes there, with 5 hardly one."""
    solved = {}
    for count in (200, 5):
        demos = reach_demos(count)
        policy = VINN({"obs_dim": 4, "act_dim": 2})
        policy.fit_statistics(demos.observations, demos.actions)
        policy.remember(*Windows(demos, policy.window, True).all())
        solved[count] = success("reach", policy)
    assert solved[200] > 0.5 > 0.2 > solved[5]


def test_a_large_library_is_looked_up_as_exactly_as_by_measuring_all_of_it():
    """Rows 1e-3 apart, far from the origin: single-precision products would not tell them apart."""
    torch.manual_seed(0)
    policy = VINN({"obs_dim": 20, "act_dim": 1})
    library = 30 + torch.cat([torch.randn(500, 20), torch.randn(1, 20) + 1e-3 * torch.randn(500, 20)])
    policy.remember(library[:, None], torch.zeros(1000, 1))
    asked = torch.cat([library[::7], library[::9] + 5e-4 * torch.randn(112, 20)])
    distance, rows = policy._nearest(asked, 4)
    expected = torch.cdist(asked, library, compute_mode="donot_use_mm_for_euclid_dist").topk(4, dim=1, largest=False)
    assert torch.equal(distance, expected.values) and torch.equal(rows, expected.indices)
    assert (distance[: len(library[::7]), 0] == 0).all()


def test_another_library_is_looked_up_at_once():
    """What is kept of a library between two looks belongs to that library: remembered anew, or loaded over it."""
    policy, moved = lookup(k=1), lookup(k=1)
    moved.library += 10
    asked = (0.1, 10.9)
    assert act(policy, *asked).tolist() == [0.0, -1.0] and act(moved, *asked).tolist() == [0.0, 0.5]
    policy.load_state_dict(moved.state_dict())
    assert act(policy, *asked).tolist() == [0.0, 0.5]
    policy.remember(torch.tensor([0.0, 11.0])[:, None, None], torch.tensor([[0.25], [0.75]]))
    assert act(policy, *asked).tolist() == [0.25, 0.75]


def test_distances_are_in_normalised_units():
    policy = VINN({"obs_dim": 2, "act_dim": 1, "k": 1})
    observations = np.array([[0, 0], [1, 300], [0, 100]], np.float32)
    policy.fit_statistics(np.concatenate([observations, -observations]), None)
    policy.remember(torch.from_numpy(observations[:, None]), torch.tensor([[0.0], [0.5], [-1.0]]))
    assert policy.act(np.array([[[0.9, 190.0]]], np.float32)).item() == 0.5  # unscaled, (0, 100) would be nearer


def test_demonstrated_observations_give_back_their_actions():
    demos = line_demos(4, 12)
    policy, history = imitate("vinn", demos, ImitateConfig(eval_episodes=0), dict(k=1))
    assert policy.config["rows"] == 48 and [row["iteration"] for row in history] == [0]
    for episode in demos.episodes():
        assert np.allclose(policy.act(episode["observations"][:-1, None])[:, 0], episode["actions"])


def test_exclusion_passes_over_what_came_up_too_often():
    """One place in the buffer, one visit tolerated: row 0, then it is out; row 1 once, then 1 is out too, which lets 0 in again, but
    not for that decision."""
    policy = lookup(k=1, exclusion=1, tolerance=1, history=5)
    stuck = 0.1 + 0.01 * np.arange(5)
    windows = np.stack([np.concatenate([np.full(7 - t, stuck[0]), stuck[1:t]]) for t in range(1, 5)])[..., None].astype(np.float32)
    assert windows.shape == (4, 6, 1) and policy.window == 6
    assert policy.act(windows)[:, 0, 0].tolist() == [0.0, 0.5, -1.0, 0.0]
    twice = lookup(k=1, exclusion=1, tolerance=2, history=5)
    assert twice.act(windows)[:, 0, 0].tolist() == [0.0, 0.0, 0.5, 0.5]
    longer = lookup(k=1, exclusion=2, tolerance=1, history=5)  # three rows, of which none is left at the fourth
    assert longer.act(windows)[:, 0, 0].tolist() == [0.0, 0.5, -1.0, -1.0]


def test_the_start_of_an_episode_is_no_decision():
    """The repeated first observation is not a place where the policy has been stuck, whatever the length of the windows."""
    demos = reach_demos(6)
    bet = clone(BeT, demos, TINY, iterations=1)
    plain, excluding = (remembered(demos, bet, k=1, **more) for more in ({}, dict(exclusion=3, history=4)))
    first = np.stack([e["observations"][0] for e in demos.episodes()])[:, None] + 0.01
    assert np.array_equal(plain.act(np.repeat(first, 3, axis=1)), excluding.act(np.repeat(first, 7, axis=1)))
    played, play = [], excluding._play
    excluding._play = lambda decisions: played.append(len(decisions)) or play(decisions)
    episode = np.concatenate([first[0], first[0] + np.arange(1, 4)[:, None]])  # after a first observation three others
    for seen in range(1, 5):
        excluding.act(np.concatenate([np.repeat(episode[:1], 7 - seen, axis=0), episode[:seen]])[None])
    assert played == [1, 2, 3, 4]


def remembered(demos, bet=None, folder=None, **config):
    if bet is not None and folder is None:
        config["representation"] = {"kind": "bet"} | bet.config
    elif folder is not None:
        save_policy(bet, folder)
        config["representation"] = str(folder)
    policy = VINN({"obs_dim": 4, "act_dim": 2} | config)
    if bet is not None and folder is None:
        policy.gpt.load_state_dict(bet.gpt.state_dict())
        policy.normalizer.load_state_dict(bet.normalizer.state_dict())
    policy.fit_statistics(demos.observations, demos.actions)
    policy.remember(*Windows(demos, policy.window, True).all())
    return policy.eval()


def test_features_of_a_trained_behavior_transformer(tmp_path):
    demos = reach_demos(6)
    bet = clone(BeT, demos, TINY | dict(act_dropout=True), iterations=30)
    bet.normalizer.mean += 1.0  # it must be this one, not one fitted anew
    policy = remembered(demos, bet, tmp_path / "bet", k=1)
    windows, actions = Windows(demos, 3, True).all()
    expected = BeT(bet.config | {"act_dropout": False}).eval()
    expected.load_state_dict(bet.state_dict())
    with torch.no_grad():
        wanted = expected.gpt(expected.normalizer(windows))[:, -1]
    assert policy.window == 3 and torch.allclose(policy.library, wanted, atol=1e-5) and torch.equal(policy.actions, actions)
    assert np.allclose(policy.train().act(windows.numpy())[:, 0], actions)  # no dropout, even while something trains


@pytest.mark.parametrize("widths", [[], [8, 5]])
def test_film_features_of_a_policy_with_a_scale_of_its_own(tmp_path, widths):
    """One that was trained from pictures: normaliser and scale together are what its network sees, through the layers that it has."""
    demos = reach_demos(6)
    diffusion = clone(DiffusionPolicy, demos, UNET | {"own_scale": True, "obs_encoder": widths}, iterations=20)
    windows = Windows(demos, 2, True).all()[0]
    with torch.no_grad():
        wanted = diffusion.film()(torch.nn.functional.mish(diffusion.condition(windows)))
    diffusion.renormalise(demos.observations * 3 + 1)
    save_policy(diffusion, tmp_path / "d")
    policy = VINN({"obs_dim": 4, "act_dim": 2, "representation": str(tmp_path / "d")})
    with torch.no_grad():
        assert torch.allclose(policy.features(windows), wanted, atol=1e-3)
    save_policy(remembered(demos, diffusion, tmp_path / "again", k=1), tmp_path / "vinn")
    assert ("obs_encoder.0.weight" in load_policy(tmp_path / "vinn").state_dict()) == bool(widths)


def test_film_features_are_the_scales_and_shifts_that_the_blocks_get_less_the_steps_part():
    """Watched in the network itself, at two diffusion steps: the same up to a constant, in the order of its blocks."""
    demos = reach_demos(6)
    diffusion = clone(DiffusionPolicy, demos, UNET, iterations=20)
    policy = VINN({"obs_dim": 4, "act_dim": 2, "representation": {"kind": "diffusion"} | diffusion.config})
    policy.film, policy.normalizer = diffusion.film(), diffusion.normalizer
    windows, seen = Windows(demos, 2, True).all()[0], {}
    for step in (0, 99):
        seen[step] = []
        blocks = [block.film for block in diffusion.unet.modules() if isinstance(block, FiLMBlock)]
        hooks = [layer.register_forward_hook(lambda _, __, out, step=step: seen[step].append(out)) for layer in blocks]
        with torch.no_grad():
            diffusion.unet(torch.zeros(len(windows), 4, 2), torch.full((len(windows),), step), diffusion.condition(windows))
        for hook in hooks:
            hook.remove()
    with torch.no_grad():
        found = policy.features(windows)
    assert found.shape == (len(windows), 2 * (2 * 8 + 2 * 16 + 2 * 16 + 2 * 8)) and policy.feature_dim == found.shape[1]
    for step in (0, 99):
        rest = torch.cat(seen[step], dim=1) - found
        assert torch.allclose(rest, rest[:1].expand_as(rest), atol=1e-5) and rest.abs().max() > 0.01


def test_film_features_from_disk_and_back(tmp_path):
    demos = reach_demos(6)
    diffusion = clone(DiffusionPolicy, demos, UNET, iterations=20)
    diffusion.normalizer.mean += 1.0  # it must be this one, not one fitted anew
    policy = remembered(demos, diffusion, tmp_path / "diffusion", k=1)
    windows, actions = Windows(demos, 2, True).all()
    assert policy.window == 2 and torch.equal(policy.normalizer.mean, diffusion.normalizer.mean)
    assert torch.equal(policy.film.weight, diffusion.film().weight) and np.allclose(policy.act(windows.numpy())[:, 0], actions)
    save_policy(policy, tmp_path / "vinn")
    shutil.rmtree(tmp_path / "diffusion")
    x = np.random.default_rng(0).normal(size=(20, 2, 4)).astype(np.float32)
    again = load_policy(tmp_path / "vinn")
    assert np.array_equal(again.act(x), policy.act(x)) and again.config["representation"]["kind"] == "diffusion"
    assert sorted(name for name in again.state_dict() if name.startswith(("film", "unet"))) == ["film.weight"]


def test_save_and_load_needs_no_other_folder(tmp_path):
    demos = reach_demos(6)
    policy = remembered(demos, clone(BeT, demos, TINY, iterations=30), tmp_path / "bet", k=3)
    save_policy(policy, tmp_path / "vinn")
    shutil.rmtree(tmp_path / "bet")
    again = load_policy(tmp_path / "vinn")
    x = np.random.default_rng(0).normal(size=(20, 3, 4)).astype(np.float32)
    assert isinstance(again, VINN) and np.array_equal(again.act(x), policy.act(x))
    assert sorted(p.name for p in (tmp_path / "vinn").iterdir()) == ["policy.json", "weights.safetensors"]
    assert str(tmp_path) not in (tmp_path / "vinn" / "policy.json").read_text()
    raw = VINN({"obs_dim": 4, "act_dim": 2, "k": 1, "skip": 2})
    raw.remember(torch.randn(9, 1, 4), torch.randn(9, 2))
    save_policy(raw, tmp_path / "raw")
    assert np.array_equal(load_policy(tmp_path / "raw").act(x), raw.act(x))
    card = json.loads((tmp_path / "vinn" / "policy.json").read_text())
    card["config"]["rows"] -= 1
    (tmp_path / "vinn" / "policy.json").write_text(json.dumps(card))
    with pytest.raises(PdkitError, match="train it again"):
        load_policy(tmp_path / "vinn")


def test_made_by_the_command(tmp_path):
    out = tmp_path / "v"
    assert train.main(["base", "Door", "--policy", "vinn", "--num-demos", "2", "--out", str(out), "--set", "k=2", "eval_episodes=0"]) == 0
    policy = load_policy(out)
    assert policy.config["k"] == 2 and policy.config["rows"] == bundled("Door").first(2).lengths.sum()


def test_bad_configurations_are_told(tmp_path):
    with pytest.raises(PdkitError, match="k=1"):
        lookup(k=2, exclusion=3)
    with pytest.raises(PdkitError, match="at least 1"):
        lookup(k=0)
    with pytest.raises(PdkitError, match="as many demonstrated steps"):
        lookup(k=4)
    with pytest.raises(PdkitError, match="no demonstrations"):
        act(VINN({"obs_dim": 1, "act_dim": 1}), 0.0)
    save_policy(MLP({"obs_dim": 1, "act_dim": 1, "hidden": 4}), tmp_path / "mlp")
    with pytest.raises(PdkitError, match="kind bet or bet-sac or diffusion, not mlp"):
        lookup(representation=str(tmp_path / "mlp"))
    with pytest.raises(PdkitError, match="nowhere"):
        lookup(representation=str(tmp_path / "nowhere"))
    save_policy(BeT({"obs_dim": 4, "act_dim": 2} | TINY), tmp_path / "bet")
    with pytest.raises(PdkitError, match="same task"):
        lookup(representation=str(tmp_path / "bet"))
