"""Methods: what each changes in the loop, and that it learns."""
import re

import numpy as np
import pytest
import torch
from peft.tuners.tuners_utils import BaseTunerLayer
from test_probes import SMALL, success
from worlds import clone, reach_demos

from pdkit.decorator import DecoratorConfig
from pdkit.errors import PdkitError
from pdkit.methods import METHODS
from pdkit.methods.config import MethodConfig
from pdkit.methods.finetune import FineTune
from pdkit.methods.registry import make_trainer, method_config
from pdkit.online import Trainer
from pdkit.online_config import OnlineConfig
from pdkit.policies import BeT, BeTForSAC, load_policy, save_policy
from pdkit.policies.lora import with_lora
from pdkit.probes import PROBES, biased_base
from pdkit.profiles import flat
from pdkit.tasks import TASKS
from pdkit.unlearning import set_spread

TINY = dict(window=3, bins=4, layers=1, heads=2, embed=16, features=16, dropout=0.0)


def run(method, base, demos=None, sac=SMALL, own=None, **changes):
    """A method's own configuration on the reach probe, at a scale of seconds."""
    m = METHODS[method].changes
    values = dict(task="reach", method=method, total_steps=3000, num_envs=4, env_workers=0, warmup_steps=500, utd=0.5, batch=64, n_step=3,
                  on_success="terminate", success_tail=0, gamma=0.9, eval_every=0, log_every=0, checkpoint_every=0, demo_fraction=0.25)
    loop = {k: v for k, v in m.items() if k in OnlineConfig.__dataclass_fields__}
    parts = {k: v for k, v in m.items() if k in sac.__dataclass_fields__}
    decorator = DecoratorConfig(**{k: v for k, v in m.items() if k in DecoratorConfig.__dataclass_fields__})
    config = OnlineConfig(**(values | loop | changes), sac=type(sac)(**(vars(sac) | parts)), decorator=decorator,
                          method_config=own or MethodConfig())
    trainer = make_trainer(config, base, demos if config.demo_fraction else None, PROBES["reach"])
    return trainer, trainer.train()


@pytest.fixture(scope="module")
def bet_sac():
    """A bet-sac policy that aims beside the goal, as the biased base does."""
    return clone(BeTForSAC, reach_demos(20, aim=(0.2, -0.2)), TINY | dict(scale=[0.5, 0.5]))


# ---- the modified Behavior Transformer -------------------------------------------------------------------------------

def test_the_modified_bet_imitates_like_the_original(bet_sac):
    demos = reach_demos(30)
    cases = ((BeT, {}), (BeTForSAC, dict(scale=[0.5, 0.5])), (BeTForSAC, {}))
    plain, scaled, unscaled = (success("reach", clone(cls, demos, TINY | extra, iterations=600)) for cls, extra in cases)
    assert min(plain, scaled) > 0.8
    assert unscaled < 0.8  # why there is a scale: full actions lie at atanh's poles
    assert success("reach", bet_sac) < 0.5


def test_offsets_live_before_the_tanh():
    """a = tanh(atanh(scale * bin) + offset) / scale, by hand, and its inverse in the loss."""
    policy = BeTForSAC({"obs_dim": 4, "act_dim": 2, **TINY, "bins": 2, "scale": [0.3, 1.0]}).eval()
    policy.centres.copy_(torch.tensor([[1.0, -0.5], [1.0, -0.5]]))
    torch.nn.init.zeros_(policy.regression.weight)
    policy.regression.bias.data = torch.tensor([0.1, 0.2, 0.1, 0.2])
    action = policy(torch.zeros(1, 3, 4))[0, 0].detach().numpy()
    expected = np.tanh(np.arctanh(np.array([0.3, -0.5])) + [0.1, 0.2]) / [0.3, 1.0]
    assert np.allclose(action, expected, atol=1e-5) and action[0] > 1  # the environment clips
    terms = policy.loss(torch.zeros(1, 3, 4), torch.from_numpy(expected.astype(np.float32)).expand(1, 3, 2))
    assert terms["offset_mse"].item() == pytest.approx(0, abs=1e-6)
    terms = policy.loss(torch.zeros(1, 3, 4), torch.zeros(1, 3, 2))
    assert terms["offset_mse"] > 0.01 and torch.allclose(terms["loss"], terms["focal"] + 1000 * terms["offset_mse"])  # as the plain one


