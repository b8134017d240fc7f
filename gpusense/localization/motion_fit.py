"""Noise of the odometry model from a log with reference poses, by maximum likelihood.

The difference between reference and odometry over a step is, to first order, normal: (along, across, heading) =
(noise of the translation, trans * noise of the first turn + noise to the side, noise of both turns). Steps that fit
better with the odometer's translation reversed are counted, and give the probability of a reverse. A Student t density
with 4 degrees of freedom keeps single slips from inflating the noise of all steps. A filter draws normal noise: the
variances are multiplied by the mean square of standardised errors, each at most 9.

Errors of an odometer repeat from step to step (a wheel's radius, a slope), while a filter draws new noise at each step.
Their constant part is fitted, too (on the intel log 3 degrees a metre). For the rest, variances are multiplied by
1 + 2 sum rho_l, the inflation of the variance of a sum by the autocorrelation rho_l of standardised errors.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray
from gpusense.localization.motion import OdometryMotion, odometry_turns
from gpusense.localization.pose_algebra import pose_difference, wrap_angle

_FREEDOM = 4.0
_LEAST_ALPHA, _MOST_ALPHA = 1e-6, 1.0
# Limits of the least deviations [m, rad], and the largest standardised error squared that counts in the tails.
_LEAST, _MOST, _FAR = 0.002, 0.1, 9.0
# A reversed translation must fit better by this distance [m] to count.
_CLEAR = 0.05
# Longest lag of the autocorrelation, and the largest inflation.
_LAGS, _MOST_INFLATION = 10, 10.0
# Deviation of the systematic error before there is data, of each of its three parts; rounds of the fit.
_PRIOR, _ROUNDS = 0.1, 3


@dataclass(frozen=True)
class MotionFit:
    """Noise of the odometry model, fitted to a log.

    Attributes:
        motion: The model.
        steps: Number of steps.
        reversed_steps: Steps in which the odometer's translation had the wrong sign.
        inflation: Factor of the variances, by the autocorrelation and the tails of errors; ``motion`` has it.
        log_likelihood: Of all steps before the inflation, natural logarithm up to a constant.

    Example:
        >>> import gpusense as gs
        >>> gs.MotionFit(gs.OdometryMotion(), 100, 0, 1.5, 42.0).inflation
        1.5
    """

    motion: OdometryMotion
    steps: int
    reversed_steps: int
    inflation: float
    log_likelihood: float


def fit_odometry_motion(odometry: AnyArray, poses: AnyArray, *, systematic: bool = True) -> MotionFit:
    """Fit the noise of :class:`OdometryMotion` to a log with reference poses.

    Args:
        odometry: (M, 3) poses of the odometer, M > 2 [m, m, rad].
        poses: (M, 3) reference poses at the same times.
        systematic: Also fit the errors that repeat at each step; they are 0 otherwise.

    Raises:
        TypeError, ValueError: not poses, or fewer than three.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> rng, truth = np.random.default_rng(0), np.zeros((400, 3))
        >>> truth[:, 0] = np.arange(400)
        >>> odometry = truth + np.cumsum(rng.normal(0, [0.1, 0, 0], (400, 3)), axis=0)
        >>> fit = gs.fit_odometry_motion(odometry, truth)
        >>> 0.005 < fit.motion.alpha[2] / fit.inflation < 0.02
        True
    """
    reported = checks.array("odometry", odometry, ("N", 3))
    reference = checks.array("poses", poses, (len(reported), 3))
    if len(reported) < 3:
        raise ValueError(f"odometry: must hold at least 3 poses, got {len(reported)}")
    turns = np.array([odometry_turns(a, b) for a, b in itertools.pairwise(reported)])
    truth = pose_difference(reference[:-1], reference[1:])
    flipped = _distance(turns * (1, -1, 1), truth) < _distance(turns, truth) - _CLEAR
    turns[flipped, 1] *= -1
    repeated = np.zeros(3)
    noise, cost = _fitted(turns, _residuals(turns, truth), [_start(0.001), _start(0.02)])
    for _ in range(_ROUNDS if systematic else 0):
        repeated = _systematic(noise, turns, _residuals(turns, truth))
        noise, cost = _fitted(turns, _residuals(_corrected(turns, repeated), truth), [noise])
    corrected = _corrected(turns, repeated)
    inflation = _inflation(noise, corrected, _residuals(corrected, truth))
    count, wrong = len(turns), int(flipped.sum())
    return MotionFit(_motion(noise * inflation, (wrong + 0.5) / (count + 1), repeated), count, wrong, inflation, -cost)


def _start(alpha: float) -> np.ndarray:
    """Return variances to begin a search with: four of alpha, to the side, and the least ones [m^2, rad^2]."""
    translation, turn = OdometryMotion().least
    return np.array([alpha] * 5 + [translation**2, turn**2])


def _motion(noise: np.ndarray, reverse: float, repeated: np.ndarray) -> OdometryMotion:
    values, least = [float(value) for value in noise], np.sqrt(noise[5:])
    missed = (float(repeated[0]), float(repeated[1]), float(repeated[2]))
    return OdometryMotion(tuple(values[:4]), reverse, (float(least[0]), float(least[1])), missed, values[4])


def _fitted(turns: np.ndarray, residual: np.ndarray, starts: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Return the most likely variances, and the negative log-likelihood there."""
    from scipy.optimize import minimize

    def cost(logs: np.ndarray) -> float:
        return _cost(_limited(logs), turns, residual)

    options = dict(maxiter=4000, maxfev=4000, adaptive=True, xatol=1e-2, fatol=1e-3)
    best: Any = min(
        (minimize(cost, np.log(start), method="Nelder-Mead", options=options) for start in starts),
        key=lambda found: found.fun,
    )
    return _limited(best.x), float(best.fun)


