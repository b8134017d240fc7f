"""Motion noise of recorded runs among landmarks: the odometry model, and a random walk that grows with time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.localization.motion import OdometryMotion, SampledMotion
from gpusense.localization.motion_fit import fit_odometry_motion
from gpusense.localization.pose_algebra import wrap_angle
from gpusense.logs.records import LandmarkRun

ALPHA = (0.09, 0.01, 0.04, 0.0004)
# Random walk of the position [m / sqrt(s)], and the least measured random walk of the heading [rad / sqrt(s)].
DRIFT, LEAST_DRIFT_HEADING = 0.01, 0.02
# Time over which the heading's walk is measured [s].
_WINDOW = 5.0


@dataclass(frozen=True)
class DriftingOdometry:
    """Odometry motion model with a random walk in addition, whose variance grows with time.

    The scans of such runs come at irregular times, and an odometer's heading drifts even without a turn. ``predict``
    takes the odometry before and after the step, and its duration [s].

    Attributes:
        alpha: (4,) noise, see :class:`OdometryMotion`.
        reverse: Probability that the translation had the opposite direction.
        drift: Random walk of the translation [m / sqrt(s)].
        drift_heading: Random walk of the heading [rad / sqrt(s)].
    """

    alpha: tuple[float, ...] = ALPHA
    reverse: float = 0.0
    drift: float = DRIFT
    drift_heading: float = 0.1

    def __post_init__(self) -> None:
        plain = OdometryMotion(self.alpha, self.reverse)
        object.__setattr__(self, "alpha", plain.alpha)
        object.__setattr__(self, "reverse", plain.reverse)
        for name in ("drift", "drift_heading"):
            object.__setattr__(self, name, checks.real(name, getattr(self, name), low=0))

    def sampled(self, *arguments: Any) -> SampledMotion:
        """Return the numbers of a step from the odometer's poses before and after it, and its duration."""
        if len(arguments) != 3:
            raise TypeError(f"predict: must have two poses of the odometer and a duration, got {len(arguments)} values")
        root = math.sqrt(checks.real("seconds", arguments[2], low=0))
        # The two turns of a step share the heading's walk.
        least = (self.drift * root, self.drift_heading * root / math.sqrt(2))
        return OdometryMotion(self.alpha, self.reverse, least, sideways=0.0).sampled(*arguments[:2])


def heading_drift(run: LandmarkRun) -> float:
    """Measure the random walk of the odometer's heading against logged poses [rad / sqrt(s)].

    It is the root mean of error^2 / time over all pairs of scans about 5 s apart, or over a whole shorter run.
    """
    ends = np.searchsorted(run.time, run.time + min(_WINDOW, float(run.time[-1] - run.time[0])))
    begins = np.flatnonzero((ends < len(run.time)) & (ends > np.arange(len(run.time))))
    if not len(begins):
        return LEAST_DRIFT_HEADING
    ends = ends[begins]
    turned = run.truth[ends, 2] - run.truth[begins, 2]
    error = wrap_angle(turned - (run.odometry[ends, 2] - run.odometry[begins, 2]))
    return float(np.sqrt(np.mean(error**2 / (run.time[ends] - run.time[begins]))))


def run_motion(
    run: LandmarkRun,
    *,
    alpha: tuple[float, ...] | None = None,
    reverse: float | None = None,
    drift: tuple[float, float] | None = None,
    fit: bool = False,
) -> DriftingOdometry:
    """Return the motion noise of a run, with missing numbers taken from the run.

    Args:
        run: The run.
        alpha: (4,) noise of the odometry; None for ``ALPHA``.
        reverse: Probability of a reverse; None for 0.
        drift: Random walks of translation and heading; None for ``DRIFT`` and the measured walk of the heading.
        fit: Whether to learn ``alpha`` and ``reverse`` by :func:`fit_odometry_motion` if they are None.
    """
    if fit and (alpha is None or reverse is None):
        found = fit_odometry_motion(run.odometry, run.truth, systematic=False).motion
        alpha = found.alpha if alpha is None else alpha
        reverse = found.reverse if reverse is None else reverse
    if drift is None:
        drift = DRIFT, max(heading_drift(run), LEAST_DRIFT_HEADING)
    return DriftingOdometry(ALPHA if alpha is None else alpha, 0.0 if reverse is None else reverse, *drift)
