"""Base policies that decide on several actions at once: steps stay primitive, a decision is one transition of the learner."""
import dataclasses
import types

import numpy as np
import pytest
import torch
from worlds import TwoAtOnce, clone, reach_demos, reach_trainer

from pdkit.decorated import Decorated, load_decorated, save_decorated
from pdkit.decorator import DecoratorConfig
from pdkit.demos.sources import rollouts
from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.methods import METHODS
from pdkit.methods.registry import method_config
from pdkit.online_config import OnlineConfig, decision_reward
from pdkit.online_rows import demo_rows
from pdkit.policies import DiffusionPolicy
from pdkit.probes import PROBES, ProbeBase
from pdkit.profiles import build, flat, online_config, policy_values
from pdkit.rl.networks import Actor

BIASED = dict(obs_dim=4, act_dim=2, kind="reach", bias=[0.2, -0.2])


def test_a_decision_is_rewarded_once_however_often_it_was_solved():
    config = OnlineConfig(reward_shift=-1.0)
    assert decision_reward(config, np.array([0, 1, 3])).tolist() == [-1, 0, 0]


def config_of(**changes):
    values = dict(task="reach", gamma=0.9, n_step=1, on_success="terminate", alpha=0.5, demo_fraction=0.25)
    return build(OnlineConfig, values | changes)


def test_demonstrations_begin_a_chunk_at_every_step():
    demos = reach_demos(1, first_seed=3)
    episode, base = demos.episode(0), ProbeBase(dict(obs_dim=4, act_dim=2, kind="zero"))
    base.chunk, base.forward = 2, lambda windows: torch.zeros(len(windows), 2, 2)
    length = len(episode["actions"])
    assert length > 4 and episode["success"].tolist() == [False] * (length - 1) + [True]
    rows = np.stack(demo_rows(demos, base, config_of(), rest=lambda last: np.float32([9, 9])))
    obs, residual, _, reward, after, _, discount = np.split(rows, np.cumsum([4, 4, 4, 1, 4, 4]), axis=1)
    followed = np.concatenate([episode["actions"], np.float32([[9, 9]])])
    order = [*range(0, length, 2), *range(1, length, 2)]
    assert len(rows) == length
    for row, t in enumerate(order):
        assert np.allclose(obs[row], episode["observations"][t]) and np.allclose(residual[row], followed[t: t + 2].ravel() / 0.5)
        assert np.allclose(after[row], episode["observations"][min(t + 2, length)])
        ends = t + 2 >= length
        assert (reward[row, 0], discount[row, 0]) == ((0, 0) if ends else (-1, np.float32(0.9)))


def test_a_trainers_demonstrations_end_as_its_task_keeps_still():
    """Displacements that went on in the last chunk would be imitated by the critics' data."""
    demos = reach_demos(2)
    for moving, wanted in ((dict(absolute_actions=False, held_actions=(1,)), lambda a: [0, a[1]]), (dict(absolute_actions=True), list)):
        spec = dataclasses.replace(PROBES["reach"], **moving)
        base = TwoAtOnce(dict(obs_dim=4, act_dim=2, kind="zero"))
        trainer = reach_trainer("residual_rl", base, demos, spec, demo_fraction=0.25, n_step=1)
        rows = np.stack(trainer._demo_rows(demos))
        last = demos.episode(0)["actions"][-1]
        seen = demos.episode(0)["observations"][-2]
        ends = rows[(rows[:, :4] == seen).all(axis=1)]
        assert len(ends) == 1 and np.allclose(ends[0, 4:8], [*last, *wanted(last)], atol=1e-6)


def test_several_steps_ahead_are_several_decisions_ahead():
    demos = reach_demos(1, first_seed=3)
    base = TwoAtOnce(dict(obs_dim=4, act_dim=2, kind="zero"))
    one, two = (np.stack(demo_rows(demos, base, config_of(n_step=n))) for n in (1, 2))
    assert np.allclose(two[0, 12], one[0, 12] + 0.9 * one[1, 12])  # rewards
    assert np.allclose(two[0, 13:17], one[1, 13:17])  # where the second decision led


