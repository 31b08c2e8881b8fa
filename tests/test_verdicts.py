"""Verdicts are computed from recorded results, by rules that can go either way."""
import numpy as np
import pandas as pd
import pytest

from pdkit import ablations, claims, report, verdicts
from pdkit.files import DATA
from pdkit.stats import Interval
from pdkit.sweep_jobs import make_jobs
from pdkit.sweep_spec import load_spec

CLAIMS = report.load_claims(DATA / "results" / "claims.csv")


def runs(recipe, ends, *, task="Door", base=0.5, **columns):
    """Rows of a recipe with these final successes, a seed each."""
    rows = {"task": task, "policy": "bet", "recipe": recipe, "seed": range(len(ends)), "decorated_success": ends, "base_success": base}
    return pd.DataFrame(rows | columns)


def write(folder, name, *tables, curves=None):
    pd.concat(tables).to_csv(folder / f"{name}.csv", index=False)
    if curves is not None:
        curves.to_csv(folder / f"{name}_curves.csv", index=False)


def test_each_lead_must_cover_the_claims_tasks(results):
    """One over rivals that were run on a part of the tasks does not become a finding about all of them beside another that was."""
    ends, tasks = {"mine": [0.9, 0.91, 0.92], "one": [0.5, 0.51, 0.49], "other": [0.3, 0.29, 0.31]}, ("Door", "StackCube")
    table = pd.concat([runs(recipe, values, task=task) for recipe, values in ends.items() for task in tasks])
    part = table[(table.recipe != "other") | (table.task == "Door")]
    write(results, "leaderboard", table)
    verdict = {name: claims.ahead("leaderboard", rows, "mine", {"a": ["one"], "b": ["other"]}, tasks).verdict
               for name, rows in (("whole", table), ("part", part))}
    assert verdict == {"whole": "reproduced", "part": "partly"}


def test_the_rule_of_a_comparison():
    assert claims.judged(Interval(0.2, 0.1, 0.3)) == "reproduced" == claims.judged(claims.turned(Interval(-0.2, -0.3, -0.1)))
    assert claims.judged(Interval(0.2, -0.1, 0.3)) == "partly"
    assert claims.judged(Interval(-0.2, -0.3, 0.1)) == "not" == claims.judged(Interval(0.0, -0.1, 0.1))
    assert claims.judged(Interval(0.2, 0.1, 0.3), 0.15) == "partly" and claims.judged(Interval(0.2, 0.1, 0.3), 0.25) == "not"


def test_students_t_covers_the_truth_where_a_bootstrap_of_few_seeds_does_not():
    """What pdkit/claims.py and notebook 16 say of intervals of three and five seeds, on normal draws whose mean is 0."""
    rng = np.random.default_rng(0)
    for seeds, bootstrap in ((3, 0.75), (5, 0.85)):
        runs_of = rng.standard_normal((2_000, seeds))
        means = rng.choice(np.arange(seeds), (400, seeds))  # the same redraws for all: 400 of them
        low, high = np.quantile(runs_of[:, means].mean(axis=2), [0.025, 0.975], axis=1)
        assert ((low < 0) & (high > 0)).mean() == pytest.approx(bootstrap, abs=0.04)
        index = pd.MultiIndex.from_product([["Door"], range(seeds)], names=["task", "seed"])
        found = [claims.mean_interval(pd.Series(values, index)) for values in runs_of]
        assert np.mean([i.low < 0 < i.high for i in found]) == pytest.approx(0.95, abs=0.02)


def test_means_beside_a_difference_are_of_the_seeds_that_it_compares(results):
    """FISH has a fourth seed, the decorator three: what is said of both is of three."""
    write(results, "leaderboard", runs("fish", [0.2, 0.2, 0.2, 1.0], base=0.1), runs("policy_decorator", [0.9] * 3, base=0.6))
    found = verdicts.find("FISH fails mainly because the VINN policy below it performs extremely poorly.")
    assert "FISH on VINN 20.0 %" in found.measured and found.seeds == "0 1 2"
    assert found.verdict == "partly"  # of two of the paper's eight tasks
    write(results, "leaderboard", runs("fish", [0.95] * 3, base=0.1), runs("policy_decorator", [0.9] * 3, base=0.6))
    assert verdicts.find("FISH fails mainly because the VINN policy below it performs extremely poorly.").verdict == "not"
    one, two = claims.matched(*(pd.Series(values, pd.MultiIndex.from_product([["Door"], range(len(values))], names=["task", "seed"]))
                                for values in ([1.0, 2.0, 3.0], [4.0, None])))
    assert one.tolist() == [1.0] and two.tolist() == [4.0]


def test_a_task_counts_once_however_many_seeds_it_has():
    """Five seeds of one task that gains 10 points, three of another that loses 20: on average a loss."""
    index = pd.MultiIndex.from_tuples([("Door", seed) for seed in range(5)] + [("Pen", seed) for seed in range(3)], names=["task", "seed"])
    values = pd.Series([0.09, 0.1, 0.11, 0.1, 0.1, -0.21, -0.2, -0.19], index)
    interval, pooled = claims.mean_interval(values), np.sqrt((0.0002 + 0.0002) / 6)
    assert interval.value == pytest.approx(claims.average(values)) == pytest.approx(-0.05)
    assert (interval.high - interval.low) / 2 == pytest.approx(2.4469 * pooled * np.sqrt(1 / 5 + 1 / 3) / 2, rel=1e-3)
    assert claims.task_by_task(values, claims.signed) == " (Door +10.0, Pen -20.0)" and not claims.task_by_task(values[:5], claims.signed)


def test_differences_are_taken_seed_by_seed():
    """Seeds differ much, the pairs hardly: unpaired, this interval would reach over zero."""
    table = pd.concat([runs("a", [0.1, 0.5, 0.9, 0.3]), runs("b", [0.05, 0.46, 0.84, 0.26]).iloc[::-1]])
    interval, values = claims.difference(claims.by_seed(table, "a", "decorated_success"), claims.by_seed(table, "b", "decorated_success"))
    assert interval.value == pytest.approx(0.0475) and interval.low > 0.03 and sorted(values.round(3)) == [0.04, 0.04, 0.05, 0.06]


def test_two_seeds_are_no_test(results):
    for ends, known in (([0.9, 0.9], False), ([0.9, 0.9, 0.9], True)):
        write(results, "low_checkpoint", runs("low", ends, base=0.1))
        assert (verdicts.find("Policy Decorator substantially improves a low-performing BeT checkpoint.") is not None) == known


def test_a_task_on_which_both_sides_end_near_0_is_left_out_and_told(results):
    """It would halve a difference seen on the other task, and count against the paper as "not above"."""
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("A large GPT actor does worse")].item()

    def found(cube):
        write(results, "calql", runs("calql_c", [0.9, 0.8, 0.85]), runs("calql_d", [0.1, 0.0, 0.2]))
        write(results, "calql_stackcube", runs("calql_c", cube[0], task="StackCube"), runs("calql_d", cube[1], task="StackCube"))
        return verdicts.find(claim)

    alone = found(([0, 0, 0.05], [0, 0.02, 0]))
    assert (alone.tasks, alone.verdict) == ("Door", "reproduced")
    assert alone.measured.endswith("-75.0 points; not judged: StackCube (all sides near 0)")
    assert found(([0, 0, 0.05], [0.3, 0.2, 0.3])).verdict == "partly" and found(([0, 0, 0.05], [0.3, 0.2, 0.3])).tasks == "Door StackCube"
    zero = pd.Series([0.01] * 3, pd.MultiIndex.from_product([["Door"], range(3)], names=["task", "seed"]))
    with pytest.raises(claims.TooLittle, match="near 0"):
        claims.told_apart(zero, zero)
    with pytest.raises(claims.TooLittle, match="Fewer than 3 seeds"):
        claims.told_apart(zero + 1, (zero + 1)[:2])


def test_where_the_named_task_is_near_0_no_other_is_judged_for_it(results):
    """D.3 names Pen."""
    rows = [runs("ppo_decorator", [0.1, 0.1, 0.1]), runs("ppo_finetune", [0.5, 0.6, 0.5])]
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Policy Decorator with PPO considerably outperforms PPO")].item()
    for pen, tasks in (([0.5, 0.4, 0.6], "Pen"), ([0.0, 0.0, 0.01], None)):
        write(results, "leaderboard", *rows, runs("ppo_decorator", pen, task="Pen"), runs("ppo_finetune", [0.0] * 3, task="Pen"))
        found = verdicts.find(claim)
        assert (found.tasks if found else None) == tasks
    write(results, "leaderboard", *rows)
    assert verdicts.find(claim).tasks == "Door"  # Pen was not run


def test_a_task_on_which_neither_learns_counts_where_the_claim_is_of_the_end(results):
    """C must exceed 90 % at the end, also where B and C are both at 0 all the way."""
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("SAC in place of Cal-QL online costs slightly")].item()
    door = [curve("calql_b", [0.9] * 3, [0.9] * 3), curve("calql_c", [0.9] * 3, [0.95] * 3)]
    write(results, "calql", runs("calql_b", [0.95] * 3), runs("calql_c", [0.96, 0.97, 0.98]), curves=pd.concat(door))
    assert verdicts.find(claim).verdict == "reproduced"
    cube = pd.concat([curve(name, [0.0] * 3, [0.0] * 3) for name in ("calql_b", "calql_c")]).assign(task="StackCube")
    write(results, "calql_stackcube", *(runs(name, [0.0] * 3, task="StackCube") for name in ("calql_b", "calql_c")), curves=cube)
    found = verdicts.find(claim)  # Adroit, which F.3 explains, is judged alone
    assert found.verdict == "reproduced" and found.tasks == "Door" and "not judged: StackCube" in found.measured
    pen = cube.assign(task="Pen")
    write(results, "calql", *(runs(name, ends, task=task) for task, two in (("Door", [0.96, 0.97, 0.98]), ("Pen", [0.0] * 3))
                              for name, ends in (("calql_b", two), ("calql_c", two))), curves=pd.concat([*door, pen]))
    found = verdicts.find(claim)
    assert found.verdict == "partly" and "Pen 0.0 %" in found.measured and "Pen (all sides near 0)" in found.measured


