"""What only a GPU can show: imitation by recorded steps gives what plain ones give, and online RL learns there. Skipped without one."""
import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
import torch
from test_pixels import REACH, painted  # noqa: F401 (painted is a fixture)
from worlds import reach_demos, reach_trainer

from pdkit.errors import PdkitError
from pdkit.evaluate import evaluate
from pdkit.gradient_steps import GradientSteps, gradient_step, make_optimizer
from pdkit.imitate import ImitateConfig, Windows, imitate
from pdkit.online import Trainer
from pdkit.online_config import OnlineConfig
from pdkit.pixels.encoders import random_shift
from pdkit.pixels.learn import HEADS, imitate_pixels
from pdkit.pixels.pictures import draw, encoded
from pdkit.policies import POLICIES, load_policy, save_policy
from pdkit.probes import PROBES, biased_base
from pdkit.profiles import flat
from pdkit.runs import Run
from pdkit.tasks import get_task
from pdkit.tasks.batched import ManiSkillBatch, load_physx_cuda

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")

SMALL = {"mlp": dict(hidden=32), "bet": dict(window=4, layers=1, heads=2, embed=16, features=16, dropout=0.0),
         "diffusion": dict(dims=[16, 32], groups=4, embed=16), "rnn": dict(hidden=16), "cnn": dict(hidden=16, layers=1)}


def trained(kind, recorded, iterations=12):
    """Weights and losses of some steps with a falling learning rate, which a recording must follow, all from the same start."""
    demos, config = reach_demos(8), ImitateConfig(iterations=iterations, schedule="cosine", bf16=False)
    torch.manual_seed(0)
    policy = POLICIES[kind](dict(obs_dim=4, act_dim=2) | SMALL[kind])
    policy.fit_statistics(demos.observations, demos.actions)
    policy.to("cuda").train()
    optimizer, windows = make_optimizer(policy, config, device="cuda"), Windows(demos, policy.window, True, policy.horizon).to("cuda")
    rates, generator = torch.optim.lr_scheduler.LambdaLR(optimizer, config.lr_factor), torch.Generator().manual_seed(1)
    step = GradientSteps(policy.loss, optimizer, "cuda", False)
    losses = []
    for _ in range(iterations):
        observations, actions = windows.sample(32, generator)
        batch = (observations, actions, *(x.to("cuda") for x in policy.draw(actions.shape)))
        terms = step(*batch) if recorded else gradient_step(policy.loss, optimizer, "cuda", False, *batch)
        losses.append(float(terms["loss"]))
        rates.step()
    return torch.nn.utils.parameters_to_vector(policy.parameters()).detach().cpu(), losses


@pytest.mark.parametrize("kind", SMALL)
def test_recorded_steps_train_as_plain_ones_do(kind):
    (weights, losses), (plain, plain_losses) = trained(kind, True), trained(kind, False)
    assert losses == pytest.approx(plain_losses, rel=1e-3, abs=1e-5) and len(set(losses)) == len(losses)
    assert torch.allclose(weights, plain, atol=2e-4)


def test_imitation_on_the_gpu_learns_the_probe_and_its_checkpoint_loads_on_the_cpu(tmp_path):
    config = ImitateConfig(iterations=400, batch=64, lr=3e-3, eval_every=200, eval_episodes=10, ema_power=0.75)
    policy, history = imitate("mlp", reach_demos(), config, SMALL["mlp"], device="cuda", spec=PROBES["reach"])
    assert next(policy.parameters()).is_cuda and max(row["success_once"] for row in history) > 0.8
    save_policy(policy, tmp_path / "it")
    loaded, windows = load_policy(tmp_path / "it"), np.random.default_rng(0).normal(size=(5, 1, 4)).astype(np.float32)
    np.testing.assert_allclose(loaded.act(windows), policy.act(windows), atol=1e-5)


@pytest.mark.parametrize("kind", ["bet", "diffusion"])
def test_an_interrupted_imitation_goes_on_as_one_that_was_not(kind, tmp_path):
    """With recorded steps, a rate that falls, dropout or an average, and the GPU's own random numbers."""
    settings = dict(iterations=12, batch=16, eval_every=6, eval_episodes=0, schedule="cosine", bf16=False)
    config = ImitateConfig(**POLICIES[kind].recipe | settings)

    def interrupt(row):
        if row["iteration"] == 6:
            raise KeyboardInterrupt

    def train(run=None, progress=None):
        return imitate(kind, reach_demos(4), config, SMALL[kind], device="cuda", spec=PROBES["reach"], run=run, progress=progress)[1]

    whole = train()
    with pytest.raises(KeyboardInterrupt):
        train(Run(tmp_path, "base", {}), interrupt)
    again = train(Run(tmp_path, "base", {}))
    assert [row["loss"] for row in again] == pytest.approx([row["loss"] for row in whole], rel=1e-3)


def test_what_checkpoints_draw_does_not_change_the_training():
    """Dropout draws from the GPU's generator, which acting seeds."""
    last = [imitate("bet", reach_demos(4), ImitateConfig(iterations=6, batch=16, eval_every=every, eval_episodes=1, bf16=False),
                    SMALL["bet"] | {"dropout": 0.5}, device="cuda", spec=PROBES["reach"])[1][-1]["loss"] for every in (1, 6)]
    assert last[0] == pytest.approx(last[1], rel=1e-4)


