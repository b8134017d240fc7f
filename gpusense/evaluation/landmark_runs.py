"""Evaluate recorded runs among landmarks: noise, association and localisation, against logged poses."""

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

# Lower bound of z_false for a filter: a fit of clean data gives 0, and the next feature may be a false positive.
LEAST_FALSE = 0.01


@dataclass(frozen=True)
class Motion:
    """Noise of the odometry motion model (book table 5.6), with a random walk in addition.

    The first four are the roots of the book's alpha_1 to alpha_4.
    """

    turn_by_turn: float = 0.3
    """Deviation of a turn per turn [rad/rad]."""
    turn_by_distance: float = 0.1
    """Deviation of a turn per distance [rad/m]."""
    distance_by_distance: float = 0.2
    """Deviation of a distance per distance [m/m]."""
    distance_by_turn: float = 0.02
    """Deviation of a distance per turn [m/rad]."""
    drift: float = 0.01
    """Random walk of the position, in x and in y [m / sqrt(s)]."""
    drift_heading: float = 0.07
    """Random walk of the heading [rad / sqrt(s)]."""


@dataclass(frozen=True, eq=False)
class Track:
    """Result of a particle filter.

    Attributes:
        estimate: (S, 3) weighted means after each scan [m, m, rad].
        error: (S,) distance from the logged position [m].
        error_heading: (S,) absolute error of the heading [rad].
        degenerate: Number of scans that are impossible at every particle.
    """

    estimate: Floats
    error: Floats
    error_heading: Floats
    degenerate: int

    def summary(self) -> dict[str, float]:
        """Return medians, 90 % quantiles and largest errors."""
        return {
            "error_median": float(np.median(self.error)), "error_90": float(np.quantile(self.error, 0.9)),
            "error_max": float(self.error.max()), "heading_median": float(np.median(self.error_heading)),
            "heading_90": float(np.quantile(self.error_heading, 0.9)), "degenerate": self.degenerate,
        }  # fmt: skip


def fit_run(run: LandmarkRun, *, known: bool = True, bias: bool = False) -> LandmarkFit:
    """Fit the noise of a run's features at its logged poses.

    Args:
        run: The run.
        known: Whether the fit uses the recorded landmark of each feature.
        bias: Whether offsets of range and bearing are fitted too.
    """
    return fit_landmark_parameters(
        run.truth, run.features, run.landmarks, correspondence=run.ids if known else None, scan=run.scan,
        range_max=run.range_max, field_of_view=run.field_of_view, bias=bias,
    )  # fmt: skip


def suspicions(run: LandmarkRun, fit: LandmarkFit) -> Suspicions:
    """Find landmarks of a run whose positions are exchanged or wrong."""
    return suspicious_landmarks(run.poses, run.features, run.landmarks, run.ids, fit.parameters)


def usable(parameters: LandmarkParameters) -> LandmarkParameters:
    """Return the parameters with ``z_false`` raised to ``LEAST_FALSE`` at least."""
    z = max(parameters.z_false, LEAST_FALSE)
    return parameters.replace(z_false=z, z_detect=1 - z)


def association(
    run: LandmarkRun, model: LandmarkModel, *, sigma_position: float, sigma_heading: float, seed: int = 0
) -> dict[str, float]:
    """Compare the likeliest landmark of each feature with the recorded one, at perturbed logged poses.

    Args:
        run: The run.
        model: The model of the run's map.
        sigma_position: Deviation of the perturbation in x and in y [m]; 0 for the logged positions.
        sigma_heading: Deviation of the perturbation of headings [rad].
        seed: Seed of the random numbers.

    Returns:
        Shares of features: right, none (classed as a false positive but recorded as a landmark) and wrong.
    """
    rng = np.random.default_rng(seed)
    poses = run.truth + rng.normal(size=run.truth.shape) * (sigma_position, sigma_position, sigma_heading)
    likeliest = np.empty(len(run.ids), np.int64)
    for first, last in _scans(run):
        likeliest[first:last] = model.associate(poses[[run.scan[first]]], run.features[first:last])[0][0]
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
    motion: Motion | None = None,
    sigma_position: float = 0.5,
    sigma_heading: float = 0.3,
    step: Callable[[str], None] | None = None,
) -> Track:
    """Run a plain particle filter (book table 8.2): odometry, the landmark model, systematic resampling.

    Args:
        run: The run.
        model: Gives log p of a scan's features.
        known: Whether the filter uses the recorded landmark of each feature.
        particles: Number of particles.
        seed: Seed of the random numbers.
        motion: Noise of the odometry.
        sigma_position: Deviation of the first particles from the first logged pose, in x and in y [m].
        sigma_heading: Deviation of their headings [rad].
        step: Called with a text before each hundredth scan.
    """
    rng, noise = np.random.default_rng(seed), motion or Motion()
    cloud = run.truth[0] + rng.normal(size=(particles, 3)) * (sigma_position, sigma_position, sigma_heading)
    estimate, log_w, degenerate = np.empty_like(run.truth), np.zeros(particles), 0
    rows = {int(run.scan[first]): (first, last) for first, last in _scans(run)}
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
    return _track(run, estimate, degenerate)