def test_three_seeds_are_asked_of_every_task():
    """One seed in each of three tasks is no test, and a task with one seed is left out beside one with three."""
    one_each = pd.concat([runs("x", [0.5], task=task) for task in ("Door", "Pen", "Hammer")])
    with pytest.raises(claims.TooLittle):
        claims.by_seed(one_each, "x", "decorated_success")
    table = pd.concat([runs("x", [0.5, 0.6, 0.7]), runs("x", [0.1], task="Pen")])
    assert set(claims.by_seed(table, "x", "decorated_success").index.get_level_values("task")) == {"Door"}


def test_every_rule_belongs_to_one_claim():
    for start in verdicts.MEASURES:
        assert CLAIMS.claim.str.startswith(start).sum() == 1, start
    assert verdicts.find("A claim that nobody made.") is None


def test_without_results_nothing_is_judged(results):
    """And what had a verdict before has none any more, but for the rows that no rule judges."""
    assert all(verdicts.find(claim) is None for claim in CLAIMS.claim)
    by_hand = ~CLAIMS.claim.map(lambda claim: any(claim.startswith(start) for start in verdicts.MEASURES))
    now = verdicts.updated(CLAIMS)
    assert now[by_hand].equals(CLAIMS[by_hand]) and set(now.verdict[~by_hand]) == {"untested"}
    assert (now[~by_hand][["tasks", "seeds", "interval", "command"]] == "").all(axis=None) and (now.measured != "").all()


@pytest.mark.parametrize("ends, verdict", [([0.9, 0.8, 0.85], "reproduced"), ([0.25, 0.15, 0.28], "not"), ([0.5, 0.2, 0.45], "partly")])
def test_a_low_checkpoint_must_rise_by_more_than_20_points(results, ends, verdict):
    write(results, "low_checkpoint", runs("low", ends, base=0.1))
    found = verdicts.find("Policy Decorator substantially improves a low-performing BeT checkpoint.")
    assert (found.verdict, found.tasks, found.seeds) == (verdict, "Door", "0 1 2")
    assert found.command == "pdkit sweep data/sweeps/low_checkpoint.toml" and "10.0 %" in found.measured


@pytest.mark.parametrize("kind, recipe", [("an MLP", "mlp"), ("a BC-RNN", "rnn"), ("a CNN", "cnn")])
def test_another_base_policy_must_rise_by_more_than_20_points(results, kind, recipe):
    """By its own rows alone; the paper's task is TurnFaucet, so that StackCube makes it partly at most."""
    claim = f"Policy Decorator significantly improves {kind} base policy."
    others = [runs(name, [0.1] * 3, task="StackCube", base=0.9) for name in {"mlp", "rnn", "cnn", "diffusion"} - {recipe}]
    for ends, verdict in (([0.9, 0.8, 0.85], "partly"), ([0.55, 0.6, 0.5], "not"), ([0.9, 0.5, 0.8], "partly")):
        write(results, "base_policies", *others, runs(recipe, ends, task="StackCube", base=0.4))
        found = verdicts.find(claim)
        assert (found.verdict, found.tasks) == (verdict, "StackCube") and f"{recipe} {100 * np.mean(ends):.1f} %" in found.measured
    write(results, "base_policies", runs(recipe, [0.9, 0.8, 0.85], task="TurnFaucet", base=0.4))
    assert verdicts.find(claim).verdict == "reproduced"
    write(results, "base_policies", *others, runs(recipe, [0.9, 0.9], task="StackCube"))
    assert verdicts.find(claim) is None


def test_the_best_rival_is_one_of_those_on_the_most_tasks():
    """A mean over an easy task alone does not beat a mean over an easy and a hard one."""
    both = [runs(recipe, [end] * 3, task=task) for recipe, ends in (("jsrl", (0.8, 0.2)), ("rot", (0.5, 0.4)))
            for task, end in zip(("Door", "StackCube"), ends, strict=True)]
    assert claims.best(pd.concat(both), ["jsrl", "rot"]) == "jsrl"
    easy = [runs("fish", [0.9] * 3), runs("fish", [0.9] * 2, task="StackCube")]  # two seeds are too few
    assert claims.best(pd.concat([*both, *easy]), ["jsrl", "rot", "fish"]) == "jsrl"
    assert claims.best(pd.concat([both[0], both[2], *easy]), ["jsrl", "rot", "fish"]) == "fish"


def test_a_claim_about_more_tasks_is_partly_reproduced_at_most(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("With BeT bases")].item()
    tables = [runs("policy_decorator", [1, 0.98, 0.99]), runs("jsrl", [0.7, 0.6, 0.5]), runs("sac_finetune", [0, 0, 0])]
    write(results, "leaderboard", *tables)
    found = verdicts.find(claim)
    assert found.verdict == "partly" and "jsrl" in found.measured and "sac_finetune" in found.measured
    write(results, "leaderboard", *tables, runs("rot", [1, 1, 1]))
    assert verdicts.find(claim).verdict == "not"  # the best of a kind counts
    # A rival that was run on some tasks says on which; the tasks are those of all leads.
    write(results, "leaderboard", *tables[:2], *(runs(r, e, task="Pen") for r, e in (("policy_decorator", [0.9] * 3), ("jsrl", [0.8] * 3))),
          tables[2])
    found = verdicts.find(claim)
    assert "jsrl (best of no fine-tuning) (Door +39.0, Pen +10.0)" in found.measured and found.measured.endswith("fine-tuning) (Door)")
    assert set(found.tasks.split()) == {"Door", "Pen"} and found.measured.startswith("94.5 %")
    everywhere = [table.assign(task=task) for table in tables for task in verdicts.registry.EIGHT]
    write(results, "leaderboard", *everywhere)
    assert verdicts.find(claim).verdict == "reproduced"


CLOSE, FAR, EVEN = [0.94, 0.9, 0.92], [0.5, 0.6, 0.55], [0.95, 0.95, 0.95]
GRID = ablations.GRID


def verdict_of(start):
    found = verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith(start)].item())
    return found and found.verdict


@pytest.mark.parametrize("start, other, worse", [
    ("A residual policy that sees the observation", "actor_input=obs+base", "reproduced"),
    ("A critic that sees the sum of base and residual action does better than one that sees both",
     "critic_input=concat,residual_units=bound", "partly"),
    ("A critic that sees the sum of base and residual action does better than one that sees the res",
     "critic_input=residual,residual_units=bound", "partly"),
    ("Increasing alpha to 1", "alpha=1.0,H=20000", "reproduced")])
def test_taking_a_part_away(results, start, other, worse):
    """E.2 is about StackCube, so that Door alone makes it partly."""
    for ends, verdict in ((FAR, worse), ([0.9, 0.9, 0.99], "partly"), ([0.96, 0.97, 0.99], "not")):
        write(results, "ablations", runs(GRID, EVEN), runs(other, ends))
        assert verdict_of(start) == verdict, ends
    write(results, "ablations", runs(GRID, EVEN), runs(other, FAR[:2]))
    assert verdict_of(start) is None


@pytest.mark.parametrize("ends, verdict", [(FAR, "reproduced"), ([0.9, 0.9, 0.99], "partly"), ([0.96, 0.97, 0.99], "not")])
def test_the_gate_is_judged_where_nothing_else_guards(results, ends, verdict):
    """Behind the lesson's other guards it is told beside, whatever it does there."""
    bare = [runs("unguarded,H=20000", EVEN), runs("unguarded,H=0", ends)]
    write(results, "ablations", *bare)
    assert verdict_of("Reducing H to 0") == verdict
    write(results, "ablations", *bare, runs(GRID, [0.9] * 3), runs("alpha=0.1,H=0", [0.1] * 3))
    found = verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith("Reducing H to 0")].item())
    assert found.verdict == verdict
    assert found.measured.endswith("; not judged: behind the lesson's other guards H 0 10.0 %, H 20,000 90.0 %: -80.0 points")
    write(results, "ablations", runs(GRID, EVEN), runs("alpha=0.1,H=0", FAR))
    assert verdict_of("Reducing H to 0") is None


@pytest.mark.parametrize("ends, base, verdict", [(CLOSE, 0.5, "partly"), (FAR, 0.4, "not"), (CLOSE, 0.93, "not")])
def test_a_factor_of_two_is_no_wide_range(results, ends, base, verdict):
    write(results, "ablations", runs(GRID, EVEN, base=base), runs("alpha=0.1,H=40000", ends, base=base), runs("alpha=0.1,H=0", FAR))
    assert verdict_of("H has a wide workable range") == verdict


@pytest.mark.parametrize("tenth, third, verdict", [(EVEN, CLOSE, "reproduced"), (EVEN, FAR, "partly"), (FAR, FAR, "not")])
def test_both_readings_of_the_action_scale_must_hold(results, tenth, third, verdict):
    """Door's demonstrations: actions of 0.51, closest to 0.3, and steps of 0.11, closest to 0.1."""
    write(results, "ablations", *(runs(f"alpha={alpha},H=20000", ends) for alpha, ends in
                                  ((0.03, EVEN), (0.1, tenth), (0.3, third), (1.0, FAR))))
    found = verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith("alpha close to")].item())
    assert found.verdict == verdict and "alpha=0.3" in found.measured and "alpha=0.1 " in found.measured
    write(results, "ablations_stackcube", *(runs(f"alpha={alpha},H=20000", ends, task="StackCube") for alpha, ends in
                                            ((0.03, EVEN), (0.1, EVEN), (0.3, FAR))))
    found = verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith("alpha close to")].item())
    assert found.verdict == ("reproduced" if verdict == "reproduced" else "partly") and found.tasks == "Door StackCube"  # there both work
    assert "StackCube mean |a| 0.17: alpha=0.1" in found.measured and "StackCube mean |a_t - a_(t-1)| 0.08: alpha=0.1" in found.measured


