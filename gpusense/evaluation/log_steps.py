"""Scans of a log for a filter: with raw odometry, and with reference poses for comparison."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Unpack

import numpy as np

from gpusense._util.notices import warn_user
from gpusense._util.typing import Floats
from gpusense.evaluation.trajectory_files import nearest_index, poses_at, read_tum
from gpusense.logs import Odometry, Pose, Scan
from gpusense.logs.reader import LogOptions, format_of, read_lasers
from gpusense.logs.records import check_scanner
from gpusense.logs.ros import PoseTrack, read_poses
from gpusense.world.pose_algebra import compose_poses, pose_difference, wrap_angle
from gpusense.world.scanner import Scanner

# Logged poses count as copied odometry if no step differs by more than this [m, rad].
_SAME = 1e-4
_LEAST_KNOWN = 3


@dataclass(frozen=True)
class Step:
    """A scan of a log with its odometry.

    Attributes:
        odometry: Pose by raw odometry alone [m, m, rad].
        reference: Pose of the robot to judge or to compare with, by default the logged one; None if unknown.
        covariance: (3, 3) covariance of the reference; None if unknown.
    """

    index: int
    scan: Scan
    odometry: Pose
    sensor: int = 0
    reference: Pose | None = None
    covariance: Floats | None = None


def read_steps(
    path: str | os.PathLike[str],
    *,
    every: int = 1,
    offset: int = 0,
    limit: int | None = None,
    sensors: Sequence[str] = (),
    odometry: bool = True,
    **options: Unpack[LogOptions],
) -> list[Step]:
    """Read scans of a log with raw odometry.

    Logs with corrected poses often repeat them as odometry, with wheel readings between the scans that start at the
    corrected pose of the previous scan. The odometry is then chained from these readings.

    ``limit``: Largest number of scans; None for all. Nothing is read after the last one. ``odometry``: Whether to read
    wheel readings between the scans, and to keep the scans of one scanner of each laser only.
    """
    chained, last, between = np.zeros(3), None, None
    steps: list[Step] = []
    counts = [0] * max(len(sensors), 1)
    for sensor, record in read_lasers(path, sensors, odometry=odometry, **options):
        if isinstance(record, Odometry):
            between = record.pose
            continue
        if last is not None:
            copied = record.pose is not None and np.allclose(record.pose, record.odometry, atol=1e-9)
            after = between if copied and between is not None else record.odometry
            chained = compose_poses(chained, pose_difference(last.odometry, after))
        last, between = record, None
        count = counts[sensor]
        if count >= offset and (count - offset) % every == 0:
            x, y, theta = (float(value) for value in chained)
            steps.append(Step(count, record, (x, y, theta), sensor, record.pose))
            if len(steps) == limit:
                break
        counts[sensor] += 1
    if not steps:
        raise ValueError(f"log: must have a scan of index {offset}, the first one chosen, got fewer scans in {path}")
    return of_one_scanner(steps, path) if odometry else steps


def of_one_scanner(steps: Sequence[Step], path: str | os.PathLike[str]) -> list[Step]:
    """Return the steps with the scanner of most scans of their laser, and warn of the others; they must be fewer.

    Scans with another mount are an error.
    """
    found: dict[int, Counter[Scanner]] = {}
    for step in steps:
        found.setdefault(step.sensor, Counter())[step.scan.scanner] += 1
    usual = {sensor: scanners.most_common(1)[0][0] for sensor, scanners in found.items()}
    kept = [step for step in steps if step.scan.scanner == usual[step.sensor]]
    few = all(2 * scanners[usual[sensor]] > scanners.total() for sensor, scanners in found.items())
    for step in steps:
        scanner = usual[step.sensor] if few else next(iter(found[step.sensor]))
        if not few or step.scan.scanner.mount != scanner.mount:
            check_scanner(step.scan, scanner, f"scan {step.index} of {path}")
    if len(kept) < len(steps):
        warn_user(
            f"{path}: scans with other beams or range limits are left out: {len(steps) - len(kept)} of {len(steps)}"
        )
    return kept


def with_poses(steps: Sequence[Step], path: str | os.PathLike[str]) -> list[tuple[int, Scan]]:
    """Return the numbered scans of steps of a log, which must have poses, and one scanner for each laser."""
    steps = of_one_scanner(steps, path)
    for step in steps:
        if step.scan.pose is None:
            raise ValueError(
                f"log: every scan must have a pose, of its own or by --reference, got none at scan {step.index} of "
                f"{path}; trajectories for --reference: of a SLAM program, of 'gpusense localize --tum' in a map, of "
                "'gpusense map --tum' without one"
            )
    return [(step.index, step.scan) for step in steps]


def repeats_odometry(steps: Sequence[Step]) -> bool:
    """Return whether the reference poses repeat the odometry, as in a log without corrections."""
    known = [step for step in steps if step.reference is not None]
    if len(known) < max(len(steps), 2):
        return False
    references = np.array([step.reference for step in known])
    odometry = np.array([step.odometry for step in known])
    moved = pose_difference(odometry[:-1], odometry[1:])
    difference = pose_difference(references[:-1], references[1:]) - moved
    difference[:, 2] = wrap_angle(difference[:, 2])
    # A robot at rest has equal steps in both.
    return bool(np.abs(moved).max() > _SAME and np.abs(difference).max() <= _SAME)


def references_to_learn_from(steps: Sequence[Step]) -> tuple[list[Pose], list[Pose]]:
    """Return odometry and reference poses of all steps, for a fit of the odometry's noise; NaN without a reference."""
    known = sum(step.reference is not None for step in steps)
    if known < _LEAST_KNOWN:
        raise ValueError(f"--fit-motion: must have poses of the robot at {_LEAST_KNOWN} scans at least, got {known}")
    if repeats_odometry(steps):
        raise ValueError("--fit-motion: must have poses that are not the odometry's own, got a log of these")
    none = (np.nan, np.nan, np.nan)
    return [step.odometry for step in steps], [step.reference or none for step in steps]


