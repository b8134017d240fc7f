"""Standard errors of the model's parameters from the observed information, for independent or correlated readings."""

from __future__ import annotations

import math

import numpy as np

from gpusense.learning.beam.point import BIAS, FORM, RATE, SIGMA, Floats, Point
from gpusense.learning.beam.problem import Problem, Value
from gpusense.learning.information import errors_of

# Share of a coordinate of the shape of hits by which its parameters' derivatives are taken.
_STEP = 1e-5


def standard_errors(problem: Problem, value: Value, scatter: Floats | None = None) -> dict[str, float]:
    """Compute the standard error of each parameter by name.

    The covariance is the inverse of minus the second derivatives by the free coordinates, transformed to the parameters
    by their derivatives. The error is NaN for a parameter that was not free (0, at a bound, or of a cause that accounts
    for no reading), and infinite if the readings hold no information about it.

    Args:
        problem: The problem.
        value: The optimum, with second derivatives.
        scatter: scatter of the gradient over blocks, see ``blocks``; None for independent readings.
    """
    assert value.hessian is not None
    free = problem.free(value)
    places = np.flatnonzero(free)
    jacobian = _jacobian(value.point)
    moved = np.append(value.point.weights > 0, free[4:])
    if not (free[:4]).any():
        # A single weight is 1 and has no error.
        moved[:4] = False
    errors = np.full(len(free), math.nan)
    inner = None if scatter is None else scatter[np.ix_(places, places)]
    errors[moved] = errors_of(-value.hessian[np.ix_(places, places)], jacobian[np.ix_(moved, places)], inner)
    return dict(zip(value.point.names, errors.tolist(), strict=True))


def _jacobian(point: Point) -> Floats:
    """Return the derivatives of the parameters by the coordinates."""
    shape = point.shape
    count = FORM + len(shape.limits)
    jacobian = np.zeros((count, count))
    jacobian[:4, :4] = np.diag(point.weights) - np.outer(point.weights, point.weights)
    jacobian[SIGMA, SIGMA], jacobian[RATE, RATE], jacobian[BIAS, BIAS] = point.sigma, point.rate, 1.0
    for place, (low, high) in enumerate(shape.limits):
        step = _STEP * shape.coordinates * (np.arange(len(shape.limits)) == place)
        ends = [np.clip(shape.coordinates + sign * step, low, high) for sign in (-1, 1)]
        before, after = (np.array(list(shape.at(end).values().values())) for end in ends)
        jacobian[FORM:, FORM + place] = (after - before) / (ends[1] - ends[0])[place]
    return jacobian
