"""Read and write logs of the Carnegie Mellon Navigation Toolkit (CARMEN): one message per line, metres and radians.

=====================  =================================================================================
message                fields after the name
=====================  =================================================================================
FLASER, RLASER         n, n ranges, laser x y theta, robot x y theta
ROBOTLASER1 and 2      type, start angle, field of view, resolution, maximum range, accuracy, remission
                       mode, n, n ranges, m, m remissions, laser x y theta, robot x y theta, tv, rv,
                       forward and side safety distance, turn axis
ODOM                   x y theta, tv, rv, acceleration
=====================  =================================================================================

Each message ends with the time of measurement, the host and the logger's time. FLASER and ROBOTLASER1 come from the
front laser, RLASER and ROBOTLASER2 from the rear laser. Every other line is skipped. So are messages that break the
format, with one warning; they are an error unless most messages are sound.

* ``Scan.time`` and ``Odometry.time`` are the time of measurement.
* ``Scan.pose`` is the laser's pose. It is corrected in a log processed by SLAM, and odometry in a raw log; the file
  does not distinguish them.
* The scanner's mount is (0, 0, 0), since the poses are the laser's.
* FLASER and RLASER state no bearings. They start at -90 degrees, counter-clockwise, in steps of 180/n degrees, or of 1,
  0.5 or 0.25 degrees if that is within 1 %: 1 degree for 180 or 181 beams, 0.5 for 360 or 361.
* ROBOTLASER states angles with six decimals. If field of view and resolution agree within this rounding, bearings are
  spaced by the field of view over n - 1, without multiplying rounding errors; otherwise by the resolution.
"""

from __future__ import annotations

import contextlib
import functools
import gzip
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gpusense._util.files import write_whole
from gpusense._util.lines import numbered_lines, numbers_in, until_cut
from gpusense.logs.records import Odometry, Pose, Scan, even_bearings
from gpusense.world.scanner import Scanner

_FRONT = (b"FLASER", b"ROBOTLASER1")
_REAR = (b"RLASER", b"ROBOTLASER2")
_KNOWN = (*_FRONT, *_REAR, b"ODOM")
_TAIL = 3  # time of measurement, host, logger's time


def read(
    path: Path, *, range_max: float | None, range_min: float | None, odometry: bool, rear: bool
) -> Iterator[Scan | Odometry]:
    """Read the records of a CARMEN log; see :func:`gpusense.read_log` for arguments and errors."""
    names = _REAR if rear else _FRONT
    scanners: dict[tuple[float, ...], Scanner] = {}
    largest = functools.cache(lambda name: range_max or _range_max_of(path, name))

    def records(lines: Iterator[tuple[int, bytes]]) -> Iterator[Scan | Odometry]:
        for where, fields in _messages(path, lines):
            if fields[0] == b"ODOM":
                values = _message_numbers(where, fields, 6)
                if odometry:
                    yield Odometry(_time(where, fields), _pose(where, values[:3]))
                continue
            if fields[0] not in names:
                continue
            config, ranges, poses = _laser(where, fields)
            if fields[0].startswith(b"ROBOT"):
                start, view, step, stated_max = config[1:5].tolist()
                # Both view and step are rounded to 1e-6.
                finer = view / (ranges.size - 1) if ranges.size > 1 else step
                step, farthest = finer if abs(finer - step) <= 1e-6 else step, range_max or stated_max
            else:
                start, step, farthest = -math.pi / 2, _old_step(ranges.size), largest(fields[0])
            geometry = start, step, ranges.size, farthest
            if geometry not in scanners:
                try:
                    scanners[geometry] = Scanner.uniform(
                        angle_min=start, angle_increment=step, count=ranges.size, range_max=farthest,
                        range_min=range_min or 0.0,
                    )  # fmt: skip
                except ValueError as error:
                    raise ValueError(f"{where}: {error}") from None
            ranges.setflags(write=False)
            yield Scan(
                _time(where, fields), ranges, scanners[geometry], _pose(where, poses[3:]), _pose(where, poses[:3])
            )

    return until_cut(path, records, skip=True)


