"""Runs of a robot among landmarks: noise, association and localisation, against logged poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpusense.learning.landmark.fit import fit_landmark_parameters
from gpusense.learning.landmark.result import LandmarkFit
from gpusense.learning.landmark.suspicious import Suspicions, suspicious_landmarks
from gpusense.localization.weights import normalize_weights, resample
from gpusense.logs.records import LandmarkRun
from gpusense.models.landmark.model import LandmarkModel
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.parameters import LandmarkParameters

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# A filter's sensor is never sure: fits of clean data have no false positives, and the next feature may be one.
LEAST_FALSE = 0.01


@dataclass(frozen=True)
class Motion:
    """Noise of the odometry motion model (book table 5.6), and what is added per root of a second.

    ``turn_by_turn`` to ``turn_by_way`` are the roots of the book's alpha_1 to alpha_4, without units but for those by
    the way (1/m) and of the way by turns (m/rad).
    """

    turn_by_turn: float = 0.3
    turn_by_way: float = 0.1
    way_by_way: float = 0.2
    way_by_turn: float = 0.02
    drift: float = 0.01
    """Of the position, in x and in y [m / sqrt(s)]."""
    drift_heading: float = 0.07
    """Of the heading [rad / sqrt(s)]."""


@dataclass(frozen=True, eq=False)
class Track:
    """What a filter found.

    Attributes:
        estimate: (S, 3) weighted means after each scan.
        error: (S,) distance from the logged position [m].
        error_heading: (S,) size of the heading's error [rad].
        degenerate: Scans that no particle could have made.
    """

    estimate: Floats
    error: Floats
    error_heading: Floats
    degenerate: int

    def summary(self) -> dict[str, float]:
        """Medians, 90 % and largest errors."""
        return {
            "error_median": float(np.median(self.error)), "error_90": float(np.quantile(self.error, 0.9)),
            "error_max": float(self.error.max()), "heading_median": float(np.median(self.error_heading)),
            "heading_90": float(np.quantile(self.error_heading, 0.9)), "degenerate": self.degenerate,
        }  # fmt: skip


def fit_run(run: LandmarkRun, *, known: bool = True, bias: bool = False) -> LandmarkFit:
    """The noise of a run's features at its logged poses."""
    return fit_landmark_parameters(
        run.truth, run.features, run.landmarks, correspondence=run.ids if known else None, scan=run.scan,
        range_max=run.range_max, field_of_view=run.field_of_view, bias=bias,
    )  # fmt: skip


def suspicions(run: LandmarkRun, fit: LandmarkFit) -> Suspicions:
    """Landmarks of a run that stand where others should."""
    return suspicious_landmarks(run.poses, run.features, run.landmarks, run.ids, fit.parameters)


def usable(parameters: LandmarkParameters) -> LandmarkParameters:
    """Parameters with at least ``LEAST_FALSE`` false positives."""
    z = max(parameters.z_false, LEAST_FALSE)
    return parameters.replace(z_false=z, z_detect=1 - z)


def association(
    run: LandmarkRun, model: LandmarkModel, *, sigma_position: float, sigma_heading: float, seed: int = 0
) -> dict[str, float]:
    """How often the likeliest landmark of a feature is the recorded one, at logged poses moved at random.

    Args:
        run: The run.
        model: Of its map.
        sigma_position: Deviation of poses in x and in y [m]; 0 for the logged ones.
        sigma_heading: Of their heading [rad].
        seed: Of the random numbers.

    Returns:
        Shares of features: right, none (taken for a false positive but recorded as a landmark) and wrong.
    """
    rng = np.random.default_rng(seed)
    poses = run.truth + rng.normal(size=run.truth.shape) * (sigma_position, sigma_position, sigma_heading)
    found = np.empty(len(run.ids), np.int64)
    for first, last in _scans(run):
        found[first:last] = model.associate(poses[[run.scan[first]]], run.features[first:last])[0][0]
    right = found == run.ids
    none = ~right & (found == -1)
    return {"right": float(right.mean()), "none": float(none.mean()), "wrong": float((~right & ~none).mean())}