@pytest.mark.parametrize("rival", ["ppo_finetune", "ppo_residual_rl"])
def test_ppo_must_be_considerably_ahead(results, rival):
    start = f"Policy Decorator with PPO considerably outperforms {'PPO fine' if rival == 'ppo_finetune' else 'residual'}"
    for ends, verdict in (([0.8, 0.8, 0.9], "partly"), ([0.5, 0.45, 0.99], "partly"), ([0.55, 0.55, 0.5], "not")):  # Pen was not run
        write(results, "leaderboard", runs("ppo_decorator", ends), runs(rival, [0.4, 0.4, 0.4]))
        assert verdict_of(start) == verdict
    write(results, "leaderboard", *(runs(r, ends, task="Pen") for r, ends in (("ppo_decorator", EVEN), (rival, FAR))))
    assert verdict_of(start) == "reproduced"


def test_claims_about_a_kind_of_task_use_that_kind(results):
    fine, zero = "The best baseline that fine-tunes BeT (36.7", "The best baseline that fine-tunes BeT reaches 0 %"
    door = [runs("policy_decorator", EVEN), runs("sac_finetune", [0.7, 0.8, 0.7])]
    cube = [runs("policy_decorator", EVEN, task="StackCube", policy="mlp"), runs("sac_finetune", [0, 0, 0], task="StackCube")]
    write(results, "leaderboard", *door, *cube)
    assert verdict_of(fine) == "not" and verdict_of(zero) == "partly"  # StackCube is one of four
    write(results, "leaderboard", *door, runs("sac_finetune", [0, 0, 0.1], task="StackCube"))
    assert verdict_of(zero) == "not"
    write(results, "leaderboard", door[0], runs("sac_finetune", [0, 0, 0.1]), runs("fish", [0.3, 0.2, 0.3]), *cube)
    assert verdict_of(fine) == "partly" == verdict_of("The best baseline that does not fine-tune (42.9") and verdict_of(zero) == "partly"
    write(results, "leaderboard", *cube)
    assert verdict_of(fine) is None is verdict_of("With BeT bases")  # the decorator's base is no BeT there


def test_the_better_rate_of_fine_tuning_counts(results):
    write(results, "leaderboard", runs("policy_decorator", CLOSE), runs("jsrl", FAR), runs("sac_finetune", [0, 0, 0]),
          runs("sac_finetune,actor_lr=1e-4", [1, 1, 1]))
    assert verdict_of("With BeT bases") == "not"


def curve(recipe, first, last, **columns):
    steps = [10_000, 20_000]
    return pd.concat([pd.DataFrame({"task": "Door", "recipe": recipe, "seed": s, "step": steps, "success_once": [a, b]} | columns)
                      for s, (a, b) in enumerate(zip(first, last, strict=True))])


def test_unlearning_and_relearning(results):
    early = CLAIMS.claim[CLAIMS.claim.str.startswith("Fine-tuning baselines unlearn")].item()
    late = CLAIMS.claim[CLAIMS.claim.str.startswith("Once unlearned")].item()

    def verdict_of(first, ends):
        both = ("sac_finetune", "rot")  # one method alone is no "baselines"
        write(results, "leaderboard", *(runs(name, ends) for name in both), curves=pd.concat(curve(name, first, ends) for name in both))
        return [found.verdict if (found := verdicts.find(claim)) else None for claim in (early, late)]

    assert verdict_of([0, 0, 0.1, 0, 0], [0, 0.1, 0, 0, 0.2]) == ["reproduced", "reproduced"]
    assert verdict_of([0, 0, 0.1, 0, 0], [0.9, 0.8, 0.9, 0.7, 0.2]) == ["reproduced", "not"]
    assert verdict_of([0.6, 0.5, 0.7, 0.6, 0.5], [0.9, 0.8, 0.9, 0.9, 0.9]) == ["not", None]


def test_a_variant_of_a_method_is_no_further_method_that_unlearns(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Fine-tuning baselines unlearn")].item()
    firsts = {"sac_finetune": [0.0] * 3, "rot": [0.1] * 3, "sac_finetune,actor_lr=1e-4": [0.6] * 3}
    write(results, "leaderboard", *(runs(name, [0.0] * 3) for name in firsts),
          curves=pd.concat(curve(name, first, [0.0] * 3) for name, first in firsts.items()))
    found = verdicts.find(claim)
    assert found.measured.startswith("2 of 2 methods fall")
    assert "; not counted: sac_finetune,actor_lr=1e-4 " in found.measured and found.measured.endswith("(Door, 3 runs)")


def test_longer_runs_of_ppo_are_told_and_not_judged(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("PPO fine-tuning performs poorly")].item()
    kinds = ("mlp", "shared", "separate")
    write(results, "q_architectures", *(runs(f"ppo_finetune,critic_backbone={kind}", [0.7, 0.8, 0.75]) for kind in kinds))
    alone = verdicts.find(claim)
    write(results, "leaderboard", runs("ppo_finetune", [0.0] * 3))
    found = verdicts.find(claim)
    assert found.verdict == alone.verdict == "not" and "not judged" not in alone.measured
    assert found.measured.startswith(alone.measured + "; not judged: mlp in the longer runs of leaderboard -")


def test_a_run_that_comes_back_in_between_was_relearned_and_one_that_falls_last_was_not_yet_tried(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Once unlearned")].item()

    def found(*successes, recipe="sac_finetune", end=0.4, train=0.0):
        lines = [pd.DataFrame({"task": "Door", "recipe": recipe, "seed": seed, "step": 1_000 * np.arange(1, 5), "success_once": successes,
                               "train_success": train}) for seed in range(5)]
        write(results, "leaderboard", runs(recipe, [end] * 5), curves=pd.concat(lines))
        return (one.verdict, one.measured) if (one := verdicts.find(claim)) else None

    met = "5 of 5 log no solved training episode any more"
    assert found(0.0, 0.3, 0.4, 0.4) == ("reproduced", f"5 of 5 unlearned runs never come back to their start; {met}")
    assert found(0.0, 0.9, 1.0, 0.4) == ("not", f"0 of 5 unlearned runs never come back to their start; {met}")
    assert found(0.9, 0.0, 0.4, 0.4, end=0.5) == ("not", f"0 of 5 unlearned runs never come back to their start; {met}")
    assert found(0.9, 0.0, 0.2, 0.2, train=[0.5, 0.0, 0.0, 0.1])[1].endswith("0 of 5 log no solved training episode any more")
    assert found(0.9, 0.0, 0.2, 0.2, train=[0.5, 0.3, 0.0, 0.0])[1].endswith(met)  # solved before the loss, not after it
    assert found(0.9, 0.8, 0.9, 0.0) is None and found(0.0, 0.3, 0.4, 0.4, recipe="rot") is None


def test_a_fall_on_one_task_alone_is_no_fall_on_both(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Fine-tuning baselines unlearn")].item()
    cells = [(method, task) for method in ("sac_finetune", "calql") for task in ("Door", "StackCube")]
    for door, verdict in ((0.8, "not"), (0.0, "reproduced")):  # on Door it rises by 30 points, or falls; on StackCube it falls by 70
        table = pd.concat(runs(method, [0.0] * 3, task=task, base=0.5 if task == "Door" else 0.7) for method, task in cells)
        lines = [curve(method, [door if task == "Door" else 0.0] * 3, [0.0] * 3).assign(task=task) for method, task in cells]
        write(results, "leaderboard", table, curves=pd.concat(lines))
        assert verdicts.find(claim).verdict == verdict


def test_residual_rl_early_and_late(results):
    early, late = (CLAIMS.claim[CLAIMS.claim.str.startswith(f"Residual RL fails {when}")].item() for when in ("early", "during"))

    def verdict_of(train, size, ends, base=0.5):
        rows = curve("residual_rl", ends, ends, train_success=train, residual_size=size, base_size=0.4).assign(step=lambda t: t.step / 2)
        write(results, "leaderboard", runs("residual_rl", ends, base=base, first_reward_step=7), curves=rows)
        return [verdicts.find(claim).verdict for claim in (early, late)]

    assert verdict_of(0.0, 0.6, [0, 0.1, 0]) == ["reproduced", "reproduced"]
    assert verdict_of(0.0, 0.6, [0.9, 0.8, 0.9]) == ["reproduced", "partly"]  # larger, and yet no harm at the end
    assert verdict_of(0.6, 0.1, [0.9, 0.8, 0.9]) == ["not", "not"]
    assert verdict_of(0.0, 0.1, [0.0, 0.1, 0.0], base=0.0)[0] == "not"  # nor does the base policy solve anything
    assert verdict_of(0.0, [0.6, 0.1], [0, 0.1, 0]) == ["reproduced", "partly"]  # larger at first, smaller at the end
    assert "1.50 times mean |base action| in the first half, 0.25 times in the last quarter" in verdicts.find(late).measured


def test_what_was_learned_offline_is_no_first_evaluation(results):
    """Cal-QL is evaluated at step 0 too, where it has its whole success."""
    lines = curve("calql", [0.0] * 3, [0.0] * 3)
    offline = lines[lines.step == 10_000].assign(step=0, success_once=0.5)
    write(results, "leaderboard", runs("calql", [0.0] * 3), curves=pd.concat([offline, lines]))
    found = verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith("Fine-tuning baselines unlearn")].item())
    assert found.verdict == "partly" and "calql -50.0" in found.measured  # the only method that is recorded


def test_most_methods_must_fall(results):
    early, late = (CLAIMS.claim[CLAIMS.claim.str.startswith(words)].item() for words in ("Fine-tuning baselines unlearn", "Once unlearned"))
    firsts = {"sac_finetune": 0.0, "rot": 0.0, "calql": 0.5, "rlpd_paper": 0.45, "ppo_finetune": 0.0}
    for falling, verdict in ((2, "partly"), (3, "reproduced")):
        if falling == 3:
            firsts["calql"] = 0.1
        tables, lines = zip(*((runs(name, [0.0] * 3), curve(name, [first] * 3, [0.0] * 3)) for name, first in firsts.items()), strict=True)
        write(results, "leaderboard", *tables, curves=pd.concat(lines))
        found = verdicts.find(early)
        assert found.verdict == verdict and found.measured.startswith(f"{falling} of 4 methods fall")  # fine-tuning by PPO is none of them
        lost = 3 * (falling - 1)  # rot's do not count
        assert verdicts.find(late).measured.startswith(f"{lost} of {lost} unlearned runs")


def test_some_success_at_first_is_not_none(results):
    rows = curve("residual_rl", [0.0] * 3, [0.5] * 3, train_success=0.1, residual_size=0.1, base_size=0.4).assign(step=lambda t: t.step / 2)
    write(results, "leaderboard", runs("residual_rl", [0.5] * 3, first_reward_step=7), curves=rows)
    assert verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith("Residual RL fails early")].item()).verdict == "partly"


