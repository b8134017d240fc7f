"""Find errors of a landmark map: exchanged and misplaced landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.learning.landmark.pairs import Limits, evaluate, make_pairs, sensor_poses
from gpusense.models.landmark.features import check_correspondence, check_features, span_of
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.parameters import LandmarkParameters

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
    """Return disjoint exchanges among the judged landmarks, the largest gain first.

    Rows of ``log_p`` and ``agree`` (M, M) are labels of features, columns positions.
    """
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