def test_log_probability_is_that_of_the_squashed_gaussian(bet_sac):
    stored, noise = torch.randn(5, 12), torch.randn(5, 2)
    action, log_pi = bet_sac.sample(stored, noise)
    mean, log_std = bet_sac.gaussian(stored.view(5, 3, 4))
    normal = torch.distributions.Normal(mean, log_std.exp())
    squashed = torch.distributions.TransformedDistribution(normal, torch.distributions.TanhTransform(cache_size=1))
    assert torch.allclose(squashed.log_prob(action * 0.5).sum(-1), log_pi, atol=1e-3)
    assert torch.allclose(bet_sac.mean_action(stored), bet_sac(stored.view(5, 3, 4))[:, 0])


def test_lora_starts_as_the_policy_and_trains_little(bet_sac, tmp_path):
    adapted, stored = bet_sac.with_lora(2), torch.randn(5, 12)
    assert torch.allclose(adapted.mean_action(stored), bet_sac.mean_action(stored), atol=1e-6)
    trained = {n for n, p in adapted.named_parameters() if p.requires_grad}
    assert trained and all("lora_" in n or n.startswith("spread.") for n in trained)
    assert {n.split(".lora")[0] for n in trained if "lora_" in n} == {"gpt.blocks.0.qkv", "gpt.blocks.0.proj", "regression"}
    for module in (adapted, with_lora(torch.nn.Sequential(torch.nn.Linear(3, 3)), 2)):
        assert {part.scaling["default"] for part in module.modules() if isinstance(part, BaseTunerLayer)} == {1.0}  # alpha is the rank
    with torch.no_grad():
        next(p for n, p in adapted.named_parameters() if "regression.lora_B" in n).fill_(0.1)
    save_policy(adapted, tmp_path / "p")
    again = load_policy(tmp_path / "p")
    assert torch.allclose(again.mean_action(stored), adapted.mean_action(stored))
    assert not torch.allclose(again.mean_action(stored), bet_sac.mean_action(stored), atol=1e-3)


@pytest.mark.parametrize("rank", [0, 2, 4])
def test_a_tuned_policy_is_tuned_on_from_where_it_is(bet_sac, tmp_path, rank):
    tuned, stored = bet_sac.with_lora(2), torch.randn(5, 12)
    with torch.no_grad():
        next(p for n, p in tuned.named_parameters() if "regression.lora_B" in n).fill_(0.1)
    further = tuned.with_lora(rank)
    assert torch.allclose(further.mean_action(stored), tuned.mean_action(stored), atol=1e-5)
    trained = [name for name, parameter in further.named_parameters() if parameter.requires_grad]
    own = [name for name in trained if "lora_" in name or name.startswith("spread.")]
    assert trained == own if rank else len(trained) == len(list(bet_sac.parameters()))
    save_policy(further, tmp_path / "p")
    assert torch.allclose(load_policy(tmp_path / "p").mean_action(stored), tuned.mean_action(stored), atol=1e-5)


def test_scale_is_checked():
    with pytest.raises(PdkitError, match="factors in"):
        BeTForSAC({"obs_dim": 4, "act_dim": 2, **TINY, "scale": [0.5]})


# ---- methods on the shared loop --------------------------------------------------------------------------------------

@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_a_configuration_in_every_profile(method):
    for profile in ("smoke", "lesson", "paper"):
        assert method_config(method, "Door", profile).method == method
    assert METHODS[method].source and METHODS[method].title


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("method", ["rot", "fish"])
def test_under_a_reward_by_likeness_no_task_ends_an_episode_at_success(method, task):
    assert method_config(method, task).on_success == "continue"