def test_two_sides_at_the_floor_are_not_told_apart(results):
    write(results, "leaderboard", runs("ppo_decorator", [0, 0.02, 0]), runs("ppo_residual_rl", [0, 0, 0]))
    assert verdicts.find(CLAIMS.claim[CLAIMS.claim.str.contains("outperforms residual RL with PPO")].item()) is None


def test_parts_and_conditions():
    assert claims.jointly("reproduced", "reproduced") == "reproduced" and claims.jointly("not", "not") == "not"
    assert claims.jointly("reproduced", "not") == claims.jointly("partly", "partly") == "partly"
    assert claims.jointly("partly", "not") == "not" == claims.weakest("reproduced", "not")


@pytest.mark.parametrize(("minutes", "verdict"), [([20.0, 22.0, 21.0], "reproduced"), ([5.0, 5.2, 5.1], "not"), ([5.0, 12, 6], "partly")])
def test_what_the_critics_of_rlpd_cost(results, minutes, verdict):
    tables = [runs(recipe, [0.9] * 3, train_minutes=took, load_average=2.0, cores=2)
              for recipe, took in (("rlpd", minutes), ("sac_from_scratch", [3.0, 3.0, 3.0]))]
    write(results, "leaderboard", *tables)
    (claim,) = starting("The Q ensemble and the high update-to-data ratio of RLPD")
    found = verdicts.find(claim)
    assert found.verdict == verdict and found.measured.endswith("SAC from scratch 3.0")
    write(results, "leaderboard", tables[0].assign(load_average=[2.0, 2.0, 7.0]), tables[1])  # one beside other work
    assert verdicts.find(claim) is None


def test_a_finding_names_the_sweeps_that_made_its_rows(results):
    table = runs("ppo_decorator", [0.9] * 3).assign(sweep="pdkit sweep data/sweeps/leaderboard.toml")
    other = runs("ppo_decorator", [0.9] * 3, task="Pen").assign(sweep="pdkit sweep other.toml")
    write(results, "leaderboard", table, other)
    assert claims.commands("leaderboard", ["Pen"]) == ["pdkit sweep other.toml"]
    beside = runs("rlpd", [0.9] * 3).assign(sweep="pdkit sweep slow.toml")  # a recipe that the finding does not look at
    write(results, "leaderboard", table, other, beside)
    assert claims.commands("leaderboard", ["Door"], ["ppo_decorator"]) == ["pdkit sweep data/sweeps/leaderboard.toml"]
    assert claims.commands("leaderboard", ["Pen"], ["rlpd"]) == []
    write(results, "leaderboard", table, other)
    assert claims.compared("leaderboard", "ppo_decorator", second_column="base_success").command.count("pdkit sweep") == 2


def test_the_record_of_another_task_is_judged_with_doors(results):
    """Door gains 30 points (five seeds), StackCube loses 10 (three, in a record of its own): 10 on average, each named with its sweep."""
    claim = "A residual policy that sees the observation alone typically does better than one that also sees the base action."
    door = [runs(recipe, [end] * 4 + [end + 0.001]) for recipe, end in ((ablations.GRID, 0.8), ("actor_input=obs+base", 0.5))]
    cube = [runs(recipe, [end + 0.001, end, end], task="StackCube")
            for recipe, end in ((ablations.GRID, 0.5), ("actor_input=obs+base", 0.6))]
    write(results, "ablations", *door)
    alone = verdicts.find(claim)
    assert (alone.tasks, alone.seeds, alone.command) == ("Door", "0 1 2 3 4", "pdkit sweep data/sweeps/ablations.toml")
    write(results, "ablations_stackcube", *cube)
    both = verdicts.find(claim)
    assert both.tasks == "Door StackCube" and "+10.0 points (Door +30.0, StackCube -10.0)" in both.measured
    assert both.command == "pdkit sweep data/sweeps/ablations.toml; pdkit sweep data/sweeps/ablations_stackcube.toml"
    write(results, "ablations_stackcube", *(rows[:2] for rows in cube))  # two seeds are no test of a task
    assert verdicts.find(claim) == alone
    (results / "ablations.csv").unlink()
    write(results, "ablations_stackcube", *cube)
    assert verdicts.find(claim).tasks == "StackCube"


def test_of_the_tasks_that_a_claim_names_those_recorded_are_judged_alone(results):
    """E.2 is about StackCube: what Door shows is told beside it, and judged only while StackCube is not recorded."""
    claim = "A critic that sees the sum of base and residual action does better than one that sees both side by side."
    write(results, "ablations", runs(ablations.GRID, [0.9, 0.91, 0.92]), runs("critic_input=concat,residual_units=bound", [0.5] * 3))
    assert verdicts.find(claim).verdict == "partly"
    write(results, "ablations_stackcube", runs(ablations.GRID, [0.5, 0.51, 0.52], task="StackCube"),
          runs("critic_input=concat,residual_units=bound", [0.6] * 3, task="StackCube"))
    found = verdicts.find(claim)
    assert (found.verdict, found.tasks) == ("not", "StackCube") and "-9.0 points; not judged: Door +41.0" in found.measured
    assert found.command == "pdkit sweep data/sweeps/ablations_stackcube.toml"


def test_tasks_that_contradict_each_other_are_no_verdict_on_their_mean():
    index = pd.MultiIndex.from_product([["Door", "StackCube"], range(3)], names=["task", "seed"])
    values = pd.Series([0.5, 0.51, 0.52, -0.1, -0.11, -0.12], index)
    assert claims.judged(claims.mean_interval(values)) == "reproduced"
    assert claims.judged_over_tasks(values) == claims.judged_over_tasks(-values) == "partly"
    assert claims.judged_over_tasks(values, 0.6) == "not" and claims.judged_over_tasks(values, -0.2) == "reproduced"


def test_a_tasks_mean_that_chance_explains_neither_saves_nor_sinks_a_claim():
    """Nothing on either task, on one of them by chance on the right side: not. Where that one tells it by itself: partly. And the same
    the other way round."""
    index = pd.MultiIndex.from_product([["Door", "StackCube"], range(3)], names=["task", "seed"])
    noise = pd.Series([0.05, -0.1, 0.08, -0.1, 0.05, 0.02], index)
    assert noise["Door"].mean() > 0 > noise.mean() and claims.judged_over_tasks(noise) == "not"
    assert claims.judged_over_tasks(pd.Series([0.05, 0.06, 0.07, -0.3, -0.2, -0.25], index)) == "partly"
    assert claims.judged_over_tasks(pd.Series([0.5, 0.51, 0.52, -0.1, 0.1, -0.03], index)) == "reproduced"
    assert claims.judged_over_tasks(pd.Series([0.5, 0.51, 0.52, -0.05, -0.06, -0.07], index)) == "partly"


def test_a_sweep_halfway_through_changes_no_verdict(results):
    """Only the whole task is recorded on StackCube yet, with two seeds elsewhere: the finding is Door's."""
    claim = "A long task horizon is a key factor in the failure of fine-tuning baselines."
    write(results, "horizon", *(runs(f"sac_finetune,start_fraction={f}", [end - 0.01, end, end + 0.01])
                                for f, end in ((0.0, 0.1), (0.5, 0.4), (0.75, 0.49))))
    door = verdicts.find(claim)
    write(results, "horizon_stackcube", runs("sac_finetune,start_fraction=0.0", [1.0] * 3, task="StackCube"),
          runs("sac_finetune,start_fraction=0.75", [0.0] * 2, task="StackCube"))
    assert verdicts.find(claim) == door and door.verdict == "reproduced"


def test_commands_that_differ_in_their_seed_are_one(results):
    rows = runs("lesson", [0.9, 0.8, 0.7], command=[f"pdkit train decorated Door --seeds {seed} --set utd=1" for seed in range(3)])
    write(results, "recipe_search", rows, runs("lesson", [0.5], task="Pen", command="pdkit something"))
    # Of a record without a sweep of its own.
    assert claims.commands("recipe_search", ["Door", "Pen"]) == ["pdkit train decorated Door --seeds 0 1 2 --set utd=1", "pdkit something"]


