"""Covariance of a match, the directions that nothing constrains, and the status.

The information of Gauss-Newton counts errors of the lines as information: in a corridor, noise turns lines, and turned
lines seem to constrain the position along it. Its expected value, ``variance * doubt``, is subtracted first.

Errors of neighbours are correlated: they share points of a line, and errors of a surface. The variance of their
weighted sum is 1 + 2 sum rho_k times that of independent errors, with the autocorrelation rho_k over k points. Blocks
of successive points measure it (Flyvbjerg and Petersen (1989), "Error estimates on averages of correlated data"): the
sum of squares of the sums of blocks of b points is 1 + 2 sum (1 - k / b) rho_k times that of single points.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

# Least pairs of points of a match, least share of points in common sight, and least score.
_FEW, _OVERLAP, _POOR = 8, 0.1, 0.46
# A direction is observed if it has this many pairs, and more than this times the information that errors of lines make
# up.
LEAST_PAIRS, _LEAST_RATIO = 1.5, 1.0


class Uncertainty(NamedTuple):
    """Covariance (S, 3, 3), eigenvalues (S, 3), directions (S, 3, 3), and whether each direction is observed (S, 3)."""

    covariance: np.ndarray
    eigenvalues: np.ndarray
    directions: np.ndarray
    observed: np.ndarray


def symmetric(upper: np.ndarray) -> np.ndarray:
    """Return (S, 3, 3) matrices from the six numbers of their upper triangles."""
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def noise_of(ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviation of normal errors, and the factor of the covariance, from a weighted mean of squared errors.

    Args:
        ratio: (S,) sum of w e^2 over the sum of w, for errors in scales, and weights (1 / (1 + e^2))^2.

    Returns:
        (S,) deviations in scales, at most 2, and E[w] E[w^2 e^2] / E[d(w e)/de]^2, by which the inverse of the sum of
        w J J' is multiplied.
    """
    known, sigma, factor = _noise_table()
    return np.interp(ratio, known, sigma), np.interp(ratio, known, factor)


@functools.cache
def _noise_table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ratios, deviations and factors of noise_of."""
    e = np.linspace(-8, 8, 801)
    sigma = np.linspace(0.0, 2.0, 101)[1:]
    u = sigma[:, None] * e
    density = np.exp(-0.5 * e * e)
    density /= density.sum()
    w = (1 + u * u) ** -2.0
    mean_w, mean_wuu = w @ density, (w * u * u) @ density
    slope = ((1 - 3 * u * u) * (1 + u * u) ** -3.0) @ density
    factor = mean_w * ((w * w * u * u) @ density) / np.maximum(slope, 0.05) ** 2
    return np.append(0, mean_wuu / mean_w), np.append(0, sigma), np.append(0, factor)


def inflation_of(squares: np.ndarray) -> np.ndarray:
    """Return (S,) variances of sums of weighted errors, relative to independent errors; at least 1.

    The ratio to single points rises with the size of blocks, and is less certain with large ones. So its steps count
    until the first one that is not positive. The last of them counts twice: once blocks are longer than the
    correlation, each step is half of the one before.

    Args:
        squares: (S, 8) sums of squares of the sums of blocks of 1, 2, 4 to 128 points.
    """
    ratio = squares / np.where(squares[:, :1] > 0, squares[:, :1], 1)
    step = np.diff(ratio, axis=1)
    rises = np.logical_and.accumulate(step > 0, axis=1)
    steps = np.where(rises, step, 0)
    count = rises.sum(axis=1)
    last = np.where(count > 0, steps[np.arange(len(steps)), count - 1], 0)
    inflation: np.ndarray = 1 + steps.sum(axis=1) + last
    return inflation


def uncertainty(
    information: np.ndarray, doubt: np.ndarray, squared: np.ndarray, scale: float, pairs: np.ndarray,
    lever: np.ndarray, inflation: np.ndarray,
) -> Uncertainty:  # fmt: skip
    """Return covariances, eigenvalues and observed directions.

    Args:
        information: (S, 3, 3) sums of w J J'.
        doubt: (S, 3, 3) the part of it that a unit variance of the points makes up.
        squared: (S,) weighted mean squared error [m^2].
        scale: Scale of the weights [m].
        pairs: (S,) sums of weights.
        lever: (S,) length by which headings are multiplied [m].
        inflation: (S,) factor of the covariance because errors of neighbours are correlated.
    """
    sigma, factor = noise_of(squared / scale**2)
    doubted = doubt * ((sigma * scale) ** 2)[:, None, None]
    variance = inflation * factor * scale**2
    return spread(information, doubted, variance, pairs, lever, np.full(len(lever), LEAST_PAIRS))


def spread(
    information: np.ndarray,
    doubted: np.ndarray,
    variance: np.ndarray,
    pairs: np.ndarray,
    lever: np.ndarray,
    least: np.ndarray,
) -> Uncertainty:
    """Return covariances, eigenvalues and observed directions of (S, 3, 3) sums of w J J'.

    Args:
        information: The sums.
        doubted: The part of them that errors of the lines make up.
        variance: (S,) factor of the inverse [m^2].
        pairs: (S,) sums of weights.
        lever: (S,) length by which headings are multiplied [m].
        least: (S,) least eigenvalue of an observed direction.
    """
    balance = np.stack([np.ones_like(lever), np.ones_like(lever), 1 / lever], axis=1)
    both = balance[:, :, None] * balance[:, None, :]
    values, vectors = np.linalg.eigh((information - doubted) * both)
    spurious = np.einsum("sik,sij,sjk->sk", vectors, doubted * both, vectors)
    observed = values > np.maximum(least[:, None], _LEAST_RATIO * spurious)
    inverse = np.where(observed, 1 / np.where(observed, values, 1), 0)
    # To meters and radians.
    axes = vectors * balance[:, :, None]
    covariance = np.einsum("sik,sk,sjk->sij", axes, variance[:, None] * inverse, axes)
    lost = np.where(observed[:, None, :], 0.0, vectors)
    covariance += _infinite(np.einsum("sik,sjk->sij", lost, lost))
    shares = np.clip(values / np.maximum(pairs, 1)[:, None], 0, None)
    return Uncertainty(covariance, shares, vectors.transpose(0, 2, 1), observed)


def _infinite(lost: np.ndarray) -> np.ndarray:
    """Return (S, 3, 3) matrices that are infinite where projections on lost directions are not almost 0."""
    return np.where(np.abs(lost) > 1e-3, np.copysign(np.inf, lost), 0.0)


def statuses(result: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Return the status of (S, 32) results of the kernel ``match_scans``."""
    pairs, seen, through, unseen = result[:, 18], result[:, 21], result[:, 22], result[:, 23]
    status = np.full(len(result), "converged", dtype="<U16")
    status[~observed.all(axis=1)] = "unobservable"
    status[result[:, 5] == 0] = "no convergence"
    status[result[:, 3] < _POOR] = "poor"
    status[seen < _OVERLAP * np.maximum(seen + through + unseen, 1)] = "no overlap"
    status[pairs < _FEW] = "few points"
    return status
