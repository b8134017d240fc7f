"""Pair features with possible landmarks, and compute the log-likelihood of the landmark model and its derivatives.

A part has the residual u = f - m and the mean m = f_j + bias. A pair's derivative by log sigma is
``(u / sigma)^2 - 1 - d log mass / d log sigma``, and by the bias ``u / sigma^2 - d log mass / d m``. The mass is the
integral of the part's normal over the limits of the sensor (docs/landmarks.md). A landmark beyond a limit has the mass
of a landmark at the limit, moved by the bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from gpusense._util.typing import Floats, Integers
from gpusense.learning.point.problem import mix
from gpusense.models.landmark.features import wrapped
from gpusense.world.frames import Mount

# Coordinates of a search: logarithms of three standard deviations, weight of a false positive, and two offsets.
RANGE, BEARING, SIGNATURE, FALSE, RANGE_BIAS, BEARING_BIAS = range(6)
# Distance below which a landmark has no bearing [m].
_NO_BEARING = 1e-6
# Pairs of poses and landmarks per pass.
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Limits:
    """Limits of the sensor."""

    range_max: float  # largest range [m]
    half_field: float  # half the field of view [rad]
    span: tuple[float, float]  # smallest and largest signature

    @property
    def full_circle(self) -> bool:
        """Return whether the field of view is a full circle."""
        return self.half_field >= math.pi


@dataclass(frozen=True, eq=False)
class Pairs:
    """P pairs in the order of their F features."""

    feature: Integers  # (P,) feature of each pair
    landmark: Integers  # (P,) landmark of each pair
    prior: Floats  # (P,) log probability of this landmark, given that the feature comes from a landmark
    residuals: Floats  # (P, 3) residuals of range, bearing (in [-pi, pi]) and signature; NaN for missing parts
    means: Floats  # (P, 3) expected range, bearing and signature
    in_view: NDArray[np.bool]  # (P,) whether the landmark is within the limits
    uniform: Floats  # (F,) log density of a false positive
    present: tuple[bool, bool, bool]  # True if at least one feature has a range, a bearing and a signature
    limits: Limits  # limits of the sensor

    @property
    def measured(self) -> tuple[bool, bool, bool]:
        """Return whether any pair has a residual of range, of bearing, and of signature."""
        measured: NDArray[np.bool] = np.any(~np.isnan(self.residuals), axis=0)
        return bool(measured[0]), bool(measured[1]), bool(measured[2])

    def every(self, step: int) -> Pairs:
        """Return the pairs of every ``step``-th feature."""
        some = self.feature % step == 0
        names = ("landmark", "prior", "residuals", "means", "in_view")
        chosen = {name: getattr(self, name)[some] for name in names}
        return replace(self, feature=self.feature[some] // step, uniform=self.uniform[::step], **chosen)


@dataclass(frozen=True, eq=False)
class Value:
    """The log-likelihoods of features and their parts."""

    log_p: Floats  # (F,) log-likelihoods
    gradient: Floats  # (F, 6) their derivatives by the coordinates
    responsibility: Floats  # (P,) probability of each pair
    false: Floats  # (F,) probability that each feature is a false positive


def sensor_poses(poses: Floats, mount: Mount) -> Floats:
    """Return the (N, 3) poses of the sensor for (N, 3) poses of the robot."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = poses[:, 0] + c * mount[0] - s * mount[1], poses[:, 1] + s * mount[0] + c * mount[1]
    return np.stack([x, y, poses[:, 2] + mount[2]], axis=1)


def expected(sensors: Floats, xy: Floats) -> tuple[Floats, Floats]:
    """Return broadcast ranges and bearings of landmarks from sensors; NaN for the bearing of a very near landmark."""
    away = xy - sensors[..., :2]
    d: Floats = np.hypot(away[..., 0], away[..., 1])
    bearing = wrapped(np.arctan2(away[..., 1], away[..., 0]) - sensors[..., 2])
    return d, np.where(d > _NO_BEARING, bearing, np.nan)


def within(d: Floats, bearing: Floats, limits: Limits) -> NDArray[np.bool]:
    """Return whether landmarks at ranges ``d`` and bearings ``bearing`` are in view."""
    visible: NDArray[np.bool] = (d <= limits.range_max) & ~(np.abs(bearing) > limits.half_field)
    return visible


