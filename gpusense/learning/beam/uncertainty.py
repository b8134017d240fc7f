"""Standard errors from the observed information, on the parameters as the model takes them."""

from __future__ import annotations

import math

import numpy as np

from gpusense.learning.beam.point import BIAS, NAMES, RATE, SIGMA, Floats
from gpusense.learning.beam.problem import Problem, Value

# Scaled information below this part of the largest is none.
_FLAT = 1e-10


def standard_errors(problem: Problem, value: Value) -> dict[str, float]:
    """The standard error of each parameter by its name.

    The inverse of minus the second derivatives by the free coordinates, carried to the parameters by the coordinates'
    derivatives there. NaN where a parameter was not free (0, at a bound, or of a cause that accounts for no reading),
    infinite where the readings hold no information about it.
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
        # One weight alone is 1 and has no error.
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
