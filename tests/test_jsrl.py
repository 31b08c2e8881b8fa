"""JSRL: when the guide gives up steps, who acts when, what is stored, and that the pair learns."""
import dataclasses

import numpy as np
import pytest
import torch
from test_online import bet_base
from worlds import reach_trainer

from pdkit import cli, recorded, transfer
from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate, timed
from pdkit.methods.config import MethodConfig
from pdkit.methods.jsrl import JSRL, JumpStart, load_jump_start, may_advance
from pdkit.probes import PROBES, biased_base, zero_base
from pdkit.profiles import flat
from pdkit.runs import Run
from pdkit.seeds import reported_seeds

SPEC = PROBES["reach"]


def start(base=None, **changes):
    values = dict(eval_every=200, eval_episodes=5, log_every=200, jsrl_episodes=40, jsrl_window=1, jsrl_step=3, total_steps=800)
    return reach_trainer("jsrl", base or biased_base((0.09, 0.0)), **values | changes)


def success(policy, episodes=100):
    return evaluate(SPEC, policy.act, reported_seeds(episodes), window=policy.window, num_envs=20).success_once.mean()


# ---- the rule --------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("scores", "window", "tolerance", "advances"), [
    ([0.5], 2, 0.1, False),  # the window is not full
    ([0.5, 0.5], 2, 0.1, True),
    ([0.5, 0.9], 1, 0.1, True),  # an improvement never blocks
    ([0.9, 0.8], 1, 0.1, True),  # just within
    ([0.9, 0.79], 1, 0.1, False),
    ([0.9, 0.9, 0.2, 0.9], 2, 0.1, False),  # the mean of the last two, 0.55, against the best such mean, 0.9
    ([0.9, 0.9, 0.7, 0.9], 2, 0.1, True),
    ([0.0], 1, 0.1, False), ([0.0, 0.0, 0.0], 2, 0.1, False),  # flat zero
    ([0.0, 0.0, 0.05], 1, 0.1, True), ([0.05, 0.0], 1, 0.1, True),  # not flat any more
])
def test_when_the_guide_gives_up_steps(scores, window, tolerance, advances):
    assert may_advance(scores, window, tolerance) == advances


@pytest.mark.parametrize(("scores", "expected"), [
    ([0.5, 0.6, 0.2, 0.55, 0.6], [9, 6, 6, 3, 3]),  # the third is too far below the best; nobody would evaluate what falls at the end
    ([0.0, 0.0, 0.0, 0.0, 0.0], [12, 12, 12, 12, 12]),
    ([1.0, 1.0, 1.0, 1.0, 1.0], [9, 6, 3, 0, 0]), ([0.0, 1.0, 1.0, 1.0, 1.0], [12, 9, 6, 3, 3]),
])
def test_the_horizon_falls_exactly_when_the_rule_says_so(monkeypatch, scores, expected):
    from pdkit import online_eval

    given = iter(scores)
    monkeypatch.setattr(online_eval, "_score", lambda *_: {"success_once": next(given), "success_at_end": 0.0, "eval_seconds": 0.0})
    trainer = start(total_steps=1000, utd=0.0)
    trainer._first_guide_steps = lambda: 12
    seen = []
    trainer.train(progress=lambda t: seen.append(t.guide_steps))
    assert seen == expected
    assert [row["guide_steps"] for row in trainer.rows] == [12, *expected[:-1]]  # a row names the horizon that was evaluated


def test_training_waits_for_the_evaluation_that_moves_the_horizon():
    """Otherwise the curve would depend on when another process answers."""
    class Slow:
        pending: dict = {}

        def submit(self, step, weights):
            self.pending[step] = weights

        def collect(self, wait=False):
            for step in list(self.pending) if wait else ():
                yield step, self.pending.pop(step), {"success_once": 1.0, "success_at_end": 1.0}

    trainer = start()
    trainer._set_guide_steps(9)
    trainer.step = 200
    trainer._add_row(196, Slow())
    assert trainer.guide_steps == 6 and trainer.rows[-1]["success_once"] == 1.0


