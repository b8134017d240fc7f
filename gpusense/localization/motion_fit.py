"""Fit the noise of the odometry model to a log with reference poses, by maximum likelihood with weak priors.

The difference between reference and odometry over a step is, to first order, normal. Between distant references it is
the sum of the errors of all steps, each carried to the end of the gap: a turn displaces the end by the angle times its
distance. The covariance is therefore a sum of variances times matrices of the path. A Student t density with 4 degrees
of freedom prevents single slips from inflating the noise of all steps, but a filter draws normal noise, so the
variances are multiplied by the mean square of standardised errors, each at most 9.

An odometer's errors repeat from step to step (a wheel's radius, a slope). Their constant part is also fitted, and the
variances of the rest are multiplied by 1 + 2 sum rho_l, the autocorrelation of standardised errors, if significant.

The logarithm of each variance has a normal prior around the default, with a deviation of a factor of ten. The
covariance of the logarithms is (I + 1 / prior variance)^-1, with the Fisher information I of the t density (Lange,
Little and Taylor 1989). A variance is determined if the data at least halve the prior's deviation.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense._util.html import card
from gpusense._util.typing import AnyArray
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.motion import SHORTEST, OdometryMotion, turns_between
from gpusense.world.pose_algebra import pose_difference, rotated, wrap_angle

_FREEDOM = 4.0
_LEAST_ALPHA, _MOST_ALPHA = 1e-6, 1.0
# Limits of the least deviations [m, rad], and largest squared standardised error in the tails.
_LEAST, _MOST, _FAR = 0.002, 0.1, 9.0
# Least improvement of a reversed translation [m].
_CLEAR = 0.05
# Longest lag of the autocorrelation, significance of its sums [deviations], and largest inflation.
_LAGS, _SIGNIFICANT, _MOST_INFLATION = 10, 4.0, 10.0
# Prior deviation of each part of the systematic error; rounds of the fit.
_PRIOR, _ROUNDS = 0.1, 3
# Defaults of the variances, prior deviation of their logarithms, and weight of the default of ``reverse`` [steps].
_DEFAULT = np.array([*DEFAULTS.alpha, DEFAULTS.sideways, *(value**2 for value in DEFAULTS.least)])
_PRIOR_LOG, _PRIOR_STEPS = math.log(10), 25
# Logarithms of the defaults, and of the limits of variances.
_LOG_DEFAULT = np.log(_DEFAULT)
_LOWEST, _HIGHEST = np.log([_LEAST_ALPHA] * 5 + [_LEAST**2] * 2), np.log([_MOST_ALPHA] * 5 + [_MOST**2] * 2)
# Largest deviation of the logarithm of a determined variance, as a share of the prior deviation.
_DETERMINED = 0.5
# Variances of the model: alpha1 to alpha4, sideways, and the squares of the least deviations.
NOISES = ("alpha1", "alpha2", "alpha3", "alpha4", "sideways", "least translation", "least turn")
# A shorter step [m, rad] is at rest: its motion may be jitter, so it informs only the least deviations. By the
# defaults, the noise of a motion of this length has a tenth of their variances.
REST = (0.02, 0.01)


@dataclass(frozen=True)
class MotionFit:
    """Noise of the odometry model, fitted to a log.

    Attributes:
        motion: The model.
        steps: Number of steps of the odometer between the first and the last reference.
        reversed_steps: Steps with a translation of the wrong sign.
        inflation: Factor of the variances for autocorrelation and tails of errors, included in ``motion``.
        log_likelihood: Log-likelihood of all differences before the inflation, up to a constant.
        references: Number of reference poses.
        travelled: Sum of the translations of the steps [m].
        turned: Sum of the turns of the steps [rad].
        log_errors: (7,) standard errors of the logarithms of alpha1 to alpha4, ``sideways`` and the squares of
            ``least``, for independent steps; 2.3, a factor of ten, if the log has no information.
        undetermined: Names of undetermined parameters, with an error of the logarithm above 1.15. Each has its
            default, or less if the log excludes the default.

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
    references: int = 0
    travelled: float = 0.0
    turned: float = 0.0
    log_errors: tuple[float, ...] = ()
    undetermined: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        motion = self.motion
        values: list[tuple[str, object]] = [(f"alpha{k}", value) for k, value in enumerate(motion.alpha, 1)]
        values += [(name, getattr(motion, name)) for name in ("reverse", "least", "systematic", "sideways")]
        rows: list[tuple[object, ...]] = [
            (name, value, "not determined" if name in self.undetermined else "") for name, value in values
        ]
        rows += [("inflation", self.inflation, ""), ("steps", self.steps, f"over {self.travelled:.1f} m")]
        return card("MotionFit", rows)