@pytest.mark.parametrize(("ends", "verdict"), [([0.97, 0.99, 0.98], "partly"), ([0.7, 0.72, 0.71], "partly"), ([0.3, 0.31, 0.29], "not")])
def test_lifting_on_some_of_the_tasks_is_partly_at_most(results, ends, verdict):
    """Two seeds of Pen are no test; three of Hammer and StackCube are, but the claim is about eight tasks."""
    tables = [runs("lesson", ends, task=task, command="x") for task in ("StackCube", "Hammer")]
    write(results, "main_job", *tables, runs("lesson", [0.0, 0.0], task="Pen", command="x"))
    found = verdicts.find("Policy Decorator lifts BeT bases from 41.5 % to 98.95 % success")
    assert found.verdict == verdict and found.tasks == "StackCube Hammer" and f"to {100 * np.mean(ends):.1f} %" in found.measured
    both = verdicts.find("Policy Decorator lifts BeT bases from 36.25 % to 98.3 %")
    assert both.verdict == verdict and both.measured.startswith("ManiSkill from 50.0 %")


def test_a_decorated_mlp_is_no_decorated_bet(results):
    mlps, bets = (runs("lesson", ends, task=task, policy=policy, command="x") for task, policy, ends in (
        ("StackCube", "mlp", [0.99] * 3), ("Hammer", "bet", [0.7, 0.71, 0.69])))
    write(results, "main_job", mlps, bets)
    found, suites = (verdicts.find(f"Policy Decorator lifts BeT bases from {start} %") for start in ("41.5", "36.25"))
    assert (found.tasks, found.verdict) == ("Hammer", "partly")
    assert "not counted: StackCube (mlp, 3 seeds) 50.0 % to 99.0 %" in found.measured
    assert (suites.tasks, suites.verdict) == ("Hammer", "partly") and suites.measured.startswith("Adroit from 50.0 %")
    write(results, "main_job", mlps)
    assert all(verdicts.find(f"Policy Decorator lifts BeT bases from {start} %") is None for start in ("41.5", "36.25"))


def test_a_bet_decorated_beside_the_main_job_stands_for_its_task(results):
    """In the form that SAC can tune, too. The main job's own runs over an MLP are then neither counted nor told."""
    write(results, "main_job", runs("lesson", [0.99] * 3, policy="mlp", task="StackCube", command="x"),
          runs("lesson", [0.7, 0.71, 0.69], task="Hammer", command="x"))
    write(results, "bet_bases", runs("lesson", [0.9, 0.91, 0.89], policy="bet-sac", task="StackCube", command="y"))
    found = verdicts.find("Policy Decorator lifts BeT bases from 41.5 % to 98.95 % success")
    assert "(Hammer 70.0 %, StackCube 90.0 %)" in found.measured and "mlp" not in found.measured
    assert "bet_bases.toml" in found.command and "main_job.toml" in found.command
    suites = verdicts.find("Policy Decorator lifts BeT bases from 36.25 %")
    assert suites.measured.startswith("ManiSkill from 50.0 % to 90.0 %")


@pytest.mark.parametrize("ends, verdict", [([0.9, 0.8, 0.85], "partly"), ([0.95, 0.4, 0.9], "partly"), ([0.3, 0.4, 0.35], "not")])
def test_novel_objects_and_the_mlp_below_them(results, ends, verdict):
    """TurnFaucet alone is one of two tasks; its runs also answer for an MLP where no sweep of base policies does, above 20 points."""
    write(results, "main_job", runs("lesson", ends, task="TurnFaucet", policy="mlp", command="x"),
          runs("lesson", [0.0], task="PushChair", policy="mlp", command="x"), runs("lesson", ends, task="Door", command="x"))
    novel = verdicts.find("Policy Decorator improves base policies on objects that no demonstration shows")
    assert (novel.tasks, novel.verdict) == ("TurnFaucet", verdict) and "PushChair (mlp, 1 seed) 50.0 % to 0.0 %" in novel.measured
    mlp = verdicts.find("Policy Decorator significantly improves an MLP base policy.")
    assert (mlp.tasks, mlp.verdict) == ("TurnFaucet", "reproduced" if min(ends) >= 0.8 else "not" if max(ends) < 0.5 else "partly")
    write(results, "base_policies", runs("mlp", [0.6] * 3))
    found = verdicts.find("Policy Decorator significantly improves an MLP base policy.")
    assert found.tasks == "TurnFaucet" and "; not judged: Door mlp 60.0 %" in found.measured  # the paper's task, by another sweep
    write(results, "base_policies", runs("mlp", [0.6] * 3), runs("mlp", [0.7] * 3, task="TurnFaucet"))
    found = verdicts.find("Policy Decorator significantly improves an MLP base policy.")
    assert found.measured.startswith("mlp 70.0 %") and "not judged: Door +10.0" in found.measured


@pytest.mark.parametrize("faucets, chairs, verdict", [(0.4, 0.3, "reproduced"), (0.4, 0.002, "partly"), (-0.3, -0.35, "not"),
                                                      (0.4, -0.2, "partly")])
def test_novel_objects_are_set_against_the_demonstrations_own(results, faucets, chairs, verdict):
    """The same policy on both; a task without a gap keeps the other from telling for both."""
    def tested(task, less):
        successes = np.array([0.6, 0.62, 0.58])
        return [runs("mlp", [np.nan] * 3, base=base, task=name) for name, base in ((f"{task}Source", successes), (task, successes - less))]

    assert verdicts.find("Tasks whose objects vary are very challenging.") is None
    write(results, "object_gap", *tested("TurnFaucet", np.array([0.01, -0.01, 0]) + faucets),
          *tested("PushChair", np.array([0, 0.01, -0.01]) + chairs))
    found = verdicts.find("Tasks whose objects vary are very challenging.")
    assert (found.tasks, found.verdict) == ("TurnFaucet PushChair", verdict) and f"TurnFaucet {100 * faucets:+.1f}" in found.measured


def test_pictures_need_three_runs_like_anything_else(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Policy Decorator improves base policies that see pictures")].item()
    door = [runs(recipe, ends, base=0.4) for recipe, ends in (("pixels", [0.9]), ("state", [0.1] * 3))]
    write(results, "pixels", *door, runs("pixels", [0.35], base=0.4, task="TurnFaucet"))
    assert verdicts.find(claim) is None
    [row] = verdicts.updated(CLAIMS[CLAIMS.claim == claim]).itertuples()
    assert row.verdict == "untested" and row.measured.endswith("(runs): Door 40.0 % to 90.0 % (1), TurnFaucet 40.0 % to 35.0 % (1).")
    for ends, verdict in (([0.9, 0.8, 0.85], "partly"), ([0.3, 0.2, 0.3], "not")):  # PushChair is the paper's, too
        write(results, "pixels", *door, runs("pixels", ends, base=0.4, task="TurnFaucet"))
        assert (verdicts.find(claim).verdict, verdicts.find(claim).tasks) == (verdict, "TurnFaucet")


def test_all_tasks_with_nearly_all_success_are_lifted(results):
    tasks = [task for suite in claims.TASKS.values() for task in suite]
    start = "Policy Decorator lifts BeT bases from 41.5 % to 98.95 % success"
    for level, verdict in ((0.97, "reproduced"), (0.8, "partly")):
        write(results, "main_job", *(runs("lesson", [level, level + 0.01, level - 0.01], task=task, command="x") for task in tasks))
        assert verdicts.find(start).verdict == verdict


@pytest.mark.parametrize("start, recipe, limit, sign", [("JSRL gives jerky", "jsrl", 1.1, 1),
                                                        ("A bounded residual keeps", "policy_decorator", 1.25, -1)])
def test_jerk_is_judged_as_a_ratio(results, start, recipe, limit, sign):
    for ratio in (limit * 1.2, limit / 1.2):
        write(results, "leaderboard", runs(recipe, [1, 1, 1], base_jerk=50.0, decorated_jerk=50 * ratio * np.array([0.98, 1, 1.02])))
        found = verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith(start)].item())
        assert found.verdict == ("reproduced" if (ratio > limit) == (sign > 0) else "not")
        assert f"{ratio:.2f} times" in found.measured


def test_the_motion_is_judged_on_all_tasks_that_were_decorated(results):
    """Jerky on tasks of which the comparison has no run: those of the main job count, or the ones over a BeT; where the comparison has
    runs, they stand for the task."""
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("A bounded residual keeps")].item()

    def jerk(times, task="Door", recipe="policy_decorator"):
        return runs(recipe, [1, 1, 1], task=task, base_jerk=50.0, decorated_jerk=50 * times * np.array([0.98, 1, 1.02]), command="x")

    write(results, "main_job", jerk(3.0, recipe="lesson"), jerk(2.0, "Hammer", "lesson"))
    assert verdicts.find(claim).verdict == "not" and "Door 3.00, Hammer 2.00" in verdicts.find(claim).measured
    write(results, "leaderboard", jerk(0.9))
    found = verdicts.find(claim)
    assert found.verdict == "partly" and "Door 0.90, Hammer 2.00" in found.measured
    write(results, "bet_bases", jerk(0.8, "Hammer", "lesson").iloc[:2])
    assert "Hammer 2.00" in verdicts.find(claim).measured  # two seeds do not stand for a task
    write(results, "bet_bases", jerk(0.8, "Hammer", "lesson"))
    found = verdicts.find(claim)
    assert found.verdict == "reproduced" and "Door 0.90, Hammer 0.80" in found.measured and "bet_bases" in found.command


@pytest.mark.parametrize("success, lifted, verdicts_of", [([0.5, 0], [0.9, 0.1], ["reproduced", "reproduced"]),
                                                          ([0.5, 0], [0.1, 0.0], ["partly", "reproduced"]),
                                                          ([1, 1], [0.9, 0.9], ["partly", "not"])])