@pytest.mark.usefixtures("painted")
@pytest.mark.parametrize("kind", HEADS)
def test_policies_learn_from_pictures_on_the_gpu(kind):
    demos = reach_demos(4)
    pictures, config = draw(demos, spec=PROBES["reach"], view=REACH), ImitateConfig(iterations=8, batch=8, eval_every=4, eval_episodes=2)
    policy, encoder, history = imitate_pixels(kind, demos, pictures, config, SMALL[kind], device="cuda", spec=PROBES["reach"], view=REACH)
    assert len(history) == 2 and history[1]["loss"] < history[0]["loss"]
    assert not any(parameter.is_cuda for parameter in (*policy.parameters(), *encoder.parameters()))
    seen = encoded(demos, pictures, encoder).observations
    assert np.isfinite(policy.act(seen[: 2 * policy.window].reshape(2, policy.window, -1))).all()


def test_random_shift_is_the_same_on_both_devices():
    pictures = torch.arange(4 * 3 * 16 * 16).reshape(4, 3, 16, 16)
    here, there = (random_shift(pictures.to(device), 4, torch.Generator().manual_seed(0)) for device in ("cpu", "cuda"))
    assert there.is_cuda and torch.equal(here, there.cpu())


@pytest.mark.parametrize(("method", "changes"), [("policy_decorator", dict(H=1000, warmup="uniform")),
                                                ("ppo_decorator", dict(H=2000, total_steps=6000, ppo_rollout=64))])
def test_the_decorator_learns_on_the_gpu_and_a_run_goes_on_there(method, changes):
    base, _ = imitate("mlp", reach_demos(aim=(0.2, -0.2)), ImitateConfig(iterations=300, lr=3e-3, eval_episodes=0), SMALL["mlp"],
                      device="cuda", spec=PROBES["reach"])
    seeds = range(1000, 1060)
    before = evaluate(PROBES["reach"], base.act, seeds).success_once.mean()
    trainers = [reach_trainer(method, base, device="cuda", alpha=0.8, alpha_scale=(), **changes) for _ in range(2)]
    policy = trainers[0].train()
    assert next(trainers[0].agent.actor.parameters()).is_cuda
    assert evaluate(PROBES["reach"], policy.act, seeds, window=policy.window).success_once.mean() > before + 0.2
    trainers[1].agent.load(trainers[0].agent.state())
    for mine, theirs in zip(*(t.agent.actor.parameters() for t in trainers), strict=True):
        assert theirs.is_cuda and torch.equal(mine, theirs)


def moved_on_the_gpu(task, seeds, chunks):
    """What four lanes see at first, after `chunks` (T, 4, act_dim), where two of them then begin anew, and after one more step.

    It needs a process that has simulated nothing yet, and changes how that simulates on the CPU.
    """
    load_physx_cuda()
    lanes = ManiSkillBatch(get_task(task), 4)
    first = lanes.reset(np.arange(4), seeds)
    for actions in chunks:
        before, _ = lanes.step(actions)
    again = lanes.reset(np.array([1, 3]), seeds[[1, 3]])
    return first, before, again, lanes.step(0 * chunks[0])[0]


def in_its_own_process(function, *arguments):
    """Skipped where SAPIEN has not got, and cannot fetch, its library for CUDA."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        try:
            return process.submit(function, *arguments).result()
        except PdkitError as error:
            if "could not be loaded" not in str(error):
                raise
            pytest.skip(str(error))


@pytest.mark.parametrize("task", ["StackCube", "PegInsertionSide", "TurnFaucet", "PushChair"])
def test_lanes_simulated_together_start_and_move_as_on_the_cpu(task):
    spec, fast, seeds = get_task(task), get_task(task).make(), np.array([3, 4, 5, 6])
    # Small actions: the arm control of a GPU falls short of large ones.
    chunks = np.random.default_rng(0).uniform(-0.1, 0.1, (5, 4, spec.act_dim)).astype(np.float32)
    first, before, again, after = in_its_own_process(moved_on_the_gpu, task, seeds, chunks)
    for lane, seed in enumerate(seeds):
        np.testing.assert_allclose(first[lane], fast.reset(int(seed)), atol=1e-4)
        for actions in chunks:
            expected, _ = fast.step(actions[lane])
        np.testing.assert_allclose(before[lane, :9], expected[:9], atol=5e-3)
        still = {"TurnFaucet": slice(39, 40), "PushChair": slice(44, 51)}.get(task, slice(0))  # nobody has touched handle or chair
        np.testing.assert_allclose(before[lane, still], expected[still], atol=2e-2)
    np.testing.assert_allclose(again, first[[1, 3]], atol=1e-4)
    np.testing.assert_allclose(after[[0, 2], :9], before[[0, 2], :9], atol=2e-2)  # these go on from where they were
    np.testing.assert_allclose(after[[1, 3], :9], first[[1, 3], :9], atol=2e-2)
    fast.close()


def test_a_run_trains_on_lanes_simulated_together():
    spec = get_task("StackCube")
    base = POLICIES["mlp"](dict(obs_dim=spec.obs_dim, act_dim=spec.act_dim, hidden=8))
    config = OnlineConfig(task="StackCube", simulator="physx_cuda", num_envs=16, total_steps=1_600, warmup_steps=320, batch=64,
                          demo_fraction=0.0, eval_every=0, train_limit=20, eval_workers=0, device="cuda")
    in_its_own_process(load_physx_cuda)
    trainer = Trainer(config, base)
    trainer.train()
    assert trainer.agent.updates > 200 and trainer.rows[-1]["train_length"] == 20


def test_a_checkpoint_holds_the_random_numbers_of_the_gpu(tmp_path):
    trained, resumed = (reach_trainer("policy_decorator", biased_base(), device="cuda", total_steps=600) for _ in range(2))
    run = Run(tmp_path, "online", flat(trained.config))
    trained.train()
    torch.cuda.manual_seed(3)
    trained.save(run, {}, {})
    expected = torch.rand(5, device="cuda")
    torch.cuda.manual_seed(4)
    resumed.load(run)
    assert torch.equal(torch.rand(5, device="cuda"), expected)
