"""The online loop: what it stores, when it learns, and that killed and resumed runs give the same curve."""
import dataclasses
import math

import numpy as np
import pytest
import torch

from pdkit.decorated import load_decorated, save_decorated
from pdkit.decorator import DecoratorConfig
from pdkit.demos.format import Demos
from pdkit.errors import PdkitError
from pdkit.online import Trainer, demo_rows
from pdkit.online_config import OnlineConfig, stops
from pdkit.policies import BeT
from pdkit.probes import PROBES, biased_base
from pdkit.profiles import differences, flat, online_config, policy_values
from pdkit.rl.sac import SACConfig
from pdkit.runs import Run

SPEC = PROBES["reach"]
SMALL = SACConfig(hidden=16, layers=2, bf16=False)


def config(**changes):
    values = dict(task="reach", total_steps=400, num_envs=4, env_workers=0, eval_workers=0, warmup_steps=100, batch=32, demo_fraction=0.0,
                  utd=0.5, n_step=3, on_success="terminate", success_tail=0, eval_every=200, eval_episodes=4, log_every=100,
                  checkpoint_every=100, normalize_obs=False, sac=SMALL, decorator=DecoratorConfig(alpha=0.6, H=300))
    return OnlineConfig(**(values | changes))


def columns(trainer):
    return {k: v.numpy() for k, v in trainer.replay.unpack(trainer.replay.rows[: trainer.replay.size]).items()}


@pytest.mark.parametrize(("rule", "at_success", "at_limit"), [("truncated", True, False), ("never", True, True), ("always", False, False)])
def test_bootstrap_rules(rule, at_success, at_limit):
    c = config(bootstrap=rule)
    assert (stops(c, True, False), stops(c, False, True), stops(c, False, False)) == (at_success, at_limit, False)


def test_what_is_stored():
    base = biased_base((0.05, 0.0))
    trainer = Trainer(config(n_step=1, warmup="uniform", decorator=DecoratorConfig(alpha=0.6, H=0)), base, spec=SPEC)
    trainer.train()
    data = columns(trainer)
    assert np.allclose(data["base"], base.act(data["obs"][:, None])[:, 0])
    assert np.allclose(data["next_base"], base.act(data["next_obs"][:, None])[:, 0])
    # the successor is what the executed sum led to, final observations of ended episodes included
    executed = np.clip(data["base"] + 0.6 * data["residual"], -1, 1)
    assert np.allclose(data["next_obs"][:, :2], np.clip(data["obs"][:, :2] + 0.2 * executed, -1.5, 1.5), atol=1e-5)
    assert np.array_equal(data["obs"][:, 2:], data["next_obs"][:, 2:])  # never across episodes
    solved = np.linalg.norm(data["next_obs"][:, :2] - data["next_obs"][:, 2:], axis=1) < 0.1
    assert solved.any()
    assert set(data["reward"][solved]) == {0.0} and set(data["reward"][~solved]) == {-1.0}  # shifted by -1
    assert set(data["discount"][solved]) == {0.0}
    assert np.allclose(data["discount"][~solved], 0.97)  # time limits bootstrap


def test_reward_goes_on_after_success_when_episodes_do():
    trainer = Trainer(config(on_success="continue", n_step=1), biased_base((0.0, 0.0)), spec=SPEC)
    trainer.train()
    data = columns(trainer)
    assert (data["reward"] == 0).sum() > 50 and np.allclose(data["discount"], 0.97)


@pytest.mark.parametrize(("warmup", "expected"), [("base", 0.0), ("uniform", 0.5)])
def test_residuals_before_learning(warmup, expected):
    trainer = Trainer(config(warmup=warmup, n_step=1, decorator=DecoratorConfig(alpha=0.6, H=0)), biased_base(), spec=SPEC)
    trainer.train()
    early = columns(trainer)["residual"][:96]
    assert np.abs(early).mean() == pytest.approx(expected, abs=0.08)  # |uniform(-1, 1)| has mean 0.5
    assert trainer.agent.updates == int((400 - 4 - 100) * 0.5)