def _track(run: LandmarkRun, estimate: Floats, degenerate: int) -> Track:
    """Return a filter's result with its errors against the logged poses."""
    away = estimate - run.truth
    turn = np.abs(np.arctan2(np.sin(away[:, 2]), np.cos(away[:, 2])))
    return Track(estimate, np.hypot(away[:, 0], away[:, 1]), turn, degenerate)


def _scans(run: LandmarkRun) -> list[tuple[int, int]]:
    """Return the first feature and the end (excluded) of each scan that has features."""
    starts = np.flatnonzero(np.diff(run.scan, prepend=-1))
    return list(zip(starts.tolist(), [*starts[1:].tolist(), len(run.scan)], strict=True))


def _move(
    cloud: Floats, before: Floats, after: Floats, seconds: float, noise: Motion, rng: np.random.Generator
) -> None:
    """Move particles by the odometry between two poses, each with its own noise."""
    x, y, turn = (float(value) for value in after - before)
    turn = math.remainder(turn, math.tau)
    distance = math.hypot(x, y)
    first = math.remainder(math.atan2(y, x) - before[2], math.tau) if distance > 1e-9 else 0.0
    if abs(first) > math.pi / 2:
        # Motion backwards: a negative distance, with turns as of a robot that moves ahead.
        distance, first = -distance, math.remainder(first + math.pi, math.tau)
    second = math.remainder(turn - first, math.tau)
    size = math.sqrt(max(seconds, 0.0))
    draws = rng.normal(size=(len(cloud), 6))

    def turned(angle: float, column: int) -> Floats:
        sigma = math.hypot(noise.turn_by_turn * angle, noise.turn_by_distance * distance)
        return angle + sigma * draws[:, column]

    heading = cloud[:, 2] + turned(first, 0)
    sigma_distance = math.hypot(noise.distance_by_distance * distance, noise.distance_by_turn * turn)
    travelled = distance + sigma_distance * draws[:, 1]
    cloud[:, 0] += travelled * np.cos(heading) + noise.drift * size * draws[:, 3]
    cloud[:, 1] += travelled * np.sin(heading) + noise.drift * size * draws[:, 4]
    cloud[:, 2] = heading + turned(second, 2) + noise.drift_heading * size * draws[:, 5]


def repaired(run: LandmarkRun, suspected: Suspicions) -> LandmarkRun:
    """Return the run with the positions of exchanged landmarks swapped back."""
    xy = run.landmarks.xy.copy()
    for pair in suspected.exchanged:
        xy[[pair.first, pair.second]] = xy[[pair.second, pair.first]]
    return replace(run, landmarks=LandmarkMap(xy, run.landmarks.signatures))


def first_scans(run: LandmarkRun, count: int | None) -> LandmarkRun:
    """Return a run of the first ``count`` scans; all where it is None."""
    if count is None or count >= len(run.time):
        return run
    kept = run.scan < count
    return replace(
        run, time=run.time[:count], odometry=run.odometry[:count], truth=run.truth[:count],
        features=run.features[kept], scan=run.scan[kept], ids=run.ids[kept],
    )  # fmt: skip
