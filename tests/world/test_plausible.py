"""Legal but implausible values are used unchanged, with one warning that names the likely cause."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

import gpusense as gs

BEARINGS = np.linspace(-math.pi / 2, math.pi / 2, 19)
RANGES = np.linspace(1.0, 6.0, 19)
CELLS = np.pad(np.zeros((118, 158), np.int8), 1, constant_values=100)
GRID = gs.OccupancyGrid(CELLS, 0.05)
POSES = np.array([(2.0, 2.0, 0.3)])


@contextmanager
def warns_once(text: str) -> Iterator[None]:
    """Check that one warning comes, at a line of this file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    assert [one.category for one in caught] == [gs.PlausibilityWarning], [str(one.message) for one in caught]
    assert text in str(caught[0].message) and caught[0].filename == __file__


@pytest.fixture
def no_warning() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", gs.PlausibilityWarning)
        yield


def scanner(**changes: float) -> gs.Scanner:
    return gs.Scanner(BEARINGS, **(dict(range_max=12.0) | changes))


def model(one: gs.Scanner | None = None, grid: gs.OccupancyGrid = GRID) -> gs.LikelihoodFieldModel:
    return gs.LikelihoodFieldModel(grid, scanner() if one is None else one, backend="numpy")


# ------------------------------------------------------------------------------------------------- geometry


def test_bearings_in_degrees() -> None:
    with warns_once("bearings: span 180 rad, more than a turn: are they in degrees?"):
        assert gs.Scanner(np.degrees(BEARINGS), 12.0).count == 19
    with warns_once("bearings: span 271.5 rad"):
        gs.Scanner.uniform(angle_min=-135.75, angle_increment=0.25, count=1087, range_max=30.0)
    with warns_once("are they in degrees?"):
        gs.RayCaster(GRID, 12.0, backend="numpy").cast(POSES, np.degrees(BEARINGS))
    with warns_once("are they in degrees?"):
        gs.triangulate([(0.0, 0.0), (4.0, 0.0), (0.0, 3.0)], [-170.0, 20.0, 100.0])
    landmarks = gs.LandmarkModel(gs.LandmarkMap([(2.0, 0.0), (0.0, 3.0)]), backend="numpy")
    with warns_once("features: bearings: span 100 rad"):
        landmarks.log_likelihood(POSES, [(1.5, -10.0), (1.0, 90.0)])
        landmarks.log_likelihood(POSES, [(1.5, -10.0), (1.0, 90.0)])


@pytest.mark.usefixtures("no_warning")
def test_bearings_of_recorded_lasers_are_quiet() -> None:
    for first, step, count in ((-math.pi, 2 * math.pi / 360, 361), (0.0, 2 * math.pi / 1440, 1440),
                               (math.pi, -2 * math.pi / 720, 721), (0.0, 2 * math.pi / 3, 4)):  # fmt: skip
        gs.Scanner.uniform(angle_min=first, angle_increment=step, count=count, range_max=30.0)
    gs.Scanner(np.float32(2 * np.pi) * np.arange(361, dtype=np.float32) / 360, 5.0)
    gs.Scanner([], 5.0), gs.Scanner([5.0], 5.0, mount=(0.9, -0.2, -math.pi))
    gs.OccupancyGrid(CELLS, 1.0, (5e6, 5e6, 3.0))
    gs.LikelihoodFieldModel(gs.OccupancyGrid([[0, 100]], 0.05), scanner(range_max=81.91), backend="numpy")


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: scanner(range_max=30000.0), "range_max: is 30000 m, farther than a range scanner sees"),
        (lambda: gs.Scanner(BEARINGS, 12.0, mount=(200.0, 0.0, 0.0)), "mount: is 200 m from the robot's centre"),
        (lambda: gs.Scanner(BEARINGS, 12.0, mount=(0.2, 0.0, 90.0)), "mount: has a heading of 90 rad"),
        (lambda: model(scanner(range_max=8000.0)), "range_max: is 8000 m in a map of 10 m from corner to corner"),
        (lambda: gs.RayCaster(GRID, 8000.0, backend="numpy"), "range_max: is 8000 m in a map of 10 m"),
        (lambda: gs.OccupancyGrid(CELLS, 5.0), "resolution: is 5 m, the side of a cell: is it in centimetres"),
        (lambda: gs.OccupancyGrid(CELLS, 0.05, (0.0, 0.0, 90.0)), "origin: has a heading of 90 rad"),
    ],
)
def test_geometry_in_other_units(make, text) -> None:
    with warns_once(text):
        make()


# ------------------------------------------------------------------------------------------------- readings


def test_negative_readings_are_missing_with_one_warning() -> None:
    some = np.where(np.arange(19) == 4, -1.0, RANGES)
    one = model()
    with warns_once("ranges: negative readings are missing readings, which say nothing (0 nats)"):
        first = one.log_likelihood(POSES, some)
        for _ in range(3):
            one.log_likelihood(POSES, some)
    np.testing.assert_array_equal(first, one.log_likelihood(POSES, np.where(some < 0, np.nan, some)))