def test_the_first_horizon_is_the_mean_length_of_successful_episodes():
    from pdkit.seeds import selection_seeds

    base, lengths = biased_base((0.09, 0.0)), []
    for seed in selection_seeds(40):
        sim = SPEC.make()
        observation, solved, t = sim.reset(seed), False, 0
        while t < SPEC.max_episode_steps and not solved:
            observation, solved = sim.step(base.act(observation[None, None])[0, 0])
            t += 1
        if solved:
            lengths.append(t)
    assert 0 < len(lengths) <= 40
    assert start()._first_guide_steps() == round(np.mean(lengths))


# ---- who acts when ---------------------------------------------------------------------------------------------------

def told(trainer, steps):
    """Each lane's steps in its episode and whether the guide acted, for a whole run."""
    log, explore = [], trainer._explore

    def noted(obs, base):
        residual = explore(obs, base)
        log.append((trainer.elapsed.copy(), (residual == 0).all(axis=1), base.copy(), obs.copy()))
        return residual

    trainer._explore = noted
    trainer._first_guide_steps = lambda: steps
    trainer.train()
    return [np.stack(x) for x in zip(*log, strict=True)]


def test_the_guide_acts_before_h_only():
    base = biased_base((0.09, 0.0))
    trainer = start(base, jsrl_tolerance=0.0, utd=0.0, jsrl_window=100)
    elapsed, guided, actions, obs = told(trainer, 4)
    assert np.array_equal(guided, elapsed < 4) and guided.any() and not guided.all()
    assert elapsed.max() == 24 and (elapsed[1:][elapsed[:-1] == 24] == 0).all()
    assert np.allclose(actions[guided], base.act(obs[guided][:, None])[:, 0]) and (actions[~guided] == 0).all()


def test_rows_hold_the_executed_action_and_no_base():
    base = biased_base((0.09, 0.0))
    trainer = start(base, n_step=1, utd=0.0, jsrl_window=100, warmup_steps=799)
    trainer._first_guide_steps = lambda: 4
    trainer.train()
    rows = {k: v.numpy() for k, v in trainer.replay.unpack(trainer.replay.rows[: trainer.replay.size]).items()}
    assert (rows["base"] == 0).all() and (rows["next_base"] == 0).all()
    executed = np.clip(rows["residual"], -1, 1)
    assert np.allclose(rows["next_obs"][:, :2], np.clip(rows["obs"][:, :2] + 0.2 * executed, -1.5, 1.5), atol=1e-5)
    guides = np.isclose(rows["residual"], base.act(rows["obs"][:, None])[:, 0]).all(axis=1)
    assert guides[:16].all() and 0 < guides.mean() < 0.6  # 4 environments, 4 steps each, then random actions


def test_evaluation_tells_each_lane_its_step():
    seen = []

    @timed
    def act(windows, elapsed):
        seen.append(elapsed.copy())
        return np.zeros((len(windows), 1, 2), np.float32)

    evaluate(SPEC, act, list(range(6)), num_envs=3, max_episode_steps=5)
    assert np.array_equal(np.stack(seen), np.repeat(np.arange(10)[:, None] % 5, 3, axis=1))


def test_the_combined_policy_switches_at_its_horizon(tmp_path):
    trainer = start(bet_base(act_dropout=False))
    trainer._set_guide_steps(3)
    with torch.no_grad():
        trainer.agent.average.head.bias[:2] = 1.0
    policy, windows = trainer.policy, np.random.default_rng(0).normal(size=(4, 3, 4)).astype(np.float32)
    assert isinstance(policy, JumpStart)
    actions = policy.act(windows, np.array([0, 2, 3, 9]))
    assert np.allclose(actions[:2], trainer.base.act(windows[:2])) and np.allclose(actions[2:], policy.learner.act(windows[2:]))
    assert not np.allclose(actions[2:], trainer.base.act(windows[2:]), atol=0.1)
    trainer.save_policy(policy, tmp_path / "p")
    back = load_jump_start(tmp_path / "p")
    assert back.guide_steps == 3 and np.array_equal(back.act(windows, np.array([0, 2, 3, 9])), actions)
    with pytest.raises(PdkitError, match="elapsed"):
        policy.act(windows)


