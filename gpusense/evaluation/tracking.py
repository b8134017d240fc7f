"""Localise a robot along a recorded log, and judge the track: errors, coverage, time to converge, times of a step."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gpusense._util.files import write_whole
from gpusense.evaluation.coverage import REGIONS, coverage_report, rank_of
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.filter import ParticleFilter
from gpusense.localization.pose_algebra import compose_poses, pose_difference, wrap_angle
from gpusense.logs import Odometry, Pose, Scan
from gpusense.logs.several import read_lasers
from gpusense.world.scanner import Scanner

Floats = NDArray[np.float64]
# A track has converged where the next scans are within these of the truth [m, rad].
CONVERGED, CONVERGED_TURN, CONVERGED_SCANS = 1.0, math.radians(20), 5
# Deviations of a tracking start: x, y [m] and heading [rad].
START = DEFAULTS.start


@dataclass(frozen=True)
class Step:
    """A scan of a log with its odometry.

    Attributes:
        index: Index of the scan in the log.
        scan: It.
        odometry: Pose by raw odometry alone [m, m, rad].
        sensor: Index of its laser.
    """

    index: int
    scan: Scan
    odometry: Pose
    sensor: int = 0


def read_steps(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    every: int = 1,
    offset: int = 0,
    limit: int | None = None,
    sensors: Sequence[str] = (),
) -> list[Step]:
    """Read scans of a log with raw odometry.

    Logs with corrected poses often have a copy of them in place of the odometry, and wheel readings between the scans
    that start at the corrected pose of the scan before. The odometry is then chained from these readings.

    Args:
        path: The log.
        range_max: Readings of at least this are "no return" [m]; None for the log's.
        every: Stride of the scans of each laser.
        offset: Index of the first scan of each laser.
        limit: Largest number of scans; None for all.
        sensors: Its lasers: topics of a bag, front or rear of a CARMEN log; none for its only or main laser.

    Raises:
        ValueError: the log breaks its format, has no scan of these, or a laser changes its geometry.
        FileNotFoundError: the log is missing.
    """
    chained, last, between = np.zeros(3), None, None
    steps: list[Step] = []
    counts = [0] * max(len(sensors), 1)
    scanners: dict[int, Scanner] = {}
    for sensor, record in read_lasers(path, sensors, range_max=range_max):
        if isinstance(record, Odometry):
            between = record.pose
            continue
        if last is not None:
            copied = record.pose is not None and np.allclose(record.pose, record.odometry, atol=1e-9)
            after = between if copied and between is not None else record.odometry
            chained = compose_poses(chained, pose_difference(last.odometry, after))
        last, between = record, None
        count = counts[sensor]
        if count >= offset and (count - offset) % every == 0 and (limit is None or len(steps) < limit):
            if record.scanner != scanners.setdefault(sensor, record.scanner):
                raise ValueError(f"log: every scan must come from the same scanner, got another at scan {count}")
            steps.append(Step(count, record, (float(chained[0]), float(chained[1]), float(chained[2])), sensor))
        counts[sensor] += 1
    if not steps:
        raise ValueError(f"log: must have a scan of index {offset}, which is the first one chosen, got fewer in {path}")
    return steps


@dataclass
class Track:
    """Estimated poses along a log.

    Attributes:
        steps: Scans so far.
        poses: Estimated poses.
        covariances: Their covariances.
        ranks: Ranks of the logged poses among the particles (:func:`rank_of`); empty without logged poses.
        sizes: Effective sample sizes.
        lost: Verdicts.
        explained: Shares of beams that the estimates explain.
        temperatures: Temperatures.
        seconds: Seconds of each step: predict, score, resample, estimate.
    """

    steps: list[Step] = field(default_factory=list)
    poses: list[Floats] = field(default_factory=list)
    covariances: list[Floats] = field(default_factory=list)
    ranks: list[Floats] = field(default_factory=list)
    sizes: list[float] = field(default_factory=list)
    lost: list[bool] = field(default_factory=list)
    explained: list[float] = field(default_factory=list)
    temperatures: list[float] = field(default_factory=list)
    seconds: list[tuple[float, float, float, float]] = field(default_factory=list)

    @property
    def truth(self) -> Floats | None:
        """(S, 3) logged poses; None where one is missing."""
        logged = [step.scan.pose for step in self.steps]
        return None if any(pose is None for pose in logged) else np.array(logged, np.float64).reshape(-1, 3)

    def errors(self) -> tuple[Floats, Floats] | None:
        """Return the errors of position [m] and heading [rad] of each scan; None without logged poses."""
        difference = self.differences()
        return None if difference is None else (np.hypot(*difference[:, :2].T), np.abs(difference[:, 2]))

    def differences(self) -> Floats | None:
        """Return (S, 3) estimates less logged poses, headings wrapped; None without logged poses."""
        truth = self.truth
        if truth is None:
            return None
        difference = np.array(self.poses).reshape(-1, 3) - truth
        difference[:, 2] = wrap_angle(difference[:, 2])
        return difference


def start(pf: ParticleFilter, steps: Sequence[Step], *, everywhere: bool, pose: Sequence[float] | None = None) -> None:
    """Initialise a filter: everywhere, or around a pose, by default the first logged one.

    Raises:
        ValueError: the first scan has no pose, and the start is not everywhere.
    """
    first = steps[0].scan.pose if pose is None else pose
    if everywhere:
        pf.initialize_uniform()
    elif first is None:
        rule = "must have a pose at the first scan, unless --start gives one or --global begins anywhere"
        raise ValueError(f"log: {rule}, got none")
    else:
        pf.initialize(mean=first, covariance=np.diag(np.square(START)))


def follow(pf: ParticleFilter, steps: Iterable[Step], track: Track) -> Iterable[Step]:
    """Run a filter along a log; yield each step once the track has it."""
    pf.time_scoring()
    for step in steps:
        times = [time.perf_counter()]
        if track.steps:
            pf.predict(track.steps[-1].odometry, step.odometry)
            pf.flush()
        times.append(time.perf_counter())
        before = pf.scoring_seconds
        pf.correct({pf.models[step.sensor]: step.scan.ranges})
        times.append(time.perf_counter())
        scoring = pf.scoring_seconds - before
        found = pf.estimate()
        times.append(time.perf_counter())
        predict, correct, estimate = np.diff(times)
        logged = step.scan.pose
        rank = None if logged is None else rank_of(pf.host_particles(), pf.host_weights(), np.array(logged))
        track.poses.append(found.pose)
        track.covariances.append(found.covariance)
        if rank is not None:
            track.ranks.append(rank)
        track.sizes.append(found.effective_sample_size)
        track.lost.append(found.lost)
        track.explained.append(found.explained)
        track.temperatures.append(found.temperature)
        track.seconds.append((float(predict), scoring, float(correct) - scoring, float(estimate)))
        track.steps.append(step)
        yield step


def summary(track: Track) -> dict[str, Any]:
    """Return figures of a track: errors, coverage, convergence, verdict and times; None without logged poses."""
    count = len(track.steps)
    seconds = np.array(track.seconds).reshape(-1, 4) * 1000
    means = np.median(seconds, axis=0)
    tail = track.lost[-max(count // 10, 1) :]
    result: dict[str, Any] = {
        "scans": count,
        "lost": bool(np.mean(tail) > 0.5),
        "scans_lost": int(np.sum(track.lost)),
        "explained_median": float(np.median(track.explained)),
        "temperature": track.temperatures[-1],
        "effective_sample_size_median": float(np.median(track.sizes)),
    }
    result |= dict(zip(("ms_predict", "ms_score", "ms_resample", "ms_estimate"), map(float, means), strict=True))
    errors, differences, truth = track.errors(), track.differences(), track.truth
    if errors is None or differences is None or truth is None:
        return result | dict.fromkeys(_WITH_TRUTH)
    position, heading = errors
    relative = pose_difference(np.array(track.poses)[:-1], np.array(track.poses)[1:])
    relative = pose_difference(pose_difference(truth[:-1], truth[1:]), relative) if count > 1 else np.zeros((1, 3))
    step_errors = np.hypot(relative[:, 0], relative[:, 1])
    values = (
        float(np.median(position)), float(np.percentile(position, 95)), float(np.median(heading)),
        float(np.percentile(heading, 95)), float(np.median(step_errors)), float(np.percentile(step_errors, 95)),
        _converged(position, heading),
    )  # fmt: skip
    result |= dict(zip(_ERRORS, values, strict=True))
    return result | coverage_report(differences, np.array(track.covariances), np.array(track.ranks))


_ERRORS = (
    "error_median", "error_95", "heading_median", "heading_95", "relative_median", "relative_95", "converged_at",
)  # fmt: skip
_WITH_TRUTH = (
    *_ERRORS, *(f"coverage_{name}" for name in REGIONS), "nees_median", "width_95", "width_heading_95",
    "rank_histogram",
)  # fmt: skip


def _converged(position: Floats, heading: Floats) -> int | None:
    """Return the first scan from which the next ones are near the truth; None if there is none."""
    near = (position < CONVERGED) & (heading < CONVERGED_TURN)
    length = min(CONVERGED_SCANS, len(near))
    return next((i for i in range(len(near) - length + 1) if near[i : i + length].all()), None)


def write_tum(track: Track, path: Path) -> None:
    """Write the estimated poses as a TUM trajectory, which evo and other tools read: time x y z and a quaternion.

    Raises:
        OSError, ValueError: the file cannot be written.
    """

    def write(stream: BinaryIO) -> None:
        for step, (x, y, theta) in zip(track.steps, track.poses, strict=True):
            z, w = math.sin(theta / 2), math.cos(theta / 2)
            stream.write(f"{step.scan.time:.6f} {x:.6f} {y:.6f} 0 0 0 {z:.9f} {w:.9f}\n".encode())

    write_whole(path, write)
