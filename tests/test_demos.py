"""The demonstration file: what is damaged, foreign or of wrong shape is refused in one sentence, and nothing is half-written."""
import dataclasses
import json
import os

import numpy as np
import pytest

from pdkit.demos.format import from_episodes, load_demos, save_demos, validate
from pdkit.errors import PdkitError


def episode(length, seed=3):
    rng = np.random.default_rng(length)
    return dict(observations=rng.normal(size=(length + 1, 39)), actions=rng.uniform(-1, 1, (length, 28)),
                success=np.arange(length) == length - 1, seed=seed)


@pytest.fixture
def demos():
    return from_episodes("Door", [episode(5), episode(9)], label="agent", how="made for a test", command="pytest")


def test_round_trip(demos, tmp_path):
    save_demos(demos, tmp_path / "d.safetensors")
    back = load_demos(tmp_path / "d.safetensors")
    assert back.num == 2 and back.label == "agent" and back.checksum == demos.checksum
    one = back.episode(1)
    assert one["observations"].shape == (10, 39) and one["actions"].shape == (9, 28) and one["success"].tolist() == [False] * 8 + [True]
    assert np.array_equal(one["observations"], demos.observations[6:])
    assert back.first(1).num == 1 and len(back.first(1).observations) == 6


def test_truncated_altered_and_foreign_files(demos, tmp_path):
    path = tmp_path / "d.safetensors"
    save_demos(demos, path)
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[-200] ^= 1
    for content in (whole[:-50], whole[:4], b"", bytes(flipped), b"\x80\x04pickle", json.dumps({"a": 1}).encode()):
        path.write_bytes(content)
        with pytest.raises(PdkitError) as error:
            load_demos(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
    with pytest.raises(PdkitError, match="does not exist"):
        load_demos(tmp_path / "none.safetensors")


def test_a_safetensors_file_of_something_else_is_refused(tmp_path):
    from safetensors.numpy import save_file

    save_file({"x": np.zeros(3)}, tmp_path / "x.safetensors")
    with pytest.raises(PdkitError, match="not a pdkit-demos"):
        load_demos(tmp_path / "x.safetensors")


@pytest.mark.parametrize(("change", "says"), [
    (dict(task="Pen"), "shape"), (dict(label="robot"), "label"), (dict(actions=np.full((14, 28), 2.0, np.float32)), "outside"),
    (dict(observations=np.full((16, 39), np.nan, np.float32)), "NaN"), (dict(success=np.zeros(3, bool)), "success"),
    (dict(seeds=np.zeros(5, np.int64)), "seeds"), (dict(lengths=np.array([14, 0])), "empty"), (dict(task="Doors"), "Unknown task"),
])
def test_wrong_contents(demos, change, says):
    with pytest.raises(PdkitError, match=says):
        validate(dataclasses.replace(demos, **change))


def test_episodes_of_the_tests_become_no_file_of_demonstrations(demos, tmp_path):
    for seed, allowed in ((999_999, True), (1_000_000, False), (2_999_999, False), (3_000_000, True)):
        mine, path = dataclasses.replace(demos, seeds=np.array([0, seed])), tmp_path / f"{seed}.safetensors"
        if allowed:
            save_demos(mine, path)
        else:
            with pytest.raises(PdkitError, match="a seed from 1,000,000 to 2,999,999"):
                save_demos(mine, path)
        assert path.exists() == allowed


@pytest.mark.parametrize("num", [0, 3])
def test_asking_for_more_than_there_is(demos, num):
    with pytest.raises(PdkitError, match="num_demos"):
        demos.first(num)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_no_permission(demos, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(PdkitError, match="permission"):
        save_demos(demos, tmp_path / "d.safetensors")


def test_full_disk_keeps_the_old_file(demos, tmp_path, monkeypatch):
    import errno

    import safetensors.numpy

    path = tmp_path / "d.safetensors"
    save_demos(demos, path)
    before = path.read_bytes()

    def full(arrays, target, metadata):
        target.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(safetensors.numpy, "save_file", full)
    with pytest.raises(PdkitError, match="disk is full"):
        save_demos(demos, path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
