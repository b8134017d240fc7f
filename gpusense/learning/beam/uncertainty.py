"""Standard errors of the model's parameters from the observed information, for independent or correlated readings."""

from __future__ import annotations

import math

import numpy as np

from gpusense.learning.beam.point import BIAS, NAMES, RATE, SIGMA, Floats, Point
from gpusense.learning.beam.problem import Problem, Value
from gpusense.learning.information import errors_of


def standard_errors(problem: Problem, value: Value, scatter: Floats | None = None) -> dict[str, float]:
    """Compute the standard error of each parameter by name.

    The covariance is the inverse of minus the second derivatives by the free coordinates, transformed to the parameters
    by their derivatives. The error is NaN for a parameter that was not free (0, at a bound, or of a cause that accounts
    for no reading), and infinite if the readings hold no information about it.

    Args:
        problem: The problem.
        value: The optimum, with second derivatives.
        scatter: (7, 7) scatter of the gradient over blocks, see ``blocks``; None for independent readings.
    """
    assert value.hessian is not None
    free = problem.free(value)
    places = np.flatnonzero(free)
    jacobian = _jacobian(value.point)
    moved = np.append(value.point.weights > 0, free[4:])
    if not (free[:4]).any():
        # A single weight is 1 and has no error.
        moved[:4] = False
    errors = np.full(7, math.nan)
    inner = None if scatter is None else scatter[np.ix_(places, places)]
    errors[moved] = errors_of(-value.hessian[np.ix_(places, places)], jacobian[np.ix_(moved, places)], inner)
    return dict(zip(NAMES, errors.tolist(), strict=True))


def _jacobian(point: Point) -> Floats:
    """Return the (7, 7) derivatives of the parameters by the coordinates."""
    jacobian = np.zeros((7, 7))
    jacobian[:4, :4] = np.diag(point.weights) - np.outer(point.weights, point.weights)
    jacobian[SIGMA, SIGMA], jacobian[RATE, RATE], jacobian[BIAS, BIAS] = point.sigma, point.rate, 1.0
    return jacobian
