"""Scans of a log with the poses of a localiser: of a topic, of transforms, of a trajectory, or of the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpusense._util.typing import Floats
from gpusense.evaluation.steps import Step
from gpusense.evaluation.trajectory_files import nearest_index, poses_at, read_tum
from gpusense.logs import Pose, Scan
from gpusense.logs.bag_poses import PoseTrack, read_poses
from gpusense.logs.reader import format_of

NEAR = 0.05
"""Largest time from a scan to a pose that belongs to it [s]."""


@dataclass(frozen=True, eq=False)
class PosedScan:
    """A scan with the pose of a localiser.

    Attributes:
        pose: Pose of the robot on the map [m, m, rad].
        covariance: (3, 3) covariance of the pose; None if unknown.
        odometry: Pose by raw odometry alone [m, m, rad].
    """

    index: int
    scan: Scan
    pose: Pose
    covariance: Floats | None
    odometry: Pose


@dataclass(frozen=True, eq=False)
class PosedScans:
    """Scans with poses.

    Attributes:
        source: Origin of the poses: a topic, frames, or a file.
    """

    source: str
    scans: list[PosedScan]


def posed_scans(
    log: Path, steps: Sequence[Step], source: str | Path | None = None, *, map_frame: str = "map"
) -> PosedScans:
    """Return the scans of a log that have a pose of a localiser.

    ``source``: A TUM trajectory as a path, or a topic of a bag as for :func:`gpusense.logs.bag_poses.read_poses`. None
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
        known = [PosedScan(s.index, s.scan, s.reference, None, s.odometry) for s in steps if s.reference is not None]
        if not known:
            raise ValueError(f"poses: must be given as a TUM trajectory for {log}, which has no poses, got None")
        return PosedScans(f"the poses of {log}", known)
    poses, covariances = poses_at(times, track.times, track.poses, near=NEAR, name="poses"), _covariances(track, times)
    return PosedScans(
        track.source,
        [
            PosedScan(step.index, step.scan, pose, covariance, step.odometry)
            for step, pose, covariance in zip(steps, poses, covariances, strict=True)
            if pose is not None
        ],
    )


def _covariances(track: PoseTrack, times: Sequence[float]) -> list[Floats | None]:
    """Return the covariance of the pose nearest to each time; None where it is unknown."""
    if track.covariances is None:
        return [None] * len(times)
    near = track.covariances[nearest_index(times, track.times)]
    return [None if np.isnan(one).any() else one for one in near]