def _messages(path: Path, lines: Iterator[tuple[int, bytes]]) -> Iterator[tuple[str, list[bytes]]]:
    """Read all messages of known names: their places ``file:line``, and their fields, names included."""
    any_message = False
    number = 0
    for number, line in lines:
        if line.startswith(_KNOWN):
            fields = line.split()
            if fields[0] in _KNOWN:
                any_message = True
                yield f"{path}:{number}", fields
    if not any_message:
        other = "; a map is passed by --map or read by gs.read_map" if path.suffix in (".yaml", ".yml", ".pgm") else ""
        found = f"got none in {number} lines{other}"
        raise ValueError(f"{path}: must hold laser or ODOM messages of CARMEN, {found}")


def _laser(where: str, fields: Sequence[bytes]) -> tuple[NDArray[np.float64], ...]:
    """Return the first seven values, which configure a ROBOTLASER, the ranges, and the six pose values of a laser."""
    robot = fields[0].startswith(b"ROBOT")
    first = 8 if robot else 1
    last = first + _count(where, fields, first)
    poses = last + 1 + _count(where, fields, last + 1) if robot else last
    values = _message_numbers(where, fields, poses + (11 if robot else 6))
    return values[:7], values[first:last].copy(), values[poses : poses + 6]


def _count(where: str, fields: Sequence[bytes], index: int) -> int:
    """Return the count in ``fields[index]`` after checking that as many values follow."""
    name = fields[0].decode()
    left = len(fields) - index - 1
    text = fields[index].decode(errors="replace") if left >= 0 else ""
    if not (text.isascii() and text.isdigit() and len(text) <= 10):
        raise ValueError(f"{where}: {name}: field {index} must be a count, got {text[:40]!r}")
    if int(text) > left:
        raise ValueError(f"{where}: {name}: field {index} must count at most {left} values, got {text}")
    return int(text)


def _message_numbers(where: str, fields: Sequence[bytes], count: int) -> NDArray[np.float64]:
    """Return the ``count`` numbers between a message's name and its tail; check the times in the tail."""
    length = 1 + count + _TAIL
    name = fields[0].decode()
    if len(fields) != length:
        raise ValueError(f"{where}: {name}: must have {length} fields, got {len(fields)}")
    numbers_in(where, fields[-3::2], lambda index: f"{name}: field {length - 3 + 2 * index}", finite=False)
    return numbers_in(where, fields[1 : 1 + count], lambda index: f"{name}: field {1 + index}", finite=False)


def _time(where: str, fields: Sequence[bytes]) -> float:
    time = float(fields[-3])
    if not math.isfinite(time):
        raise ValueError(f"{where}: {fields[0].decode()}: the time must be finite, got {time}")
    return time


def _pose(where: str, values: NDArray[np.float64]) -> Pose:
    x, y, theta = values.tolist()
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(theta)):
        raise ValueError(f"{where}: a pose must be finite, got ({x}, {y}, {theta})")
    return x, y, theta


def _old_step(count: int) -> float:
    degrees = 180.0 / max(count, 1)
    for common in (1.0, 0.5, 0.25):
        if abs(degrees - common) <= 0.01 * common:
            degrees = common
    return math.radians(degrees)


def _range_max_of(path: Path, name: bytes) -> float:
    """Return range_max of a log's messages of one name, from their largest reading; see ``read_log``."""
    largest, times = 0.0, 0
    for where, fields in _messages(path, numbered_lines(path)):
        if fields[0] == name:
            with contextlib.suppress(ValueError):
                ranges = _laser(where, fields)[1]
                top = float(np.max(ranges, where=np.isfinite(ranges), initial=0.0))
                if top > largest:
                    largest, times = top, 0
                times += int(np.count_nonzero(ranges == largest))
    if largest == 0.0:
        raise ValueError(f"{path}: must have a reading > 0 unless range_max is given, got none")
    return largest if times >= 3 else math.nextafter(largest, math.inf)


# Decimals of readings [m] and of poses [m, rad]; host in each message.
_READING, _POSE, _HOST = 4, 6, "simulated"


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
    """Return readings that stay below range_max after rounding, if they are."""
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
    first, step = even_bearings(scanner, "a CARMEN log")
    view = float(scanner.bearings[-1]) - first if scanner.count else 0.0
    return f"0 {first!r} {view!r} {step!r} {scanner.range_max!r} 0.0 0"
