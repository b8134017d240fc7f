"""Evaluate recorded runs among landmarks: noise, association and localisation, against logged poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.learning.fitted import LandmarkFit
from gpusense.learning.landmark.fit import fit_landmark_parameters
from gpusense.localization.filter import ParticleFilter
from gpusense.localization.motion import OdometryMotion, SampledMotion
from gpusense.localization.motion_fit import fit_odometry_motion
from gpusense.localization.pose_algebra import wrap_angle
from gpusense.localization.spread import LOST
from gpusense.logs.records import LandmarkRun
from gpusense.models.landmark.model import LandmarkModel
from gpusense.world.parameters import LandmarkParameters

ALPHA: tuple[float, ...] = (0.09, 0.01, 0.04, 0.0004)
# Random walk of the position [m / sqrt(s)], and the least measured random walk of the heading [rad / sqrt(s)].
DRIFT, LEAST_DRIFT_HEADING = 0.01, 0.02
# Time over which the heading's walk is measured [s].
_WINDOW = 5.0


@dataclass(frozen=True)
class DriftingOdometry:
    """Odometry motion model plus a random walk: its variance grows with time.

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


def run_motion(run: LandmarkRun, *, drift: tuple[float, float] | None = None, fit: bool = False) -> DriftingOdometry:
    """Return the motion noise of a run; ``fit`` learns ``alpha`` and ``reverse`` by :func:`fit_odometry_motion`.

    ``drift``: Random walks of translation and heading; None for ``DRIFT`` and the measured walk of the heading.
    """
    alpha, reverse = ALPHA, 0.0
    if fit:
        found = fit_odometry_motion(run.odometry, run.truth, systematic=False).motion
        alpha, reverse = found.alpha, found.reverse
    return DriftingOdometry(alpha, reverse, *(drift or (DRIFT, max(heading_drift(run), LEAST_DRIFT_HEADING))))


# Lower bound of z_false for a filter, since a fit of clean data gives 0, and the next feature may be a false positive.
LEAST_FALSE = 0.01
# Tracks begin around the first logged pose, with these deviations of x and y [m], and of the heading [rad].
START, START_HEADING = 0.5, 0.3