def test_the_gate_is_applied_while_training_and_not_in_evaluation():
    trainer = Trainer(config(n_step=1, total_steps=3000, warmup="uniform", warmup_steps=2990, eval_every=0,
                             decorator=DecoratorConfig(alpha=0.6, H=3000)), biased_base(), spec=SPEC)
    trainer.train()
    zero = (columns(trainer)["residual"] == 0).all(axis=1)
    assert zero[:600].mean() > 0.8 and 0.35 < zero[1200:1800].mean() < 0.65 and zero[-600:].mean() < 0.2
    windows = np.random.default_rng(0).normal(size=(8, 1, 4)).astype(np.float32)
    fresh = Trainer(config(decorator=DecoratorConfig(alpha=0.6, H=10**9)), biased_base(), spec=SPEC).policy
    with torch.no_grad():
        fresh.actor.head.bias[:2] = 1.0
    base, residual = fresh.parts(windows)
    assert (np.abs(residual) > 0.5).all()
    assert np.allclose(fresh.act(windows)[:, 0], base + 0.6 * residual)
    assert np.array_equal(fresh.act(windows), fresh.act(windows))


def test_the_gate_holds_for_learned_residuals_and_what_is_stored_is_what_was_executed():
    c = config(n_step=1, total_steps=2000, eval_every=0, decorator=DecoratorConfig(alpha=0.6, H=3000), on_success="continue")
    trainer = Trainer(c, biased_base(), spec=SPEC)
    trainer.train()
    rows = {k: v[1000:] for k, v in columns(trainer).items()}  # long after the warm-up; the gate is between 1/3 and 2/3 open
    closed = (rows["residual"] == 0).all(axis=1)
    assert 0.35 < closed.mean() < 0.65
    executed = np.clip(rows["base"] + 0.6 * rows["residual"], -1, 1)
    assert np.allclose(rows["next_obs"][:, :2], np.clip(rows["obs"][:, :2] + 0.2 * executed, -1.5, 1.5), atol=1e-5)