@pytest.mark.parametrize("profile", ["lesson", "paper"])
def test_what_jsrl_has_learned_is_its_last_policy(profile):
    """Evaluations on the way are of a policy that the base policy begins for, at horizons of their own."""
    assert method_config("jsrl", "Door", profile).select == "last"


@pytest.mark.parametrize("task", ["StackCube", "TurnFaucet", "PushChair"])
@pytest.mark.parametrize("profile", ["lesson", "paper"])
def test_fish_bounds_all_numbers_of_an_action_alike(task, profile):
    """The lesson's decorator does not, on these tasks."""
    decorator = method_config("fish", task, profile).decorator
    assert (decorator.alpha, decorator.alpha_scale, decorator.H) == (0.2, (), 0)


@pytest.mark.parametrize(("method", "changes"), [
    ("ppo_decorator", dict(actor_lr=1e-3)), ("ppo_finetune", dict(batch=64, average=0.0)),
    ("sac_finetune", dict(log_std_range=(-3.0, 2.0))), ("dipo", dict(actor_value="mean")), ("dppo", dict(tau=0.1)),
    ("fish", dict(ot_trunk=8)), ("calql_a", dict(calql_pretrained=False)),
    ("policy_decorator", dict(ppo_lr=1e-3)), ("rot", dict(critic_backbone="shared")), ("jsrl", dict(calql_actions=2))])
def test_a_setting_that_a_method_does_not_read_is_refused(method, changes):
    """Else a sweep over it would be the same run many times."""
    with pytest.raises(PdkitError, match=f"{re.escape(METHODS[method].title)} does not read {', '.join(changes)}; leave that out"):
        method_config(method, "Door", **changes)


@pytest.mark.parametrize(("method", "changes"), [
    ("ppo_finetune", dict(ppo_lr=1e-3, lora=4)), ("dppo", dict(ppo_epochs=2, dppo_clip=0.1, lora=4)), ("rot", dict(ot_trunk=8, lora=4)),
    ("dipo", dict(dipo_lr=0.1, critic_lr=1e-3)), ("calql", dict(calql_actions=2, lora=4)), ("jsrl", dict(jsrl_step=5, actor_lr=1e-3))])
def test_a_setting_that_a_method_reads_is_taken(method, changes):
    assert flat(method_config(method, "Door", **changes)).items() >= changes.items()


def test_rlpd_has_the_numbers_of_the_original():
    """facts.md 3.2, 5.3: all of them but what is told in methods/scratch.py."""
    config = method_config("rlpd", "Door", "paper")
    sac = config.sac
    assert (sac.num_critics, sac.target_subset, sac.actor_value, sac.entropy_backup) == (10, 2, "mean", False)
    assert (sac.critic_layer_norm, sac.target_entropy_scale, sac.tau, sac.actor_lr, sac.critic_lr) == (True, 0.5, 0.005, 3e-4, 3e-4)
    assert (config.utd, config.batch, config.gamma, config.n_step, config.demo_fraction) == (20.0, 256, 0.99, 1, 0.5)
    assert (config.warmup_steps, config.total_steps, config.on_success, sac.actor_every) == (5_000, 1_000_000, "continue", 20)
    lesson = method_config("rlpd", "Door").sac
    assert (lesson.num_critics, lesson.target_subset, lesson.actor_value, lesson.entropy_backup) == (10, 2, "mean", False)


@pytest.mark.parametrize("method, spread", [("rlpd", 0.6), ("calql_a", 0.37), ("calql_b", 0.37), ("calql_c", 0.37)])
def test_originals_start_with_their_own_spread(method, spread):
    """Not with the 1e-4 of the paper's code, in which neither explores nor finds its actions among sampled ones."""
    sac = method_config(method, "Door", "paper").sac
    assert np.exp(np.mean(sac.log_std_range)) == pytest.approx(spread, abs=0.01)
    assert (sac.xavier_init, sac.init_temperature) == ((True, 1.0) if method == "rlpd" else (False, 0.1))


