"""Protection level of a position: a radius that the error exceeds with at most a stated probability, the risk.

Let p_lost be the probability that the pose is lost. The protection level is the smallest r with

    p_lost + (1 - p_lost) P(|error| > r | not lost) <= risk

(Joerger and others, "Integrity monitoring of localization systems", *Sensors* 18(8), 2018, 2740, use the same terms).
P comes from a normal density with the covariance of the position, and from the distances of spread-out particles.
Errors of filters have longer tails than the particles, so the spread is multiplied by a factor measured on logs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense.localization.spread import FAR, deviations

Floats = NDArray[np.float64]

# Factor of the spread, and least risk that its calibration supports.
WIDENING, LEAST_RISK = 2.0, 0.01
# Least effective sample size of a meaningful covariance.
LEAST_SAMPLE = 10.0
# Angles of the integral over a normal position: middles of parts of a quarter turn.
_PARTS = 96
_COSINES = np.cos((np.arange(_PARTS) + 0.5) * (math.pi / 2 / _PARTS)) ** 2
# Steps of the bisection; each halves the interval.
_STEPS = 60


class Distances:
    """Distances of particles from a pose, sorted when a radius is first asked for: a filter's step has no use for them.

    Args:
        particles: Returns (N, 3) particles and (N,) weights >= 0, not necessarily normalised.
        pose: (3,) pose.
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


def protection_level(
    risk: float, p_lost: float, covariance: Floats | None, widening: float, distances: Distances | None = None
) -> float:
    """Return the protection level of a pose [m].

    Args:
        risk: Largest probability that the position is farther off, from ``LEAST_RISK`` to 1.
        p_lost: Probability that the pose is lost.
        covariance: (3, 3) covariance of x, y [m] and heading; None if unknown: a pose that is not lost is off by at
            most 1 m.
        widening: Factor of the spread.
        distances: Distances of the particles from the pose; None if the covariance describes them.
    """
    risk = check_risk(risk)
    if risk == 1:
        return 0.0
    if not p_lost <= risk:
        return math.inf
    if covariance is None:
        return FAR
    beyond = (risk - p_lost) / (1 - p_lost)
    radius = normal_radius(covariance, beyond)
    if distances is not None:
        radius = max(radius, distances.radius(beyond))
    return widening * radius


def normal_radius(covariance: Floats, beyond: float) -> float:
    """Return the distance that a normal position exceeds with a probability.

    The position is (a u cos t, b u sin t) with the deviations a and b along its axes, u of a Rayleigh density and t
    uniform. It is beyond r with probability exp(-r^2 / (2 (a^2 cos^2 t + b^2 sin^2 t))), averaged over t. The mean over
    equal angles converges faster than any power of their number, even for b = 0.

    Args:
        covariance: (3, 3) covariance of x, y [m] and heading; entries may be infinite or NaN.
        beyond: The probability, from 0 to 1.

    Returns:
        The distance [m]; infinite for an infinite covariance or a probability of 0.
    """
    large, _ = deviations(covariance)
    if not math.isfinite(large):
        return math.inf
    if large == 0 or beyond >= 1:
        return 0.0
    if beyond <= 0:
        return math.inf
    (xx, _, _), (_, yy, _), _ = (covariance / large / large).tolist()
    small = min(max(xx + yy - 1, 0.0), 1.0)
    variances = small + (1 - small) * _COSINES
    low, high = 0.0, math.sqrt(-2 * math.log(beyond))
    for _ in range(_STEPS):
        middle = (low + high) / 2
        if np.exp(-0.5 * middle * middle / variances).mean() > beyond:
            low = middle
        else:
            high = middle
    return large * high
