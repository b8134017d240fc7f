"""Scans of a log for a filter: with raw odometry, and with reference poses for comparison."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np

from gpusense._util.typing import Floats
from gpusense.evaluation.trajectory_files import poses_at
from gpusense.localization.pose_algebra import compose_poses, pose_difference, wrap_angle
from gpusense.logs import Odometry, Pose, Scan
from gpusense.logs.reader import LogOptions, read_lasers
from gpusense.logs.records import check_scanner
from gpusense.world.scanner import Scanner

# Logged poses count as copied odometry if no step differs by more than this [m, rad].
_SAME = 1e-4
_LEAST_KNOWN = 3


@dataclass(frozen=True)
class Step:
    """A scan of a log with its odometry.

    Attributes:
        index: Index of the scan in the log.
        odometry: Pose by raw odometry alone [m, m, rad].
        reference: Pose of the robot for comparison with estimates, by default the logged one; None if unknown.
    """

    index: int
    scan: Scan
    odometry: Pose
    sensor: int = 0
    reference: Pose | None = None


def read_steps(
    path: str | os.PathLike[str],
    *,
    every: int = 1,
    offset: int = 0,
    limit: int | None = None,
    sensors: Sequence[str] = (),
    **options: Unpack[LogOptions],
) -> list[Step]:
    """Read scans of a log with raw odometry.

    Logs with corrected poses often repeat them as odometry, with wheel readings between the scans that start at the
    corrected pose of the previous scan. The odometry is then chained from these readings.

    ``limit``: Largest number of scans; None for all. Nothing is read after the last one.
    """
    chained, last, between = np.zeros(3), None, None
    steps: list[Step] = []
    counts = [0] * max(len(sensors), 1)
    scanners: dict[int, Scanner] = {}
    for sensor, record in read_lasers(path, sensors, **options):
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
            check_scanner(record, scanners.setdefault(sensor, record.scanner), f"scan {count}")
            x, y, theta = (float(value) for value in chained)
            steps.append(Step(count, record, (x, y, theta), sensor, record.pose))
            if len(steps) == limit:
                break
        counts[sensor] += 1
    if not steps:
        raise ValueError(f"log: must have a scan of index {offset}, the first one chosen, got fewer scans in {path}")
    return steps


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
