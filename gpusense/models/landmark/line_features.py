"""Lines of scans for a device: checks, and the numbers of the kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense._util import checks
from gpusense.interface import feature_layout as at
from gpusense.interface.constants import log_weight
from gpusense.models.landmark.features import PreparedFeatures, in_two_parts
from gpusense.world.frames import Mount
from gpusense.world.sensor_parameters import LARGEST_ANGLE_DEVIATION, LineParameters

ANGLE, DISTANCE, FIRST, LAST, ANGLE_VARIANCE, MIXED, DISTANCE_VARIANCE = range(7)
# Columns of features: angle and distance; and the ends; and the covariance.
_COLUMNS = (2, 4, 7)
# Distance assumed for unknown ends [m].
_UNKNOWN_END = 1e9
# Columns of low parts, and the columns that they belong to.
_LOW_PARTS = (
    (at.RANGE_LOW, at.RANGE_AT), (at.COSINE_LOW, at.COSINE), (at.SINE_LOW, at.SINE),
    (at.RANGE_SCALE_LOW, at.RANGE_SCALE), (at.BEARING_SCALE_LOW, at.BEARING_SCALE),
    (at.MIXED_SCALE_LOW, at.MIXED_SCALE), (at.PEAK_LOW, at.PEAK),
)  # fmt: skip
# Gates are widened by this share, for rounding errors.
_WIDER = 1e-5
# Two features may belong to the same line if their angles differ by less than this [rad].
_ALIKE = 0.5


def possible_lines(features: object, p: LineParameters) -> tuple[np.ndarray, np.ndarray]:
    """Return (F, 7) lines, all NaN where impossible or not measured, and (F,) whether they are impossible."""
    values = checks.as_array("features", features, masked=True)
    values = np.zeros((0, 7)) if values.shape == (0,) else checks.array("features", values, finite=False)
    if values.ndim != 2 or values.shape[1] not in _COLUMNS:
        raise ValueError(f"features: shape must be (F, 2), (F, 4) or (F, 7), got {checks.shape_text(values.shape)}")
    full = np.full((len(values), 7), np.nan)
    full[:, : values.shape[1]] = values
    unknown = np.isnan(full[:, [FIRST, LAST]]).any(axis=1)
    full[:, FIRST] = np.where(unknown, -_UNKNOWN_END, full[:, [FIRST, LAST]].min(axis=1))
    full[:, LAST] = np.where(unknown, _UNKNOWN_END, full[:, [FIRST, LAST]].max(axis=1))
    covariance = full[:, ANGLE_VARIANCE:]
    covariance[np.isnan(covariance).any(axis=1)] = 0.0
    _check_covariances(covariance)
    missing = np.isnan(full[:, :FIRST]).any(axis=1)
    deviation = np.sqrt(covariance[:, 0] + p.sigma_angle**2)
    bad = np.isinf(full).any(axis=1) | (deviation > LARGEST_ANGLE_DEVIATION)
    bad |= (full[:, DISTANCE] < 0) | (full[:, DISTANCE] > p.range_max)
    full[bad | missing] = np.nan
    return full, bad & ~missing


def _check_covariances(covariance: np.ndarray) -> None:
    """Refuse variances and covariance (F, 3) of a matrix that is not positive semidefinite."""
    one, both, other = covariance.T
    with np.errstate(over="ignore", invalid="ignore"):
        wrong = (one < 0) | (other < 0) | (np.square(both) > one * other * (1 + 1e-9))
    index = np.flatnonzero(wrong)
    if len(index):
        got = checks.show(covariance[index[0]].tolist())
        raise ValueError(f"features: covariance must be positive semidefinite, got {got} at index {index[0]}")


@dataclass(frozen=True)
class _Whitened:
    """Covariances of features by Cholesky's factor: the exponent is (a da)^2 + (b da + c dr)^2."""

    a: np.ndarray  # (K,) factor of the angle
    b: np.ndarray  # (K,) factor of the angle in the second root
    c: np.ndarray  # (K,) factor of the distance
    slope: np.ndarray  # (K,) change of the expected distance with the angle [m/rad]
    spread: np.ndarray  # (K,) standard deviation of the distance [m]


def _whitened(features: np.ndarray, p: LineParameters) -> _Whitened:
    """Return the covariance of features: the measured one plus the model's, at the middle of the visible part."""
    middle = 0.5 * (features[:, FIRST] + features[:, LAST])
    one = features[:, ANGLE_VARIANCE] + p.sigma_angle**2
    both = features[:, MIXED] + middle * p.sigma_angle**2
    slope = both / one
    # The model's part first: the contribution of the lever cancels.
    across = p.sigma_distance**2 + (middle - slope) ** 2 * p.sigma_angle**2
    measured = features[:, DISTANCE_VARIANCE] - 2 * slope * features[:, MIXED] + slope**2 * features[:, ANGLE_VARIANCE]
    rest = across + np.maximum(measured, 0.0)
    a, c = np.sqrt(0.5 / one), np.sqrt(0.5 / rest)
    return _Whitened(a, -slope * c, c, slope, np.sqrt(rest + slope**2 * one))


