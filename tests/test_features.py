"""What a residual's networks may see beside the observation."""
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pdkit.decorated import load_decorated, save_decorated
from pdkit.demos import sources
from pdkit.demos.chair_expert import PushChairExpert
from pdkit.demos.peg_expert import _Scene
from pdkit.errors import PdkitError
from pdkit.files import DATA
from pdkit.methods import METHODS
from pdkit.methods.registry import make_trainer, method_config
from pdkit.policies import load_policy
from pdkit.policies.base import Normalizer
from pdkit.probes import PROBES, ProbeBase, zero_base
from pdkit.profiles import online_config
from pdkit.tasks import features
from pdkit.tasks.features import FEATURES, Sight

PEG = "PegInsertionSide"


def test_rotations_are_those_of_scipy():
    rng = np.random.default_rng(0)
    first, second = Rotation.random(200, rng), Rotation.random(200, rng)
    first[:3] = second[:3] * Rotation.from_rotvec([[0, 0, 0], [1e-5, 0, 0], [0, 3.1, 0]])
    a, b = (torch.from_numpy(r.as_quat(scalar_first=True)) for r in (first, second))
    v = rng.normal(size=(200, 3))
    assert np.allclose(features.rotated(a, torch.from_numpy(v)), first.apply(v))
    turned = features.turn_between(a, -b)  # a quaternion and its negative are the same rotation
    assert np.allclose(turned, (second * first.inv()).as_rotvec(), atol=1e-6)


def test_the_peg_is_seen_from_its_hole():
    """As the scripted expert takes observations apart, which is other code; on demonstrations, from the grasp to the peg in its hole."""
    obs = sources.bundled(PEG).observations[::97]
    found = features.peg(torch.from_numpy(obs)).numpy()
    assert found.shape == (len(obs), FEATURES[PEG][0])
    for numbers, scene in zip(found, map(_Scene.of, obs), strict=True):
        head = scene.head_in_hole
        beside, still = scene.hole_turn.apply(head * [0, 1, 1]), head[:1] + scene.half_length
        lengths = (beside, 0.008, 0.05), (scene.misalignment, 0.03, 0.2), (still, 0.01, 0.1), (scene.peg - scene.tool, 0.02, 0.1)
        expected = np.concatenate([part for x, near, far in lengths for part in (np.clip(x / far, -5, 5), np.tanh(x / near))])
        assert np.allclose(numbers, expected, atol=2e-4)


def test_what_is_seen_is_the_normalised_observation_and_the_features_behind_it():
    normalizer, obs = Normalizer(50), torch.from_numpy(sources.bundled(PEG).observations[:8])
    normalizer.mean.fill_(1.0)
    seen = Sight(normalizer, features=PEG)
    assert torch.equal(seen(obs)[:, :50], obs - 1) and torch.equal(seen(obs)[:, 50:], features.peg(obs)) and seen.more == 20
    plain = Sight(normalizer, normalize=False)
    assert torch.equal(plain(obs), obs) and plain.more == 0
    with pytest.raises(PdkitError, match="No features are known for Door"):
        Sight(normalizer, features="Door")


def test_actor_and_critics_see_them_and_the_saved_policy_does_too(tmp_path):
    base, config = load_policy(DATA / "checkpoints" / PEG / "base"), online_config(PEG, "smoke")
    trainer = make_trainer(config, base, sources.bundled(PEG).first(2))
    assert trainer.agent.actor.config["in_dim"] == 70 and next(trainer.agent.critics.parameters()).shape[-1] == 77
    windows = np.repeat(sources.bundled(PEG).observations[:6, None], base.window, axis=1)
    policy = trainer.policy
    save_decorated(policy, tmp_path / "decorated")
    again = load_decorated(tmp_path / "decorated")
    assert again.sight.features == PEG and np.allclose(again.act(windows), policy.act(windows), atol=1e-6)
    closer = windows.copy()
    closer[..., 42:45] += 0.002  # the hole, 2 mm further: what the raw observation hardly shows
    with torch.inference_mode():
        far, near = (policy.sight(torch.from_numpy(w[:, -1])) for w in (windows, closer))
    assert (far - near)[:, 50:].abs().max() > 3 * (far - near)[:, :50].abs().max()


