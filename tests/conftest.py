"""Shared by all tests: one thread, results in a temporary folder, and the option --slow."""
import os

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"  # before torch and numpy load

import pytest  # noqa: E402


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="also run the tests that take minutes")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--slow"):
        return
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="takes minutes; run with --slow"))


@pytest.fixture(autouse=True, scope="session")
def _results_elsewhere(tmp_path_factory):
    """Tests, and the processes they start, never write into the user's runs/."""
    before = os.environ.get("PDKIT_RUNS")
    os.environ["PDKIT_RUNS"] = str(tmp_path_factory.mktemp("runs"))
    yield
    if before is None:
        del os.environ["PDKIT_RUNS"]
    else:
        os.environ["PDKIT_RUNS"] = before


@pytest.fixture
def results(tmp_path, monkeypatch):
    """An empty data/results in a temporary folder, from which recorded results are then read."""
    from pdkit import recorded

    monkeypatch.setattr(recorded, "DATA", tmp_path)
    (tmp_path / "results").mkdir()
    return tmp_path / "results"
