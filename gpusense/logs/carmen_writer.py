"""Write scans as a log of the Carnegie Mellon Robot Navigation Toolkit; see carmen.py for its messages."""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gpusense._util.files import write_whole
from gpusense.logs.records import Scan
from gpusense.world.scanner import Scanner

# Decimals of readings [m]; of poses [m, rad]; the host in each message.
_READING, _POSE, _HOST = 4, 6, "simulated"
# Largest difference of bearings from even steps [rad].
_EVEN = 1e-9


def write_carmen(path: Path, scans: Iterable[Scan]) -> None:
    """Write scans as messages ODOM and ROBOTLASER1, compressed where the name ends in ``.gz``.

    Readings have four decimals; "no return" is the scanner's ``range_max``. A scan without a pose is written with its
    odometry. The format has no mount and no missing readings.
    """

    def write(stream: BinaryIO) -> None:
        if path.suffix.lower() != ".gz":
            stream.writelines(_lines(scans))
            return
        with gzip.GzipFile(filename="", mode="wb", fileobj=stream, mtime=0) as packed:
            packed.writelines(_lines(scans))

    write_whole(path, write)


def _lines(scans: Iterable[Scan]) -> Iterator[bytes]:
    for scan in scans:
        tail = f"{scan.time:.6f} {_HOST} {scan.time:.6f}\n"
        yield f"ODOM {_numbers(scan.odometry, _POSE)} 0 0 0 {tail}".encode()
        pose = scan.odometry if scan.pose is None else scan.pose
        poses = f"{_numbers(pose, _POSE)} {_numbers(scan.odometry, _POSE)}"
        readings = _numbers(_within(scan), _READING)
        fields = f"{_geometry(scan.scanner)} {len(scan.ranges)} {readings} 0 {poses} 0 0 0 0 0 "
        yield f"ROBOTLASER1 {' '.join(fields.split())} {tail}".encode()


def _numbers(values: Iterable[float], decimals: int) -> str:
    return " ".join(f"{value:.{decimals}f}" for value in values)


def _within(scan: Scan) -> Iterable[float]:
    """Return readings in which ranges below range_max stay below it after rounding."""
    if np.isnan(scan.ranges).any():
        raise ValueError(f"ranges: must be no NaN in a CARMEN log, got one in the scan at {scan.time}")
    limit, unit = scan.scanner.range_max, 10.0**-_READING
    largest = (math.ceil(round(limit / unit, 6)) - 1) * unit
    none = math.ceil(round(limit / unit, 6)) * unit
    values: list[float] = np.where(scan.ranges >= limit, none, np.clip(scan.ranges, 0.0, largest)).tolist()
    return values


def _geometry(scanner: Scanner) -> str:
    """Return type, start angle, field of view, resolution, maximum range, accuracy and remission mode."""
    if any(scanner.mount):
        raise ValueError(f"mount: must be (0, 0, 0) in a CARMEN log, got {scanner.mount}")
    bearings = scanner.bearings
    first = float(bearings[0]) if len(bearings) else 0.0
    view = float(bearings[-1]) - first if len(bearings) else 0.0
    step = view / max(len(bearings) - 1, 1)
    if np.abs(bearings - (first + step * np.arange(len(bearings)))).max(initial=0.0) > _EVEN:
        raise ValueError("bearings: must have even steps in a CARMEN log, got uneven ones")
    return f"0 {first!r} {view!r} {step!r} {scanner.range_max!r} 0.0 0"