@pytest.mark.parametrize("zeros", [3, 8, 19])
def test_readings_of_exactly_0(zeros: int) -> None:
    some = np.where(np.arange(19) < zeros, 0.0, RANGES)
    text = f"ranges: {zeros} of 19 readings are exactly 0, a range of 0 m: a scanner's code for no return or an error?"
    one = model()
    with warns_once(text):
        for _ in range(3):
            one.log_likelihood(POSES, some)
    with warns_once(text), contextlib.suppress(ValueError):
        gs.match_scan(some, some, scanner(), backend="numpy")
    with warns_once(text.replace("19", "171").replace(f": {zeros}", f": {9 * zeros}")):
        gs.fit_beam_parameters(np.tile(some, 9), np.tile(RANGES, 9), 12.0, backend="numpy")


@pytest.mark.usefixtures("no_warning")
def test_readings_of_0_below_range_min_are_quiet() -> None:
    model(scanner(range_min=0.1)).log_likelihood(POSES, np.zeros(19))
    one = np.where(np.arange(19) < 9, 0.0, RANGES)
    gs.fit_beam_parameters(np.tile(one, 9), np.tile(RANGES, 9), 12.0, range_min=0.1, backend="numpy")


def test_readings_in_millimetres() -> None:
    for one in (scanner(), scanner(range_max=1000.0)):
        with warns_once("are they in millimetres? Metres are meant"):
            model(one).log_likelihood(POSES, 1000 * RANGES + 500)
    with warns_once("ranges: most readings are far beyond range_max = 12 m"):
        gs.match_scan(1000 * RANGES, 1000 * RANGES, scanner(), backend="numpy")
    none = pytest.raises(ValueError, match="scans: must have a range, got none")
    with warns_once("scans: most readings are far beyond"), none:
        gs.build_map([1000 * RANGES], POSES, scanner(), resolution=0.5, backend="numpy")
    with warns_once("ranges: most readings are far beyond"):
        gs.locate_scan(model(), 1000 * RANGES, resolution=1.0, angle=1.0)
    with warns_once("ranges: most readings are far beyond"):
        gs.fit_beam_parameters(1000 * np.tile(RANGES, 9), np.tile(RANGES, 9), 12.0, backend="numpy")


@pytest.mark.usefixtures("no_warning")
def test_ordinary_readings_are_quiet() -> None:
    for readings in (
        RANGES, np.full(19, np.nan), np.full(19, np.inf), np.full(19, -np.inf), np.full(19, 655.35),
        np.where(np.arange(19) < 2, 0.0, RANGES),
        np.where(np.arange(19) < 9, 8191.0, RANGES), np.where(np.arange(19) < 18, np.nan, 24.8), 2 * RANGES + 12,
    ):  # fmt: skip
        model().log_likelihood(POSES, readings)
        gs.match_scan(readings, RANGES, scanner(), backend="numpy")
    model(gs.Scanner([], 12.0)).log_likelihood(POSES, [])


def test_scans_cost_nothing_once_some_were_looked_at(monkeypatch) -> None:
    from gpusense.world import plausible

    looked = []
    monkeypatch.setattr(plausible, "look_at_readings", lambda *_: looked.append(1))
    one = model()
    for _ in range(100):
        one.log_likelihood(POSES, np.full(19, 20.0))
    assert len(looked) == 32


# ------------------------------------------------------------------------------------------------- start


def start(*pose: float, at: gs.LikelihoodFieldModel | gs.PositionModel | None = None) -> np.ndarray:
    pf = gs.ParticleFilter(model() if at is None else at, particles=50, seed=0)
    pf.initialize(mean=pose, covariance=np.diag([0.01, 0.01, 0.01]))
    return pf.host_particles()


def test_a_start_that_cannot_be_meant() -> None:
    with warns_once("start: (40, 2) m lies outside the map, which has x from 0 to 8 m and y from 0 to 6 m"):
        assert abs(start(40.0, 2.0, 0.0)[:, 0].mean() - 40) < 1
    with warns_once("start: has a heading of 90 rad, more than a turn: is it in degrees?"):
        start(2.0, 2.0, 90.0)
    with warns_once("start: has a heading of 90 rad"):
        start(1e6, 0.0, 90.0, at=gs.PositionModel(gs.PositionParameters(sigma=0.1), backend="numpy"))


@pytest.mark.usefixtures("no_warning")
def test_ordinary_starts_are_quiet() -> None:
    turned = gs.OccupancyGrid(CELLS, 0.05, (5e6, -3.0, 2.0))
    x, y = turned.cell_centers([60], [80])[0]
    start(x, y, 6.28, at=model(grid=turned))
    start(0.0, 0.0, -math.pi)
    start(1e6, 0.0, 0.0, at=gs.PositionModel(gs.PositionParameters(sigma=0.1), backend="numpy"))


@pytest.mark.parametrize(
    ("factor", "offset", "warned"), [(1, 0, False), (1, 40, False), (180 / np.pi, 0, True), (1e5, 0, False)]
)
@pytest.mark.parametrize("given", [np.asarray, np.ndarray.tolist])
@pytest.mark.parametrize("kind", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_headings_that_spread_like_degrees_are_named(kind, given, factor, offset, warned):
    """Unwrapped and huge headings are legal; degrees spread over many turns, none of them far from 0."""
    model = kind(gs.worlds.building(), gs.Scanner([-0.5, 0.5], range_max=9.0), backend="numpy")
    poses = gs.worlds.cloud_uniform(model.grid, 50, np.random.default_rng(0))
    poses[:, 2] = factor * poses[:, 2] + offset
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.log_likelihood(given(poses), [1.0, 2.0])
    assert [str(one.message)[:41] for one in caught] == ["poses: have headings over more than four "] * warned
