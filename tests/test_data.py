"""The bundled data: complete, unaltered, labelled, and what the lessons say they are."""
import numpy as np
import pandas as pd
import pytest

from pdkit.decorated import load_decorated
from pdkit.demos import sources
from pdkit.doctor import data_files
from pdkit.files import DATA, read_json, sha256
from pdkit.policies import load_policy
from pdkit.tasks import get_task

SHIPPED = {"Door": "agent", "StackCube": "scripted", "TurnFaucet": "scripted"}  # task: who made the demonstrations


def test_every_bundled_file_has_the_recorded_checksum():
    assert read_json(DATA / "checksums.json") == {str(p.relative_to(DATA)): sha256(p) for p in data_files()}


def test_the_repository_stays_small():
    assert sum(p.stat().st_size for p in data_files()) < 60e6  # eight tasks are to come


@pytest.mark.parametrize("task", SHIPPED)
def test_demonstrations_load_and_succeed(task):
    demos = sources.bundled(task)
    assert demos.label == SHIPPED[task] and demos.task == (get_task(task).demo_task or task)
    assert all(e["success"].any() for e in demos.episodes())
    assert demos.command.startswith("pdkit demos")


@pytest.mark.parametrize("task", SHIPPED)
def test_checkpoints_load_and_fit_the_task(task):
    spec = get_task(task)
    base = load_policy(DATA / "checkpoints" / task / "base")
    decorated = load_decorated(DATA / "checkpoints" / task / "decorated")
    assert base.config["obs_dim"] == decorated.base.config["obs_dim"] == spec.obs_dim
    card = read_json(DATA / "checkpoints" / task / "base" / "policy.json")["info"]
    assert card["demos_checksum"] == sources.bundled(task).first(card["demos"]).checksum
    # the decorated policy holds the very base policy that is shipped beside it
    for ours, theirs in zip(base.state_dict().values(), decorated.base.state_dict().values(), strict=True):
        assert ours.equal(theirs)


@pytest.mark.parametrize("card", sorted((DATA / "checkpoints").rglob("decorated.json")), ids=lambda path: "-".join(path.parts[-3:-1]))
def test_every_decorated_checkpoint_loads(card):
    policy = load_decorated(card.parent)
    assert np.isfinite(policy.act(np.zeros((2, policy.window, policy.base.config["obs_dim"]), np.float32))).all()


def test_the_main_jobs_evidence_has_a_row_a_seed_and_a_command_each():
    table = pd.read_csv(DATA / "results" / "main_job.csv")
    needed = ["task", "policy", "seed", "train_minutes", "cores", "env_steps", "updates", "episodes", "base_success", "decorated_success",
              "decorated_success_at_end", "command"]
    assert set(needed) <= set(table.columns)
    door = table[table.task == "Door"]
    assert door.seed.nunique() >= 5 and (door.episodes == 200).all()
    assert table.command.str.startswith("pdkit train decorated").all()
    assert door.base_success.between(0.4, 0.6).all()
    assert ((door.decorated_success >= 0.95) & (door.train_minutes <= 5)).sum() >= 4  # what the README promises
    cubes = table[table.task == "StackCube"]
    assert len(cubes) >= 3 and ((cubes.decorated_success >= 0.9) & (cubes.train_minutes <= 20)).all()