def test_what_is_executed_is_the_sum_of_two_chunks_and_steps_are_primitive(monkeypatch):
    trainer = reach_trainer("policy_decorator", TwoAtOnce(BIASED), alpha=0.3, alpha_scale=(1.0, 0.5), H=0, warmup="uniform",
                            total_steps=600, warmup_steps=400, n_step=1)
    executed, store = [], trainer._store

    def spy(obs, residual, base, result, base_final):
        executed.append((residual, base, result))
        return store(obs, residual, base, result, base_final)

    monkeypatch.setattr(trainer, "_store", spy)
    trainer.train()
    steps = sum(int(result.steps.sum()) for _, _, result in executed)
    assert trainer.step == steps >= 600 and trainer.replay.size < steps / 1.5
    assert trainer.agent.updates == int((steps - executed[-1][2].steps.sum() - 400) * 0.5)  # per primitive step
    rows = trainer.replay.unpack(trainer.replay.rows[: trainer.replay.size])
    assert rows["residual"].shape[1] == rows["base"].shape[1] == 4
    first_residual, first_base, first_result = executed[0]
    both = np.clip(first_base + first_residual * np.float32([0.3, 0.15, 0.3, 0.15]), -1, 1)  # the factors hold for each action
    start = rows["obs"][: len(both), :2].numpy()
    moved = np.clip(np.clip(start + 0.2 * both[:, :2], -1.5, 1.5) + 0.2 * both[:, 2:], -1.5, 1.5)
    whole = first_result.steps == 2
    assert whole.any() and np.allclose(first_result.final_windows[whole, -1, :2], moved[whole], atol=1e-5)


def test_a_decorator_repairs_a_policy_that_acts_in_chunks():
    base = TwoAtOnce(BIASED)
    trainer = reach_trainer("policy_decorator", base, alpha=1.0, H=500, total_steps=4000, warmup="uniform")
    policy = trainer.train()
    seeds = range(10_000, 10_100)
    before, after = (evaluate(PROBES["reach"], p.act, seeds, chunk=2).success_once.mean() for p in (base, policy))
    assert before < 0.5 and after > before + 0.3


def test_a_decorated_chunk_on_disk(tmp_path):
    demos = reach_demos(5)
    small = dict(window=2, horizon=4, chunk=3, dims=[16, 32], groups=4, embed=16)
    base = clone(DiffusionPolicy, demos, small, iterations=2)
    actor = Actor(4, 6, 8, 1, False, (-5.0, 2.0))
    torch.nn.init.normal_(actor.head.weight, std=0.5)  # not so large that a residual reaches its bound, where rounding decides
    policy = Decorated(base, actor, DecoratorConfig(alpha=0.2, alpha_scale=(1.0, 0.5) * 3))
    save_decorated(policy, tmp_path / "d")
    again, windows = load_decorated(tmp_path / "d"), np.random.default_rng(0).normal(size=(5, 2, 4)).astype(np.float32)
    actions = []
    for p in (policy, again):
        p.reset(0)
        actions.append(p.act(windows))
    base.reset(0)
    assert actions[0].shape == (5, 3, 2) and again.chunk == 3 and np.array_equal(*actions)
    difference = np.abs(actions[0] - base.act(windows)).max(axis=(0, 1))
    assert 0.05 < difference[0] <= 0.2 and 0.02 < difference[1] <= 0.1


def test_motion_is_measured_within_chunks_too():
    one, two = (evaluate(PROBES["reach"].__class__(**vars(PROBES["reach"]) | {"joints": 2}), act, range(5), chunk=chunk)
                for act, chunk in ((lambda w: np.full((len(w), 1, 2), 0.5), 1), (lambda w: np.full((len(w), 2, 2), 0.5), 2)))
    assert np.allclose(one.jerk, two.jerk) and one.jerk.notna().all() and (one.length == two.length).all()


def test_rollouts_of_chunks_are_recorded_step_by_step():
    """A constant action gives the same episodes whether it is decided on once or three times as often."""
    seeds, played, started = range(4), [], []
    for chunk in (1, 3):
        policy = ProbeBase(dict(obs_dim=4, act_dim=2, kind="zero"))
        policy.chunk, policy.act = chunk, lambda windows, chunk=chunk: np.full((len(windows), chunk, 2), 0.4, np.float32)
        policy.reset = started.append
        played.append(rollouts(policy, PROBES["reach"], seeds))
    assert started == [0, 0]  # so that one that samples makes the same again
    for name in ("observations", "actions", "success", "lengths"):
        assert np.array_equal(getattr(played[0], name), getattr(played[1], name)), name


def test_a_replay_has_room_for_twice_the_whole_chunks_of_a_run():
    for chunk, room in ((1, 901), (2, 901), (5, 362)):
        base = TwoAtOnce(BIASED)
        base.chunk = chunk
        assert reach_trainer("residual_rl", base, total_steps=901).replay.capacity == room
    dipo = DiffusionPolicy(dict(obs_dim=4, act_dim=2, window=2, horizon=8, chunk=4, dims=[16], groups=4, embed=16))
    assert len(reach_trainer("dipo", dipo, total_steps=901, warmup_steps=100).agent.memory.obs) == 452


def test_methods_for_single_actions_say_so():
    with pytest.raises(PdkitError, match="decides on 2 at once"):
        reach_trainer("jsrl", TwoAtOnce(BIASED), eval_every=1000, eval_episodes=5)


