"""Compute a point's errors of ranges, of log-likelihoods and of the posterior, against the float64 truth.

The truth is the exact caster and the models in float64, on the fastest device present with float64. A test compares it
with the NumPy reference.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util.typing import Floats
from gpusense.backends import Backend, get_backend
from gpusense.evaluation.benchmark.scenes import Scene
from gpusense.localization.weights import normalize_weights
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel

SHARING = 0.1
"""Effective sample size of the tempered posterior, as a share of the particles."""
_HALVINGS = 60
MOST_FACTOR = 1e6
"""Largest factor of log-likelihoods that is tried to make weights as sharp as the exact ones."""
# Of a fine grid of poses: half widths of the first one [m, m, rad], and poses along each axis. A grid is fine enough if
# each deviation is at least this many spacings; the next one spans this many deviations on each side.
_HALF, _SIDE, _FINE, _SPAN, _ROUNDS = (0.3, 0.3, 0.15), 13, 1.0, 5.0, 10


class UnstableError(ValueError):
    """Raised for a result that is not finite, or of the wrong shape."""


def truth_device() -> Backend:
    """Open the fastest device, or NumPy if that lacks float64."""
    device = get_backend("auto")
    return device if device.info.float64 else get_backend("numpy")


@dataclass(frozen=True)
class FinePosterior:
    """Poses of a regular grid with their exact log-likelihoods.

    Attributes:
        poses: (M, 3) poses [m, m, rad].
        deviation: (3,) standard deviations of the posterior [m, m, rad].
    """

    poses: Floats
    log_p: Floats
    deviation: Floats


@dataclass(frozen=True, eq=False)
class Truth:
    """Exact results for the first particles of a cloud.

    Attributes:
        poses: (M, 3) the particles that are checked.
    """

    scene: Scene
    poses: Floats
    device: Backend
    _log_p: dict[str, Floats] = field(default_factory=dict)
    _fine: dict[str, FinePosterior] = field(default_factory=dict)

    @functools.cached_property
    def ranges(self) -> Floats:
        """Compute (M, K) exact expected ranges [m]."""
        caster = RayCaster(self.scene.grid, self.scene.scanner.range_max, backend=self.device, precision="float64")
        return caster.cast(self.poses, self.scene.scanner.bearings)

    def _model(self, problem: str) -> BeamModel | LikelihoodFieldModel:
        scene = self.scene
        options: dict[str, Any] = {"backend": self.device, "precision": "float64"}
        if problem == "field":
            return LikelihoodFieldModel(scene.grid, scene.scanner, scene.field, **options)
        return BeamModel(scene.grid, scene.scanner, scene.beam, **options)

    def log_p(self, problem: str) -> Floats:
        """Return (M,) log-likelihoods of a problem's model."""
        if problem not in self._log_p:
            self._log_p[problem] = self._model(problem).log_likelihood(self.poses, self.scene.readings)
        return self._log_p[problem]

    def fine(self, problem: str) -> FinePosterior:
        """Return the posterior of a problem's model on a fine grid of poses around the true one."""
        if problem not in self._fine:
            model, readings = self._model(problem), self.scene.readings
            self._fine[problem] = fine_posterior(lambda poses: model.log_likelihood(poses, readings), self.scene.pose)
        return self._fine[problem]


def temperature_of(log_p: Floats) -> float:
    """Find the factor of log-likelihoods, in (0, 1], at which the effective sample size is a tenth of the particles.

    The plain product over beams gives one particle nearly all weight, and such a posterior hides most errors.

    ``log_p``: (M,) log-likelihoods, finite.
    """
    return factor_for(log_p, SHARING * len(log_p), 1.0)


def factor_for(log_p: Floats, size: float, most: float = MOST_FACTOR) -> float:
    """Find the largest factor of log-likelihoods at which the effective sample size is at least ``size``.

    The effective sample size falls as the factor rises. Weights flatter than the exact ones, such as sums of cubes, are
    compared at the factor that makes the effective sample sizes equal.

    ``log_p``: (M,) log-likelihoods, finite. ``size``: Effective sample size, in [1, M].
    """

    def enough(factor: float) -> bool:
        return normalize_weights(factor * log_p).effective_sample_size >= size

    low, high = 0.0, min(1.0, most)
    while enough(high):
        if high >= most:
            return most
        low, high = high, min(2 * high, most)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if enough(middle) else (low, middle)
    return low


