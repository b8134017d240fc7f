"""``fit_landmark_parameters``: deviations and weights of the landmark model from features at known poses.

``landmark_pairs`` has the log-likelihood, ``landmark_em`` climbs it, ``landmark_report`` says how well that went.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.learning.landmark.em import climb, first_guess
from gpusense.learning.landmark.pairs import (
    Floats,
    Integers,
    Limits,
    Pairs,
    Value,
    in_view,
    make_pairs,
    sensor_poses,
)
from gpusense.learning.landmark.report import report
from gpusense.learning.landmark.result import LandmarkFit
from gpusense.models.landmark.features import check_correspondence, check_features
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.parameters import LandmarkParameters


@dataclass(frozen=True)
class Sightings:
    """The arguments of a fit, checked: features that say something, and where all were."""

    sensors: Floats
    scan: Integers
    features: Floats
    kept: Integers
    total: int
    pairs: Pairs


def fit_landmark_parameters(
    poses: ArrayLike,
    features: ArrayLike,
    landmarks: LandmarkMap,
    *,
    correspondence: ArrayLike | None = None,
    scan: ArrayLike | None = None,
    range_max: float = 20.0,
    field_of_view: float = 2 * math.pi,
    signature_span: tuple[float, float] | None = None,
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
    bias: bool = False,
    initial: LandmarkParameters | None = None,
    max_iterations: int = 300,
    tolerance: float = 1e-8,
) -> LandmarkFit:
    """Learn the landmark model's parameters: those that make features at known poses likeliest (book section 6.6).

    A feature with a known landmark j adds ``log(z_detect p(f | j) + z_false p_uniform(f))``, as in ``LandmarkModel``;
    one without has ``sum_j p(f | j) / V`` there, over the V landmarks in view from its pose. A known false positive
    adds ``log(z_false p_uniform(f))``.

    Args:
        poses: (F, 3) pose of the robot for each feature, or (S, 3) with ``scan`` [m, m, rad].
        features: (F, 2) ranges [m] and bearings [rad], or (F, 3) with signatures; NaN is what was not measured.
        landmarks: The map.
        correspondence: (F,) landmark that each feature is, -1 for none; None where that is not known.
        scan: (F,) index of each feature's pose. It also lets landmarks in view be counted, those of poses without a
            feature included: p_detect is then the share of them that some feature is.
        range_max: Largest range of a feature [m].
        field_of_view: Angle in which features are seen, in (0, 2 pi] [rad].
        signature_span: Smallest and largest signature; None is the span of the map's and the features'.
        mount: The sensor's pose (x, y, yaw) on the robot [m, m, rad].
        bias: Also fit offsets of ranges and bearings, so that they are no part of the deviations.
        initial: Where to begin; its limits do not count. None is a guess from the residuals.
        max_iterations: Most iterations.
        tolerance: The search has converged once it expects to gain less than this [nats].

    Returns:
        The fit.

    Raises:
        TypeError: an argument is not of the kind described.
        ValueError: a value breaks a rule above, the shapes differ, a feature is outside what the sensor can measure, or
            no feature says anything.
    """
    if not isinstance(landmarks, LandmarkMap):
        raise TypeError(f"landmarks: must be a LandmarkMap, got {checks.show(landmarks)}")
    if initial is not None and not isinstance(initial, LandmarkParameters):
        raise TypeError(f"initial: must be LandmarkParameters, got {checks.show(initial)}")
    if not isinstance(bias, bool):
        raise TypeError(f"bias: must be True or False, got {checks.show(bias)}")
    most = checks.integer("max_iterations", max_iterations, low=1)
    least = checks.real("tolerance", tolerance, above=0)
    base = LandmarkParameters(range_max=range_max, field_of_view=field_of_view, signature_span=signature_span)
    seen = _sightings(poses, features, landmarks, correspondence, scan, base, mount)
    start = first_guess(seen.pairs, initial)
    pairs, value, trace, converged = climb(seen.pairs, start, bias, most, least)
    seen_by_scan = None if scan is None else _seen(replace(seen, pairs=pairs), landmarks, value)
    base = base if initial is None else replace(base, p_detect=initial.p_detect)
    return report(pairs, seen.kept, seen.total, value, trace, converged, bias, base, seen_by_scan)


def _sightings(
    poses: ArrayLike, features: ArrayLike, landmarks: LandmarkMap, correspondence: ArrayLike | None,
    scan: ArrayLike | None, base: LandmarkParameters, mount: tuple[float, float, float],
) -> Sightings:  # fmt: skip
    own = landmarks.signatures
    with_signature = replace(base, sigma_signature=None if own is None else 1.0)
    full = check_features(features, with_signature, base.signature_span or (-math.inf, math.inf))
    x, y, yaw = (float(number) for number in checks.array("mount", mount, (3,)))
    where = checks.array("poses", poses, (len(full) if scan is None else "S", 3))
    at = np.arange(len(full)) if scan is None else checks.array("scan", scan, (len(full),), dtype=np.int64)
    bad = np.flatnonzero((at < 0) | (at >= len(where)))
    if len(bad):
        raise ValueError(f"scan: indices must be in [0, {len(where)}), got {at[bad[0]]} at index {bad[0]}")
    known = None if correspondence is None else check_correspondence(correspondence, len(full), len(landmarks))
    kept = np.flatnonzero((~np.isnan(full)).any(axis=1))
    if not len(kept):
        raise ValueError(f"features: must have one that says something, got {len(full)} that say nothing")
    signatures = np.concatenate([full[:, 2][~np.isnan(full[:, 2])], np.zeros(0) if own is None else own])
    span = base.signature_span or (
        (float(signatures.min()), float(signatures.max())) if len(signatures) and np.ptp(signatures) > 0 else (0.0, 1.0)
    )
    limits = Limits(base.range_max, base.field_of_view / 2, span)
    sensors = sensor_poses(where, (x, y, yaw))
    pairs = make_pairs(sensors[at[kept]], full[kept], landmarks.xy, own, None if known is None else known[kept], limits)
    return Sightings(sensors, at[kept], full[kept], kept, len(full), pairs)


def _seen(seen: Sightings, landmarks: LandmarkMap, value: Value) -> tuple[int, float]:
    """Landmarks in view, over all poses, and how many of them some feature is, as expected."""
    pairs = seen.pairs
    total = len(in_view(seen.sensors, landmarks.xy, pairs.limits)[0])
    at = pairs.in_view
    key = seen.scan[pairs.feature[at]] * len(landmarks) + pairs.landmark[at]
    _, place = np.unique(key, return_inverse=True)
    with np.errstate(divide="ignore"):
        unseen = np.bincount(place.ravel(), np.log1p(-np.minimum(value.responsibility[at], 1)))
    return total, float((-np.expm1(unseen)).sum())