def test_the_factors_of_the_bound_are_counted_for_an_action_not_for_a_chunk():
    with pytest.raises(PdkitError, match="alpha_scale has 3 factors; the action has 2 dimensions"):
        reach_trainer("policy_decorator", TwoAtOnce(BIASED), alpha_scale=(1.0, 1.0, 0.5))


def test_over_a_policy_that_sees_the_paper_profile_is_the_script_for_pictures():
    def config(obs_dim):
        sees = types.SimpleNamespace(kind="mlp", chunk=1, config={"obs_dim": obs_dim})
        return method_config("policy_decorator", "TurnFaucet", "paper", policy=sees)

    assert (config(288).batch, config(288).decorator.alpha, config(288).total_steps) == (256, 0.05, 2_000_000)
    assert (config(40).batch, config(40).decorator.alpha, config(40).total_steps) == (1024, 0.2, 3_000_000)


def test_the_papers_budgets_count_chunks_and_ours_primitive_steps():
    """facts.md 1.3 and 1.4: 4M chunks of 4 actions by default, TurnFaucet 2M, H 100,000 chunks, 0.25 updates a chunk."""
    paper = online_config("TurnFaucet", "paper", **policy_values("TurnFaucet", "paper", "diffusion", 4))
    assert (paper.total_steps, paper.decorator.H, paper.utd, paper.warmup_steps) == (8_000_000, 400_000, 0.0625, 32_000)
    chair = policy_values("PushChair", "paper", "diffusion", 4)
    assert (chair["alpha"], chair["H"], chair["gamma"]) == (0.2, 1_200_000, 0.9)
    eyes = policy_values("TurnFaucet", "paper", "diffusion", 4, visual=True)  # the script for pictures
    assert (eyes["total_steps"], eyes["H"], eyes["alpha"], eyes["batch"], eyes["utd"]) == (8_000_000, 120_000, 0.05, 256, 0.0625)
    chair = policy_values("PushChairSource", "paper", "mlp", 1, visual=True)
    assert (chair["total_steps"], chair["H"], chair["alpha"], chair["actor_lr"]) == (5_000_000, 100_000, 0.2, 1e-4)
    assert policy_values("Door", "lesson", "mlp", 1, visual=True) == {}
    assert policy_values("TurnFaucet", "paper", "bet", 1) == policy_values("Door", "lesson", "diffusion", 1) == {}
    assert policy_values("StackCube", "lesson", "diffusion", 4) == {"gamma": 0.922, "n_step": 2}  # 0.98 and 5 a step


@pytest.mark.parametrize("chunk", [2, 4, 16])  # 4 is the paper's, which sees 2 observations and predicts 16 actions
def test_the_decorator_trains_over_chunks(chunk):
    base = DiffusionPolicy(dict(obs_dim=4, act_dim=2, window=2, horizon=20 if chunk == 16 else 8, chunk=chunk, dims=[16, 32], groups=4,
                                embed=16, sampler_steps=2))
    trainer = reach_trainer("policy_decorator", base, total_steps=500, warmup_steps=200, utd=0.1, batch=16)
    policy = trainer.train()
    assert trainer.act_dim == 2 * chunk == trainer.replay.unpack(trainer.replay.rows[:1])["base"].shape[1]
    assert 500 <= trainer.step < 500 + 4 * chunk and trainer.agent.updates > 0
    assert trainer.replay.size >= trainer.step / chunk - 4 * trainer.config.n_step  # one a decision; the latest still wait for returns
    table = evaluate(PROBES["reach"], policy.act, range(500, 505), window=2, chunk=chunk)
    assert table.length.max() <= PROBES["reach"].max_episode_steps and policy.act(np.zeros((3, 2, 4), np.float32)).shape == (3, chunk, 2)


def test_what_a_method_is_stays_with_it_whatever_the_policy():
    """Residual RL keeps its open bound and gate over a Diffusion Policy; methods of single actions keep their discount."""
    base = DiffusionPolicy(dict(obs_dim=4, act_dim=2, window=2, horizon=4, chunk=2, dims=[16, 32], groups=4, embed=16))
    for method, m in METHODS.items():
        for profile, own in (("lesson", m.changes | m.lesson), ("paper", m.changes | m.paper)):
            config = flat(method_config(method, "StackCube", profile, policy=base))
            assert all(config[name] == (list(value) if isinstance(value, tuple) else value) for name, value in own.items()), method
    assert method_config("sac_from_scratch", "StackCube", policy=base).gamma == 0.98
    assert method_config("residual_rl", "StackCube", policy=base).gamma == pytest.approx(0.98**2, abs=1e-3)