@pytest.mark.parametrize("profile", ["lesson", "paper"])
def test_fish_shows_its_critics_what_is_added(profile):
    config = method_config("fish", "Door", profile).decorator
    assert (config.critic_input, config.residual_units, config.alpha) == ("concat", "action", 0.2)


@pytest.mark.parametrize("method", ["ppo_decorator", "ppo_residual_rl", "ppo_finetune", "dppo"])
def test_what_learns_on_policy_normalises_observations_at_full_scale_too(method):
    assert method_config(method, "StackCube", "paper").normalize_obs


@pytest.mark.parametrize("profile", ["lesson", "paper"])
def test_the_papers_rlpd_adds_layer_norm_and_demonstrations_to_fine_tuning(profile):
    """Appendix B.5: and neither ensemble nor a high update-to-data ratio."""
    ours, plain = (method_config(name, "Door", profile) for name in ("rlpd_paper", "sac_finetune"))
    assert (ours.sac.critic_layer_norm, ours.demo_fraction, plain.demo_fraction) == (True, 0.5, 0.0)
    assert (ours.sac.num_critics, ours.sac.target_subset, ours.utd) == (2, 0, plain.utd)


CALQL = dict(calql_offline_updates=20_000, calql_actions=10, calql_weight=1.0, calql_max_target=True)


@pytest.mark.parametrize("method, numbers", [  # facts.md 3.1 to 3.7, appendix B.5; PPO: cleanrl
    ("jsrl", dict(jsrl_step=10, jsrl_episodes=100)),
    ("dppo", dict(ppo_lr=1e-4, ppo_grad_clip=1e6, dppo_value_lr=1e-3, lora=0)),
    ("rot", dict(ot_epsilon=0.01, ot_iterations=100, ot_total=10.0, ot_trunk=50, ot_renew_every=10_000, bc_weight=0.03)),
    ("fish", dict(ot_epsilon=0.01, ot_iterations=100, ot_total=10.0, bc_weight=0.03, alpha=0.2, H=0, critic_input="concat",
                  actor_input="obs+base")),
    ("calql", CALQL), ("calql_d", CALQL),
    ("calql_a", CALQL | dict(actor_lr=1e-4, critic_lr=3e-4, tau=0.005, gamma=0.99, batch=256, utd=1.0, hidden=512, demo_fraction=0.5,
                             on_success="terminate")),
    ("rlpd", dict(utd=20.0, num_critics=10, target_subset=2, layers=3, hidden=256, entropy_backup=False, batch=256, actor_lr=3e-4,
                  critic_lr=3e-4, tau=0.005, gamma=0.99, warmup_steps=5_000, target_entropy_scale=0.5, init_temperature=1.0,
                  total_steps=1_000_000, demo_fraction=0.5, critic_layer_norm=True)),
    ("ppo_finetune", dict(ppo_clip=0.2, ppo_gae_lambda=0.95, ppo_epochs=10, ppo_minibatches=32, ppo_lr=3e-4, ppo_value_coef=0.5,
                          ppo_entropy_coef=0.0, ppo_grad_clip=0.5)),
    ("dipo", dict(dipo_steps=20, dipo_lr=0.03, dipo_norm=0.1)),
    ("residual_rl", dict(alpha=1.0, alpha_scale=[], H=0)), ("sac_from_scratch", dict(demo_fraction=0.0))])
def test_the_paper_profile_has_the_numbers_of_its_sources(method, numbers):
    values = flat(method_config(method, "Door", "paper"))
    assert {name: values[name] for name in numbers} == numbers


@pytest.mark.parametrize("method", ["sac_finetune", "rlpd_paper"])
def test_fine_tuning_learns_and_leaves_the_start_alone(bet_sac, method):
    """It starts with the spread that small actors start with: with its own, a quarter of that, one seed of six hardly meets a reward."""
    start = bet_sac.with_lora(0)
    set_spread(start, -1.5)
    before = {k: v.clone() for k, v in start.state_dict().items()}
    trainer, policy = run(method, start, reach_demos(), total_steps=3000)
    assert isinstance(trainer, FineTune) and (trainer.demos is None) == (method == "sac_finetune")
    assert success("reach", policy) > success("reach", start) + 0.5
    assert all(torch.equal(v, before[k]) for k, v in start.state_dict().items())