def fit_odometry_motion(odometry: AnyArray, poses: AnyArray, *, systematic: bool = True) -> MotionFit:
    """Fit the noise of :class:`OdometryMotion` to a log with reference poses.

    The noise depends on the length of a step, so pass ``odometry`` with the steps of the filter. Some reference poses
    may be unknown. A variance that the log does not determine is at most the default of :class:`OdometryMotion`, and is
    listed in ``undetermined``.

    Args:
        odometry: (M, 3) poses of the odometer, M > 2 [m, m, rad].
        poses: (M, 3) reference poses at the same times; rows of NaN where unknown, at most M - 3.
        systematic: Fit the errors that repeat at each step instead of assuming 0.

    Raises:
        TypeError, ValueError: the arrays are no poses, or fewer than three, or the odometer moved by less than 1 cm and
            0.01 rad.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> rng, truth = np.random.default_rng(0), np.zeros((400, 3))
        >>> truth[:, 0] = np.arange(400)
        >>> odometry = truth + np.cumsum(rng.normal(0, [0.1, 0, 0], (400, 3)), axis=0)
        >>> fit = gs.fit_odometry_motion(odometry, truth)
        >>> 0.005 < fit.motion.alpha[2] / fit.inflation < 0.02, "alpha1" in fit.undetermined
        (True, True)
    """
    checks.boolean("systematic", systematic)
    reported = checks.array("odometry", odometry, ("N", 3), largest=checks.FARTHEST)
    if len(reported) < 3:
        raise ValueError(f"odometry: must hold at least 3 poses, got {len(reported)}")
    reference, at = _references(poses, len(reported))
    turns = np.array([turns_between(a, b) for a, b in itertools.pairwise(reported[at[0] : at[-1] + 1].tolist())])
    at = at - at[0]
    travelled, turned = float(np.abs(turns[:, 1]).sum()), float(np.abs(turns[:, [0, 2]]).sum())
    if travelled < REST[0] and turned < REST[1]:
        rule = f"must move by {REST[0]} m or {REST[1]} rad in all between the first and the last reference"
        raise ValueError(f"odometry: {rule}, got {travelled:.3g} m and {turned:.3g} rad")
    moved, wrong = _reverse(turns, reference, at)
    repeated = np.zeros(3)
    errors = errors_of(turns, reference, at)
    noise, cost = _fitted(errors, [np.array([alpha] * 5 + list(_DEFAULT[5:])) for alpha in (0.001, 0.02)])
    for _ in range(_ROUNDS if systematic else 0):
        repeated = repeated + _systematic(noise, errors, repeated)
        errors = errors_of(corrected(turns, repeated), reference, at)
        noise, cost = _fitted(errors, [noise])
    inflation, deviations = _inflation(noise, errors), _log_errors(noise, errors)
    unsure = deviations > _DETERMINED * _PRIOR_LOG
    noise = np.where(unsure, np.minimum(noise * max(inflation, 1.0), _DEFAULT), noise * inflation)
    reverse = (wrong + _PRIOR_STEPS * DEFAULTS.reverse) / (moved + _PRIOR_STEPS)
    return MotionFit(
        motion=_motion(noise, reverse, repeated),
        steps=len(turns),
        reversed_steps=wrong,
        inflation=inflation,
        log_likelihood=-cost,
        references=len(at),
        travelled=travelled,
        turned=turned,
        log_errors=tuple(float(value) for value in deviations),
        undetermined=tuple(itertools.compress(NOISES, unsure)),
    )


