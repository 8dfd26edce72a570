"""What holds for all tests: nothing is remembered of the code that they name."""

import atexit
import gc
import os
import shutil
import tempfile
from collections.abc import Iterator

import pytest

if "PACE_TEST_STATE" not in os.environ:  # processes that tests start share it
    os.environ["PACE_TEST_STATE"] = os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="pace-state-")
    atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # each core has a process of its own
        os.environ.setdefault(name, "1")

from warm_python import WarmPython, warm_python

from pace_actuators.effects import registry


def pytest_collection_finish() -> None:
    """Let the garbage collector leave alone what was imported and collected: all of it stays."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def warm() -> Iterator[WarmPython]:
    """A ``python`` that starts at once, for tests that start commands."""
    with warm_python() as python:
        yield python


@pytest.fixture
def no_export(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings do not write the policy's own files, which takes ONNX seconds."""
    monkeypatch.setattr("pace_envs.rl.training.export_policy", lambda *_: None)


@pytest.fixture(autouse=True, scope="module")
def _effects_are_forgotten() -> Iterator[None]:
    """Effects that one file of tests registers are not those of the next one in the same process."""
    before = dict(registry._EFFECTS)
    yield
    registry._EFFECTS.clear()
    registry._EFFECTS.update(before)
