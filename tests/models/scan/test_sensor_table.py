"""The tabulated beam mixture: values, errors, and classes of readings as in the formula."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from support.oracles import Mixture

import gpusense as gs

RANGE = 4.0
NAN, INF = math.nan, math.inf
PRECISIONS = ("float32", "float64")
WEIGHTS = {"all": (0.7, 0.1, 0.1, 0.1), "no short": (0.8, 0.0, 0.1, 0.1), "no rand": (0.7, 0.2, 0.1, 0.0)}


@functools.cache
def scene() -> tuple[gs.OccupancyGrid, gs.Scanner, np.ndarray]:
    """Return a corridor with expected ranges of 0 to 3.9 m ahead and range_max behind; four beams in each direction."""
    cells = np.zeros((1, 400), int)
    cells[0, -1] = 100
    poses = np.zeros((80, 3))
    poses[:, 0] = np.linspace(1e-3, 3.99, 80)
    poses[:, 1] = 0.005
    return gs.OccupancyGrid(cells, 0.01), gs.Scanner([0.0] * 4 + [math.pi] * 4, RANGE), poses


def model(width: float | None, weights: str = "all", **options: object) -> gs.BeamModel:
    grid, scanner, _ = scene()
    p = gs.BeamParameters(*WEIGHTS[weights], sigma_hit=0.5, lambda_short=0.2)
    return gs.BeamModel(grid, scanner, p, sensor_table=width, **{"backend": "numpy", **options})


def readings(seed: int = 0, count: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, RANGE, count)


def bits(array: np.ndarray) -> np.ndarray:
    return array.view(array.dtype.str.replace("f", "u"))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("width", [1.0, 0.3, 0.01])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_table_holds_the_mixture_at_the_centres_of_bins(width, precision):
    """4 m is no multiple of 0.3 m: the table has 13 bins of 4/13 m."""
    _, _, poses = scene()
    tabulated = model(width, precision=precision)
    cells, mixture = round(RANGE / width), Mixture.of(tabulated.parameters, RANGE)
    middle = (np.arange(cells) + 0.5) * RANGE / cells
    expected = tabulated.expected_ranges(poses)
    column = np.minimum((expected.astype(float) / RANGE * cells).astype(int), cells - 1)
    centre = np.where(expected >= RANGE, RANGE, middle[column])
    last = np.nextafter(np.dtype(precision).type(RANGE), np.dtype(precision).type(0))
    for z in (*readings(1), 0.0, float(last), *(np.arange(1, 4) + 0.001)):
        _, parts = tabulated.log_likelihood(poses, [z] * 8, per_beam=True)
        wanted = mixture.log_densities(middle[min(int(z / RANGE * cells), cells - 1)], centre)
        # If a range is within rounding of a bin's edge, either bin is right.
        place = expected.astype(float) / RANGE * cells
        sure = (np.abs(place - np.round(place)) > 1e-4) | (expected >= RANGE)
        eps = np.finfo(precision).eps
        assert (np.abs(parts - wanted) <= 8 * eps * (1 + np.abs(wanted)))[sure].all() and sure.mean() > 0.9


@pytest.mark.sampled(1, without="warp:cpu")
@pytest.mark.parametrize("specialize", [True, False])
def test_missing_and_max_readings_are_treated_as_the_formula_treats_them(specialize, backend):
    _, _, poses = scene()
    scan = [NAN, INF, 1.0, -1.0, RANGE, -INF, 2.5, RANGE + 1]
    for weights in (WEIGHTS["all"], (0.8, 0.1, 0.0, 0.1)):
        p = gs.BeamParameters(*weights, sigma_hit=0.5, lambda_short=0.2)
        grid, scanner, _ = scene()
        tabulated = gs.BeamModel(grid, scanner, p, backend=backend, sensor_table=0.1, specialize=specialize)
        log_p, parts = tabulated.log_likelihood(poses, scan, per_beam=True)
        assert (parts[:, [0, 3, 5]] == 0).all()
        assert (parts[:, [1, 4, 7]] == np.float32(math.log(p.z_max) if p.z_max else 0)).all()
        _, hits = tabulated.log_likelihood(poses, [1.0] * 4 + [2.5] * 4, per_beam=True)
        assert (parts[:, 2] == hits[:, 2]).all() and (parts[:, 6] == hits[:, 6]).all()
        np.testing.assert_allclose(log_p, parts.astype(float).sum(axis=1), rtol=1e-6)
        assert (tabulated.log_likelihood(poses, [NAN] * 8) == 0).all()


@pytest.mark.sampled(1, without="warp:cpu")
def test_impossible_scans_are_minus_infinity_and_no_others(backend):
    """If all causes are unexpected obstacles, a reading beyond the expected range's bin is impossible."""
    grid, scanner, poses = scene()
    p = gs.BeamParameters(0.0, 0.9, 0.1, 0.0, lambda_short=0.2)
    for precision in PRECISIONS:
        tabulated = gs.BeamModel(grid, scanner, p, backend=backend, precision=precision, sensor_table=0.25)
        expected = tabulated.expected_ranges(poses)
        column = np.where(expected >= RANGE, 16, np.minimum((expected * np.float32(4)).astype(int), 15))
        for seed in range(5):
            z = readings(seed) * 0.7
            log_p, parts = tabulated.log_likelihood(poses, z, per_beam=True)
            impossible = (z * 4).astype(int) > column
            np.testing.assert_array_equal(np.isneginf(parts), impossible)
            np.testing.assert_array_equal(np.isneginf(log_p), impossible.any(axis=1))
            assert not np.isnan(log_p).any() and 0 < np.count_nonzero(np.isneginf(log_p)) < len(poses)
            assert (tabulated.log_likelihood(poses, z)[~impossible.any(axis=1)] == log_p[np.isfinite(log_p)]).all()


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("weights", WEIGHTS)
def test_every_backend_has_the_bits_of_numpy_with_and_without_specialisation(weights, precision, backend):
    """Expected ranges have the same bits on every backend; the rest is look-ups and sums in a fixed order."""
    _, _, poses = scene()
    for seed, options in ((0, {}), (1, {"temperature": 0.3}), (2, {"beams": 3})):
        z = readings(seed)
        reference = model(0.05, weights, precision=precision, **options).log_likelihood(poses, z, per_beam=True)
        for specialize in (True, False):
            tabulated = model(0.05, weights, precision=precision, backend=backend, specialize=specialize, **options)
            for found, wanted in zip(tabulated.log_likelihood(poses, z, per_beam=True), reference, strict=True):
                np.testing.assert_array_equal(bits(found), bits(wanted))