def test_unlearning_the_cube(results, success, lifted, verdicts_of):
    table = pd.DataFrame({"task": "StackCube", "seed": range(5), "success.before.value": [0.9, 1, 0.9, 1, 0.9], "lifted.before": 1.0,
                          "success.random critic, 100.value": success[0], "success.random critic, 200.value": success[1],
                          "lifted.random critic, 100": lifted[0], "lifted.random critic, 200": lifted[1],
                          "cosine_random": [0.01, -0.02, 0, 0.03, -0.01], "drift.random critic": 0.1, "drift.critic learns": 0.2})
    table.to_csv(results / "unlearning.csv", index=False)
    starts = ("After 100 updates", "After 200 updates", "Gradients of")
    found = [verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith(start)].item()).verdict for start in starts]
    assert found == [*verdicts_of, "reproduced"]


@pytest.mark.parametrize("off, expected, everywhere", [
    ([0.02, -0.03, 0.0], "partly", "reproduced"),  # alike, but on two of the paper's eight tasks
    ([0.4, -0.4, 0.03], "partly", "partly"),  # alike on average, seeds far apart
    ([0.15, 0.14, 0.13], "partly", "not"),  # on average over the two tasks within 10 points, but one is beyond
    ([-0.3, -0.3, -0.31], "not", "not")])
def test_the_modified_bet_must_be_within_10_points_of_the_original(results, off, expected, everywhere):
    """`off` the original on StackCube, exactly as good on Door; then on all eight tasks."""
    plain = np.array([0.5, 0.6, 0.4])
    claim, = starting("The BeT modified")

    def verdict_of(tasks):
        write(results, "bet_forms", *(runs(form, plain, task=task, base=plain + (np.array(shift) if form == "bet-sac" else 0))
                                      for task, shift in tasks.items() for form in ("bet", "bet-sac")))
        return verdicts.find(claim).verdict

    assert verdict_of({"Door": [0.0] * 3, "StackCube": off}) == expected
    assert f"StackCube {100 * np.mean(off):+.1f})" in verdicts.find(claim).measured
    assert verdict_of(dict.fromkeys(verdicts.registry.EIGHT, off)) == everywhere
    # What the kit scales otherwise is told and not judged, even where nothing else was run.
    rows = [runs(form, plain, task="Door", base=plain) for form in ("bet", "bet-sac")]
    write(results, "bet_forms", *rows, *(runs(form, plain, task="StackCube", base=plain + more)
                                         for form, more in (("bet", 0), ("bet-sac,arm", 0.3))))
    found = verdicts.find(claim)
    assert (found.verdict, found.tasks) == ("partly", "Door") and "scaled, too, StackCube +30.0" in found.measured


def starting(*starts):
    return [CLAIMS.claim[CLAIMS.claim.str.startswith(start)].item() for start in starts]


@pytest.mark.parametrize("mlp, others, ppo, expected", [
    (0.6, 0.4, 0.2, ["reproduced", "reproduced", "reproduced"]),
    (0.8, 0.53, 0.5, ["partly", "partly", "not"]),  # more than slightly; a gain whose interval reaches beyond 5 points; as good as the base
    (0.4, 0.7, 0.6, ["not", "not", "not"]), (0.51, 0.4, 0.48, ["partly", "reproduced", "partly"])])
def test_the_critics_architecture(results, mlp, others, ppo, expected):
    spread = 0.02 * np.array([-1, 1, 0])
    ends = {("sac", "mlp"): mlp, ("sac", "shared"): others, ("sac", "separate"): 0.1, ("ppo", "mlp"): 0.1, ("ppo", "shared"): 0.0,
            ("ppo", "separate"): ppo}
    tables = [runs(f"{m}_finetune,critic_backbone={k}", end + spread) for (m, k), end in ends.items()]
    claims_of = starting("SAC fine-tuning with an MLP critic", "SAC fine-tuning with either of the two other", "PPO fine-tuning performs")
    write(results, "q_architectures", *tables)
    found = [verdicts.find(claim) for claim in claims_of]
    assert [f.verdict for f in found] == expected
    assert "separate -40.0" in found[1].measured and f"separate {100 * (ppo - 0.5):+.1f}" in found[2].measured
    write(results, "q_architectures", *tables[:2], *tables[3:5])  # without the separate transformer only the MLP can be judged
    assert [verdicts.find(claim) is None for claim in claims_of] == [False, True, True]


def calql_results(results, ends, curves, minutes=None, load=2.0):
    """`ends`: recipe -> mean final success; `curves`: recipe -> success at each online evaluation; `load` on 2 cores."""
    spread = 0.02 * np.array([-1, 1, 0])
    tables = {r: runs(r, end + spread, train_minutes=(minutes or {}).get(r, 5.0), load_average=load, cores=2) for r, end in ends.items()}
    noise = {r: spread * (-1 if r == "calql_a" else 1) for r in curves}  # or else it would cancel seed by seed
    lines = pd.concat([curve(r, first + noise[r], last + noise[r]) for r, (first, last) in curves.items()])
    offline = lines.groupby(["recipe", "seed"], as_index=False).first().assign(step=0, success_once=1.0)  # must not count
    write(results, "calql", *[t for r, t in tables.items() if r.startswith("calql_")], curves=pd.concat([lines, offline]))
    board = {r: t for r, t in tables.items() if not r.startswith("calql_")}
    ways = [t[["task", "recipe", "seed"]].assign(step=8_000, success_once=t.decorated_success) for t in board.values()]
    write(results, "leaderboard", *board.values(), runs("policy_decorator", [1, 1, 1]), curves=pd.concat(ways) if ways else None)


@pytest.mark.parametrize("a, b, c, negative, online", [
    ((0.5, 0.9), (0.2, 0.6), (0.6, 0.95), "reproduced", "reproduced"),  # C is even ahead of B: a gain is no cost
    ((0.5, 0.9), (0.5, 0.9), (0.4, 0.85), "not", "partly"),  # cheap, but C stays below 90 %
    ((0.5, 0.9), (0.4, 0.77), (0.1, 0.5), "partly", "not")])
def test_negative_data_and_sac_online(results, a, b, c, negative, online):
    calql_results(results, {"calql_a": a[1], "calql_b": b[1], "calql_c": c[1]}, {"calql_a": a, "calql_b": b, "calql_c": c})
    first, second = (verdicts.find(claim) for claim in starting("Cal-QL depends strongly", "SAC in place of Cal-QL online costs"))
    assert (first.verdict, second.verdict) == (negative, online)
    assert f"{100 * sum(a) / 2:.1f} %" in first.measured and f"C ends at {100 * c[1]:.1f} %" in second.measured


def test_what_cal_ql_saves_and_what_its_actor_is(results):
    starts = ("A critic pre-trained by Cal-QL", "SAC in place of Cal-QL online saves", "A large GPT actor", "A pre-trained BeT actor")

    def verdicts_of(e, tuned, c, d, slower, load=2.0):
        calql_results(results, {"calql": e, "sac_finetune": tuned, "calql_b": 0.5, "calql_c": c, "calql_d": d}, {"calql_b": (0.1, 0.2)},
                      {"calql_b": 5.0 * slower}, load)
        return [verdicts.find(claim) for claim in starting(*starts)]

    found = verdicts_of(e=0.4, tuned=0.4, c=0.9, d=0.2, slower=2.0)
    assert [f.verdict for f in found] == ["reproduced"] * 4 and "2.00 times" in found[1].measured
    assert found[3].command.count("data/sweeps/") == 2 and found[0].command == "pdkit sweep data/sweeps/leaderboard.toml"
    assert [f.verdict for f in verdicts_of(e=0.6, tuned=0.4, c=0.2, d=0.9, slower=1.1)] == ["not"] * 4
    assert [f and f.verdict for f in verdicts_of(e=0.6, tuned=0.4, c=0.2, d=0.9, slower=1.1, load=4.0)] == ["not", None, "not", "not"]


def test_where_cal_ql_loses_and_what_its_queries_cost(results):
    """A above E on Adroit; and an update with a transformer for an actor against one of SAC."""
    gap, cost, slower = starting("The difference between Cal-QL's published", "Querying the actor", "SAC in place of Cal-QL online saves")
    for e, verdict in ((0.1, "reproduced"), (0.95, "not")):
        calql_results(results, {"calql": e, **{f"calql_{letter}": 0.8 for letter in "abcd"}}, {"calql_b": (0.1, 0.2)})
        found = verdicts.find(gap)
        assert (found.verdict, found.tasks) == (verdict, "Door") and f"C 80.0 %, D 80.0 %, E {100 * e:.1f} %" in found.measured
        assert found.command.endswith("pdkit sweep data/sweeps/leaderboard.toml")
    assert "4 sampled actions of each kind" in verdicts.find(slower).measured
    for ratio, verdict in ((3.0, "reproduced"), (1.5, "not")):
        seconds = {"seconds.transformer.Cal-QL": 0.1 * ratio, "seconds.transformer.SAC": 0.1, "seconds.small MLP.Cal-QL": 1.2,
                   "seconds.small MLP.SAC": 0.1}
        rows = pd.DataFrame([{"task": "Door", "recipe": "calql_losses", "seed": seed, "command": "x"} | seconds for seed in range(3)])
        write(results, "calql_losses", rows)
        assert verdicts.find(cost).verdict == verdict and f"{ratio:.2f} times" in verdicts.find(cost).measured
        assert "12.0 times where it is a small MLP" in verdicts.find(cost).measured


