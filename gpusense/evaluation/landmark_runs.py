"""Evaluate recorded runs among landmarks: noise, association and localisation, against logged poses."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from gpusense._util import checks
from gpusense.evaluation.log_steps import Step
from gpusense.evaluation.tracking import Track
from gpusense.learning.fitted import LandmarkFit
from gpusense.learning.landmark.fit import fit_landmark_parameters
from gpusense.localization.filter import ParticleFilter
from gpusense.localization.motion import OdometryMotion, SampledMotion
from gpusense.localization.motion_fit import fit_odometry_motion
from gpusense.logs.records import LandmarkRun, Pose, Scan
from gpusense.models.landmark.model import LandmarkModel
from gpusense.world.parameters import LandmarkParameters
from gpusense.world.pose_algebra import wrap_angle
from gpusense.world.scanner import Scanner

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


def make_filter(
    run: LandmarkRun, model: LandmarkModel, motion: DriftingOdometry, *, particles: int = 2000, seed: int = 0
) -> ParticleFilter:
    """Make a filter that starts around the first logged pose of a run (``START``)."""
    pf = ParticleFilter(model, motion=motion, particles=particles, seed=seed)
    pf.initialize(mean=run.truth[0], covariance=np.diag([START**2, START**2, START_HEADING**2]))
    return pf


def follow(pf: ParticleFilter, run: LandmarkRun, track: Track, *, known: bool) -> Iterator[Step]:
    """Run a filter along a run; yield each step, a scan without beams, after it was added to the track."""
    rows = {int(run.scan[first]): slice(first, last) for first, last in _scans(run)}
    no_beams = Scanner((), 1.0)
    for s, (seconds, odometry, truth) in enumerate(zip(run.time, run.odometry, run.truth, strict=True)):
        clock = [time.perf_counter()]
        if s:
            pf.predict(run.odometry[s - 1], odometry, float(seconds - run.time[s - 1]))
        clock.append(time.perf_counter())
        if s in rows:
            pf.correct((run.features[rows[s]], run.ids[rows[s]] if known else None))
        clock.append(time.perf_counter())
        pose, reference = (cast(Pose, tuple(pose.tolist())) for pose in (odometry, truth))
        step = Step(s, Scan(float(seconds), np.empty(0), no_beams, pose, reference), pose, reference=reference)
        track.add(pf, step, clock)
        yield step


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
