"""Compute the probability that a pose is far off, its word, and the protection level of a position.

The protection level is a radius that the error exceeds with at most a stated probability, the risk (Joerger and others,
"Integrity monitoring of localization systems", *Sensors* 18(8), 2018, 2740). Errors of filters have longer tails than
the particles, and the walls of a map are off by about a cell. So the radius is multiplied by a factor, and a margin is
added; both were measured on logs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.interface import constants
from gpusense.localization.sensors import Sensor
from gpusense.world.pose_algebra import wrap_angle

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


def deviations(covariance: Floats) -> tuple[float, float]:
    """Return the largest standard deviation of the position over directions [m], and the heading's deviation [rad]."""
    # Python's floats are several times faster than arrays of nine items.
    (xx, xy, xt), (yx, yy, yt), (tx, ty, tt) = covariance.tolist()
    if not math.isfinite(xx + xy + xt + yx + yy + yt + tx + ty + tt):
        return math.inf, math.inf
    largest = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
    return math.sqrt(max(largest, 0.0)), math.sqrt(max(tt, 0.0))


class Spread(NamedTuple):
    """Standard deviations of a covariance, and classes by them."""

    position: float  # the position's largest standard deviation [m]
    heading: float  # the heading's [rad]
    wide: bool  # true if the position's exceeds 0.5 m, or the heading's 0.25 rad
    # True if the position's exceeds 1 m, or the heading's 0.5 rad: the distribution may cover several places.
    apart: bool
    # True if the position's is below 0.2 m and the heading's below 0.1 rad: a normal density then describes the
    # particles.
    narrow: bool
    clear: bool  # true if both are below three quarters of these limits: the next ones will probably be narrow


def spread_of(covariance: Floats) -> Spread:
    """Classify a (3, 3) covariance of x, y [m] and heading [rad]."""
    position, heading = deviations(covariance)
    return Spread(
        position, heading, position > WIDE or heading > WIDE_TURN, position > FAR or heading > FAR_TURN,
        position < _NARROW and heading < _NARROW_TURN, position < 0.75 * _NARROW and heading < 0.75 * _NARROW_TURN,
    )  # fmt: skip


def verdict_label(p_lost: float, wrong: float, *, wide: bool, apart: bool) -> Word:
    """Return the word for the probability of being lost, and of another place being right by the scans.

    A distribution that is ``apart`` may cover several places, so that scans cannot contradict a single one.
    """
    if wrong > LOST and not apart:
        return "lost"
    return "uncertain" if wide or apart or p_lost > TRACKING else "tracking"


def share_off(covariance: Floats, spread: Spread | None = None) -> float:
    """Return the probability that a normal error with a (3, 3) covariance is beyond 1 m or 0.5 rad.

    Position and heading are treated as independent, correct to second order in each.
    """
    large, heading, *_ = spread_of(covariance) if spread is None else spread
    if math.isinf(large):
        return 1.0
    within = _within(FAR_TURN, heading)
    if large >= _NARROW:
        small = min(max(float(covariance[0, 0] + covariance[1, 1]) - large * large, 0.0), large * large)
        within *= 1 - _beyond(FAR, large * large, small)
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


def _beyond(radius: float, large: float, small: float) -> float:
    """Return the probability that a normal position with two principal variances is beyond a radius.

    The position is (a u cos t, b u sin t) with the deviations a and b along its axes, u of a Rayleigh density and t
    uniform. It is beyond r with probability exp(-r^2 / (2 (a^2 cos^2 t + b^2 sin^2 t))), averaged over t. The mean over
    equal angles converges faster than any power of their number, even for b = 0.
    """
    return float(np.exp(-0.5 * radius * radius / (small + (large - small) * _COSINES)).mean())


# Factor of the spread, least margin [m], and least risk that their calibration supports.
WIDENING, MARGIN, LEAST_RISK = 1.25, 0.05, 0.01
# Least effective sample size of a meaningful covariance.
LEAST_SAMPLE = 10.0
# Angles of the integral over a normal position: middles of parts of a quarter turn.
_PARTS = 96
_COSINES = np.cos((np.arange(_PARTS) + 0.5) * (math.pi / 2 / _PARTS)) ** 2
# Steps of the bisection; each halves the interval.
_STEPS = 60
# Number of poses around a pose without a covariance, and of beams that weigh them. Steps of a low-discrepancy sequence:
# the first powers of 1 / x for x^4 = x + 1 (Roberts, "The unreasonable effectiveness of quasirandom sequences" (2018)).
_AROUND, _BEAMS, _SEQUENCE = 2048, 240, 1.2207440846057596 ** -np.arange(1.0, 4.0)


class Distances:
    """Distances of particles from a (3,) pose, sorted when a radius is first asked for, since steps need none.

    ``particles`` returns (N, 3) particles and (N,) weights >= 0, not necessarily normalised.
    """

    def __init__(self, particles: Callable[[], tuple[Floats, Floats]], pose: Floats) -> None:
        self._particles, self._pose = particles, pose

    def __getstate__(self) -> dict[str, Any]:
        return {"_sorted": self._sorted}

    @functools.cached_property
    def _sorted(self) -> tuple[Floats, Floats]:
        """Distances (N,) [m], increasing, and the share of the particles that is farther than each."""
        (poses, weights), pose = self._particles(), self._pose
        distance = np.hypot(poses[:, 0] - pose[0], poses[:, 1] - pose[1])
        order = np.argsort(distance, kind="stable")
        sums = np.cumsum(weights[order])
        return distance[order], 1 - sums / sums[-1]

    def radius(self, beyond: float) -> float:
        """Return the least distance exceeded by at most a share of the particles."""
        distance, farther = self._sorted
        # Sums of many weights are 1 up to rounding.
        k = int(np.searchsorted(-farther, -beyond - 1e-12))
        return float(distance[min(k, len(distance) - 1)])