def localise(
    run: LandmarkRun,
    model: LandmarkModel,
    *,
    known: bool,
    particles: int = 2000,
    seed: int = 0,
    motion: Motion | None = None,
    sigma_position: float = 0.5,
    sigma_heading: float = 0.3,
    step: Callable[[str], None] | None = None,
) -> Track:
    """A plain particle filter over a run (book table 8.2): odometry, the landmark model, systematic resampling.

    Args:
        run: The run.
        model: Gives log p of a scan's features.
        known: Whether the filter is told which landmark each feature is.
        particles: Their number.
        seed: Of the random numbers.
        motion: Noise of the odometry.
        sigma_position: Deviation of the first particles from the first logged pose, in x and in y [m].
        sigma_heading: Of their heading [rad].
        step: Called with a text before each hundredth scan.
    """
    rng, noise = np.random.default_rng(seed), motion or Motion()
    cloud = run.truth[0] + rng.normal(size=(particles, 3)) * (sigma_position, sigma_position, sigma_heading)
    estimate, log_w, degenerate = np.empty_like(run.truth), np.zeros(particles), 0
    bounds = _scans(run)
    rows = {int(run.scan[first]): (first, last) for first, last in bounds}
    for s in range(len(run.time)):
        if step is not None and s % 100 == 0:
            step(f"scan {s}")
        if s:
            _move(cloud, run.odometry[s - 1], run.odometry[s], float(run.time[s] - run.time[s - 1]), noise, rng)
        if s in rows:
            first, last = rows[s]
            ids = run.ids[first:last] if known else None
            log_w = log_w + model.log_likelihood(cloud, run.features[first:last], ids).astype(np.float64)
        weights = normalize_weights(log_w)
        if weights.degenerate:
            degenerate, log_w = degenerate + 1, np.zeros(particles)
        w = weights.weights
        x, y = w @ cloud[:, :2]
        estimate[s] = x, y, math.atan2(w @ np.sin(cloud[:, 2]), w @ np.cos(cloud[:, 2]))
        if weights.effective_sample_size < particles / 2:
            cloud, log_w = cloud[resample(w, particles, rng)], np.zeros(particles)
    away = estimate - run.truth
    turn = np.abs(np.arctan2(np.sin(away[:, 2]), np.cos(away[:, 2])))
    return Track(estimate, np.hypot(away[:, 0], away[:, 1]), turn, degenerate)


def _scans(run: LandmarkRun) -> list[tuple[int, int]]:
    """First and last feature (excluded) of each scan that has some."""
    starts = np.flatnonzero(np.diff(run.scan, prepend=-1))
    return list(zip(starts.tolist(), [*starts[1:].tolist(), len(run.scan)], strict=True))


def _move(
    cloud: Floats, before: Floats, after: Floats, seconds: float, noise: Motion, rng: np.random.Generator
) -> None:
    """Move particles as odometry says it did, each with its own error."""
    x, y, turn = (float(value) for value in after - before)
    turn = math.remainder(turn, math.tau)
    way = math.hypot(x, y)
    first = math.remainder(math.atan2(y, x) - before[2], math.tau) if way > 1e-9 else 0.0
    if abs(first) > math.pi / 2:
        # Backwards: the turns are those of a robot that looks ahead.
        way, first = -way, math.remainder(first + math.pi, math.tau)
    second = math.remainder(turn - first, math.tau)
    size = math.sqrt(max(seconds, 0.0))
    draws = rng.normal(size=(len(cloud), 6))

    def turned(angle: float, column: int) -> Floats:
        sigma = math.hypot(noise.turn_by_turn * angle, noise.turn_by_way * way)
        return angle + sigma * draws[:, column]

    heading = cloud[:, 2] + turned(first, 0)
    far = way + math.hypot(noise.way_by_way * way, noise.way_by_turn * turn) * draws[:, 1]
    cloud[:, 0] += far * np.cos(heading) + noise.drift * size * draws[:, 3]
    cloud[:, 1] += far * np.sin(heading) + noise.drift * size * draws[:, 4]
    cloud[:, 2] = heading + turned(second, 2) + noise.drift_heading * size * draws[:, 5]


def repaired(run: LandmarkRun, found: Suspicions) -> LandmarkRun:
    """The run with the positions of exchanged landmarks put back."""
    xy = run.landmarks.xy.copy()
    for each in found.exchanged:
        xy[[each.first, each.second]] = xy[[each.second, each.first]]
    return replace(run, landmarks=LandmarkMap(xy, run.landmarks.signatures))


def first_scans(run: LandmarkRun, count: int | None) -> LandmarkRun:
    """The run's first scans; all where ``count`` is None."""
    if count is None or count >= len(run.time):
        return run
    kept = run.scan < count
    return replace(
        run, time=run.time[:count], odometry=run.odometry[:count], truth=run.truth[:count],
        features=run.features[kept], scan=run.scan[kept], ids=run.ids[kept],
    )  # fmt: skip