def test_fine_tuning_stores_windows_and_shows_critics_the_last_observation(bet_sac):
    trainer, _ = run("sac_finetune", bet_sac, total_steps=700, utd=0.0)
    rows = trainer.replay.unpack(trainer.replay.rows[: trainer.replay.size])
    windows = rows["obs"].view(-1, 3, 4)
    assert (windows[:, :, 2:] == windows[:, -1:, 2:]).all()  # the goal does not move within an episode
    assert (windows[:, 1:, :2] != windows[:, :-1, :2]).any() and (rows["base"] == 0).all()
    assert torch.allclose(trainer.agent.critic_view(rows["obs"]), bet_sac.normalizer(windows[:, -1]))
    raw, _ = run("sac_finetune", bet_sac, total_steps=700, utd=0.0, normalize_obs=False)  # as in the paper profile
    assert torch.equal(raw.agent.critic_view(rows["obs"]), windows[:, -1])


def test_fine_tuning_wants_a_policy_it_can_tune():
    with pytest.raises(PdkitError, match="bet-sac"):
        run("sac_finetune", biased_base())


@pytest.mark.parametrize("profile", ["lesson", "paper"])
def test_nothing_of_the_decorator_holds_back_a_method_that_acts_by_itself(profile):
    """On StackCube, whose lesson has a bound, one of the gripper's own, a gate and a penalty."""
    held = method_config("policy_decorator", "StackCube", "lesson")
    assert held.decorator.alpha < 1 and held.decorator.alpha_scale and held.decorator.H and held.sac.residual_penalty
    free = set(METHODS) - {"policy_decorator", "ppo_decorator", "fish"}
    for method in free:
        c = method_config(method, "StackCube", profile)
        found = c.decorator.alpha, tuple(c.decorator.alpha_scale), c.decorator.H, c.sac.residual_penalty
        assert found == (1.0, (), 0, 0.0), method


def test_residual_rl_is_the_decorator_without_bound_and_schedule():
    assert method_config("residual_rl", "Door").warmup == "uniform"
    trainer, policy = run("residual_rl", biased_base(), reach_demos(), total_steps=4000)
    assert type(trainer) is Trainer and success("reach", policy) > 0.9


@pytest.mark.parametrize(("method", "steps"), [("sac_from_scratch", 6000), ("rlpd", 3000)])
def test_from_scratch_nothing_of_the_base_is_used(method, steps):
    trainer, policy = run(method, biased_base(), reach_demos(), total_steps=steps, warmup_steps=1000)
    rows = trainer.replay.unpack(trainer.replay.rows[: trainer.replay.size])
    assert (rows["base"] == 0).all() and success("reach", policy) > 0.9
    assert (trainer.demos is None) == (method == "sac_from_scratch")
    for profile in ("lesson", "paper"):
        assert method_config(method, "Door", profile).demo_fraction == (0.5 if method == "rlpd" else 0.0)


@pytest.mark.parametrize("method", ["rlpd", "rlpd_paper"])
def test_symmetric_sampling_takes_half_of_each_batch_from_demonstrations(method, monkeypatch, bet_sac):
    from pdkit.rl.replay import Replay

    drawn = []
    draw = Replay.draw
    monkeypatch.setattr(Replay, "draw", lambda self, count, generator: drawn.append((self, count)) or draw(self, count, generator))
    trainer, _ = run(method, bet_sac, reach_demos(), total_steps=600, warmup_steps=500, utd=0.1)
    sizes = {"replay": {n for who, n in drawn if who is trainer.replay}, "demos": {n for who, n in drawn if who is trainer.demos}}
    assert sizes == {"replay": {32}, "demos": {32}}