def test_cal_ql_is_judged_on_adroit_where_it_was_run(results):
    """F.3 explains results there; StackCube stands beside it."""
    [claim] = starting("Cal-QL depends strongly")
    lines = pd.concat([curve("calql_a", [0.9] * 3, [0.9] * 3), curve("calql_b", [0.2] * 3, [0.2] * 3)])
    write(results, "calql", runs("calql_a", [0.9] * 3), runs("calql_b", [0.2] * 3), curves=lines)
    cube = pd.concat([curve("calql_a", [0.1] * 3, [0.1] * 3), curve("calql_b", [0.9] * 3, [0.9] * 3)]).assign(task="StackCube")
    write(results, "calql_stackcube", *(runs(f"calql_{letter}", [0.5] * 3, task="StackCube") for letter in "ab"), curves=cube)
    found = verdicts.find(claim)
    assert (found.verdict, found.tasks) == ("reproduced", "Door") and "not judged: StackCube -80.0" in found.measured


def test_versatile_is_every_kind_and_a_backbone_is_compared_by_its_way(results):
    versatile, backbone = starting("Policy Decorator is versatile", "SAC is a more sample-efficient")
    mlp, cnn = (runs(name, [0.9, 0.8, 0.85], task="StackCube", base=0.4) for name in ("mlp", "cnn"))
    for third, verdict in (([0.6, 0.7, 0.65], "reproduced"), ([0.3, 0.2, 0.3], "partly"), ([0.9], "reproduced")):
        write(results, "base_policies", mlp, cnn, runs("diffusion", third, task="StackCube", base=0.4))
        assert verdicts.find(versatile).verdict == verdict
    write(results, "base_policies", mlp)
    assert verdicts.find(versatile) is None
    for sac, verdict in (([0.8, 0.9, 0.85], "reproduced"), ([0.1, 0.2, 0.1], "not")):
        lines = pd.concat([curve("policy_decorator", sac, sac), curve("ppo_decorator", [0.4, 0.5, 0.4], [0.4, 0.5, 0.4])])
        write(results, "leaderboard", runs("policy_decorator", [0.9] * 3), runs("ppo_decorator", [0.9] * 3), curves=lines)
        assert verdicts.find(backbone).verdict == verdict


def test_what_a_lesson_cannot_reach_stays_untested():
    [claim] = starting("Cal-QL in its original setting")
    assert verdicts.find(claim) is None and CLAIMS.verdict[CLAIMS.claim == claim].item() == "untested"


@pytest.mark.parametrize(("late", "scatter", "verdict"), [
    ((0.9, 0.9), 0.02, None), ((0.75, 0.9), 0.02, None), ((0.7, 0.7), 0.02, "partly"), ((0.5, 0.5), 0.2, "partly")])
def test_a_longer_run_of_cal_ql_is_unstable_where_its_last_third_is_worse(results, late, scatter, verdict):
    """Not by a single evaluation, nor by what happened in the first third, and never more than partly: the paper's run is ten times as
    long."""
    steps = [50_000, 100_000, 150_010, 200_000, 250_000, 300_010]
    ways = {"calql_a,n_step=1": late, "policy_decorator": (1.0, 1.0)}
    curves = [pd.DataFrame({"task": "Door", "recipe": recipe, "seed": seed, "step": steps,
                            "success_once": [1.0, 0.2, 0.9, 0.9, *np.add(end, scatter * (seed - 1))]})
              for recipe, end in ways.items() for seed in range(3)]
    write(results, "calql_long", runs("calql_a,n_step=1", [0.5] * 3), runs("policy_decorator", [1.0] * 3), curves=pd.concat(curves))
    [claim] = starting("Cal-QL is unstable when run longer")
    found, told = verdicts.find(claim), verdicts.updated(CLAIMS[CLAIMS.claim == claim]).measured.item()
    assert (found and found.verdict) == verdict
    assert f"300,010 steps: 90.0 % and {50 * sum(late):.1f} %; not judged: the decorator's 90.0 % and 100.0 %" in told
    write(results, "calql_long", runs("calql_a,n_step=1", [0.5] * 3), curves=pd.concat(curves[:3]))  # without the decorator
    assert (found := verdicts.find(claim)) is None or (found.verdict == verdict and "decorator" not in found.measured)
    assert (found is None) == (verdict is None)


def test_an_untested_claim_says_why():
    untested = CLAIMS[CLAIMS.verdict == "untested"]
    assert len(untested) and (untested.measured != "").all()


def test_two_sides_near_0_are_told_as_the_reason(results):
    calql_results(results, {"calql": 0.03, "sac_finetune": 0.02, "calql_b": 0.2}, {"calql_b": (0.1, 0.2)})
    [row] = verdicts.updated(CLAIMS[CLAIMS.claim.str.startswith("A critic pre-trained by Cal-QL")]).itertuples()
    assert row.verdict == "untested" and row.measured == "All sides end near 0: this budget does not tell them apart."


def test_the_shipped_claims_are_what_the_recorded_results_say():
    assert verdicts.updated(CLAIMS).equals(CLAIMS)
    assert set(verdicts.shown(CLAIMS, "E.2").section) == {"E.2"} and len(verdicts.shown(CLAIMS, "G.1")) == 4


@pytest.mark.parametrize(("late", "verdict"), [(0.1, "reproduced"), (0.5, "not"), (0.0, None)])
def test_a_warm_start_is_judged_at_equal_ages_of_the_actor(results, late, verdict):
    """While its actor waits, a warm start loses nothing: what it has at 5,000 and 10,000 steps is no merit. Without is 30 % at 500."""
    def curve(recipe, at):
        return [pd.DataFrame({"task": "Door", "recipe": recipe, "seed": seed, "step": [5_000, 10_000, 15_000, 20_000],
                              "updates": [0, 501, 1_126, 1_751], "success_once": at}) for seed in range(3)]

    first = 0.3 if verdict else 0.0
    curves = [*curve("vanilla", [0.5, first, 0.0, 0.0]), *curve("warm-fixed", [0.5, 0.5, late, 0.0])]
    write(results, "warm_finetuning", runs("vanilla", [0.0] * 3), runs("warm-fixed", [0.0] * 3), curves=pd.concat(curves))
    found = verdicts.find("Fine-tuning without a warm start outperforms fine-tuning with a warm start and a fixed entropy coefficient.")
    if verdict is None:  # both have lost everything by then
        assert found is None
    else:
        assert found.verdict == verdict
        assert f"without {50 * first:.1f} %, with a warm start and a fixed temperature {50 * late:.1f} %" in found.measured


@pytest.mark.parametrize("stack, others, verdict", [
    ({}, {}, "reproduced"),
    ({"runs.warm.loss": 40.0}, {}, "partly"),  # it does not explode on StackCube: 8 times vanilla's
    ({}, {"runs.vanilla.loss": 400.0}, "partly"),  # it does without a warm start, too
    ({}, {"runs.warm.temperature": 1.5}, "partly"),
    ({}, {"runs.warm.temperature": 1.2, "runs.vanilla.temperature": 0.3}, "partly"),  # that it falls without is no rise with one
    ({}, {"runs.warm.loss": 8.0, "runs.warm.temperature": 1.5}, "not")])
def test_a_warm_start_explodes_where_the_critics_loss_does_on_every_task(results, stack, others, verdict):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Warm-starting the critic makes")].item()
    usual = {"runs.warm.temperature": 2.8, "runs.vanilla.temperature": 1.0, "runs.warm.loss": 100.0, "runs.vanilla.loss": 5.0,
             "runs.fixed.loss": 20.0, "runs.warm.q": 120.0, "runs.vanilla.q": 30.0, "rewards_alone": 50.0}
    for name, task, changed in (("warm_start", "Door", others), ("warm_start_stackcube", "StackCube", others | stack)):
        write(results, name, pd.DataFrame({"task": task, "recipe": "x", "seed": range(3)} | usual | changed))
    found = verdicts.find(claim)
    assert found.verdict == verdict and found.tasks == "Door StackCube"


@pytest.mark.parametrize("fixed, verdict", [([40.0, 50.0, 60.0], "reproduced"), ([4.0, 5.0, 6.0], "partly"), ([0.4, 0.5, 0.6], "not")])
def test_a_critic_is_very_unstable_by_its_loss(results, fixed, verdict):
    """Against 1 without a warm start; the largest that a run logs counts."""
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("With a warm start and a fixed entropy coefficient, the training")].item()
    lines = [curve(recipe, [0.0] * 3, [0.0] * 3).assign(critic_loss=lambda rows, top=top: np.where(
        rows.step == 10_000, rows.seed.map(dict(enumerate(top))), 0.1)) for recipe, top in (("warm-fixed", fixed), ("vanilla", [1.0] * 3))]
    write(results, "warm_finetuning", *(runs(recipe, [0.0] * 3) for recipe in ("warm-fixed", "vanilla")), curves=pd.concat(lines))
    assert verdicts.find(claim).verdict == verdict