def test_evaluate_and_film_know_its_folder(tmp_path, monkeypatch, capsys):
    """The recipe tells it from a decorated policy; a film shows it beside its guide."""
    trainer, shown = start(bet_base(act_dropout=False)), []
    trainer._set_guide_steps(3)
    trainer.save_policy(trainer.policy, tmp_path / "p")
    monkeypatch.setattr(transfer, "get_task", lambda name: SPEC)
    monkeypatch.setattr(recorded, "DATA", tmp_path)
    assert cli.main(["evaluate", str(tmp_path / "p"), "--tasks", "reach", "--episodes", "20", "--record", "j"]) == 0
    (row,) = recorded.load("j")[0].itertuples()
    assert row.recipe == "jsrl" and row.success == success(load_jump_start(tmp_path / "p"), 20)
    assert cli.main(["evaluate", str(tmp_path / "p"), "--tasks", "reach", "--sampling", "temperature=0"]) == 2
    assert "this is a JumpStart" in capsys.readouterr().err
    monkeypatch.setattr(transfer.video, "try_render", lambda spec: None)
    monkeypatch.setattr(transfer.video, "contrasts", lambda spec, *policies, seeds=(), **options: shown.extend(policies[:2]) or [])
    monkeypatch.setattr(transfer.video, "record_all", lambda spec, policies, *words, **options: shown.append(list(policies)) or [None])
    monkeypatch.setattr(transfer.video, "side_by_side", lambda *clips: None)
    monkeypatch.setattr(transfer.video, "write_video", lambda *words, **options: True)
    transfer.film(policy := load_jump_start(tmp_path / "p"), SPEC, tmp_path / "f.webp", 2)
    assert shown == [policy.guide, policy, ["base", "JSRL"]]


# ---- the whole -------------------------------------------------------------------------------------------------------

def test_the_learner_takes_over_and_is_better_than_its_guide():
    base = biased_base((0.12, 0.0))
    before = evaluate(SPEC, base.act, reported_seeds(100), num_envs=20).success_once.mean()
    trainer = start(base, total_steps=3500, eval_every=500, eval_episodes=20, jsrl_tolerance=0.2)
    policy = trainer.train()
    assert trainer.rows[0]["guide_steps"] > 0 and policy.guide_steps == trainer.guide_steps == 0
    assert before < 0.7 and success(policy) > 0.9


@pytest.mark.parametrize("where", [300, 500])
def test_killed_and_resumed_gives_the_same_curve(tmp_path, monkeypatch, where):
    """At 228 steps the lanes are at step 7, and the horizon has just fallen from 9 to 6: the action now due is still the guide's.
    The guide draws random numbers (dropout)."""
    def make():
        trainer = start(bet_base(), checkpoint_every=228, eval_every=228, utd=0.1, warmup_steps=100, log_every=100)
        trainer._first_guide_steps = lambda: 9
        return trainer

    given = {228: 0.5, 456: 0.55, 684: 0.1, 800: 0.6}  # an untrained guide solves nothing: scores that move the horizon
    collect = JSRL._collect

    def scored(trainer, evaluations, progress, wait=False):
        collect(trainer, evaluations, progress, wait)
        for row in trainer.rows:
            row |= {"success_once": given[row["step"]]} if "success_once" in row else {}

    monkeypatch.setattr(JSRL, "_collect", scored)
    whole = make()
    config = flat(whole.config)
    whole.train(Run(tmp_path / "whole", "online", config))

    def killed(trainer):
        if trainer.step >= where:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make().train(Run(tmp_path / "cut", "online", config), killed)
    resumed = make()
    resumed.train(Run(tmp_path / "cut", "online", config))
    strip = lambda rows: [{k: v for k, v in row.items() if "seconds" not in k} for row in rows]  # noqa: E731
    assert strip(resumed.rows) == strip(whole.rows) and whole.guide_steps < 9
    one, other = whole.agent.state(), resumed.agent.state()
    assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
    assert torch.equal(whole.replay.rows, resumed.replay.rows)


def test_bad_input_is_told():
    with pytest.raises(PdkitError, match="alpha=1"):
        start(alpha=0.5)
    with pytest.raises(PdkitError, match="eval_every"):
        start(eval_every=0)
    with pytest.raises(PdkitError, match="jsrl_step"):
        dataclasses.replace(MethodConfig(), jsrl_step=0)
    with pytest.raises(PdkitError, match="solved none"):
        start(zero_base(SPEC), jsrl_episodes=3).train()
