"""Verdicts are computed from recorded results, by rules that can go either way."""
import numpy as np
import pandas as pd
import pytest

from pdkit import claims, recorded, report, verdicts
from pdkit.files import DATA
from pdkit.stats import Interval

CLAIMS = report.load_claims(DATA / "results" / "claims.csv")


@pytest.fixture
def results(tmp_path, monkeypatch):
    monkeypatch.setattr(recorded, "DATA", tmp_path)
    (tmp_path / "results").mkdir()
    return tmp_path / "results"


def runs(recipe, ends, *, task="Door", base=0.5, **columns):
    """Rows of a recipe with these final successes, a seed each."""
    rows = {"task": task, "recipe": recipe, "seed": range(len(ends)), "decorated_success": ends, "base_success": base}
    return pd.DataFrame(rows | columns)


def write(folder, name, *tables, curves=None):
    pd.concat(tables).to_csv(folder / f"{name}.csv", index=False)
    if curves is not None:
        curves.to_csv(folder / f"{name}_curves.csv", index=False)


def test_the_rule_of_a_comparison():
    assert claims.judged(Interval(0.2, 0.1, 0.3)) == "reproduced" == claims.judged(claims.turned(Interval(-0.2, -0.3, -0.1)))
    assert claims.judged(Interval(0.2, -0.1, 0.3)) == "partly"
    assert claims.judged(Interval(-0.2, -0.3, 0.1)) == "not" == claims.judged(Interval(0.0, -0.1, 0.1))
    assert claims.judged(Interval(0.2, 0.1, 0.3), 0.15) == "partly" and claims.judged(Interval(0.2, 0.1, 0.3), 0.25) == "not"


def test_differences_are_taken_seed_by_seed():
    """Seeds differ much, the pairs hardly: unpaired, this interval would reach over zero."""
    table = pd.concat([runs("a", [0.1, 0.5, 0.9, 0.3]), runs("b", [0.05, 0.46, 0.84, 0.26]).iloc[::-1]])
    interval, values = claims.difference(claims.by_seed(table, "a", "decorated_success"), claims.by_seed(table, "b", "decorated_success"))
    assert interval.value == pytest.approx(0.0475) and interval.low > 0.03 and sorted(values.round(3)) == [0.04, 0.04, 0.05, 0.06]


def test_two_seeds_are_no_test(results):
    for ends, known in (([0.9, 0.9], False), ([0.9, 0.9, 0.9], True)):
        write(results, "low_checkpoint", runs("low", ends, base=0.1))
        assert (verdicts.find("Policy Decorator substantially improves a low-performing BeT checkpoint.") is not None) == known


def test_every_rule_belongs_to_one_claim():
    for start in verdicts.MEASURES:
        assert CLAIMS.claim.str.startswith(start).sum() == 1, start
    assert verdicts.find("A claim that nobody made.") is None


def test_without_results_nothing_is_judged(results):
    assert all(verdicts.find(claim) is None for claim in CLAIMS.claim)
    assert verdicts.updated(CLAIMS).equals(CLAIMS)


@pytest.mark.parametrize("ends, verdict", [([0.9, 0.8, 0.85], "reproduced"), ([0.25, 0.15, 0.28], "not"), ([0.5, 0.2, 0.45], "partly")])
def test_a_low_checkpoint_must_rise_by_more_than_20_points(results, ends, verdict):
    write(results, "low_checkpoint", runs("low", ends, base=0.1))
    found = verdicts.find("Policy Decorator substantially improves a low-performing BeT checkpoint.")
    assert (found.verdict, found.tasks, found.seeds) == (verdict, "Door", "0 1 2")
    assert found.command == "pdkit sweep data/sweeps/low_checkpoint.toml" and "10.0 %" in found.measured


def test_a_claim_about_more_tasks_is_partly_reproduced_at_most(results):
    claim = CLAIMS.claim[CLAIMS.claim.str.startswith("With BeT bases")].item()
    tables = [runs("policy_decorator", [1, 0.98, 0.99]), runs("jsrl", [0.7, 0.6, 0.5]), runs("sac_finetune", [0, 0, 0])]
    write(results, "leaderboard", *tables)
    found = verdicts.find(claim)
    assert found.verdict == "partly" and "jsrl" in found.measured and "sac_finetune" in found.measured
    write(results, "leaderboard", *tables, runs("rot", [1, 1, 1]))
    assert verdicts.find(claim).verdict == "not"  # the best of a kind counts
    everywhere = [table.assign(task=task) for table in tables for task in verdicts.EIGHT]
    write(results, "leaderboard", *everywhere)
    assert verdicts.find(claim).verdict == "reproduced"


