"""Readings for learning, and problems made from them."""

from __future__ import annotations

import numpy as np

from gpusense.backends import Backend, get_backend
from gpusense.evaluation.worlds import sample_readings
from gpusense.learning.beam.device_sums import DeviceSums, make_bounds
from gpusense.learning.beam.pairs import Point, first_guess, make_pairs, random_start
from gpusense.learning.beam.problem import NO_PRIOR, Prior, Problem
from gpusense.world.hit_shapes import NORMAL, HitShape
from gpusense.world.parameters import BeamParameters

RANGE_MAX = 10.0
TYPICAL = BeamParameters(0.7, 0.1, 0.1, 0.1, 0.15, 1.0)


def draw(
    parameters: BeamParameters, count: int, seed: int, low: float = 0.1, high: float = 0.9
) -> tuple[np.ndarray, np.ndarray]:
    """Draw readings and expected ranges between two parts of range_max."""
    rng = np.random.default_rng(seed)
    expected = rng.uniform(low, high, count) * RANGE_MAX
    return sample_readings(expected, RANGE_MAX, parameters, rng), expected


def problem_of(
    z: np.ndarray,
    expected: np.ndarray,
    *,
    backend: str | Backend = "numpy",
    real: type = np.float64,
    prior: Prior = NO_PRIOR,
    fit_bias: bool = True,
) -> Problem:
    pairs = make_pairs(z, expected, RANGE_MAX)
    device = DeviceSums(get_backend(backend), np.dtype(real), pairs)
    return Problem(device, pairs, make_bounds(pairs), prior, fit_bias)


def starts(z: np.ndarray, expected: np.ndarray, range_max: float, count: int) -> list[BeamParameters]:
    """Draw starts at random, as ``restarts`` does."""
    pairs = make_pairs(z, expected, range_max)
    bounds, rng = make_bounds(pairs), np.random.default_rng(5)
    guess = first_guess(pairs, bounds)
    return [random_start(guess, bounds, rng).parameters() for _ in range(count)]


def point(*weights: float, sigma: float, rate: float, bias: float = 0.0, shape: HitShape = NORMAL) -> Point:
    return Point(np.array(weights), sigma, rate, bias, shape)