def _limited(logs: np.ndarray) -> np.ndarray:
    """Return variances within their limits."""
    low = np.log([_LEAST_ALPHA] * 5 + [_LEAST**2] * 2)
    return np.exp(np.clip(logs, low, np.log([_MOST_ALPHA] * 5 + [_MOST**2] * 2)))


def _corrected(turns: np.ndarray, repeated: np.ndarray) -> np.ndarray:
    """Return motions without the systematic error, as :class:`OdometryMotion` corrects them."""
    stretch, gain, drift = repeated
    first, trans, second = turns.T
    half = drift * trans / 2
    return np.stack([first * (1 + gain) + half, trans * (1 + stretch), second * (1 + gain) + half], axis=1)


def _systematic(noise: np.ndarray, turns: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return the systematic error (3,) by least squares, reweighted for the t density, given the variances."""
    first, trans, second = turns.T
    zero = np.zeros_like(trans)
    along, a, b, c, determinant = _covariances(noise, turns)
    # Rows: error along, across, and of the heading, for each part of the systematic error.
    design = np.stack(
        [
            np.stack([trans, zero, zero], axis=1),
            np.stack([zero, trans * first, trans * trans / 2], axis=1),
            np.stack([zero, first + second, trans], axis=1),
        ],
        axis=1,
    )
    inverse = np.zeros((len(turns), 3, 3))
    inverse[:, 0, 0] = 1 / along
    inverse[:, 1, 1], inverse[:, 2, 2] = c / determinant, a / determinant
    inverse[:, 1, 2] = inverse[:, 2, 1] = -b / determinant
    repeated = np.zeros(3)
    for _ in range(20):
        left = residual - design @ repeated
        weight = (_FREEDOM + 3) / (_FREEDOM + np.einsum("mi,mij,mj->m", left, inverse, left))
        weighted = weight[:, None, None] * inverse
        normal = np.einsum("mik,mij,mjl->kl", design, weighted, design) + np.eye(3) / _PRIOR**2
        repeated = np.linalg.solve(normal, np.einsum("mik,mij,mj->k", design, weighted, residual))
    return repeated


def _covariances(noise: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the variance along, the covariance (a, b; b, c) of (across, heading), and its determinant."""
    first, trans, second = turns.T
    squares = first**2 + second**2
    along = noise[2] * trans**2 + noise[3] * squares + noise[5]
    one, two = (noise[0] * turn**2 + noise[1] * trans**2 + noise[6] for turn in (first, second))
    a, b, c = one * trans**2 + noise[4] * squares + noise[5], one * trans, one + two
    return along, a, b, c, np.maximum(a * c - b * b, 1e-30)


def _distance(turns: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return distances between the ends of steps."""
    x, y = turns[:, 1] * np.cos(turns[:, 0]), turns[:, 1] * np.sin(turns[:, 0])
    return np.hypot(x - truth[:, 0], y - truth[:, 1])


def _residuals(turns: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return (M, 3) errors of steps along and across the translation, and of the heading."""
    x = truth[:, 0] - turns[:, 1] * np.cos(turns[:, 0])
    y = truth[:, 1] - turns[:, 1] * np.sin(turns[:, 0])
    cosine, sine = np.cos(turns[:, 0]), np.sin(turns[:, 0])
    heading = wrap_angle(truth[:, 2] - turns[:, 0] - turns[:, 2])
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, heading], axis=1)


def _inflation(noise: np.ndarray, turns: np.ndarray, residual: np.ndarray) -> float:
    """Return the factor of the variances by the tails of errors, and by their largest autocorrelation."""
    along, a, _, c, _ = _covariances(noise, turns)
    errors = [error / np.sqrt(variance) for error, variance in zip(residual.T, (along, a, c), strict=True)]
    factors, tails = [1.0], [float(np.mean(np.minimum(error**2, _FAR))) for error in errors]
    for error in errors:
        held = np.clip(error, -4, 4)
        products = [held[lag:] @ held[: len(held) - lag] for lag in range(min(_LAGS, len(held) - 1) + 1)]
        if products[0] > 0:
            factors.append(1 + 2 * sum(max(product, 0.0) for product in products[1:]) / products[0])
    return float(min(max(factors), _MOST_INFLATION)) * max(float(np.mean(tails)), 0.5)


def _cost(noise: np.ndarray, turns: np.ndarray, residual: np.ndarray) -> float:
    """Return the negative log-likelihood of residuals."""
    along, a, b, c, determinant = _covariances(noise, turns)
    across, heading = residual[:, 1], residual[:, 2]
    squared = (c * across**2 - 2 * b * across * heading + a * heading**2) / determinant + residual[:, 0] ** 2 / along
    logs = np.log(determinant) + np.log(along)
    return float(np.sum(0.5 * logs + 0.5 * (_FREEDOM + 3) * np.log1p(squared / _FREEDOM)))