def check_risk(risk: float) -> float:
    """Return a risk that the calibration supports."""
    risk = checks.real("risk", risk, high=1.0)
    if risk < LEAST_RISK:
        rule = f"must be at least {LEAST_RISK}, the least risk that the calibration on logs supports"
        raise ValueError(f"risk: {rule}, got {checks.show(risk)}")
    return risk


def distances_by_scan(sensors: Sequence[Sensor], readings: Mapping[int, tuple[Any, ...]], pose: Floats) -> Distances:
    """Return distances of poses within 1 m and 0.5 rad of a pose, weighted by the likelihoods of readings there.

    The poses are denser near the pose (3,); their weights make up for it. Keys of the readings are indices of sensors.
    """
    far, angle, turn = (np.arange(1, _AROUND + 1)[:, None] * _SEQUENCE % 1).T
    far, angle, turn = far**2, math.tau * angle, 2 * turn - 1
    offsets = np.column_stack([
        FAR * far * np.cos(angle), FAR * far * np.sin(angle), FAR_TURN * turn * np.abs(turn),
    ])  # fmt: skip
    poses = pose + offsets

    def particles() -> tuple[Floats, Floats]:
        log_p = np.zeros(_AROUND)
        for index, reading in readings.items():
            sensor, every = sensors[index], 1
            if sensor.calibrates and sensor.beams == len(reading[0]):
                # Few beams have as much information at their temperature, in less time.
                every = max(sensor.beams // _BEAMS, 1)
                reading = (np.where(np.arange(sensor.beams) % every == 0, reading[0], np.nan), *reading[1:])
            temperature = min(every * sensor.temperature("auto"), 1.0)
            log_p += temperature * np.asarray(sensor.model.log_likelihood(poses, *reading), np.float64)
        best = log_p.max()
        likelihood = np.exp(log_p - best) if math.isfinite(best) else np.ones(_AROUND)
        return poses, np.asarray(likelihood * far**1.5 * np.abs(turn))

    return Distances(particles, pose)


def margins_of(sensors: Sequence[Sensor]) -> tuple[float, float]:
    """Return the factor of the spread and the margin [m] of poses that sensors with a map judge."""
    cells = [sensor.model.grid.resolution for sensor in sensors if sensor.calibrates]
    return WIDENING, max([MARGIN, *cells])


class JudgedPose:
    """A pose with the probability of being lost, and the radius of its error."""

    p_lost: float
    covariance: Floats | None
    widening: float
    margin: float
    distances: Distances | None

    @property
    def lost(self) -> bool:
        """True if p_lost is above 0.5: the pose is unusable, because scans contradict it or the spread is wide."""
        return self.p_lost > LOST

    def _moments(self) -> Floats | None:
        """Return the (3, 3) second moments of the error, or None if the localiser states none."""
        return self.covariance

    def protection_level(self, risk: float) -> float:
        """Return the radius that the error of the position exceeds with at most a stated probability [m].

        It is the smallest r with ``p_lost + (1 - p_lost) P(|error| > r | not lost) <= risk``. P comes from the
        particles or the covariance, with the spread times ``widening`` and plus ``margin``; see
        ``docs/localization.md``. If a localiser states no covariance, P comes from the likelihood of the scan at poses
        around the pose, and the radius is at most 1 m, the largest error of a pose that is not lost.

        Args:
            risk: The probability, from 0.01 to 1, the range supported by logs.

        Returns:
            The radius; infinite if p_lost exceeds the risk or a filter's effective sample size is below 10.

        Raises:
            TypeError, ValueError: ``risk`` breaks its rule.

        Example:
            >>> import gpusense as gs, numpy as np
            >>> e = gs.Estimate(np.zeros(3), np.eye(3) * 0.01, 250.0, 0.0, "tracking", 0.9, 0.1, 1.0, False, 500)
            >>> round(e.protection_level(risk=0.01), 3)
            0.303
        """
        risk, moments, distances = check_risk(risk), self._moments(), self.distances
        if risk == 1:
            return 0.0
        if not self.p_lost <= risk:
            return math.inf
        beyond = (risk - self.p_lost) / (1 - self.p_lost)
        if moments is None:
            return FAR if distances is None else min(self.widening * distances.radius(beyond) + self.margin, FAR)
        radius = normal_radius(moments, beyond)
        if distances is not None:
            radius = max(radius, distances.radius(beyond))
        return self.widening * radius + self.margin


def normal_radius(covariance: Floats, beyond: float) -> float:
    """Return the distance that a normal position exceeds with a probability."""
    large, _ = deviations(covariance)
    if not math.isfinite(large):
        return math.inf
    if large == 0 or beyond >= 1:
        return 0.0
    if beyond <= 0:
        return math.inf
    (xx, _, _), (_, yy, _), _ = (covariance / large / large).tolist()
    small = min(max(xx + yy - 1, 0.0), 1.0)
    low, high = 0.0, math.sqrt(-2 * math.log(beyond))
    for _ in range(_STEPS):
        middle = (low + high) / 2
        if _beyond(middle, 1.0, small) > beyond:
            low = middle
        else:
            high = middle
    return large * high