def test_a_residual_learns_from_features_what_the_observation_hides(monkeypatch):
    """The reach probe, its goal scaled to nothing in the observation: only the feature says where it is."""
    spec = PROBES["reach"]
    monkeypatch.setitem(FEATURES, spec.name, (2, lambda obs: (obs[:, 2:] - obs[:, :2]) * 5))
    blind = zero_base(spec)
    blind.normalizer.std.fill_(1e6)
    settings = dict(total_steps=5_000, warmup_steps=1_000, warmup="uniform", H=0, alpha=1.0, num_envs=4, env_workers=0, eval_workers=0,
                    demo_fraction=0.0, eval_every=5_000, eval_episodes=20, log_every=1_000, batch=64, hidden=64, utd=0.5,
                    residual_penalty=0.0, checkpoint_every=0,
                    # With those of the profile it depends on the seed, and on how a processor rounds, whether so few steps are enough.
                    actor_lr=3e-3, critic_lr=3e-3, tau=0.05, average=0.95, actor_every=1, gamma=0.9, init_temperature=0.3)
    ends = {}
    for seen in (True, False):
        trainer = make_trainer(online_config("Door", "smoke", features=seen, **settings), blind, spec=spec)
        trainer.train()
        ends[seen] = trainer.rows[-1]["success_once"]
    assert ends[True] >= 0.9 > 0.6 > ends[False]


def test_who_sees_features():
    """In that task's lesson the methods with the loop's own networks, over policies told the state; never the paper's profile."""
    assert online_config(PEG, "lesson").features and not online_config(PEG, "paper").features and not online_config("Door").features
    sighted = {method for method in METHODS if method_config(method, PEG).features}
    assert sighted == {"policy_decorator", "residual_rl", "sac_from_scratch", "rlpd", "jsrl"}
    visual = ProbeBase(dict(obs_dim=300, act_dim=7, kind="visual", bias=[0.0] * 7))
    assert not method_config("policy_decorator", PEG, policy=visual).features
    config = method_config("ppo_decorator", PEG, "smoke", features=True)
    with pytest.raises(PdkitError, match="set features=False"):
        make_trainer(config, load_policy(DATA / "checkpoints" / PEG / "base"))
    with pytest.raises(PdkitError, match="No features are known for Door"):
        make_trainer(online_config("Door", "smoke", features=True, demo_fraction=0.0), load_policy(DATA / "checkpoints" / "Door" / "base"))
    with pytest.raises(PdkitError, match="features must be of type bool"):
        online_config(PEG, features="yes")


def test_the_way_round_the_chair_is_the_expert_s():
    obs = sources.bundled("PushChair").observations[::37]
    found = features.chair(torch.from_numpy(obs)).numpy()
    base, chair, motion = (obs[:, part] for part in (PushChairExpert.BASE, PushChairExpert.CHAIR, PushChairExpert.MOTION))
    around = (np.arctan2(*chair.T[::-1]) - np.arctan2(*(base - chair).T[::-1]) + np.pi) % (2 * np.pi) - np.pi
    assert np.allclose(found[:, 12], around, atol=1e-3) and np.allclose(found[:, 14] * 0.5, np.linalg.norm(base - chair, axis=1), atol=1e-4)
    assert np.allclose(np.linalg.norm(found[:, 8:10], axis=1) * 0.3, np.linalg.norm(motion, axis=1), atol=1e-4)


def test_the_chair_is_seen_from_the_robot():
    """Turning the room about the target turns nothing that the robot sees; and being behind the chair is no angle."""
    obs = sources.bundled("PushChair").observations[::50].copy()
    found = features.chair(torch.from_numpy(obs)).numpy()
    assert found.shape == (len(obs), FEATURES["PushChair"][0]) and np.isfinite(found).all()
    angle, turned = 0.7, obs.copy()
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], np.float32)
    for part in (slice(38, 40), slice(44, 46), slice(51, 53)):
        turned[:, part] = obs[:, part] @ matrix.T
    turned[:, 40] += angle
    assert np.allclose(features.chair(torch.from_numpy(turned)).numpy(), found, atol=1e-4)
    behind = torch.zeros(1, 131)
    behind[0, [38, 44]] = torch.tensor([2.0, 1.0])  # robot, chair and target in a row; the robot looks along x, away from both
    numbers = features.chair(behind)[0]
    assert numbers[:4].tolist() == pytest.approx([-2.0, 0, -1, 0], abs=1e-5) and numbers[12].abs() < 1e-6  # 1 m behind itself, at 0.5 m
    aside = behind.clone()
    aside[0, 38:40] = torch.tensor([1.0, 1.0])
    assert features.chair(aside)[0, 12].item() == pytest.approx(-np.pi / 2)  # a quarter to the right round the chair