def prepare_lines(
    features: np.ndarray,
    p: LineParameters,
    mount: Mount,
    real: np.dtype,
    *,
    extent: float,
    longest: float,
    gated: bool,
    grouped: int,
) -> PreparedFeatures:
    """Return the numbers of (F, 7) possible lines.

    ``features``: angle, distance, ends and covariance; NaN where left out; ``mount``: the sensor's pose on the robot;
    ``extent``: largest coordinate of the map in its buckets' frame [m]; ``longest``: half the length of the longest
    line of the map [m]; ``gated``: whether to bound the lines that can matter; ``grouped``: largest number of features
    among which overlaps are searched.
    """
    columns = np.flatnonzero(~np.isnan(features[:, ANGLE]))
    kept = features[columns]
    w = _whitened(kept, p)
    uniform = -math.log(2 * math.pi) - math.log(p.range_max)
    false = np.where(np.isnan(features[:, ANGLE]), 0.0, log_weight(p.z_false) + uniform)
    angle = kept[:, ANGLE] + mount[2]
    numbers = np.zeros((len(columns), at.FEATURE))
    numbers[:, at.RANGE_AT] = kept[:, DISTANCE]
    numbers[:, at.COSINE], numbers[:, at.SINE] = np.cos(angle), np.sin(angle)
    numbers[:, at.BEARING_SCALE], numbers[:, at.MIXED_SCALE], numbers[:, at.RANGE_SCALE] = w.a, w.b, w.c
    numbers[:, at.PEAK] = log_weight(p.z_detect) + np.log(w.a * w.c / math.pi)
    numbers[:, at.FALSE_POSITIVE] = false[columns]
    numbers[:, at.FIRST_END], numbers[:, at.LAST_END] = kept[:, FIRST], kept[:, LAST]
    numbers[:, at.RANGE_SPREAD] = math.sqrt(0.5) / w.spread
    if len(kept) <= grouped:
        numbers[:, at.GROUP] = _groups(kept)
    _gate(numbers, kept, w, p, real, extent=extent, longest=longest, gated=gated)
    rounded = in_two_parts(numbers, real, _LOW_PARTS)
    return PreparedFeatures(columns, rounded, np.ones((len(columns), 3), bool), false)


def _gate(
    numbers: np.ndarray, kept: np.ndarray, w: _Whitened, p: LineParameters, real: np.dtype, *, extent: float,
    longest: float, gated: bool,
) -> None:  # fmt: skip
    """Write the bounds of the lines whose density is at least eps / e of a false positive's.

    The middle of such a line is in a disc around the foot of the feature's normal: some point of the feature between
    its ends is opposite to a point of the line.
    """
    # The mass of the distance is least for a line at the sensor or at range_max.
    mass = np.vectorize(math.erf, otypes=[float])(p.range_max * numbers[:, at.RANGE_SPREAD])
    with np.errstate(divide="ignore"):
        highest = numbers[:, at.PEAK] - np.log(0.5 * mass)
    smallest = numbers[:, at.FALSE_POSITIVE] + math.log(np.finfo(real).eps) - 1
    exponent = np.where(np.isneginf(highest), -np.inf, highest - smallest) if gated else np.full(len(kept), np.inf)
    root = np.sqrt(np.maximum(exponent, 0.0))
    turn = np.minimum(root / w.a, math.pi)
    end = np.abs(kept[:, [FIRST, LAST]]).max(axis=1, initial=0)
    off = root / w.c + np.abs(w.slope) * turn
    reach = kept[:, DISTANCE]
    radius = longest + end * (1 + np.sin(turn)) + off + reach * (1 - np.cos(turn))
    radius = np.where(turn < math.pi / 2, radius, np.inf)
    slack = 16 * np.finfo(real).eps * (extent + 2 * p.range_max)
    numbers[:, at.REACH] = reach
    numbers[:, at.RADIUS] = np.where(exponent < 0, -1.0, radius * (1 + _WIDER) + slack)
    numbers[:, at.AXIS] = np.where(turn < math.pi / 2, np.cos(turn * (1 + _WIDER) + _WIDER), -2.0)


def _groups(kept: np.ndarray) -> np.ndarray:
    """Return the group of each feature; features that overlap, directly or through a chain, share a group.

    Features of one line overlap if the projection of one on the other shares a part with it, and their angles are
    similar.
    """
    from scipy.sparse.csgraph import connected_components

    if not len(kept):
        return np.zeros(0)
    angle, distance = kept[:, ANGLE], kept[:, DISTANCE]
    turn = angle[:, None] - angle
    ends = [distance[:, None] * np.sin(turn) + kept[:, [e]] * np.cos(turn) for e in (FIRST, LAST)]
    low, high = np.minimum(*ends), np.maximum(*ends)
    common = (low < kept[:, LAST]) & (high > kept[:, FIRST]) & (np.cos(turn) > math.cos(_ALIKE))
    return connected_components(common | common.T, directed=False)[1].astype(float)
