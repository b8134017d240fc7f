"""Python calls and files of a steady call of a device: each costs time or readers, and their number is exact."""

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
# Largest number of calls of Python functions, NumPy's included (Python 3.11, 3.12). A step always judges its pose.
MOST_FIELD, MOST_BEAMS, MOST_CAST, MOST_MATCH, MOST_STEP, MOST_BOUND = 63, 63, 60, 246, 178, 90
# Most stays of a call in rooms of the package; successive calls in a room are one stay.
MOST_STAYS = 22
# Most files of the package in a call.
FILES_FIELD, FILES_BEAMS, FILES_CAST, FILES_MATCH, FILES_STEP = 12, 13, 11, 26, 36


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


def files_of(called: list[CodeType]) -> list[Path]:
    """Return the file of the package of each call, in order."""
    files = (Path(code.co_filename) for code in called)
    return [file.relative_to(PACKAGE) for file in files if file.is_relative_to(PACKAGE)]


def stays(called: list[CodeType]) -> list[str]:
    """Return the rooms of the package that a call enters one after the other."""
    return [room for room, _ in itertools.groupby(file.parts[0] for file in files_of(called))]


@pytest.mark.parametrize(
    ("kind", "most", "files"),
    [(gs.LikelihoodFieldModel, MOST_FIELD, FILES_FIELD), (gs.BeamModel, MOST_BEAMS, FILES_BEAMS)],
    ids=["field", "beams"],
)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_steady_call(kind, most, files, precision, needs):
    needs("opencl")
    model = kind(GRID, SCANNER, backend="opencl:pocl", precision=precision)
    poses = POSE + np.random.default_rng(0).normal(0, 0.05, (200, 3))
    for _ in range(40):
        model.log_likelihood(poses, RANGES)
    counts = [calls_of(lambda: model.log_likelihood(poses, RANGES)) for _ in range(3)]
    assert max(counts) <= most and len(set(counts)) == 1, counts
    called = called_by(lambda: model.log_likelihood(poses, RANGES))
    rooms = stays(called)
    assert {"models", "backends"} <= set(rooms) and len(rooms) <= MOST_STAYS, rooms
    assert len(set(files_of(called))) <= files


@pytest.mark.parametrize("what", ["cast", "match"])
def test_a_steady_cast_and_match(what, needs):
    """A cast repeats the program of an earlier one, as models do."""
    needs("opencl")
    caster, poses = gs.RayCaster(GRID, 9.0, backend="opencl:pocl"), np.tile(POSE, (200, 1))
    run, most, files = {
        "cast": (lambda: caster.cast(poses, SCANNER.bearings), MOST_CAST, FILES_CAST),
        "match": (lambda: gs.match_scan(RANGES, RANGES, SCANNER, backend="opencl:pocl"), MOST_MATCH, FILES_MATCH),
    }[what]
    for _ in range(40):
        run()
    called = min((called_by(run) for _ in range(3)), key=len)
    assert len(called) <= most and len(set(files_of(called))) <= files, (len(called), len(set(files_of(called))))


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
    assert min(len(set(files_of(called_by(step)))) for _ in range(5)) <= FILES_STEP
