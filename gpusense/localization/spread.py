"""Compute the probability that a pose is far off, from particles or from a covariance, and its word."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from gpusense._util.typing import Floats
from gpusense.interface import constants
from gpusense.localization.pose_algebra import wrap_angle

Word = Literal["tracking", "uncertain", "lost"]
WORDS: tuple[Word, ...] = ("tracking", "uncertain", "lost")
# Bounds on the probability of "lost" (above) and "tracking" (up to).
LOST, TRACKING = 0.5, 0.1
# Least errors of a pose far off, in the definition of p_lost [m, rad].
FAR, FAR_TURN = constants.FAR, constants.FAR_TURN
# Largest deviations of concentrated particles [m, rad].
WIDE, WIDE_TURN = 0.5, 0.25
# Largest deviations for a normal density instead of particles [m, rad].
_NARROW, _NARROW_TURN = 0.2, 0.1
# Nodes and weights of a Gauss-Legendre quadrature on [-1, 1].
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)


def deviations(covariance: Floats) -> tuple[float, float]:
    """Return the largest standard deviation of the position over directions [m], and the heading's deviation [rad]."""
    # Python's floats are several times faster than arrays of nine items.
    (xx, xy, xt), (yx, yy, yt), (tx, ty, tt) = covariance.tolist()
    if not all(map(math.isfinite, (xx, xy, xt, yx, yy, yt, tx, ty, tt))):
        return math.inf, math.inf
    largest = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
    return math.sqrt(max(largest, 0.0)), math.sqrt(max(tt, 0.0))


class Spread(NamedTuple):
    """Classes of a covariance, by the largest standard deviations of position and heading.

    Attributes:
        wide: True if the position's exceeds 0.5 m, or the heading's 0.25 rad.
        apart: True if the position's exceeds 1 m, or the heading's 0.5 rad: the distribution may cover several
            places.
        narrow: True if the position's is below 0.2 m and the heading's below 0.1 rad: a normal density then describes
            the particles.
    """

    wide: bool
    apart: bool
    narrow: bool


def spread_of(covariance: Floats) -> Spread:
    """Classify a (3, 3) covariance of x, y [m] and heading [rad]."""
    position, heading = deviations(covariance)
    return Spread(
        position > WIDE or heading > WIDE_TURN, position > FAR or heading > FAR_TURN,
        position < _NARROW and heading < _NARROW_TURN,
    )  # fmt: skip


def verdict_label(p_lost: float, wrong: float, *, wide: bool, apart: bool) -> Word:
    """Return the word for the probability of being lost, and of another place being right by the scans.

    A distribution that is ``apart`` may cover several places, so that scans cannot contradict a single one.
    """
    if wrong > LOST and not apart:
        return "lost"
    return "uncertain" if wide or apart or p_lost > TRACKING else "tracking"


def share_off(covariance: Floats) -> float:
    """Return the probability that a normal error with a (3, 3) covariance is beyond 1 m or 0.5 rad.

    Position and heading are treated as independent, correct to second order in each.
    """
    large, heading = deviations(covariance)
    if math.isinf(large):
        return 1.0
    trace = max(float(covariance[0, 0] + covariance[1, 1]), 0.0)
    small = math.sqrt(max(trace - large * large, 0.0))
    within = _within_disc(large, small) * _within(FAR_TURN, heading)
    return min(max(1.0 - within, 0.0), 1.0)


def share_off_of(poses: Floats, weights: Floats, pose: Floats) -> float:
    """Return the share of (N, 3) particles, by (N,) weights, that are beyond 1 m or 0.5 rad of a (3,) pose."""
    total = float(weights.sum())
    if not total > 0:
        return 1.0
    d = poses - pose
    far = (d[:, 0] ** 2 + d[:, 1] ** 2 > FAR**2) | (np.abs(wrap_angle(d[:, 2])) > FAR_TURN)
    return float(weights[far].sum()) / total


def _within(limit: float, deviation: float) -> float:
    """Return the probability that a normal number is within +-``limit``."""
    return 1.0 if deviation == 0 else math.erf(limit / deviation / math.sqrt(2))


def _within_disc(large: float, small: float) -> float:
    """Return the probability that a normal error with two principal deviations is within the disc of radius FAR."""
    if large < _NARROW:
        return 1.0
    reach = min(FAR, 8 * large)
    along = reach * _NODES
    chord = np.sqrt(np.maximum(FAR**2 - along**2, 0.0))
    across = np.array([_within(half, small) for half in chord.tolist()])
    density = np.exp(-0.5 * (along / large) ** 2) / (large * math.sqrt(2 * math.pi))
    return float(reach * (_WEIGHTS @ (density * across)))
