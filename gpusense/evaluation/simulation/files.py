"""Write simulated runs as logs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gpusense._util import checks
from gpusense.evaluation.simulation.run import SimulatedRun
from gpusense.localization.pose_algebra import compose_poses
from gpusense.logs.bag_writer import write_bag
from gpusense.logs.carmen import write_carmen
from gpusense.logs.records import Scan
from gpusense.world.scanner import Scanner

FORMATS = ("carmen", "ros1", "ros2")


def write_run(run: SimulatedRun, path: str | os.PathLike[str], kind: str | None = None) -> None:
    """Write a simulated run as a log that ``read_log`` reads.

    Args:
        run: The run.
        path: The log.
        kind: ``"carmen"``, compressed if the name ends in ``.gz``, with true poses of the laser, since the format has
            no mount. ``"ros1"``, a bag of ROS 1 whose name ends in ``.bag``, or ``"ros2"``, the folder of a bag of ROS
            2, which must not exist: both have the mount, but no true poses. None takes ``"ros1"`` if the name ends in
            ``.bag``, and else ``"carmen"``.

    Raises:
        TypeError, ValueError: an argument has the wrong type, or the format cannot hold the scans.
        ImportError: the library rosbags is absent, and the log is a bag.
        OSError: the log cannot be written.

    Example:
        >>> import gpusense as gs, numpy as np, pathlib, tempfile
        >>> scanner = gs.Scanner(np.radians(np.arange(-90, 91)), range_max=12.0)
        >>> run = gs.worlds.simulate_run(gs.worlds.building(), scanner, scans=3)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     gs.worlds.write_run(run, log := pathlib.Path(folder, "run.log"))
        ...     len(list(gs.read_log(log)))
        3
    """
    checks.instance("run", run, SimulatedRun)
    file = checks.path("path", path)
    kind = kind_of(file) if kind is None else checks.choice("kind", kind, FORMATS)
    if kind == "carmen":
        write_carmen(file, records_of(run, of_laser=True))
        return
    write_bag(file, records_of(run), first=kind == "ros1")


def kind_of(path: Path) -> str:
    """Return the format of a log by its name."""
    suffix = path.suffix.lower()
    if suffix in (".db3", ".mcap"):
        raise ValueError(
            f"{path}: must not end in .db3 or .mcap; a bag of ROS 2 is a folder, format ros2, got {suffix!r}"
        )
    return "ros1" if suffix == ".bag" else "carmen"


def records_of(run: SimulatedRun, *, of_laser: bool = False) -> Iterator[Scan]:
    """Yield the scans of a run as records of a log, with true poses."""
    scanner, poses, odometry = run.scanner, run.poses, run.odometry
    if of_laser and any(scanner.mount):
        poses, odometry = (compose_poses(one, scanner.mount) for one in (poses, odometry))
        scanner = Scanner(
            scanner.bearings, scanner.range_max, scanner.range_min, cone=scanner.cone, cone_rays=scanner.cone_rays,
            critical_incidence=scanner.critical_incidence,
        )  # fmt: skip
    for time, ranges, odometer, pose in zip(run.times.tolist(), run.scans, odometry, poses, strict=True):
        readings = np.array(ranges)
        readings.setflags(write=False)
        yield Scan(time, readings, scanner, _pose(odometer), _pose(pose))


def _pose(pose: np.ndarray) -> tuple[float, float, float]:
    x, y, theta = pose.tolist()
    return x, y, theta