def curve(recipe, first, last, **columns):
    steps = [10_000, 20_000]
    return pd.concat([pd.DataFrame({"task": "Door", "recipe": recipe, "seed": s, "step": steps, "success_once": [a, b]} | columns)
                      for s, (a, b) in enumerate(zip(first, last, strict=True))])


def test_unlearning_and_relearning(results):
    early = CLAIMS.claim[CLAIMS.claim.str.startswith("Fine-tuning baselines unlearn")].item()
    late = CLAIMS.claim[CLAIMS.claim.str.startswith("Once unlearned")].item()

    def verdict_of(first, ends):
        write(results, "leaderboard", runs("sac_finetune", ends), curves=curve("sac_finetune", first, ends))
        return [found.verdict if (found := verdicts.find(claim)) else None for claim in (early, late)]

    assert verdict_of([0, 0, 0.1, 0, 0], [0, 0.1, 0, 0, 0.2]) == ["reproduced", "reproduced"]
    assert verdict_of([0, 0, 0.1, 0, 0], [0.9, 0.8, 0.9, 0.7, 0.2]) == ["reproduced", "not"]
    assert verdict_of([0.6, 0.5, 0.7, 0.6, 0.5], [0.9, 0.8, 0.9, 0.9, 0.9]) == ["not", None]


def test_residual_rl_early_and_late(results):
    early, late = (CLAIMS.claim[CLAIMS.claim.str.startswith(f"Residual RL fails {when}")].item() for when in ("early", "later"))

    def verdict_of(train, size, ends):
        rows = curve("residual_rl", ends, ends, train_success=train, residual_size=size, base_size=0.4).assign(step=lambda t: t.step / 2)
        write(results, "leaderboard", runs("residual_rl", ends, first_reward_step=7), curves=rows)
        return [verdicts.find(claim).verdict for claim in (early, late)]

    assert verdict_of(0.0, 0.6, [0, 0.1, 0]) == ["reproduced", "reproduced"]
    assert verdict_of(0.0, 0.6, [0.9, 0.8, 0.9]) == ["reproduced", "partly"]  # larger, and yet no harm at the end
    assert verdict_of(0.6, 0.1, [0.9, 0.8, 0.9]) == ["not", "not"]


@pytest.mark.parametrize("start, recipe, limit, sign", [("JSRL gives jerky", "jsrl", 1.1, 1),
                                                        ("A bounded residual keeps", "policy_decorator", 1.25, -1)])
def test_jerk_is_judged_as_a_ratio(results, start, recipe, limit, sign):
    for ratio in (limit * 1.2, limit / 1.2):
        write(results, "leaderboard", runs(recipe, [1, 1, 1], base_jerk=50.0, decorated_jerk=50 * ratio * np.array([0.98, 1, 1.02])))
        found = verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith(start)].item())
        assert found.verdict == ("reproduced" if (ratio > limit) == (sign > 0) else "not")
        assert f"{ratio:.2f} times" in found.measured


@pytest.mark.parametrize("success, lifted, verdicts_of", [([0.5, 0], [0.9, 0.1], ["reproduced", "reproduced"]),
                                                          ([0.5, 0], [0.1, 0.0], ["partly", "reproduced"]),
                                                          ([1, 1], [0.9, 0.9], ["partly", "not"])])
def test_unlearning_the_cube(results, success, lifted, verdicts_of):
    table = pd.DataFrame({"task": "StackCube", "seed": range(5), "success.before.value": [0.9, 1, 0.9, 1, 0.9], "lifted.before": 1.0,
                          "success.random critic, 100.value": success[0], "success.random critic, 200.value": success[1],
                          "lifted.random critic, 100": lifted[0], "lifted.random critic, 200": lifted[1],
                          "cosine_random": [0.01, -0.02, 0, 0.03, -0.01], "drift.random critic": 0.1})
    table.to_csv(results / "unlearning.csv", index=False)
    starts = ("After 100 updates", "After 200 updates", "Gradients of")
    found = [verdicts.find(CLAIMS.claim[CLAIMS.claim.str.startswith(start)].item()).verdict for start in starts]
    assert found == [*verdicts_of, "reproduced"]


def test_the_shipped_claims_are_what_the_recorded_results_say():
    assert verdicts.updated(CLAIMS).equals(CLAIMS)
    assert set(verdicts.shown(CLAIMS, "E.2").section) == {"E.2"} and len(verdicts.shown(CLAIMS, "G.1")) == 4
