"""The scans of a log that a command takes, with their poses: its own, or those of a trajectory."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gpusense.logs import Scan


def add_poses(parser: argparse.ArgumentParser) -> None:
    """Add ``--reference``, the poses of the scans, and ``--topic``, their laser."""
    parser.add_argument(
        "--reference", type=Path, metavar="FILE",
        help="a TUM trajectory with the poses of the robot at the times of the scans; scans without one are left out "
        "(default: the logged poses)",
    )  # fmt: skip
    parser.add_argument("--topic", metavar="NAME", help="topic of the scans in a bag (default: /scan, or the only one)")


def read_scans(args: argparse.Namespace) -> list[tuple[int, Scan]]:
    """Read the chosen scans of ``--log`` with their indices and poses.

    Raises:
        ValueError: a file breaks its format, no scan is chosen, or a chosen scan has no pose or another scanner.
        FileNotFoundError: a file is missing.
    """
    from gpusense.evaluation.scoring import chosen_scans, with_poses
    from gpusense.evaluation.trajectory_files import poses_at, read_tum

    trajectory = None if args.reference is None else read_tum(args.reference)
    scans = chosen_scans(
        args.log, range_max=args.range_max, every=args.every, offset=args.offset, limit=args.limit, topic=args.topic
    )
    if trajectory is not None:
        chosen, poses = len(scans), poses_at([scan.time for _, scan in scans], *trajectory)
        scans = [
            (k, replace(scan, pose=pose)) for (k, scan), pose in zip(scans, poses, strict=True) if pose is not None
        ]
        if len(scans) < chosen:
            sys.stderr.write(f"gpusense: --reference: has poses of {len(scans)} of {chosen} chosen scans\n")
    return with_poses(scans, args.log)
