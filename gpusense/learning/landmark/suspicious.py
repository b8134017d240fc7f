"""Landmarks whose readings say that they stand where another one does, as in maps with two of them exchanged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.learning.landmark.pairs import Floats, Limits, Point, evaluate, make_pairs, sensor_poses
from gpusense.models.landmark.features import check_correspondence, check_features, span_of
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.parameters import LandmarkParameters


@dataclass(frozen=True)
class Exchange:
    """Two landmarks that fit their readings better with positions exchanged."""

    first: int
    """Index in the map."""
    second: int
    """Index in the map."""
    readings: tuple[int, int]
    """Features of each."""
    gain: float
    """Nats that the log-likelihood of these features gains."""
    before: tuple[float, float]
    """Share of each one's features that agree with its position: more likely it than a false positive."""
    after: tuple[float, float]
    """The same with positions exchanged."""


@dataclass(frozen=True)
class Misplaced:
    """A landmark that most of its readings do not agree with, and no exchange explains."""

    landmark: int
    """Index in the map."""
    readings: int
    """Its features."""
    agree: float
    """Share of them that agree with its position."""


@dataclass(frozen=True)
class Suspicions:
    """What is suspicious of a map."""

    exchanged: tuple[Exchange, ...]
    """Pairs, the largest gain first."""
    misplaced: tuple[Misplaced, ...]
    """Others, in the order of the map."""


def suspicious_landmarks(
    poses: ArrayLike,
    features: ArrayLike,
    landmarks: LandmarkMap,
    correspondence: ArrayLike,
    parameters: LandmarkParameters,
    *,
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
    least_gain: float = 20.0,
    least_readings: int = 5,
) -> Suspicions:
    """Compare the features of each known landmark with the position of every landmark.

    S[j, k] is the log-likelihood of the features known as landmark j if it stood where k does, false positives
    included. j and k are reported as exchanged if each fits better in the other's place, S[j, k] > S[j, j] and
    S[k, j] > S[k, k], and both together by ``least_gain``. Parameters may be fitted to the same features: false
    positives take what does not fit. Signatures are left out.

    Args:
        poses: (F, 3) pose of the robot for each feature [m, m, rad].
        features: (F, 2 or 3) ranges [m] and bearings [rad]; NaN is what was not measured.
        landmarks: The map.
        correspondence: (F,) landmark that each feature is said to be, -1 for none.
        parameters: Of the sensor; a z_false below 1e-3 or z_detect counts as 1e-3.
        mount: The sensor's pose on the robot [m, m, rad].
        least_gain: Smallest gain of an exchange [nats], > 0.
        least_readings: Landmarks with fewer features are not judged.

    Returns:
        Pairs to exchange, and landmarks that less than half of their features agree with.

    Raises:
        TypeError: an argument is not of the kind described.
        ValueError: a value breaks a rule above, or the shapes differ.
    """
    if not isinstance(landmarks, LandmarkMap):
        raise TypeError(f"landmarks: must be a LandmarkMap, got {checks.show(landmarks)}")
    if not isinstance(parameters, LandmarkParameters):
        raise TypeError(f"parameters: must be LandmarkParameters, got {checks.show(parameters)}")
    full = check_features(features, parameters, span_of(parameters, landmarks))
    known = check_correspondence(correspondence, len(full), len(landmarks))
    where = checks.array("poses", poses, (len(full), 3))
    x, y, yaw = (float(number) for number in checks.array("mount", mount, (3,)))
    least = checks.real("least_gain", least_gain, above=0)
    few = checks.integer("least_readings", least_readings, low=1)
    full[:, 2] = np.nan
    kept = (known >= 0) & (~np.isnan(full)).any(axis=1)
    known, full, sensors = known[kept], full[kept], sensor_poses(where[kept], (x, y, yaw))
    count = np.bincount(known, minlength=len(landmarks))
    log_p, agree = _scores(full, sensors, known, count, landmarks, parameters)
    judged = np.flatnonzero(count >= few)
    found = []
    for place, j in enumerate(judged):
        for k in judged[place + 1 :]:
            gains = log_p[j, k] - log_p[j, j], log_p[k, j] - log_p[k, k]
            if min(gains) > 0 and sum(gains) >= least:
                found.append(Exchange(
                    int(j), int(k), (int(count[j]), int(count[k])), float(sum(gains)),
                    (float(agree[j, j]), float(agree[k, k])), (float(agree[j, k]), float(agree[k, j])),
                ))  # fmt: skip
    exchanged: list[Exchange] = []
    taken: set[int] = set()
    for each in sorted(found, key=lambda e: -e.gain):
        if not {each.first, each.second} & taken:
            exchanged.append(each)
            taken |= {each.first, each.second}
    misplaced = [
        Misplaced(int(j), int(count[j]), float(agree[j, j])) for j in judged if j not in taken and agree[j, j] < 0.5
    ]
    return Suspicions(tuple(exchanged), tuple(misplaced))


def _scores(
    features: Floats, sensors: Floats, known: np.ndarray, count: np.ndarray, landmarks: LandmarkMap,
    p: LandmarkParameters,
) -> tuple[Floats, Floats]:  # fmt: skip
    """(M, M) log-likelihood of row's features at column's position, and the share of them that agree."""
    limits = Limits(p.range_max, p.field_of_view / 2, (0.0, 1.0))
    sigma = tuple(1.0 if s is None else s for s in (p.sigma_range, p.sigma_bearing, None))
    measured = features.copy()
    for column, deviation in enumerate((p.sigma_range, p.sigma_bearing)):
        if deviation is None:
            measured[:, column] = np.nan
    point = Point((sigma[0], sigma[1], 1.0), float(np.clip(p.z_detect, 1e-3, 1 - 1e-3)), (0.0, 0.0))
    size = len(landmarks)
    log_p, agree = np.zeros((size, size)), np.zeros((size, size))
    order = np.argsort(known, kind="stable")
    first = np.concatenate([[0], np.cumsum(count)])
    for j in np.flatnonzero(count):
        own = order[first[j] : first[j + 1]]
        for k in range(size):
            at = np.full(len(own), k)
            value = evaluate(make_pairs(sensors[own], measured[own], landmarks.xy, None, at, limits), point)
            log_p[j, k], agree[j, k] = value.log_likelihood, float(np.mean(value.false < 0.5))
    return log_p, agree
