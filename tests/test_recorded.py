"""Recorded results: what is read back from data/results."""
import pandas as pd
import pytest

from pdkit import recorded
from pdkit.errors import PdkitError


def test_rows_and_curves_of_one_task_are_loaded(results):
    rows = pd.DataFrame({"task": ["Door", "Door", "Pen"], "recipe": "a", "seed": [0, 1, 0], "decorated_success": [0.5, 0.7, 0.1]})
    rows.to_csv(results / "x.csv", index=False)
    assert recorded.load("x")[1].empty
    rows.drop(columns="decorated_success").assign(step=10).to_csv(results / "x_curves.csv", index=False)
    table, curves = recorded.load("x", "Door")
    assert table.seed.tolist() == [0, 1] == curves.seed.tolist() and len(recorded.load("x")[1]) == 3


def test_what_is_not_recorded_is_said_with_the_command_that_makes_it(results):
    with pytest.raises(PdkitError, match="No results 'x' are recorded.*pdkit sweep data/sweeps/x.toml"):
        recorded.load("x")
    pd.DataFrame({"task": ["Pen"], "recipe": "a", "seed": 0}).to_csv(results / "x.csv", index=False)
    with pytest.raises(PdkitError, match="No results 'x' of Door"):
        recorded.load("x", "Door")


def test_a_notebooks_columns_become_rows_by_arm():
    table = pd.DataFrame({"seed": [0, 1], "success.before.value": [0.9, 0.8], "success.random critic, 2.value": [0.1, None],
                          "success.before.low": 0.0, "successes.x.value": 1.0})
    rows = recorded.by_arm(table, "success", "value", "success")
    assert rows.to_dict("records") == [{"recipe": "before", "seed": 0, "success": 0.9},
                                       {"recipe": "random critic, 2", "seed": 0, "success": 0.1},
                                       {"recipe": "before", "seed": 1, "success": 0.8}]
    with pytest.raises(PdkitError, match="no columns drift.ARM.value"):
        recorded.by_arm(table, "drift", "value", "drift")
