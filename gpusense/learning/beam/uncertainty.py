"""Standard errors of the model's parameters from the observed information, for independent or correlated readings."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gpusense.learning.beam.point import BIAS, NAMES, RATE, SIGMA, Floats, Point
from gpusense.learning.beam.problem import Problem, Value

# Scaled information below this share of the largest counts as none.
_FLAT = 1e-10


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
    if len(places):
        curve = -value.hessian[np.ix_(places, places)]
        scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(curve)), 1e-300))
        size, axes = np.linalg.eigh(curve * np.outer(scale, scale))
        known = size > _FLAT * max(float(size[-1]), 0.0)
        inner = None if scatter is None else scatter[np.ix_(places, places)]
        for k in np.flatnonzero(moved):
            row: Floats = axes.T @ (scale * jacobian[k, places])
            unknown = np.abs(row[~known]) > 1e-6 * max(float(np.abs(row).max()), 1e-300)
            errors[k] = math.inf if unknown.any() else _error(row, size, known, scale[:, None] * axes, inner)
    return dict(zip(NAMES, errors.tolist(), strict=True))


def _jacobian(point: Point) -> Floats:
    """Return the (7, 7) derivatives of the parameters by the coordinates."""
    jacobian = np.zeros((7, 7))
    jacobian[:4, :4] = np.diag(point.weights) - np.outer(point.weights, point.weights)
    jacobian[SIGMA, SIGMA], jacobian[RATE, RATE], jacobian[BIAS, BIAS] = point.sigma, point.rate, 1.0
    return jacobian


def _error(row: Floats, size: Floats, known: NDArray[np.bool_], axes: Floats, scatter: Floats | None) -> float:
    """Return the standard error of a parameter.

    Args:
        row: (m,) derivatives of the parameter along the axes.
        size: (m,) eigenvalues of the scaled information.
        known: (m,) mask of the axes with information.
        axes: (m, m) axes as columns, in the coordinates.
        scatter: (m, m) scatter of the gradient over blocks, or None.
    """
    if scatter is None:
        return math.sqrt(float((row[known] ** 2 / size[known]).sum()))
    influence = axes[:, known] @ (row[known] / size[known])
    return math.sqrt(max(float(influence @ scatter @ influence), 0.0)) if np.isfinite(scatter).all() else math.nan
