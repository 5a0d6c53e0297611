"""Fixtures that every room's tests may use."""

import gc
import os
from pathlib import Path

import hypothesis
import numpy as np
import pytest

# How long one example takes says more of what else the machine does than of the code.
hypothesis.settings.register_profile("calgraph", deadline=None, max_examples=60)
hypothesis.settings.load_profile("calgraph")

# No test takes detections of another one, nor writes into the cache of whoever runs them; commands inherit it.
os.environ["CALGRAPH_CACHE"] = "off"


def pytest_collection_finish() -> None:
    """Garbage is not looked for among the thousands of tests, which also stay shared with forked processes."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20150713)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings; tests that need it skip where it is missing."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("CALGRAPH_DATA", beside))
    if not path.is_dir():
        pytest.skip(f"real recordings are not at {path}; set CALGRAPH_DATA to their folder")
    return path
