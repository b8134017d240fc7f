"""Noise of the odometry model from a log with reference poses, by maximum likelihood.

The difference between reference and odometry over a step is, to first order, normal: (along, across, heading) = (trans
noise, trans * first turn's noise, sum of both turns' noises). Steps that fit better with the odometer's translation
reversed are counted, and give the probability of a reverse. A Student t density with 4 degrees of freedom keeps single
slips from inflating the noise of all steps. Errors of an odometer repeat from step to step (a wheel's radius, a slope),
while a filter draws new noise at each step: variances are multiplied by 1 + 2 sum rho_l, the inflation of the variance
of a sum by the autocorrelation rho_l of standardised errors.
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
# A reversed translation must fit better by this distance [m] to count.
_CLEAR = 0.05
# Longest lag of the autocorrelation, and the largest inflation.
_LAGS, _MOST_INFLATION = 10, 10.0


@dataclass(frozen=True)
class MotionFit:
    """Noise of the odometry model, fitted to a log.

    Attributes:
        motion: The model.
        steps: Number of steps.
        reversed_steps: Steps in which the odometer's translation had the wrong sign.
        inflation: Factor of the variances, by the autocorrelation of errors; ``motion`` has it.
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


def fit_odometry_motion(odometry: AnyArray, poses: AnyArray) -> MotionFit:
    """Fit the noise of :class:`OdometryMotion` to a log with reference poses.

    Args:
        odometry: (M, 3) poses of the odometer, M > 2 [m, m, rad].
        poses: (M, 3) reference poses at the same times.

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
    from scipy.optimize import minimize

    reported = checks.array("odometry", odometry, ("N", 3))
    reference = checks.array("poses", poses, (len(reported), 3))
    if len(reported) < 3:
        raise ValueError(f"odometry: must hold at least 3 poses, got {len(reported)}")
    turns = np.array([odometry_turns(a, b) for a, b in itertools.pairwise(reported)])
    truth = pose_difference(reference[:-1], reference[1:])
    flipped = _distance(turns * (1, -1, 1), truth) < _distance(turns, truth) - _CLEAR
    turns[flipped, 1] *= -1
    least = OdometryMotion().least
    residual = _residuals(turns, truth)

    def cost(logs: np.ndarray) -> float:
        alpha = np.exp(np.clip(logs, np.log(_LEAST_ALPHA), np.log(_MOST_ALPHA)))
        return _cost(alpha, turns, residual, least)

    best: Any = min(
        (minimize(cost, np.log([a] * 4), method="Nelder-Mead", options=dict(maxiter=2000)) for a in (0.001, 0.02)),
        key=lambda found: found.fun,
    )
    alpha = np.exp(np.clip(best.x, np.log(_LEAST_ALPHA), np.log(_MOST_ALPHA)))
    inflation = _inflation(alpha, turns, residual, least)
    alpha = alpha * inflation
    count, wrong = len(turns), int(flipped.sum())
    motion = OdometryMotion(tuple(float(a) for a in alpha), (wrong + 0.5) / (count + 1), least)
    return MotionFit(motion, count, wrong, inflation, -float(best.fun))


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


def _inflation(alpha: np.ndarray, turns: np.ndarray, residual: np.ndarray, least: tuple[float, float]) -> float:
    """Return the largest inflation of variance by autocorrelation, of errors along and of the heading."""
    first, trans, second = turns.T
    squares = first**2 + second**2
    along = alpha[2] * trans**2 + alpha[3] * squares + least[0] ** 2
    heading = alpha[0] * squares + 2 * alpha[1] * trans**2 + 2 * least[1] ** 2
    factors = [1.0]
    for error in (residual[:, 0] / np.sqrt(along), residual[:, 2] / np.sqrt(heading)):
        held = np.clip(error, -4, 4)
        products = [held[lag:] @ held[: len(held) - lag] for lag in range(min(_LAGS, len(held) - 1) + 1)]
        if products[0] > 0:
            factors.append(1 + 2 * sum(max(product, 0.0) for product in products[1:]) / products[0])
    return float(min(max(factors), _MOST_INFLATION))


def _cost(alpha: np.ndarray, turns: np.ndarray, residual: np.ndarray, least: tuple[float, float]) -> float:
    """Return the negative log-likelihood of residuals."""
    first, trans, second = turns.T
    along = alpha[2] * trans**2 + alpha[3] * (first**2 + second**2) + least[0] ** 2
    one, two = (alpha[0] * turn**2 + alpha[1] * trans**2 + least[1] ** 2 for turn in (first, second))
    # Covariance of (across, heading); across also has the least deviation.
    a, b, c = one * trans**2 + least[0] ** 2, one * trans, one + two
    determinant = np.maximum(a * c - b * b, 1e-30)
    across, heading = residual[:, 1], residual[:, 2]
    squared = (c * across**2 - 2 * b * across * heading + a * heading**2) / determinant + residual[:, 0] ** 2 / along
    logs = np.log(determinant) + np.log(along)
    return float(np.sum(0.5 * logs + 0.5 * (_FREEDOM + 3) * np.log1p(squared / _FREEDOM)))