def test_rows_tell_how_large_residual_and_base_action_were_since_the_row_before():
    c = config(n_step=1, total_steps=1200, log_every=400, eval_every=0, decorator=DecoratorConfig(alpha=0.6, H=3000), on_success="continue")
    trainer = Trainer(c, biased_base(), spec=SPEC)
    trainer.train()
    stored = columns(trainer)
    edges = [0, *(row["step"] for row in trainer.rows)]
    for low, high, row in zip(edges, edges[1:], trainer.rows, strict=False):
        assert row["residual_size"] == pytest.approx(0.6 * np.abs(stored["residual"][low:high]).mean(), rel=1e-5)
        assert row["base_size"] == pytest.approx(np.abs(stored["base"][low:high]).mean(), rel=1e-5)
    first = np.flatnonzero(stored["reward"] > c.reward_shift)[0]
    assert trainer.first_reward == c.num_envs * (first // c.num_envs + 1)  # all environments step together


def test_actor_and_learner_see_observations_through_the_base_policys_normaliser():
    base = biased_base()
    base.normalizer.mean.fill_(0.5)
    base.normalizer.std.fill_(2.0)
    observations = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    for normalize in (True, False):
        trainer = Trainer(config(normalize_obs=normalize), base, spec=SPEC)
        trainer.agent.average.head.weight.data.normal_()
        expected = torch.from_numpy((observations - 0.5) / 2 if normalize else observations)
        with torch.no_grad():
            residual = trainer.agent.average.mean_action(expected).numpy()
        assert np.allclose(trainer.policy.parts(observations[:, None])[1], residual, atol=1e-6)
        acted = trainer.agent.act(torch.from_numpy(observations), torch.zeros(5, 2))
        assert np.allclose(acted.numpy(), residual, atol=1e-6)


def test_training_episodes_keep_their_own_time_limit_and_tail():
    seen = []
    trainer = Trainer(config(train_limit=7, eval_every=0), biased_base(), spec=SPEC)
    trainer.train(progress=lambda t: seen.append(t.rows[-1].get("train_length")))
    assert max(x for x in seen if x) <= 7
    base = biased_base((0.0, 0.0))
    lengths = {}
    for tail in (0, 2):
        trainer = Trainer(config(on_success="continue", success_tail=tail, eval_every=0, log_every=400, utd=0.0), base, spec=SPEC)
        trainer.train()
        lengths[tail] = trainer.rows[-1]["train_length"]
    assert lengths[2] < lengths[0]


def test_a_dead_evaluator_is_told_in_one_sentence():
    trainer = Trainer(config(eval_workers=1), biased_base(), spec=SPEC)
    evaluations = trainer._evaluations()
    evaluations._process.terminate()
    evaluations._process.join()
    with pytest.raises(PdkitError, match="eval_workers=0"):
        evaluations.submit(1, trainer._actor.state_dict())
        list(evaluations.collect(wait=True))


def test_the_base_policy_runs_once_for_each_window():
    base = biased_base()
    seen = []
    act = base.act
    base.act = lambda windows: (seen.append(len(windows)), act(windows))[1]
    trainer = Trainer(config(eval_every=0), base, spec=SPEC)
    trainer.train()
    decisions, ended = 100, sum(trainer.episode_counts) - 4 * 2
    assert sum(seen) == 4 * (decisions + 1) + ended


def test_demo_rows_execute_the_demonstrated_action():
    rng = np.random.default_rng(0)
    observations, actions = rng.normal(size=(7, 4)).astype(np.float32), rng.uniform(-1, 1, (6, 2)).astype(np.float32)
    success = np.array([0, 0, 0, 1, 1, 1], bool)
    demos = Demos("reach", "scripted", "", "", observations, actions, success, np.array([6]), np.array([0]))
    replay = Trainer(config(), biased_base(), spec=SPEC).replay
    for rule, length in (("terminate", 4), ("continue", 6)):
        rows = replay.unpack(torch.from_numpy(np.stack(demo_rows(demos, biased_base(), config(on_success=rule, n_step=1)))))
        assert len(rows["reward"]) == length
        assert np.allclose(rows["base"] + 0.6 * rows["residual"], actions[:length], atol=1e-5)
        assert rows["reward"].tolist() == [-1, -1, -1, 0, 0, 0][:length]
        assert (rows["discount"] == 0).tolist() == [False] * (length - 1) + [rule == "terminate"]


def test_demo_rows_show_the_base_policy_the_windows_that_it_would_see_when_acting():
    rng = np.random.default_rng(0)
    observations, actions = rng.normal(size=(7, 4)).astype(np.float32), rng.uniform(-1, 1, (6, 2)).astype(np.float32)
    demos = Demos("reach", "scripted", "", "", observations, actions, np.arange(6) == 5, np.array([6]), np.array([0]))
    base, replay = bet_base(act_dropout=False), Trainer(config(), biased_base(), spec=SPEC).replay
    rows = replay.unpack(torch.from_numpy(np.stack(demo_rows(demos, base, config(n_step=1)))))
    history = [observations[0]] * base.window  # an episode starts with its first observation repeated
    for t in range(6):
        history = history[1:] + [observations[t]]
        assert np.allclose(rows["base"][t], base.act(np.stack(history)[None])[0, 0], atol=1e-5)


def test_a_batch_mixes_in_the_asked_fraction_of_demonstrations():
    rng = np.random.default_rng(0)
    demos = Demos("reach", "scripted", "", "", rng.normal(size=(41, 4)).astype(np.float32), rng.uniform(-1, 1, (40, 2)).astype(np.float32),
                  np.arange(40) == 39, np.array([40]), np.array([0]))
    trainer = Trainer(config(demo_fraction=0.25), biased_base(), demos, spec=SPEC)
    drawn = {"replay": 0, "demos": 0}
    for name in drawn:
        buffer = getattr(trainer, name)
        draw = buffer.draw
        buffer.draw = lambda n, g, name=name, draw=draw: (drawn.__setitem__(name, n), draw(n, g))[1]
    trainer.train()
    assert drawn == {"replay": 24, "demos": 8}
    with pytest.raises(PdkitError, match="no demonstrations"):
        Trainer(config(demo_fraction=0.25), biased_base(), spec=SPEC)


def bet_base(act_dropout=True):
    torch.manual_seed(0)
    base = BeT(dict(obs_dim=4, act_dim=2, window=3, bins=2, layers=1, heads=2, embed=16, features=16, act_dropout=act_dropout))
    rng = np.random.default_rng(0)
    base.fit_statistics(rng.normal(size=(50, 4)).astype(np.float32), rng.uniform(-1, 1, (50, 2)).astype(np.float32))
    return base.eval()


@pytest.mark.parametrize(("stochastic", "eval_workers"), [(False, 0), (True, 0), (True, 1)])
def test_killed_and_resumed_gives_the_same_curve(tmp_path, stochastic, eval_workers):
    """Killed between checkpoints, resumed, against an uninterrupted run: same rows, same weights, bit for bit."""
    make = bet_base if stochastic else biased_base
    c = config(n_step=3, eval_workers=eval_workers)
    whole = Trainer(c, make(), spec=SPEC)
    whole.train(Run(tmp_path / "whole", "online", flat(c)))

    def killed(trainer):
        if trainer.step >= 280:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Trainer(c, make(), spec=SPEC).train(Run(tmp_path / "cut", "online", flat(c)), killed)
    resumed = Trainer(c, make(), spec=SPEC)
    resumed.train(Run(tmp_path / "cut", "online", flat(c)))
    timing = {"seconds", "eval_seconds"}
    strip = lambda rows: [{k: v for k, v in row.items() if k not in timing} for row in rows]  # noqa: E731
    assert strip(resumed.rows) == strip(whole.rows)
    one, other = whole.agent.state(), resumed.agent.state()
    assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
    assert torch.equal(whole.replay.rows, resumed.replay.rows)
    assert all("success_once" in row for row in whole.rows if row["step"] % 200 == 0)


def test_where_evaluations_run_does_not_matter(tmp_path):
    """In this process or in another, while training goes on: same rows, same policy selected."""
    outcomes = []
    for workers in (0, 1):
        trainer = Trainer(config(eval_every=100, eval_workers=workers, decorator=DecoratorConfig(alpha=0.6, H=200)), bet_base(), spec=SPEC)
        policy = trainer.train()
        outcomes.append(([(row["step"], row["success_once"], row["success_at_end"]) for row in trainer.rows], policy.actor.state_dict()))
    (rows, actor), (other_rows, other_actor) = outcomes
    assert rows == other_rows and all(torch.equal(actor[k], other_actor[k]) for k in actor)


def test_the_load_beside_a_run_is_that_of_all_of_it(monkeypatch, tmp_path):
    """Also where it was interrupted: the work of the first hour slowed it all the same."""
    loads = iter([6.0, 2.0, 6.0, 2.0, 6.0, 2.0])
    monkeypatch.setattr("pdkit.online.load_average", lambda: next(loads))
    c = config(eval_every=0, checkpoint_every=200)

    def killed(t):
        if t.step >= 280:
            raise KeyboardInterrupt

    run = Run(tmp_path, "online", flat(c))
    with pytest.raises(KeyboardInterrupt):
        Trainer(c, biased_base(), spec=SPEC).train(run, killed)
    resumed = Trainer(c, biased_base(), spec=SPEC)
    resumed.train(run)
    assert len(resumed.rows) == resumed.loads[1] == 4 and resumed.loads[0] == 6 + 2 + 2 + 6  # rows at 100 and 200, and at 300 and 400 again


def test_an_evaluation_in_this_process_rounds_as_in_another(monkeypatch):
    """With one thread, however many training has."""
    threads = torch.get_num_threads()
    monkeypatch.setattr("pdkit.online_eval.selection_scores",
                        lambda *_: {"success_once": float(torch.get_num_threads()), "success_at_end": 0.0})
    try:
        torch.set_num_threads(2)
        made = Trainer(config(), biased_base(), spec=SPEC)._evaluations()
        made.submit(100, made._arguments[2].state_dict())
        (_, _, row), = made.collect()
        assert row["success_once"] == 1.0 and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def test_an_evaluation_that_was_not_back_at_a_checkpoint_is_made_after_resuming(tmp_path):
    c = config(eval_every=100, checkpoint_every=100)
    run = Run(tmp_path, "online", flat(c))
    trainer = Trainer(c, biased_base(), spec=SPEC)

    def stop_before_it_is_back(t):
        if t.step == 200 and "success_once" not in t.rows[-1]:
            envs = {k: v for k, v in run.load_checkpoint()[0].items() if k.startswith("envs.")}
            t.save(run, {k.removeprefix("envs."): v for k, v in envs.items()}, {200: t._actor.state_dict()})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer.train(run, stop_before_it_is_back)
    resumed = Trainer(c, biased_base(), spec=SPEC)
    resumed.train(run)
    assert all("success_once" in row for row in resumed.rows)


def test_learning_rates_of_actor_and_critics_fall_to_a_tenth():
    trainer = Trainer(config(lr_decay_from=0.5, eval_every=0), biased_base(), spec=SPEC)
    seen = []
    trainer.train(progress=lambda t: seen.append([o.param_groups[0]["lr"] for o in (t.agent.actor_optimizer, t.agent.critic_optimizer)]))
    assert seen[1] == [SMALL.actor_lr, SMALL.critic_lr]  # at half of the run
    assert np.allclose(seen[-1], [0.1 * SMALL.actor_lr, 0.1 * SMALL.critic_lr], rtol=0.25)


def test_the_result_is_the_best_evaluated_policy_or_the_last(tmp_path):
    for select in ("best", "last"):
        trainer = Trainer(config(select=select, eval_every=100, decorator=DecoratorConfig(alpha=0.6, H=200)), biased_base(), spec=SPEC)
        scores, actors = {}, {}

        def note(t, scores=scores, actors=actors):
            row = t.rows[-1]
            if "success_once" not in row:  # called once for the row and once more when it has been evaluated
                return
            scores[t.step] = (row["success_once"] + row["success_at_end"]) / 2
            actors[t.step] = t.agent.average.head.bias.clone()

        policy = trainer.train(progress=note)
        open_gate = {step: score for step, score in scores.items() if step >= 200}
        best = max(open_gate, key=lambda step: (open_gate[step], step))
        assert torch.equal(policy.actor.head.bias, actors[best if select == "best" else max(actors)])
    assert not torch.equal(actors[min(actors)], actors[max(actors)])


def scripted(monkeypatch, scores):
    """Evaluations in this process give these, as (once, at the end), one after the other."""
    told = iter([{"success_once": once, "success_at_end": end} for once, end in scores])
    monkeypatch.setattr("pdkit.online_eval.selection_scores", lambda *_: next(told))


@pytest.mark.parametrize(("H", "best"), [(0, 200), (300, 400)])
def test_an_evaluation_before_the_gate_is_fully_open_chooses_no_policy(monkeypatch, H, best):
    scripted(monkeypatch, [(0.1, 0.1), (0.9, 0.9), (0.2, 0.2), (0.3, 0.3)])
    c = config(eval_every=100, decorator=DecoratorConfig(alpha=0.6, H=H))
    trainer, actors = Trainer(c, biased_base(), spec=SPEC), {}
    policy = trainer.train(progress=lambda t: actors.setdefault(t.step, t.agent.average.head.bias.clone()))
    assert torch.equal(policy.actor.head.bias, actors[best]) and not torch.equal(actors[200], actors[400])


@pytest.mark.parametrize(("on_success", "best", "score"), [("terminate", 300, 0.9), ("continue", 400, 0.8)])
def test_where_episodes_go_on_after_success_staying_solved_counts_half(monkeypatch, on_success, best, score):
    scripted(monkeypatch, [(0.5, 0.5), (0.6, 0.6), (0.9, 0.1), (0.8, 0.8)])
    c = config(eval_every=100, on_success=on_success, decorator=DecoratorConfig(alpha=0.6, H=0))
    trainer, actors = Trainer(c, biased_base(), spec=SPEC), {}
    policy = trainer.train(progress=lambda t: actors.setdefault(t.step, t.agent.average.head.bias.clone()))
    assert trainer.best_score == pytest.approx(score)
    assert torch.equal(policy.actor.head.bias, actors[best]) and not torch.equal(actors[300], actors[400])


def test_the_best_policy_so_far_outlives_a_kill(monkeypatch, tmp_path):
    """The best evaluation lies before the kill, a worse one after it."""
    c = config(eval_every=100, decorator=DecoratorConfig(alpha=0.6, H=0))
    scores = [(0.1, 0.1), (0.9, 0.9), (0.2, 0.2), (0.3, 0.3)]
    scripted(monkeypatch, scores)
    whole = Trainer(c, biased_base(), spec=SPEC)
    policy = whole.train()

    def killed(t):
        if t.step >= 300:
            raise KeyboardInterrupt

    scripted(monkeypatch, scores)
    run = Run(tmp_path, "online", flat(c))
    with pytest.raises(KeyboardInterrupt):
        Trainer(c, biased_base(), spec=SPEC).train(run, killed)
    assert run.load_checkpoint()[1]["step"] == 200
    scripted(monkeypatch, scores[2:])
    resumed = Trainer(c, biased_base(), spec=SPEC)
    again = resumed.train(run)
    assert resumed.best_score == whole.best_score == 0.9
    one, other = policy.actor.state_dict(), again.actor.state_dict()
    assert all(torch.equal(one[k], other[k]) for k in one)
    assert not torch.equal(one["head.bias"], whole.agent.average.head.bias)  # the last is another


@pytest.mark.parametrize("critic_warmup", [0, 60])
def test_what_has_not_learned_yet_is_never_the_result(monkeypatch, critic_warmup):
    """Without a gate evaluations count from the first on, and those in the warm-up are of what the run started from."""
    scores = iter([1.0, 1.0, 0.5, 0.2])
    monkeypatch.setattr("pdkit.online_eval.selection_scores", lambda *_: dict(success_once=(s := next(scores)), success_at_end=s))
    c = config(select="best", eval_every=100, warmup_steps=250, decorator=DecoratorConfig(alpha=0.6, H=0),
               sac=dataclasses.replace(SMALL, critic_warmup=critic_warmup))
    trainer, actors = Trainer(c, biased_base(), spec=SPEC), {}
    policy = trainer.train(progress=lambda t: actors.setdefault(t.step, t.agent.average.head.bias.clone()))
    updates = [row["updates"] for row in trainer.rows]
    assert updates[:2] == [0, 0] and 0 < updates[2] < 60 < updates[3]
    assert trainer.best_score == (0.2 if critic_warmup else 0.5)
    assert torch.equal(policy.actor.head.bias, actors[400 if critic_warmup else 300])


def test_a_run_that_learned_nothing_is_told():
    with pytest.raises(PdkitError, match="Not one update was made in 400 steps .*batch 400.: take more steps"):
        Trainer(config(batch=400), biased_base(), spec=SPEC).train()


def test_another_configuration_does_not_resume_a_run(tmp_path):
    Run(tmp_path, "online", flat(config()))
    with pytest.raises(PdkitError, match="differing: alpha"):
        Run(tmp_path, "online", flat(config(decorator=DecoratorConfig(alpha=0.5, H=300))))


def test_an_altered_checkpoint_is_refused(tmp_path):
    run = Run(tmp_path, "online", {})
    run.save_checkpoint({"x": np.arange(5)}, {"step": 3})
    assert run.load_checkpoint()[0]["x"].tolist() == [0, 1, 2, 3, 4]
    path = tmp_path / "checkpoint" / "arrays.safetensors"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(PdkitError, match="truncated or altered"):
        run.load_checkpoint()


def test_nan_stops_with_one_sentence_and_keeps_the_last_good_checkpoint(tmp_path):
    c = config(eval_every=0)
    run = Run(tmp_path, "online", flat(c))
    trainer = Trainer(c, biased_base(), spec=SPEC)

    def poison(t):
        if t.step >= 250:
            with torch.no_grad():
                next(t.agent.critics.parameters()).fill_(math.nan)

    with pytest.raises(PdkitError, match="no longer a number"):
        trainer.train(run, poison)
    arrays, values = run.load_checkpoint()
    assert values["step"] <= 300 and all(np.isfinite(v).all() for k, v in arrays.items() if k.startswith("agent."))


def test_wrong_dimensions_and_ranges():
    with pytest.raises(PdkitError, match="4 observations"):
        Trainer(dataclasses.replace(config(), task="Door"), biased_base())
    for bad in (dict(demo_fraction=1.0), dict(gamma=0.0), dict(n_step=0), dict(warmup="x"), dict(bootstrap="x"), dict(total_steps=50)):
        with pytest.raises(PdkitError):
            config(**bad)


def test_profiles_reject_unknown_names_and_wrong_types():
    assert online_config("Door", "lesson", alpha=0.2).decorator.alpha == 0.2
    assert differences(online_config("Door", "lesson", alpha=0.25, utd=1), "lesson") == {"alpha": (0.1, 0.25), "utd": (0.25, 1.0)}
    for bad in (dict(alhpa=0.2), dict(alpha="0.2"), dict(num_envs=2.5), dict(alpha=2.0)):
        with pytest.raises(PdkitError):
            online_config("Door", "lesson", **bad)
    with pytest.raises(PdkitError, match="profile"):
        online_config("Door", "leson")


def test_the_paper_profile_is_the_official_recipe():
    c = online_config("StackCube", "paper")
    assert (c.sac.actor_lr, c.batch, c.utd, c.gamma, c.sac.tau, c.num_envs, c.warmup_steps) == (1e-4, 1024, 0.25, 0.97, 0.01, 16, 8000)
    assert (c.decorator.alpha, c.decorator.H, c.total_steps, c.sac.init_temperature) == (0.03, 1_000_000, 3_000_000, 1.0)
    assert (c.warmup, c.bootstrap, c.reward_shift, c.demo_fraction, c.n_step) == ("uniform", "truncated", -1.0, 0.0, 1)
    assert (c.sac.layers, c.sac.hidden, c.sac.actor_every, c.sac.residual_penalty) == (3, 256, 1, 0.0)
    assert (c.train_limit, c.success_tail, c.lr_decay_from, c.normalize_obs) == (0, 0, 1.0, False)
    assert (c.decorator.critic_input, c.decorator.actor_input, c.sac.critic_layer_norm, c.sac.average) == ("sum", "obs", False, 0.0)
    assert c.decorator.residual_units == "bound" and online_config("StackCube").decorator.residual_units == "action"
    assert [online_config(task, "paper").sac.xavier_init for task in ("PushChair", "TurnFaucet")] == [True, False]
    chunks = policy_values("TurnFaucet", "paper", "diffusion", 4)  # the script counts chunks
    assert (chunks["total_steps"], chunks["eval_every"]) == (8_000_000, 200_000)


@pytest.mark.parametrize("profile", ["lesson", "paper"])
@pytest.mark.parametrize("task", ["TurnFaucet", "PushChair"])
def test_a_task_of_other_objects_has_the_values_of_its_twin(task, profile):
    novel, source = (dataclasses.asdict(online_config(name, profile)) for name in (task, f"{task}Source"))
    assert novel.pop("task") != source.pop("task") and novel == source and novel["decorator"]["alpha"] != DecoratorConfig().alpha
    assert policy_values(task, profile, "diffusion", 4) == policy_values(f"{task}Source", profile, "diffusion", 4)


def test_decorated_policy_survives_the_disk(tmp_path):
    base = bet_base()
    trainer = Trainer(config(), base, spec=SPEC)
    trainer.train()
    base.config["act_dropout"] = False
    policy = trainer.policy
    policy.base.eval()
    save_decorated(policy, tmp_path / "d", {"note": 1})
    windows = np.random.default_rng(0).normal(size=(5, 3, 4)).astype(np.float32)
    back = load_decorated(tmp_path / "d")
    assert np.array_equal(back.act(windows), policy.act(windows))
    weights = tmp_path / "d" / "actor.safetensors"
    weights.write_bytes(weights.read_bytes()[:-8])
    with pytest.raises(PdkitError, match="truncated"):
        load_decorated(tmp_path / "d")