def test_random_gradients_that_point_apart_on_two_tasks_are_no_noise(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Gradients of a randomly")].item()
    for cosine, other, verdict in ((0.05, -0.05, "reproduced"), (0.6, -0.6, "not"), (-0.3, 0.02, "not")):
        write(results, "unlearning", pd.DataFrame({
            "task": ["Door"] * 3 + ["StackCube"] * 3, "seed": [0, 1, 2] * 2, "drift.random critic": 0.1, "drift.critic learns": 0.2,
            "cosine_random": [cosine, cosine + 0.01, cosine - 0.01] + [other] * 3}))
        assert verdicts.find(claim).verdict == verdict


@pytest.mark.parametrize("ends, verdict", [([0.96] * 9 + [0.9], "reproduced"), ([0.96] * 3 + [0.9], "partly"), ([0.96] + [0.9] * 2, "not")])
def test_most_seeds_of_door_reach_nearly_all(results, ends, verdict):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Policy Decorator lifts an imperfect BeT base")].item()
    write(results, "main_job", runs("lesson", ends), runs("lesson", [1.0] * 5, task="Hammer"))
    found = verdicts.find(claim)
    assert found.verdict == verdict and found.tasks == "Door" and found.measured.startswith(f"{ends.count(0.96)} of {len(ends)} seeds")


def test_a_warm_start_lasts_a_whole_number_of_evaluations_and_what_is_compared_learns_alike():
    for name in ("warm_finetuning", "warm_finetuning_stackcube"):
        jobs = {job.labels["recipe"]: job.config for job in make_jobs(load_spec(DATA / "sweeps" / f"{name}.toml"))}
        waits = {recipe: config["critic_warmup"] for recipe, config in jobs.items()}
        assert waits == {"vanilla": 0, "warm-fixed": verdicts.failures.WARM_UPDATES, "warm-learned": verdicts.failures.WARM_UPDATES}
        for config in jobs.values():
            between = config["eval_every"] * config["utd"]
            assert verdicts.failures.WARM_UPDATES % between == 0 and between > 100 and config["lr_decay_from"] == 1.0


# ---- the horizon -----------------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("whole", "late", "verdict"), [(0.1, 0.6, "reproduced"), (0.1, 0.3, "partly"), (0.6, 0.6, "not")])  # base 0.5
def test_a_long_horizon_is_a_factor_where_fine_tuning_fails_on_the_whole_task_alone(results, whole, late, verdict):
    parts = [runs(f"sac_finetune,start_fraction={f}", [end - 0.01, end, end + 0.01]) for f, end in ((0.0, whole), (0.5, 0.4), (0.75, late))]
    write(results, "horizon", *parts, runs("policy_decorator,start_fraction=0.0", [0.9] * 3))
    found = verdicts.find("A long task horizon is a key factor in the failure of fine-tuning baselines.")
    assert (found.verdict, found.tasks, found.seeds) == (verdict, "Door", "0 1 2")
    assert f"SAC fine-tuning 0: {100 * (whole - 0.5):+.1f}, 0.5: -10.0, " in found.measured and "the decorator: 0: +40.0" in found.measured
    assert found.command.endswith("sweeps/horizon.toml")


@pytest.mark.parametrize(("rates", "verdict"), [([0.0, 0.5], "reproduced"), ([0.2, 0.2], "not"), ([0.4, 0.1], "not")])
def test_random_exploration_against_the_horizon(results, rates, verdict):
    columns = {"met.random actions.0": rates[0], "met.random actions.0.5": 0.9, "met.random actions.0.9": rates[1], "met.base.0": 0.7}
    write(results, "exploration", pd.DataFrame({"seed": range(3), "recipe": "exploration", "task": "10"} | columns))
    found = verdicts.find("With a longer horizon, random exploration meets the sparse reward less often.")
    assert found.verdict == verdict and f"0.9: {100 * rates[1]:.1f} %" in found.measured


@pytest.mark.parametrize(("updates", "verdict"), [
    ([[100, 200, 400]] * 3, "reproduced"), ([[100, 90, 400], [100, 200, 400], [100, 200, 400]], "partly"), ([[400, 200, 100]] * 3, "not")])
def test_the_reward_takes_longer_on_a_longer_way(results, updates, verdict):
    rows = pd.DataFrame(updates, columns=[f"updates.1-step.{length}" for length in (5, 10, 40)])
    write(results, "exploration", rows.assign(seed=range(3), recipe="exploration", task="10", **{"updates.5-step.5": 1.0}))
    write(results, "exploration_stackcube", rows.mul(2).assign(seed=range(3), recipe="exploration", task="StackCube"))  # does not count
    found = verdicts.find("With a longer horizon, the sparse reward takes longer to propagate through the trajectory.")
    assert (found.verdict, found.tasks) == (verdict, "Door") and f"40 steps: {rows['updates.1-step.40'].mean():,.0f}" in found.measured


# ---- Diffusion Policy ------------------------------------------------------------------------------------------------

OWN = "policy_decorator,alpha=0.03"


@pytest.mark.parametrize("ends, dipo, lifts, beats, best", [
    ([0.95, 0.96, 0.97], [0.0, 0.0, 0.0], "partly", "partly", "partly"),  # as the paper says, on one of its tasks
    ([0.95, 0.96, 0.97], [0.0, 0.1, 0.0], "partly", "partly", "not"),
    ([0.7, 0.72, 0.71], [0.0, 0.0, 0.0], "partly", "partly", "partly"),
    ([0.3, 0.28, 0.32], [0.6, 0.65, 0.7], "not", "not", "not")])
def test_diffusion_policy_is_judged_by_the_cell_chosen_beforehand(results, ends, dipo, lifts, beats, best):
    write(results, "diffusion_finetuning", *(runs(recipe, values, task="StackCube") for recipe, values in (
        (OWN, ends), ("policy_decorator", [0.1, 0.1, 0.1]), ("dipo", dipo), ("residual_rl", [0.2, 0.1, 0.15]), ("dppo", [0.9, 0.9, 0.9]))))
    claims_ = ("Policy Decorator lifts Diffusion", "With Diffusion Policy bases", "The best baseline that fine-tunes Diffusion")
    found = [verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith(words)].iloc[0]) for words in claims_]
    assert [one.verdict for one in found] == [lifts, beats, best] and found[0].tasks == "StackCube" and "residual_rl" in found[1].measured


def test_diffusion_policy_is_judged_on_both_tasks_that_have_enough_seeds(results):
    """Door's decorator is called otherwise than StackCube's, which counts from three seeds on."""
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Policy Decorator lifts Diffusion")].iloc[0]
    write(results, "diffusion_door", runs("policy_decorator", [0.9, 0.92, 0.94], base=0.2))
    for cube, tasks, start in (([0.5], "Door", "20.0 %"), ([0.5, 0.52, 0.51], "StackCube Door", "40.0 %")):
        write(results, "diffusion_finetuning", runs(OWN, cube, task="StackCube", base=0.6),
              runs("policy_decorator", [0.0] * 3, task="StackCube", base=0.6))
        found = verdicts.find(claim)
        assert found.tasks == tasks and found.measured.startswith(start) and found.command.count("pdkit sweep") == len(tasks.split())
    write(results, "diffusion_tasks", *(runs("policy_decorator", [0.9, 0.92, 0.94], task=task, base=0.1) for task in ("Hammer", "Pen")))
    found = verdicts.find(claim)
    assert found.tasks == "StackCube Door Hammer Pen" and found.measured.startswith("25.0 %") and found.seeds == "0 1 2"


def test_a_method_with_one_seed_on_a_task_is_not_judged_there(results):
    """Three seeds of DIPO on Door and one on StackCube are no four seeds on both."""
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("The best baseline that fine-tunes Diffusion")].iloc[0]
    write(results, "diffusion_door", runs("policy_decorator", [0.9] * 3), runs("dipo", [0.0] * 3))
    write(results, "diffusion_finetuning", runs(OWN, [0.9] * 3, task="StackCube"), runs("dipo", [0.7], task="StackCube"))
    found = verdicts.find(claim)
    assert found.tasks == "Door" and found.seeds == "0 1 2" and "largest of its seeds 0.0 %" in found.measured


def test_dppo_is_compared_on_other_tasks_than_the_papers(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("Policy Decorator on DPPO")].iloc[0]
    tunes = CLAIMS.claim[CLAIMS.claim.str.startswith("DPPO successfully fine-tunes")].item()
    for dppo, tuned in (([0.5, 0.55, 0.6], "partly"), ([0.3, 0.31, 0.32], "not")):
        for other in ("dppo,lora=8", "dppo"):  # the better of both settings counts
            mine = next(name for name in ("dppo,lora=8", "dppo") if name != other)
            write(results, "diffusion_finetuning", runs(OWN, [0.8, 0.82, 0.85], task="StackCube", base=0.4),
                  runs(mine, dppo, task="StackCube", base=0.4), runs(other, [0.1, 0.1, 0.1], task="StackCube", base=0.4))
            named, general = (next(verdicts.updated(CLAIMS[CLAIMS.claim == each]).itertuples()) for each in (claim, tunes))
            assert (named.verdict, named.command, general.verdict) == ("untested", "", tuned)  # not by other tasks than it names
            assert all(mine in each.measured and f"beside them {other} 10.0 %" in each.measured for each in (named, general))
            assert f"{OWN.split(',')[0]} 82.3 %, {mine}" in named.measured and named.measured.count("(Student's t") == 1
    write(results, "diffusion_door", runs("policy_decorator", [0.9] * 3, base=0.2), runs("dppo", [0.1, 0.12, 0.11], base=0.2))
    found = verdicts.find(tunes)  # the better setting of each task, not the one that was run on both
    assert found.tasks == "StackCube Door" and f"{mine} on StackCube, dppo on Door 21.0 %" in found.measured
    (results / "diffusion_door.csv").unlink()
    write(results, "diffusion_finetuning", runs(OWN, [0.8], task="StackCube"), runs("dppo", [0.1], task="StackCube"))
    assert verdicts.find(claim) is None


def test_intervals_in_words_stay_within_what_is_possible():
    assert claims.points(Interval(0.86, 0.609, 1.111)) == "+60.9 to +100.0 points (Student's t over seeds, 95 %)"
    assert claims.points(Interval(-0.826, -1.24, -0.413)).startswith("-100.0 to -41.3 points")
    assert claims.points(Interval(-0.508, -0.508, -0.508)) == "-50.8 points by every seed, whose spread gives no interval"
    assert claims.shares(Interval(0.98, 0.943, 1.017)) == "94.3 % to 100.0 %"
    assert claims.shares(Interval(0.007, -0.012, 0.026)) == "0.0 % to 2.6 %"
