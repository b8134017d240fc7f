"""Standard errors of the model's parameters from the observed information."""

from __future__ import annotations

import math

import numpy as np

from gpusense.learning.beam.point import BIAS, NAMES, RATE, SIGMA, Floats
from gpusense.learning.beam.problem import Problem, Value

# Scaled information below this share of the largest counts as none.
_FLAT = 1e-10


def standard_errors(problem: Problem, value: Value) -> dict[str, float]:
    """Compute the standard error of each parameter by name.

    The covariance is the inverse of minus the second derivatives by the free coordinates, transformed to the parameters
    by their derivatives. The error is NaN for a parameter that was not free (0, at a bound, or of a cause that accounts
    for no reading), and infinite if the readings hold no information about it.
    """
    assert value.hessian is not None
    free = problem.free(value)
    point = value.point
    places = np.flatnonzero(free)
    jacobian = np.zeros((7, 7))
    weights = point.weights
    jacobian[:4, :4] = np.diag(weights) - np.outer(weights, weights)
    jacobian[SIGMA, SIGMA], jacobian[RATE, RATE], jacobian[BIAS, BIAS] = point.sigma, point.rate, 1.0
    moved = np.append(weights > 0, free[4:])
    if not (free[:4]).any():
        # A single weight is 1 and has no error.
        moved[:4] = False
    errors = np.full(7, math.nan)
    if len(places):
        curve = -value.hessian[np.ix_(places, places)]
        scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(curve)), 1e-300))
        size, axes = np.linalg.eigh(curve * np.outer(scale, scale))
        known = size > _FLAT * max(float(size[-1]), 0.0)
        for k in np.flatnonzero(moved):
            row: Floats = axes.T @ (scale * jacobian[k, places])
            unknown = np.abs(row[~known]) > 1e-6 * max(float(np.abs(row).max()), 1e-300)
            errors[k] = math.inf if unknown.any() else math.sqrt(float((row[known] ** 2 / size[known]).sum()))
    return dict(zip(NAMES, errors.tolist(), strict=True))
