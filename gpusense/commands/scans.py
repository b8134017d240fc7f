"""Read the scans of a log for a command, with poses from the log or a trajectory."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gpusense as gs
from gpusense.commands.arguments import Options, finite_number
from gpusense.evaluation import log_steps, trajectory_files

if TYPE_CHECKING:
    from gpusense.evaluation.log_steps import Step
    from gpusense.logs.reader import LogOptions

FORMATS = "CARMEN or Wean Hall, plain or .gz; a bag of ROS 1 (.bag) or of ROS 2 (folder, .db3, .mcap)"
OPTIONS = {
    "topic": "topic", "sensors": "topic", "mount": "mount", "node": "node", "frame": "frame",
    "odometry_from": "odometry", "range_min": "range-min", "range_max": "range-max",
    "poses": "poses", "risk": "risk", "mean": "start",
}  # fmt: skip
"""Command line options by the library's arguments."""


def add_log(add: Options, what: str, *, required: bool = True, several: str | None = None) -> None:
    """Add ``--log``, and its laser or ``several`` lasers, described by their use: ``--topic`` and ``--mount``."""
    add("--log FILE", f"{what}: {FORMATS}", Path, required=required)
    names = "topic of a bag (default: /scan, or the only one); front or rear of a CARMEN log (default: front)"
    if several:
        add("--topic NAME...", f"{several}, one or more: {names}", default=[])
    else:
        add("--topic NAME", f"laser: {names}")
    add("--mount X Y THETA", "pose of a bag's laser on the robot [m, m, rad] (default: by the bag's transforms)",
        finite_number)  # fmt: skip
    add("--frame NAME", "frame of the laser, if several share a bag's topic")
    add("--odometry NAME", "topic of a bag's odometry, or frame of the transforms that move the robot (default: near "
        "the scans, /odom, or the first one)", dest="odometry_from")  # fmt: skip


def log_options(args: argparse.Namespace) -> LogOptions:
    """Return the options of the log for the library's readers."""
    return {
        "range_max": args.range_max, "range_min": args.range_min, "frame": args.frame, "mount": args.mount,
        "odometry_from": args.odometry_from,
    }  # fmt: skip


@contextlib.contextmanager
def options_named() -> Iterator[None]:
    """Name command line options in errors about the library's arguments."""
    try:
        yield
    except ValueError as error:
        found = re.match(r"(.*:\d+: )?(\w+): ", str(error))
        if found is None or found[2] not in OPTIONS:
            raise
        raise ValueError(f"{found[1] or ''}--{OPTIONS[found[2]]}: {str(error)[found.end() :]}") from None


def read_scans(args: argparse.Namespace) -> list[tuple[int, gs.Scan]]:
    """Read the chosen scans of ``--log`` with their indices; each must have a pose."""
    return log_steps.with_poses(read_posed_steps(args), args.log)


def read_scan(args: argparse.Namespace) -> gs.Scan:
    """Read the scan ``--scan`` of ``--log``, the first one by default."""
    from gpusense.logs.reader import read_lasers

    wanted, index = args.scan or 0, 0
    with options_named():
        sensors = () if args.topic is None else (args.topic,)
        for _, scan in read_lasers(args.log, sensors, odometry=False, **log_options(args)):
            if index == wanted and isinstance(scan, gs.Scan):
                return scan
            index += 1
    raise ValueError(f"--scan: must be below the log's number of scans, {index}, got {wanted}")


def read_chosen_steps(args: argparse.Namespace, *, odometry: bool = True) -> list[Step]:
    """Read the chosen scans of ``--log`` with raw odometry, of one laser or of several by time."""
    sensors = [args.topic] if isinstance(args.topic, str) else args.topic or ()
    with options_named():
        steps = log_steps.read_steps(
            args.log, every=args.every, offset=args.offset, limit=args.limit, sensors=sensors, odometry=odometry,
            **log_options(args),
        )  # fmt: skip
    for index, name in enumerate(sensors):
        if all(step.sensor != index for step in steps):
            raise ValueError(f"--topic: must have scans that are chosen, got none of {name}")
    return steps


def read_posed_steps(args: argparse.Namespace) -> list[Step]:
    """Read the chosen scans of ``--log``, with the poses of ``--reference`` if set; scans without one are skipped."""
    steps = read_chosen_steps(args, odometry=False)
    if args.reference is None:
        return log_steps.of_one_scanner(steps, args.log)
    poses = trajectory_files.poses_at([step.scan.time for step in steps], *trajectory_files.read_tum(args.reference))
    known = [replace(step, scan=replace(step.scan, pose=pose)) for step, pose in zip(steps, poses, strict=True) if pose]
    if len(known) < len(steps):
        sys.stderr.write(f"gpusense: --reference: has poses of {len(known)} of {len(steps)} chosen scans\n")
    return log_steps.of_one_scanner(known, args.log)


def scanners_of(steps: list[Step]) -> dict[str, Any]:
    """Return the library's arguments ``scanner`` and ``sensor`` for scans of one or several lasers."""
    scanners = {step.sensor: step.scan.scanner for step in steps}
    if len(scanners) == 1:
        return {"scanner": steps[0].scan.scanner}
    numbers = {one: k for k, one in enumerate(sorted(scanners))}
    return {"scanner": [scanners[one] for one in numbers], "sensor": [numbers[step.sensor] for step in steps]}


def write_trajectory(path: Path | None, times: Sequence[float], poses: Any, first: int = 0) -> None:
    """Write the poses of scans from ``first`` on for evo, if a file is passed; by indices unless times increase."""
    if path is None:
        return
    indices = not all(one < two for one, two in itertools.pairwise(times))
    if indices:
        rule = "the times of the log do not increase: the trajectory has the indices of the scans instead"
        sys.stderr.write(f"gpusense: --tum: {rule}\n")
    at = range(len(times)) if indices else times
    trajectory_files.write_tum(path, at[first:], poses[first:], indices=indices)
