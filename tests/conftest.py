"""What every test may use: a seeded generator, the motor plant, the real records where they are."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from real_cases import real_folder

os.environ.setdefault("MPLBACKEND", "Agg")  # figures without a display, for processes started by tests too

from motorid.records.datasets import load_plant

LONG = ("notebooks", "real_records", "remainder", "data/test_data", "diagnosis", "bench", "shooting", "recovered")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files whose tests take long: none is to run alone at the end while other workers wait."""
    items.sort(key=lambda item: next((k for k, word in enumerate(LONG) if word in item.nodeid.split("::")[0]), 99))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Let idle workers take over what others have before them: xdist's default deals out long tests in one heap."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.getoption("dist") == "load" else None


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more worker than cores: the bench's tests wait for their motor, others for processes that they start."""
    return (os.cpu_count() or 1) + 1


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed, new for every test."""
    return np.random.default_rng(20240611)


@pytest.fixture(scope="session")
def plant():
    """The independent motor plant (data/plant), which shares no code with the models."""
    return load_plant()


@pytest.fixture(scope="session")
def lab(plant):
    """The plant's motor of a teaching bench."""
    return plant.MOTORS["lab"]


@pytest.fixture(scope="session")
def real() -> Path:
    """Folder of the real records; the test is skipped where it is absent."""
    folder = real_folder()
    if folder is None:
        pytest.skip("the real records are not on this machine (set MOTORID_REAL_DATA to their folder)")
    return folder
