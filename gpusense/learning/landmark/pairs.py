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
from gpusense.models.landmark.features import wrapped
from gpusense.world.frames import Mount

RANGE, BEARING, SIGNATURE, ODDS, RANGE_BIAS, BEARING_BIAS = range(6)
# Distance below which a landmark has no bearing [m].
_NO_BEARING = 1e-6
# Pairs of poses and landmarks per pass.
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Point:
    """Parameters during a search."""

    sigma: tuple[float, float, float]  # standard deviations of range [m], bearing [rad] and signature
    z_detect: float  # weight of a feature that comes from a landmark
    bias: tuple[float, float]  # offsets of range [m] and bearing [rad]

    def moved(self, step: Floats) -> Point:
        """Return the point after a step in log sigma, log odds of z_detect, and offsets."""
        sigma = [s * math.exp(d) for s, d in zip(self.sigma, step[:ODDS], strict=True)]
        z = self.z_detect
        if 0 < z < 1:
            z = float(1 / (1 + (1 - z) / z * math.exp(-step[ODDS])))
        bias = self.bias[0] + float(step[RANGE_BIAS]), self.bias[1] + float(step[BEARING_BIAS])
        return replace(self, sigma=(sigma[0], sigma[1], sigma[2]), z_detect=z, bias=bias)


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

    def part(self, mask: NDArray[np.bool]) -> Pairs:
        """Return the pairs in ``mask`` (P,), with all features."""
        names = ("feature", "landmark", "prior", "residuals", "means", "in_view")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})


@dataclass(frozen=True, eq=False)
class Value:
    """The log-likelihood at a point and its parts."""

    point: Point
    log_likelihood: float  # log-likelihood of all features
    gradient: Floats  # (6,) derivatives by the steps of :meth:`Point.moved`
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


def evaluate(pairs: Pairs, point: Point) -> Value:
    """Evaluate ``sum_f log(z_detect sum_j prior_j p(f | j) + z_false p_uniform(f))`` and its gradient."""
    log_p, score = pairs.prior.copy(), np.zeros((len(pairs.prior), 6))
    for part, column in enumerate((RANGE, BEARING, SIGNATURE)):
        add, by_sigma, by_bias = _part(pairs, point, part)
        log_p += add
        score[:, column] = by_sigma
        if part < 2:
            score[:, RANGE_BIAS + part] = by_bias
    z = point.z_detect
    detected = log_p + (math.log(z) if z > 0 else -math.inf)
    none = pairs.uniform + (math.log1p(-z) if z < 1 else -math.inf)
    top = none.copy()
    np.maximum.at(top, pairs.feature, detected)
    base = np.where(np.isfinite(top), top, 0)
    exact = np.exp(detected - base[pairs.feature])
    rest = np.exp(none - base)
    total = np.bincount(pairs.feature, exact, len(none)) + rest
    with np.errstate(divide="ignore", invalid="ignore"):
        log_f = base + np.log(total)
        responsibility, false = exact / total[pairs.feature], rest / total
    gradient = responsibility @ score
    gradient[ODDS] = responsibility.sum() - z * len(none)
    return Value(point, float(log_f.sum()), gradient, responsibility, false)


def hessian(pairs: Pairs, point: Point) -> Floats:
    """Compute the (6, 6) second derivatives by central differences of the gradient."""
    second = np.zeros((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-4 * (point.sigma[k - RANGE_BIAS] if k >= RANGE_BIAS else 1)
        above, below = (evaluate(pairs, point.moved(sign * step)).gradient for sign in (1, -1))
        second[k] = (above - below) / (2 * step[k])
    return (second + second.T) / 2


def _part(pairs: Pairs, point: Point, part: int) -> tuple[Floats, Floats, Floats]:
    """Return the log densities of one part of the features, and their derivatives by log sigma and by the offset."""
    sigma, limits = point.sigma[part], pairs.limits
    bias = point.bias[part] if part < 2 else 0.0
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
    mass = np.where(measured, mass, 1)
    log_p = -0.5 * x * x - math.log(sigma * math.sqrt(2 * math.pi)) - np.log(mass)
    slope = x * x - 1 - by_sigma / mass
    return measured * log_p, np.where(measured, slope, 0), np.where(measured, (x - by_mean / mass) / sigma, 0)


def _mass(low: Floats, high: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the mass of a standard normal on [low, high], its derivative by log sigma, and by the mean times sigma."""
    below, above = (np.exp(-0.5 * end * end) / math.sqrt(2 * math.pi) for end in (low, high))
    return ndtr(high) - ndtr(low), low * below - high * above, below - above