def in_view(sensors: Floats, xy: Floats, limits: Limits) -> tuple[Integers, Integers]:
    """Return the indices of poses and of landmarks of all pairs in view, pose by pose."""
    rows = max(_BLOCK // max(len(xy), 1), 1)
    blocks = []
    for first in range(0, len(sensors), rows):
        pose, landmark = np.nonzero(within(*expected(sensors[first : first + rows, None], xy[None]), limits))
        blocks.append((pose + first, landmark))
    if not blocks:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate([pose for pose, _ in blocks]), np.concatenate([landmark for _, landmark in blocks])


def make_pairs(
    sensors: Floats, features: Floats, xy: Floats, signatures: Floats | None, known: Integers | None, limits: Limits
) -> Pairs:
    """Pair (F, 3) features with their known (F,) landmarks, -1 for none, or else with all landmarks in view.

    Missing parts of features are NaN. ``sensors`` holds the (F, 3) poses of the sensor.
    """
    if known is None:
        feature, landmark = in_view(sensors, xy, limits)
        count = np.bincount(feature, minlength=len(features))
        prior = -np.log(count[feature].astype(float))
    else:
        feature = np.flatnonzero(known >= 0)
        landmark, prior = known[feature], np.zeros(len(feature))
    d, bearing = expected(sensors[feature], xy[landmark])
    signature = np.full(len(feature), np.nan) if signatures is None else signatures[landmark]
    means = np.stack([d, bearing, signature], axis=1)
    residuals = features[feature] - means
    residuals[:, BEARING] = wrapped(residuals[:, BEARING])
    lengths = np.array([limits.range_max, 2 * limits.half_field, limits.span[1] - limits.span[0]])
    uniform = -(~np.isnan(features) * np.log(lengths)).sum(axis=1)
    # A landmark without a bearing has a uniform density of bearings.
    lost = np.isnan(bearing) & ~np.isnan(features[feature, BEARING])
    prior = prior - lost * math.log(lengths[BEARING])
    present: NDArray[np.bool] = np.any(~np.isnan(features), axis=0)
    return Pairs(
        feature, landmark, prior, residuals, means, within(d, bearing, limits), uniform,
        (bool(present[0]), bool(present[1]), bool(present[2])), limits,
    )  # fmt: skip


def evaluate(pairs: Pairs, theta: Floats) -> Value:
    """Evaluate ``log((1 - z_false) sum_j prior_j p(f | j) + z_false p_uniform(f))`` of each feature at coordinates."""
    log_p, score = pairs.prior.copy(), np.zeros((len(pairs.prior), 6))
    for part in (RANGE, BEARING, SIGNATURE):
        add, by_sigma, by_bias = _part(pairs, theta, part)
        log_p += add
        score[:, part] = by_sigma
        if part < 2:
            score[:, RANGE_BIAS + part] = by_bias
    count = len(pairs.uniform)
    top = np.full(count, -math.inf)
    np.maximum.at(top, pairs.feature, log_p)
    base = np.where(np.isfinite(top), top, 0)
    exact = np.exp(log_p - base[pairs.feature])
    total = np.bincount(pairs.feature, exact, count)
    with np.errstate(divide="ignore"):
        detected = base + np.log(total)
    log_f, (share, false), ratios = mix([(1 - theta[FALSE], detected), (float(theta[FALSE]), pairs.uniform)])
    responsibility = share[pairs.feature] * exact / np.maximum(total[pairs.feature], 1e-300)
    gradient = np.zeros((count, 6))
    for column, each in enumerate(score.T):
        gradient[:, column] = np.bincount(pairs.feature, responsibility * each, count)
    gradient[:, FALSE] = ratios[1] - ratios[0]
    return Value(log_f, gradient, responsibility, false)


def _part(pairs: Pairs, theta: Floats, part: int) -> tuple[Floats, Floats, Floats]:
    """Return the log densities of one part of the features, and their derivatives by log sigma and by the offset."""
    sigma, limits = math.exp(theta[part]), pairs.limits
    bias = float(theta[RANGE_BIAS + part]) if part < 2 else 0.0
    u, mean = pairs.residuals[:, part] - bias, pairs.means[:, part]
    if part == BEARING:
        u, ends = wrapped(u), (-limits.half_field, limits.half_field)
        center = np.clip(mean, *ends) + bias
        low, high = np.maximum(ends[0] - center, -math.pi), np.minimum(ends[1] - center, math.pi)
        if limits.full_circle:
            low, high = np.full_like(center, -math.pi), np.full_like(center, math.pi)
    else:
        ends = (0.0, limits.range_max) if part == RANGE else limits.span
        center = np.clip(mean, *ends) + bias
        low, high = ends[0] - center, ends[1] - center
    mass, by_sigma, by_mean = _mass(low / sigma, high / sigma)
    if part == BEARING and not limits.full_circle:
        # In a wide field of view, differences beyond half a turn wrap around.
        side = limits.half_field + np.abs(center)
        more, more_sigma, more_mean = _mass((2 * math.pi - side) / sigma, np.full_like(side, math.pi / sigma))
        wide = side > math.pi
        mass, by_sigma = mass + wide * more, by_sigma + wide * more_sigma
        by_mean = by_mean + wide * np.sign(center) * more_mean
    if part == BEARING and limits.full_circle:
        by_mean = np.zeros_like(center)
    measured = ~np.isnan(u)
    x = np.where(measured, u, 0) / sigma
    mass = np.where(measured, np.maximum(mass, 1e-300), 1)
    log_p = -0.5 * x * x - math.log(sigma * math.sqrt(2 * math.pi)) - np.log(mass)
    slope = x * x - 1 - by_sigma / mass
    return measured * log_p, np.where(measured, slope, 0), np.where(measured, (x - by_mean / mass) / sigma, 0)


def _mass(low: Floats, high: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the mass of a standard normal on [low, high], its derivative by log sigma, and by the mean times sigma."""
    below, above = (np.exp(-0.5 * end * end) / math.sqrt(2 * math.pi) for end in (low, high))
    # Tails keep their digits on the negative side.
    mass = np.where(low > 0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))
    return mass, low * below - high * above, below - above