def _references(poses: AnyArray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference poses and their indices."""
    values = checks.array("poses", poses, (count, 3), finite=False, largest=checks.FARTHEST)
    absent = np.isnan(values).all(axis=1)
    checks.array("poses", np.where(absent[:, None], 0.0, values))
    at = np.flatnonzero(~absent)
    if len(at) < 3:
        raise ValueError(f"poses: must hold at least 3 rows that are not NaN, got {len(at)}")
    return values[at], at


def _reverse(turns: np.ndarray, reference: np.ndarray, at: np.ndarray) -> tuple[int, int]:
    """Reverse translations that fit better reversed; return the numbers of tested and reversed steps.

    Only steps with references before and after can be tested.
    """
    single = np.flatnonzero(np.diff(at) == 1)
    truth, steps = pose_difference(reference[single], reference[single + 1]), at[single]
    taken = turns[steps]
    flipped = _distance(taken * (1, -1, 1), truth) < _distance(taken, truth) - _CLEAR
    turns[steps[flipped], 1] *= -1
    return int(np.count_nonzero(2 * np.abs(taken[:, 1]) > _CLEAR)), int(flipped.sum())


def _motion(noise: np.ndarray, reverse: float, repeated: np.ndarray) -> OdometryMotion:
    values, least = [float(value) for value in noise], np.sqrt(noise[5:])
    missed = (float(repeated[0]), float(repeated[1]), float(repeated[2]))
    return OdometryMotion(tuple(values[:4]), reverse, (float(least[0]), float(least[1])), missed, values[4])


def _fitted(errors: Errors, starts: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Return the most probable variances given the prior, and their negative log-likelihood without it."""
    from scipy.optimize import minimize

    def cost(logs: np.ndarray) -> float:
        return _cost(_limited(logs), errors) + 0.5 * float(np.sum((logs - _LOG_DEFAULT) ** 2)) / _PRIOR_LOG**2

    options = dict(maxiter=4000, maxfev=4000, adaptive=True, xatol=1e-2, fatol=1e-3)
    best: Any = min(
        (minimize(cost, np.log(start), method="Nelder-Mead", options=options) for start in starts),
        key=lambda found: found.fun,
    )
    noise = _limited(best.x)
    return noise, _cost(noise, errors)


def _limited(logs: np.ndarray) -> np.ndarray:
    """Return variances within their limits."""
    return np.exp(np.clip(logs, _LOWEST, _HIGHEST))


def _systematic(noise: np.ndarray, errors: Errors, before: np.ndarray) -> np.ndarray:
    """Return the correction (3,) of the systematic error for given variances.

    Least squares, reweighted for the t density, start from the present correction.
    """
    inverse = np.linalg.inv(errors.covariances(noise))
    design, residual = errors.design, errors.residual
    added = np.zeros(3)
    for _ in range(20):
        left = residual - np.einsum("gik,k->gi", design, added)
        weight = (_FREEDOM + 3) / (_FREEDOM + np.einsum("gi,gij,gj->g", left, inverse, left))
        weighted = weight[:, None, None] * inverse
        normal = np.einsum("gik,gij,gjl->kl", design, weighted, design) + np.eye(3) / _PRIOR**2
        right = np.einsum("gik,gij,gj->k", design, weighted, residual) - before / _PRIOR**2
        added = np.linalg.solve(normal, right)
    return added


def _distance(turns: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the distances between the ends of steps and of reference steps."""
    x, y = turns[:, 1] * np.cos(turns[:, 0]), turns[:, 1] * np.sin(turns[:, 0])
    return np.hypot(x - truth[:, 0], y - truth[:, 1])


def _log_errors(noise: np.ndarray, errors: Errors) -> np.ndarray:
    """Return the standard errors (7,) of the logarithms of the variances, by the Fisher information and the prior."""
    inverse = np.linalg.inv(errors.covariances(noise))
    parts = noise[:, None, None, None] * np.einsum("gij,kgjl->kgil", inverse, errors.basis)
    traces = np.trace(parts, axis1=2, axis2=3)
    top = _FREEDOM + 3
    products = np.einsum("agij,bgji->ab", parts, parts)
    information = (top * products - traces @ traces.T) / (2 * (top + 2))
    return np.sqrt(np.diag(np.linalg.inv(information + np.eye(len(noise)) / _PRIOR_LOG**2)))


def _inflation(noise: np.ndarray, errors: Errors) -> float:
    """Return the factor of the variances for tails and autocorrelation of errors."""
    variances = np.diagonal(errors.covariances(noise), axis1=1, axis2=2)
    standardised = errors.residual / np.sqrt(variances)
    tails = float(np.mean(np.minimum(standardised**2, _FAR)))
    return min(_correlation_factor(np.clip(standardised, -4, 4)), _MOST_INFLATION) * max(tails, 0.5)


def _correlation_factor(errors: np.ndarray) -> float:
    """Return 1 + 2 sum rho_l of errors (G, C), the mean over the components with a significant autocorrelation.

    The rho_l keep their signs, so that noise has no mean effect. For independent errors the sum of the first m has the
    variance m / G, or less. A component is significant if any sum exceeds a multiple of the deviation.
    """
    lags = np.arange(1, min(_LAGS, len(errors) - 1) + 1)
    squares = np.maximum(np.sum(errors**2, axis=0), 1e-300)
    products = np.array([np.sum(errors[lag:] * errors[:-lag], axis=0) for lag in lags])
    sums = np.cumsum(products / squares, axis=0)
    significant = (sums > _SIGNIFICANT * np.sqrt(lags / len(errors))[:, None]).any(axis=0)
    factors = 1 + 2 * sums[-1, significant]
    return max(float(factors.mean()), 1.0) if len(factors) else 1.0


def _cost(noise: np.ndarray, errors: Errors) -> float:
    """Return the negative log-likelihood of residuals."""
    (a, b, c), (_, d, e), (_, _, f) = errors.covariances(noise).transpose(1, 2, 0)
    # Inverse of a symmetric matrix by its minors.
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = np.maximum(a * p + b * q + c * r, 1e-30)
    x, y, z = errors.residual.T
    squared = p * x * x + (a * f - c * c) * y * y + (a * d - b * b) * z * z
    squared += 2 * (q * x * y + r * x * z + (b * c - a * e) * y * z)
    tails = 0.5 * (_FREEDOM + 3) * np.log1p(squared / determinant / _FREEDOM)
    return float(np.sum(0.5 * np.log(determinant) + tails))


# ---- errors of steps


class Errors(NamedTuple):
    """Errors of G gaps along and across the motion [m], and of the heading [rad]."""

    residual: np.ndarray  # (G, 3) errors
    basis: np.ndarray  # (7, G, 3, 3) covariances per unit of each variance of ``NOISES``
    design: np.ndarray  # (G, 3, 3) errors per unit of each part of the systematic error

    def covariances(self, noise: np.ndarray) -> np.ndarray:
        """Return the (G, 3, 3) covariances for (7,) variances."""
        count = len(self.residual)
        return (noise @ self.basis.reshape(len(NOISES), count * 9)).reshape(count, 3, 3)


def corrected(turns: np.ndarray, repeated: np.ndarray) -> np.ndarray:
    """Return motions (M, 3) without the systematic error, corrected like :class:`OdometryMotion`."""
    stretch, gain, drift = repeated
    first, trans, second = turns.T
    half = drift * trans / 2
    return np.stack([first * (1 + gain) + half, trans * (1 + stretch), second * (1 + gain) + half], axis=1)


def errors_of(turns: np.ndarray, references: np.ndarray, at: np.ndarray) -> Errors:
    """Return the errors between (G + 1, 3) references before steps ``at``, of (M, 3) steps [rad, m, rad]."""
    first, trans, second = turns.T
    heading = np.r_[0.0, np.cumsum(first + second)]
    way = heading[:-1] + first
    x, y = (np.r_[0.0, np.cumsum(trans * part)] for part in (np.cos(way), np.sin(way)))
    path = np.stack([x, y, heading], axis=1)
    moved, truth = pose_difference(path[at[:-1]], path[at[1:]]), pose_difference(references[:-1], references[1:])
    # Along the motion between references, ahead or backwards; along the heading if there is none.
    turn = np.where(np.hypot(moved[:, 0], moved[:, 1]) < SHORTEST, 0.0, np.arctan2(moved[:, 1], moved[:, 0]))
    turn = np.where(np.abs(turn) > np.pi / 2, turn - np.copysign(np.pi, turn), turn)
    difference = truth - moved
    residual = np.column_stack([rotated(difference[:, :2], -turn), wrap_angle(difference[:, 2])])
    steps = slice(at[0], at[-1])
    gap = np.repeat(np.arange(len(moved)), np.diff(at))
    axis = (path[at[:-1], 2] + turn)[gap]
    # Line from the end of a step to the end of its gap: a turn displaces the gap's end at right angles.
    lever = rotated((path[at[1:]][gap] - path[1:][steps])[:, :2], -axis)
    carry = np.zeros((len(gap), 3, 3))
    carry[:, :2, 0] = rotated(np.array([1.0, 0.0]), way[steps] - axis)
    carry[:, :2, 1] = rotated(np.array([0.0, 1.0]), way[steps] - axis)
    carry[:, 0, 2], carry[:, 1, 2], carry[:, 2, 2] = -lever[:, 1], lever[:, 0], 1.0
    basis, design = _of_steps(turns[steps])
    first_steps = at[:-1] - at[0]
    return Errors(
        residual,
        np.add.reduceat(carry @ basis @ carry.transpose(0, 2, 1), first_steps, axis=1),
        np.add.reduceat(carry @ design, first_steps, axis=0),
    )


def _of_steps(turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return basis (7, M, 3, 3) and design (M, 3, 3) of steps, along and across their translation."""
    moving = ~at_rest(turns)
    first, trans, second = np.where(moving[:, None], turns, 0.0).T
    squares = first**2 + second**2
    basis = np.zeros((len(NOISES), len(turns), 3, 3))
    # A first turn moves the end sideways; the second turn changes only the heading.
    for noise, (one, two) in {0: (first**2, second**2), 1: (trans**2, trans**2), 6: (1.0, 1.0)}.items():
        length = turns[:, 1] if noise == 6 else trans
        basis[noise, :, 1, 1] = one * length**2
        basis[noise, :, 1, 2] = basis[noise, :, 2, 1] = one * length
        basis[noise, :, 2, 2] = one + two
    basis[2, :, 0, 0] = trans**2
    basis[3, :, 0, 0] = basis[4, :, 1, 1] = squares
    basis[5, :, 0, 0] = basis[5, :, 1, 1] = 1.0
    design = np.zeros((len(turns), 3, 3))
    design[:, 0, 0] = trans
    design[:, 1, 1], design[:, 2, 1] = trans * first, first + second
    design[:, 1, 2], design[:, 2, 2] = trans * trans / 2, trans
    return basis, design


def at_rest(turns: np.ndarray) -> np.ndarray:
    """Return the mask of steps (M, 3) that translate and turn by less than ``REST``."""
    return (np.abs(turns[:, 1]) < REST[0]) & (np.abs(wrap_angle(turns[:, 0] + turns[:, 2])) < REST[1])
