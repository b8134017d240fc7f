"""Features paired with the landmarks that they may be: log-likelihood of the landmark model and its derivatives.

With residuals u = f - m and the mean m = f_j + bias of a part, a pair's derivatives are, by log sigma,
``(u / sigma)^2 - 1 - d log mass / d log sigma`` and, by the bias, ``u / sigma^2 - d log mass / d m``. The mass is that
of the part's normal on what can be measured (docs/landmarks.md); for a landmark beyond a limit, that of one at the
limit, moved by the bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from gpusense.models.landmark.features import wrapped
from gpusense.world.frames import Mount

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

RANGE, BEARING, SIGNATURE, ODDS, RANGE_BIAS, BEARING_BIAS = range(6)
# Nearer than this a landmark has no bearing [m].
_NO_BEARING = 1e-6
# Pairs of poses and landmarks that are looked at together.
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Point:
    """Deviations of range, bearing and signature, the weight z_detect, offsets of range and bearing."""

    sigma: tuple[float, float, float]
    z_detect: float
    bias: tuple[float, float]

    def moved(self, step: Floats) -> Point:
        """By log sigma, log odds of z_detect, and offsets."""
        sigma = [s * math.exp(d) for s, d in zip(self.sigma, step[:ODDS], strict=True)]
        z = self.z_detect
        if 0 < z < 1:
            z = float(1 / (1 + (1 - z) / z * math.exp(-step[ODDS])))
        bias = self.bias[0] + float(step[RANGE_BIAS]), self.bias[1] + float(step[BEARING_BIAS])
        return replace(self, sigma=(sigma[0], sigma[1], sigma[2]), z_detect=z, bias=bias)


@dataclass(frozen=True)
class Limits:
    """What the sensor can measure: range_max [m], half the field of view [rad], the signatures' span."""

    range_max: float
    half_field: float
    span: tuple[float, float]

    @property
    def full_circle(self) -> bool:
        """Whether the sensor sees all around."""
        return self.half_field >= math.pi


@dataclass(frozen=True, eq=False)
class Pairs:
    """P pairs in the order of their F features.

    Attributes:
        feature: (P,) feature of each pair.
        landmark: (P,) its landmark.
        prior: (P,) log probability of that landmark for a feature that is one.
        residuals: (P, 3) of range, bearing (in [-pi, pi]) and signature; NaN where not measured.
        means: (P, 3) expected range, bearing and signature.
        in_view: (P,) whether the landmark is within the limits.
        uniform: (F,) log density of a false positive.
        given: Whether some feature has a range, a bearing and a signature, compared with a landmark's or not.
        limits: Of the sensor.
    """

    feature: Integers
    landmark: Integers
    prior: Floats
    residuals: Floats
    means: Floats
    in_view: NDArray[np.bool]
    uniform: Floats
    given: tuple[bool, bool, bool]
    limits: Limits

    @property
    def measured(self) -> tuple[bool, bool, bool]:
        """Whether some pair has a range, a bearing and a signature."""
        there: NDArray[np.bool] = np.any(~np.isnan(self.residuals), axis=0)
        return bool(there[0]), bool(there[1]), bool(there[2])

    def part(self, kept: NDArray[np.bool]) -> Pairs:
        """Some of the pairs, of the same features."""
        names = ("feature", "landmark", "prior", "residuals", "means", "in_view")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})


@dataclass(frozen=True, eq=False)
class Value:
    """At a point: log-likelihood, gradient by Point's steps, (P,) probabilities of the pairs."""

    point: Point
    log_likelihood: float
    gradient: Floats
    responsibility: Floats
    false: Floats