@dataclass(frozen=True, eq=False)
class Track:
    """Result of a particle filter.

    Attributes:
        estimate: (S, 3) weighted means after each scan [m, m, rad].
        error: (S,) distance from the logged position [m].
        error_heading: (S,) absolute error of the heading [rad].
        degenerate: Number of scans that are impossible at every particle.
        time: (S,) time of each scan [s].
        gain: (S,) gain of the particles over chance in predicting recent features [nats per feature].
        scans_lost: (S,) whether p_lost is above 0.5 after each scan.
        p_lost: (S,) probability that the estimate is off by more than 1 m or 0.5 rad.
    """

    estimate: Floats
    error: Floats
    error_heading: Floats
    degenerate: int
    time: Floats
    gain: Floats
    scans_lost: NDArray[np.bool_]
    p_lost: Floats

    @property
    def lost(self) -> bool:
        """Tell whether the filter is lost at the end: at most of the last tenth of the scans."""
        return bool(np.mean(self.scans_lost[-max(len(self.time) // 10, 1) :]) > 0.5)

    @property
    def lost_since(self) -> float | None:
        """Time after the first scan from which the filter is lost to the end [s]; None if it is not lost."""
        if not self.lost:
            return None
        found = np.flatnonzero(~self.scans_lost)
        last = int(np.flatnonzero(self.scans_lost)[-1])
        before = found[found < last]
        return float(self.time[int(before[-1]) + 1 if len(before) else 0] - self.time[0])

    def summary(self) -> dict[str, float | bool | None]:
        """Return medians, 90 % quantiles and largest errors, and the verdict."""
        last = max(len(self.time) // 10, 1)
        tail = self.gain[-last:]
        return {
            "error_median": float(np.median(self.error)), "error_90": float(np.quantile(self.error, 0.9)),
            "error_max": float(self.error.max()), "heading_median": float(np.median(self.error_heading)),
            "heading_90": float(np.quantile(self.error_heading, 0.9)), "degenerate": self.degenerate,
            "lost": self.lost, "lost_since": self.lost_since, "scans_lost": int(self.scans_lost.sum()),
            "p_lost": float(np.median(self.p_lost[-last:])),
            "gain_last": None if np.isnan(tail).all() else float(np.nanmedian(tail)),
        }  # fmt: skip


def fit_run(run: LandmarkRun, *, known: bool = True) -> LandmarkFit:
    """Fit the noise of a run's features at its logged poses."""
    return fit_landmark_parameters(
        run.truth, run.features, run.landmarks, correspondence=run.ids if known else None, scan=run.scan,
        range_max=run.range_max, field_of_view=run.field_of_view,
    )  # fmt: skip


def usable(parameters: LandmarkParameters) -> LandmarkParameters:
    """Return the parameters with ``z_false`` raised to at least ``LEAST_FALSE``."""
    z = max(parameters.z_false, LEAST_FALSE)
    return parameters.replace(z_false=z, z_detect=1 - z)


def association(run: LandmarkRun, model: LandmarkModel) -> dict[str, float]:
    """Compare the likeliest landmark of each feature at the logged poses with the recorded one.

    Returns:
        Shares of features: right, none (classed as a false positive but recorded as a landmark) and wrong.
    """
    likeliest = np.empty(len(run.ids), np.int64)
    for first, last in _scans(run):
        likeliest[first:last] = model.associate(run.truth[[run.scan[first]]], run.features[first:last])[0][0]
    right = likeliest == run.ids
    none = ~right & (likeliest == -1)
    return {"right": float(right.mean()), "none": float(none.mean()), "wrong": float((~right & ~none).mean())}


def localise(
    run: LandmarkRun,
    model: LandmarkModel,
    *,
    known: bool,
    particles: int = 2000,
    seed: int = 0,
    motion: DriftingOdometry | None = None,
    step: Callable[[str], None] | None = None,
) -> Track:
    """Run :class:`ParticleFilter` along a run, from around its first logged pose (``START``)."""
    pf = ParticleFilter(model, motion=run_motion(run) if motion is None else motion, particles=particles, seed=seed)
    pf.initialize(mean=run.truth[0], covariance=np.diag([START**2, START**2, START_HEADING**2]))
    degenerate = 0
    estimate, gain, p_lost = np.empty_like(run.truth), np.empty(len(run.time)), np.empty(len(run.time))
    rows = {int(run.scan[first]): slice(first, last) for first, last in _scans(run)}
    for s in range(len(run.time)):
        if step is not None and s % 100 == 0:
            step(f"scan {s}" + (", lost" if s and p_lost[s - 1] > LOST else ""))
        if s:
            pf.predict(run.odometry[s - 1], run.odometry[s], float(run.time[s] - run.time[s - 1]))
        if s in rows:
            features, ids = run.features[rows[s]], run.ids[rows[s]] if known else None
            pf.correct((features, ids))
        found = pf.estimate()
        degenerate += found.degenerate and s in rows
        estimate[s], gain[s], p_lost[s] = found.pose, pf.gain, found.p_lost
    away = estimate - run.truth
    turn = np.abs(wrap_angle(away[:, 2]))
    return Track(estimate, np.hypot(*away[:, :2].T), turn, degenerate, run.time, gain, p_lost > LOST, p_lost)


def _scans(run: LandmarkRun) -> list[tuple[int, int]]:
    """Return the first feature and the end (excluded) of each scan that has features."""
    starts = np.flatnonzero(np.diff(run.scan, prepend=-1))
    return list(zip(starts.tolist(), [*starts[1:].tolist(), len(run.scan)], strict=True))


def first_scans(run: LandmarkRun, count: int | None) -> LandmarkRun:
    """Return a run of the first ``count`` scans; None for all."""
    if count is None or count >= len(run.time):
        return run
    kept = run.scan < count
    return replace(
        run, time=run.time[:count], odometry=run.odometry[:count], truth=run.truth[:count],
        features=run.features[kept], scan=run.scan[kept], ids=run.ids[kept],
    )  # fmt: skip