def with_references(steps: Sequence[Step], times: Floats, poses: Floats) -> list[Step]:
    """Return steps with references from a trajectory: (T, 3) poses at (T,) increasing times [s]."""
    found = poses_at([step.scan.time for step in steps], times, poses)
    return [replace(step, reference=pose) for step, pose in zip(steps, found, strict=True)]


NEAR = 0.05
"""Largest time from a scan to a pose that belongs to it [s]."""


def posed_scans(
    log: Path, steps: Sequence[Step], source: str | Path | None = None, *, map_frame: str = "map"
) -> tuple[str, list[Step]]:
    """Return the steps of a log that have a pose of a localiser, as their reference, and the origin of the poses.

    ``source``: A TUM trajectory as a path, or a topic of a bag as for :func:`gpusense.logs.ros.read_poses`. None
    takes the likeliest poses of a bag, and the logged poses of another log.
    """
    times = [step.scan.time for step in steps]
    form = format_of(log)
    if isinstance(source, Path):
        track = PoseTrack(str(source), *read_tum(source))
    elif form.topics:
        track = read_poses(log, np.array(times), topic=source, map_frame=map_frame)
    elif source is not None:
        raise ValueError(f"poses: must be a TUM trajectory such as run.tum for {form.name}, got {source!r}")
    else:
        known = [step for step in steps if step.reference is not None]
        if not known:
            raise ValueError(f"poses: must be given as a TUM trajectory for {log}, which has no poses, got None")
        return f"the poses of {log}", known
    poses, covariances = poses_at(times, track.times, track.poses, near=NEAR, name="poses"), _covariances(track, times)
    judged = zip(steps, poses, covariances, strict=True)
    return track.source, [
        replace(step, reference=pose, covariance=covariance) for step, pose, covariance in judged if pose is not None
    ]


def _covariances(track: PoseTrack, times: Sequence[float]) -> list[Floats | None]:
    """Return the covariance of the pose nearest to each time; None where it is unknown."""
    if track.covariances is None:
        return [None] * len(times)
    near = track.covariances[nearest_index(times, track.times)]
    return [None if np.isnan(one).any() else one for one in near]