def sensor_poses(poses: Floats, mount: Mount) -> Floats:
    """(N, 3) poses of the sensor."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = poses[:, 0] + c * mount[0] - s * mount[1], poses[:, 1] + s * mount[0] + c * mount[1]
    return np.stack([x, y, poses[:, 2] + mount[2]], axis=1)


def expected(sensors: Floats, xy: Floats) -> tuple[Floats, Floats]:
    """Ranges and bearings of landmarks from sensors, broadcast; NaN is the bearing of what is too near to have one."""
    away = xy - sensors[..., :2]
    d: Floats = np.hypot(away[..., 0], away[..., 1])
    bearing = wrapped(np.arctan2(away[..., 1], away[..., 0]) - sensors[..., 2])
    return d, np.where(d > _NO_BEARING, bearing, np.nan)


def within(d: Floats, bearing: Floats, limits: Limits) -> NDArray[np.bool]:
    """Whether a landmark is in view."""
    seen: NDArray[np.bool] = (d <= limits.range_max) & ~(np.abs(bearing) > limits.half_field)
    return seen


def in_view(sensors: Floats, xy: Floats, limits: Limits) -> tuple[Integers, Integers]:
    """Poses and landmarks of all pairs in view, pose by pose."""
    rows = max(_BLOCK // max(len(xy), 1), 1)
    found = []
    for first in range(0, len(sensors), rows):
        row, which = np.nonzero(within(*expected(sensors[first : first + rows, None], xy[None]), limits))
        found.append((row + first, which))
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate([row for row, _ in found]), np.concatenate([which for _, which in found])


def make_pairs(
    sensors: Floats, features: Floats, xy: Floats, signatures: Floats | None, known: Integers | None, limits: Limits
) -> Pairs:
    """Pairs of (F, 3) features, seen from (F, 3) sensors, with their landmarks or with all that are in view.

    Args:
        sensors: Pose of the sensor for each feature.
        features: Range, bearing and signature; NaN where not measured.
        xy: (M, 2) landmarks.
        signatures: Theirs, if any.
        known: (F,) landmarks, -1 for none, or None.
        limits: Of the sensor.
    """
    if known is None:
        feature, landmark = in_view(sensors, xy, limits)
        count = np.bincount(feature, minlength=len(features))
        prior = -np.log(count[feature].astype(float))
    else:
        feature = np.flatnonzero(known >= 0)
        landmark, prior = known[feature], np.zeros(len(feature))
    d, bearing = expected(sensors[feature], xy[landmark])
    own = np.full(len(feature), np.nan) if signatures is None else signatures[landmark]
    means = np.stack([d, bearing, own], axis=1)
    residuals = features[feature] - means
    residuals[:, BEARING] = wrapped(residuals[:, BEARING])
    lengths = np.array([limits.range_max, 2 * limits.half_field, limits.span[1] - limits.span[0]])
    uniform = -(~np.isnan(features) * np.log(lengths)).sum(axis=1)
    # A landmark without a bearing has every one with the same density.
    lost = np.isnan(bearing) & ~np.isnan(features[feature, BEARING])
    prior = prior - lost * math.log(lengths[BEARING])
    given: NDArray[np.bool] = np.any(~np.isnan(features), axis=0)
    return Pairs(
        feature, landmark, prior, residuals, means, within(d, bearing, limits), uniform,
        (bool(given[0]), bool(given[1]), bool(given[2])), limits,
    )  # fmt: skip


def evaluate(pairs: Pairs, point: Point) -> Value:
    """The log-likelihood ``sum_f log(z_detect sum_j prior_j p(f | j) + z_false p_uniform(f))`` and its gradient."""
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
    """(6, 6) second derivatives, by central differences of the gradient."""
    found = np.zeros((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-4 * (point.sigma[k - RANGE_BIAS] if k >= RANGE_BIAS else 1)
        above, below = (evaluate(pairs, point.moved(sign * step)).gradient for sign in (1, -1))
        found[k] = (above - below) / (2 * step[k])
    return (found + found.T) / 2


def _part(pairs: Pairs, point: Point, part: int) -> tuple[Floats, Floats, Floats]:
    """What one part of the features adds: log densities, and their derivatives by log sigma and by the offset."""
    sigma, limits = point.sigma[part], pairs.limits
    bias = point.bias[part] if part < 2 else 0.0
    u, mean = pairs.residuals[:, part] - bias, pairs.means[:, part]
    if part == BEARING:
        u, ends = wrapped(u), (-limits.half_field, limits.half_field)
        held = np.clip(mean, *ends) + bias
        low, high = np.maximum(ends[0] - held, -math.pi), np.minimum(ends[1] - held, math.pi)
        if limits.full_circle:
            low, high = np.full_like(held, -math.pi), np.full_like(held, math.pi)
    else:
        ends = (0.0, limits.range_max) if part == RANGE else limits.span
        held = np.clip(mean, *ends) + bias
        low, high = ends[0] - held, ends[1] - held
    mass, by_sigma, by_mean = _mass(low / sigma, high / sigma)
    if part == BEARING and not limits.full_circle:
        # Of a wide field of view, differences beyond half a turn come in at the other side.
        side = limits.half_field + np.abs(held)
        more, more_sigma, more_mean = _mass((2 * math.pi - side) / sigma, np.full_like(side, math.pi / sigma))
        wide = side > math.pi
        mass, by_sigma = mass + wide * more, by_sigma + wide * more_sigma
        by_mean = by_mean + wide * np.sign(held) * more_mean
    if part == BEARING and limits.full_circle:
        by_mean = np.zeros_like(held)
    there = ~np.isnan(u)
    x = np.where(there, u, 0) / sigma
    mass = np.where(there, mass, 1)
    log_p = -0.5 * x * x - math.log(sigma * math.sqrt(2 * math.pi)) - np.log(mass)
    slope = x * x - 1 - by_sigma / mass
    return there * log_p, np.where(there, slope, 0), np.where(there, (x - by_mean / mass) / sigma, 0)


def _mass(low: Floats, high: Floats) -> tuple[Floats, Floats, Floats]:
    """Mass of a standard normal on [low, high], its derivative by log sigma, and by the mean times sigma."""
    below, above = (np.exp(-0.5 * end * end) / math.sqrt(2 * math.pi) for end in (low, high))
    return ndtr(high) - ndtr(low), low * below - high * above, below - above
