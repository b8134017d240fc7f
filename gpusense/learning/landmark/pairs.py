"""Pair features with possible landmarks, compute the landmark model's log-likelihood, and find errors of a map.

A part has the residual u = f - m and the mean m = f_j + bias. A pair's derivative by log sigma is
``(u / sigma)^2 - 1 - d log mass / d log sigma``, and by the bias ``u / sigma^2 - d log mass / d m``. The mass is the
integral of the part's normal over the limits of the sensor (docs/landmarks.md). A landmark beyond a limit has the mass
of a landmark at the limit, moved by the bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.point.problem import mix
from gpusense.models.landmark.features import check_correspondence, check_features, span_of, wrapped
from gpusense.world.frames import Mount
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.parameters import LandmarkParameters

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
    """Pair (F, 3) features at (F, 3) poses with known (F,) landmarks, -1 for none, or with all landmarks in view."""
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


# Smallest gain of an exchange [nats], and least number of features for judging a landmark.
_LEAST_GAIN, _FEWEST = 20.0, 5


@dataclass(frozen=True)
class Exchange:
    """Two landmarks that fit their readings better after exchanging their positions."""

    first: int
    """Index of the first landmark in the map."""
    second: int
    """Index of the second landmark in the map."""
    readings: tuple[int, int]
    """Their numbers of features."""
    gain: float
    """Gain in log-likelihood of these features [nats]."""
    before: tuple[float, float]
    """Share of each landmark's features that agree with its position: likelier from it than a false positive."""
    after: tuple[float, float]
    """The same shares after the exchange."""


@dataclass(frozen=True)
class Misplaced:
    """Landmark that disagrees with most of its readings, without an exchange that explains them."""

    landmark: int
    """Index in the map."""
    readings: int
    """Number of its features."""
    agree: float
    """Share of its features that agree with its position."""


@dataclass(frozen=True)
class Suspicions:
    """Suspicious landmarks of a map."""

    exchanged: tuple[Exchange, ...]
    """Exchanged pairs, the largest gain first."""
    misplaced: tuple[Misplaced, ...]
    """Misplaced landmarks, in the order of the map."""


def suspicious_landmarks(
    poses: ArrayLike,
    features: ArrayLike,
    landmarks: LandmarkMap,
    correspondence: ArrayLike,
    parameters: LandmarkParameters,
    *,
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Suspicions:
    """Find exchanged and misplaced landmarks by comparing features with the positions of all landmarks.

    S[j, k] is the log-likelihood of the features labelled j at the position of landmark k, false positives included.
    Landmarks j and k are reported as exchanged if each fits better at the other's position, S[j, k] > S[j, j] and S[k,
    j] > S[k, k], and both gains together are at least 20 nats. Landmarks with fewer than 5 features are not judged. The
    parameters may be fitted to the same features, since false positives absorb features that do not fit. Signatures are
    ignored.

    Args:
        poses: (F, 3) pose of the robot for each feature [m, m, rad].
        features: (F, 2 or 3) ranges [m] and bearings [rad]; NaN for missing parts.
        landmarks: The map.
        correspondence: (F,) labelled landmark of each feature, -1 for none.
        parameters: Parameters of the sensor; a z_false or z_detect below 1e-3 counts as 1e-3.
        mount: The sensor's pose on the robot [m, m, rad].

    Returns:
        Exchanged pairs, and landmarks that agree with less than half of their features.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A value breaks a rule above, or the shapes differ.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> landmarks, poses = gs.LandmarkMap([(5, 0), (0, 5)]), np.zeros((20, 3))
        >>> features, labels = [(5.0, 0.0), (5.0, np.pi / 2)] * 10, [1, 0] * 10
        >>> errors = gs.suspicious_landmarks(poses, features, landmarks, labels, gs.LandmarkParameters())
        >>> [(pair.first, pair.second) for pair in errors.exchanged]
        [(0, 1)]
    """
    checks.instance("landmarks", landmarks, LandmarkMap)
    checks.instance("parameters", parameters, LandmarkParameters)
    full = check_features(features, parameters, span_of(parameters, landmarks))
    known = check_correspondence(correspondence, len(full), len(landmarks))
    robots = checks.array("poses", poses, (len(full), 3), largest=checks.FARTHEST)
    x, y, yaw = (float(number) for number in checks.array("mount", mount, (3,), largest=checks.FARTHEST))
    full[:, 2] = np.nan
    used = (known >= 0) & (~np.isnan(full)).any(axis=1)
    known, full, sensors = known[used], full[used], sensor_poses(robots[used], (x, y, yaw))
    count = np.bincount(known, minlength=len(landmarks))
    log_p, agree = _scores(full, sensors, known, count, landmarks, parameters)
    judged = np.flatnonzero(count >= _FEWEST)
    exchanged = _exchanges(judged, count, log_p, agree)
    explained = {index for pair in exchanged for index in (pair.first, pair.second)}
    misplaced = [
        Misplaced(int(j), int(count[j]), float(agree[j, j])) for j in judged if j not in explained and agree[j, j] < 0.5
    ]
    return Suspicions(tuple(exchanged), tuple(misplaced))


def _exchanges(judged: np.ndarray, count: np.ndarray, log_p: Floats, agree: Floats) -> list[Exchange]:
    """Return disjoint exchanges, the largest gain first, by (M, M) tables of labels' features at positions."""
    candidates = []
    for place, j in enumerate(judged):
        for k in judged[place + 1 :]:
            gains = log_p[j, k] - log_p[j, j], log_p[k, j] - log_p[k, k]
            if min(gains) > 0 and sum(gains) >= _LEAST_GAIN:
                candidates.append(Exchange(
                    int(j), int(k), (int(count[j]), int(count[k])), float(sum(gains)),
                    (float(agree[j, j]), float(agree[k, k])), (float(agree[j, k]), float(agree[k, j])),
                ))  # fmt: skip
    exchanged: list[Exchange] = []
    taken: set[int] = set()
    for pair in sorted(candidates, key=lambda candidate: -candidate.gain):
        if not {pair.first, pair.second} & taken:
            exchanged.append(pair)
            taken |= {pair.first, pair.second}
    return exchanged


def _scores(
    features: Floats, sensors: Floats, known: np.ndarray, count: np.ndarray, landmarks: LandmarkMap,
    p: LandmarkParameters,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return (M, M) log-likelihoods of the row's features at the column's position, and the shares that agree."""
    limits = Limits(p.range_max, p.field_of_view / 2, (0.0, 1.0))
    sigma = [1.0 if s is None else s for s in (p.sigma_range, p.sigma_bearing, None)]
    measured = features.copy()
    for column, deviation in enumerate((p.sigma_range, p.sigma_bearing)):
        if deviation is None:
            measured[:, column] = np.nan
    theta = np.array([*np.log(sigma), 1 - np.clip(p.z_detect, 1e-3, 1 - 1e-3), 0.0, 0.0])
    size = len(landmarks)
    log_p, agree = np.zeros((size, size)), np.zeros((size, size))
    order = np.argsort(known, kind="stable")
    first = np.concatenate([[0], np.cumsum(count)])
    for j in np.flatnonzero(count):
        rows = order[first[j] : first[j + 1]]
        for k in range(size):
            landmark = np.full(len(rows), k)
            pairs = make_pairs(sensors[rows], measured[rows], landmarks.xy, None, landmark, limits)
            value = evaluate(pairs, theta)
            log_p[j, k], agree[j, k] = float(value.log_p.sum()), float(np.mean(value.false < 0.5))
    return log_p, agree
