"""The beam model's mixture against mpmath on a stiff grid, and its mass."""

from __future__ import annotations

import itertools
import math

import mpmath as mp
import numpy as np
import pytest
from support.beam_world import PRECISIONS, exact_log_density, parameters
from support.oracles import Mixture
from support.selection import on_every_backend

import gpusense as gs
from gpusense.reference.mixture import log_density

BOUND = 16  # eps (1 + |log p|) of one reading
WEIGHTS = {
    "all": (0.7, 0.1, 0.1, 0.1),
    "hit": (1.0, 0.0, 0.0, 0.0),
    "short": (0.0, 1.0, 0.0, 0.0),
    "rand": (0.0, 0.0, 0.0, 1.0),
    "hit and short": (0.5, 0.5, 0.0, 0.0),
    "hit and rand": (0.5, 0.0, 0.0, 0.5),
    "short and rand": (0.0, 0.5, 0.0, 0.5),
    "little rand": (0.5, 0.25, 0.25, 2.0**-90),
    "hardly any rand": (0.5, 0.25, 0.25, 2.0**-110),
}
SIGMAS = (1e-8, 1e-4, 1e-2, 0.3, 10.0, 1e6)  # of range_max
RATES = (0.0, 1e-12, 1e-3, 1.0, 30.0, 1e6)  # times range_max
RANGE_MAX = (1.0, 80.0)


def readings_around(expected: float, p: gs.BeamParameters, range_max: float, real: np.dtype) -> np.ndarray:
    """Return critical readings for an expected range: the ends, z* and neighbours, deviations and decay lengths."""
    top, last = real.type(range_max), np.nextafter(real.type(range_max), real.type(0))
    z = real.type(expected)
    beside = [0.0, z, np.nextafter(z, real.type(0)), np.nextafter(z, top), last, range_max / 3, expected / 2]
    away = [expected + sign * u * p.sigma_hit for sign in (-1, 1) for u in (0.3, 1.0, 3.0, 5.9, 12.0, 37.0)]
    decay = [1 / p.lambda_short, 13 / p.lambda_short] if p.lambda_short else [0.1 * range_max]
    with np.errstate(over="ignore"):
        return np.clip(np.array([*beside, *away, *decay]), 0, last).astype(real)


def error_in_eps(found: float, mixture: Mixture, z: float, expected: float, eps: float) -> float:
    """Return the error over eps (1 + |log p|); infinite if only one value is infinite, or for NaN."""
    truth = exact_log_density(mixture, float(z), float(expected))
    if mp.isinf(truth) or not math.isfinite(found):
        return 0.0 if truth == -mp.inf and found == -math.inf else math.inf
    return float(abs(mp.mpf(float(found)) - truth) / (1 + abs(truth))) / eps


# Three sets of weights reach all of Warp's mixture code.
@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.15)
@on_every_backend(weights=WEIGHTS, on_warp=lambda weights: weights in ("all", "hit and short", "hardly any rand"))
@pytest.mark.parametrize("precision", PRECISIONS)
def test_mixture_on_a_stiff_grid(weights, precision, backend):
    """Score poses in a corridor at chosen distances from its end, with all rays along the corridor."""
    real = np.dtype(precision)
    cells = np.zeros((1, 64), int)
    cells[0, -1] = 100
    columns = np.array([63.5, 63 - 2**-20, 62.99, 60.0, 55.3, 47.5, 47.0000001, 46.9999, 40.0])
    rng = np.random.default_rng([*weights.encode(), len(precision)])
    cases = list(itertools.product(RANGE_MAX, SIGMAS, RATES))
    worst = (0.0, None)
    for i in rng.permutation(len(cases))[:12]:
        range_max, sigma, rate = cases[i]
        p = parameters(precision, range_max, sigma, rate, WEIGHTS[weights])
        grid = gs.OccupancyGrid(cells, range_max / 16)
        poses = np.stack([columns * grid.resolution, np.full(len(columns), grid.resolution / 2), 0 * columns], axis=1)
        caster = gs.RayCaster(grid, range_max, backend=backend, precision=precision)
        expected = caster.cast(poses, [0.0])[:, 0]
        scans = np.stack([readings_around(e, p, range_max, real) for e in expected])
        scanner = gs.Scanner(np.zeros(scans.shape[1]), range_max)
        model = gs.BeamModel(grid, scanner, p, backend=backend, precision=precision)
        assert (model.expected_ranges(poses) == expected[:, None]).all()
        _, parts = model.log_likelihood(poses[:, None], scans, per_beam=True)
        assert not np.isnan(parts).any()
        mixture = Mixture.of(p, range_max)
        for s, k in np.ndindex(scans.shape):
            error = error_in_eps(parts[s, 0, k], mixture, scans[s, k], expected[s], np.finfo(real).eps)
            if error > worst[0]:
                worst = (error, (p, scans[s, k], expected[s], parts[s, 0, k]))
    assert worst[0] <= BOUND, worst


@pytest.mark.parametrize("precision", PRECISIONS)
def test_where_the_logarithm_cancels(precision):
    """Bound the error of a log density near 0, a difference of large terms, relative to these terms."""
    real, rng = np.dtype(precision), np.random.default_rng(3)
    eps, grid = np.finfo(real).eps, gs.OccupancyGrid([[0]], 1.0)
    for _ in range(100):
        range_max = float(rng.choice([1.0, 30.0, 80.0]))
        weights = WEIGHTS[rng.choice(["hit", "hit and short", "hit and rand"])]
        p = parameters(precision, range_max, 10 ** rng.uniform(-8, -2), 10 ** rng.uniform(-3, 6), weights)
        model = gs.BeamModel(grid, gs.Scanner([0.0], range_max), p, backend="numpy", precision=precision)
        expected = real.type(range_max * rng.choice([1, 0.5, rng.random()]))
        peak = max(math.log(p.z_hit / p.sigma_hit / math.sqrt(2 * math.pi)), 0)
        away = p.sigma_hit * np.sqrt(2 * np.maximum(peak + rng.uniform(-1, 1, 8), 0)) * rng.choice([-1, 1], 8)
        z = np.clip(expected + away, 0, np.nextafter(real.type(range_max), real.type(0))).astype(real)
        with np.errstate(all="ignore"):
            found = log_density(model._pipeline.mixture.flags, z, np.full(8, expected), model._pipeline.mixture.terms)
        mixture = Mixture.of(p, range_max)
        for f, x in zip(found, z, strict=True):
            truth = exact_log_density(mixture, float(x), float(expected))
            assert abs(mp.mpf(float(f)) - truth) <= BOUND * eps * (1 + abs(truth) + 2 * peak), (p, x, expected, f)
