"""Python calls in a steady call of a device: each costs time, and their number is exact."""

from __future__ import annotations

import gc
import itertools
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import CodeType

import numpy as np
import pytest
from support.tracking_scene import GRID

import gpusense as gs

SCANNER = gs.Scanner(np.linspace(-np.pi / 2, np.pi / 2, 60), range_max=9.0)
POSE = np.array([4.0, 3.0, 0.3])
RANGES = gs.RayCaster(GRID, 9.0, backend="numpy").cast(POSE[None], SCANNER.bearings)[0]
PACKAGE = Path(gs.__file__).parent
# Largest number of calls of Python functions, NumPy's included, with Python 3.11. A step always judges its pose.
MOST_FIELD, MOST_BEAMS, MOST_STEP, MOST_BOUND = 80, 90, 225, 90
# Most stays of a call in rooms of the package; successive calls in a room are one stay.
MOST_STAYS = 22


@pytest.fixture(autouse=True)
def unwatched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not poll for the ends of launches, since the number of polls depends on the machine."""
    if find_spec("pyopencl") is not None:
        monkeypatch.setattr("gpusense.backends.opencl.backend.watch", lambda event: None)


def called_by(run: Callable[[], object]) -> list[CodeType]:
    """Return the Python functions that a function calls, in order, without garbage collection of other tests'
    objects.
    """
    called: list[CodeType] = []
    gc.disable()
    sys.setprofile(lambda frame, event, argument: called.append(frame.f_code) if event == "call" else None)
    try:
        run()
    finally:
        sys.setprofile(None)
        gc.enable()
    return called[:-1]


def calls_of(run: Callable[[], object]) -> int:
    """Return the number of Python functions that a function calls."""
    return len(called_by(run))


def stays(called: list[CodeType]) -> list[str]:
    """Return the rooms of the package that a call enters one after the other."""
    files = (Path(code.co_filename) for code in called)
    rooms = (file.relative_to(PACKAGE).parts[0] for file in files if file.is_relative_to(PACKAGE))
    return [room for room, _ in itertools.groupby(rooms)]


@pytest.mark.parametrize(
    ("kind", "most"), [(gs.LikelihoodFieldModel, MOST_FIELD), (gs.BeamModel, MOST_BEAMS)], ids=["field", "beams"]
)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_steady_call(kind, most, precision, needs):
    needs("opencl")
    model = kind(GRID, SCANNER, backend="opencl:pocl", precision=precision)
    poses = POSE + np.random.default_rng(0).normal(0, 0.05, (200, 3))
    for _ in range(40):
        model.log_likelihood(poses, RANGES)
    counts = [calls_of(lambda: model.log_likelihood(poses, RANGES)) for _ in range(3)]
    assert max(counts) <= most and len(set(counts)) == 1, counts
    rooms = stays(called_by(lambda: model.log_likelihood(poses, RANGES)))
    assert {"models", "backends"} <= set(rooms) and len(rooms) <= MOST_STAYS, rooms


def test_a_bound_call(needs):
    needs("opencl")
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend="opencl:pocl")
    call = model.bind(np.tile(POSE, (200, 1)), RANGES.copy())
    for _ in range(40):
        call()
    assert calls_of(call) <= MOST_BOUND


@pytest.mark.parametrize("recovery", [None, "sensor"])
def test_a_step_of_a_filter(recovery, needs):
    """The bound is for the median: some steps check the spread of particles, learn the temperature, or judge."""
    needs("opencl")
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend="opencl:pocl")
    pf = gs.ParticleFilter(model, particles=500, seed=1, recovery=recovery)
    pf.initialize(mean=POSE, covariance=np.diag([0.01, 0.01, 0.002]))

    def step() -> None:
        pf.predict((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        pf.correct(RANGES)

    for _ in range(75):
        step()
    counts = [calls_of(step) for _ in range(21)]
    assert np.median(counts) <= MOST_STEP, counts