def errors(
    truth: Truth, problem: str, result: NDArray[np.floating], temperature: float = 1.0
) -> dict[str, dict[str, float]]:
    """Compute all errors of a point from its (M, K) ranges [m] or (M,) log-likelihoods.

    Returns:
        Errors by kind: ``"ranges"``; or ``"log_p"``, and ``"comparable"``: the posterior at the temperature that gives
        the candidate the effective sample size of the exact tempered posterior.
    """
    if problem == "ranges":
        right = truth.ranges
        return {"ranges": range_errors(_checked("ranges", result, right), right, truth.scene.grid.resolution)}
    right = truth.log_p(problem)
    scores = temperature * _checked("log-likelihoods", result, right)
    factor = temperature_of(right)
    size = normalize_weights(factor * right).effective_sample_size
    comparable = posterior_errors(factor_for(scores, size) * scores, factor * right, truth.poses)
    return {"log_p": log_p_errors(scores, right), "comparable": comparable}


def fine_errors(truth: Truth, problem: str, log_p: NDArray[np.floating], temperature: float = 1.0) -> dict[str, float]:
    """Compare log-likelihoods on the fine grid of poses with the true, untempered posterior of a problem there."""
    fine = truth.fine(problem)
    return posterior_errors(temperature * _checked("log-likelihoods", log_p, fine.log_p), fine.log_p, fine.poses)


def fine_posterior(score: Callable[[Floats], NDArray[np.floating]], pose: ArrayLike) -> FinePosterior:
    """Find the posterior near a pose, with a uniform prior.

    The first grid is 0.6 m wide. While a standard deviation is below the grid's spacing, the next grid is narrower and
    lies around the mean.

    ``score``: Returns the log-likelihoods of (M, 3) poses, finite. ``pose``: (3,) pose at the middle of the first grid
    [m, m, rad].
    """
    middle, half = np.asarray(pose, np.float64), np.array(_HALF)
    steps = np.linspace(-1.0, 1.0, _SIDE)
    unit = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    for _ in range(_ROUNDS):
        spacing, poses = 2 * half / (_SIDE - 1), middle + unit * half
        log_p = np.asarray(score(poses), np.float64)
        weights = normalize_weights(log_p).weights
        mean = weights @ poses
        deviation = np.sqrt(weights @ np.square(poses - mean))
        if (deviation >= _FINE * spacing).all():
            break
        middle, half = mean, np.minimum(_SPAN * np.maximum(deviation, 0.5 * spacing), half)
    return FinePosterior(poses, log_p, deviation)


def _checked(quantity: str, computed: NDArray[np.floating], right: Floats) -> Floats:
    values = np.asarray(computed, np.float64)
    if values.shape != right.shape:
        raise UnstableError(f"{quantity} have the shape {values.shape}, must have {right.shape}")
    wrong = int(np.count_nonzero(~np.isfinite(values)))
    if wrong:
        raise UnstableError(f"{wrong} of {values.size} {quantity} are not finite")
    return values


def range_errors(computed: Floats, right: Floats, resolution: float) -> dict[str, float]:
    """Compute errors of ranges in cells: median, p95, max, and ``wrong_1``, the share wrong by more than a cell."""
    apart = np.abs(computed - right) / resolution
    if apart.size == 0:
        return dict.fromkeys(("median", "p95", "max", "wrong_1"), 0.0)
    median, tail, largest = (float(value) for value in np.quantile(apart, (0.5, 0.95, 1.0)))
    return {"median": median, "p95": tail, "max": largest, "wrong_1": np.count_nonzero(apart > 1) / apart.size}


def log_p_errors(computed: Floats, right: Floats) -> dict[str, float]:
    """Compute the largest and the root-mean-square error of log-likelihoods [nats]."""
    apart = np.abs(computed - right)
    return {"max": float(apart.max(initial=0.0)), "rms": math.sqrt(float(np.sum(apart * apart)) / max(len(apart), 1))}


def posterior_errors(computed: Floats, right: Floats, poses: Floats) -> dict[str, float]:
    """Compare the normalised weights of (M,) finite log-likelihoods with the exact ones, at (M, 3) poses [m, m, rad].

    Returns:
        ``kl``: the Kullback-Leibler divergence ``sum p log(p / q)`` of the computed weights q from the exact weights p
        [nats]; ``shift_m``: the shift of the weighted mean position.
    """
    p, q = normalize_weights(right).weights, normalize_weights(computed).weights
    log_p, log_q = (values - _log_sum(values) for values in (right, computed))
    # Positions are relative to the first particle, since a sum far from the origin would lose digits.
    shift = (q - p) @ (poses[:, :2] - poses[0, :2])
    # The divergence is never negative, but rounding may make the sum negative.
    return {"kl": max(float(np.sum(p * (log_p - log_q))), 0.0), "shift_m": math.hypot(*shift)}


def _log_sum(values: Floats) -> float:
    largest = float(values.max())
    return largest + math.log(float(np.sum(np.exp(values - largest))))
