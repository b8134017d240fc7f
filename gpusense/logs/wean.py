"""Read logs of Carnegie Mellon's course 16-831 (Wean Hall): one message per line, centimetres and radians.

=======  ===========================================================================
message  fields after the letter
=======  ===========================================================================
L        robot x y theta, laser x y theta, 180 ranges, time [s]
O        robot x y theta, time [s]
=======  ===========================================================================

Beam k has the bearing -90 + k degrees. Readings of 8183 cm and more are "no return". The poses of robot and laser
determine the scanner's mount, rounded to 1 mm and 1e-3 rad. All scans share the mount of the first one. The odometry
frame is arbitrary, and ``Scan.pose`` is None. Results are in metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gpusense._util.lines import numbers_in, until_cut
from gpusense._util.typing import Floats
from gpusense.logs.records import Odometry, Pose, Scan
from gpusense.world.pose_algebra import pose_difference
from gpusense.world.scanner import Scanner

_BEAMS, _RANGE_MAX = 180, 81.83
_NAMES = {b"L": 6 + _BEAMS + 1, b"O": 4}
# Largest change of the laser's mount after the first scan [m, rad].
_MOVED = 0.02


def read(path: Path, *, range_max: float | None, range_min: float | None, odometry: bool) -> Iterator[Scan | Odometry]:
    """Read the records of a log; see :func:`gpusense.read_log` for arguments and errors."""
    scanners: list[Scanner] = []

    def records(lines: Iterator[tuple[int, bytes]]) -> Iterator[Scan | Odometry]:
        for number, line in lines:
            fields = line.split()
            if not fields:
                continue
            where = f"{path}:{number}"
            values = _numbers(where, fields)
            pose = float(values[0]) / 100, float(values[1]) / 100, float(values[2])
            if fields[0] == b"O":
                if odometry:
                    yield Odometry(float(values[-1]), pose)
                continue
            mount = _mount(pose, (float(values[3]) / 100, float(values[4]) / 100, float(values[5])))
            if not scanners:
                bearings = -math.pi / 2 + math.pi / _BEAMS * np.arange(_BEAMS)
                scanners.append(Scanner(bearings, range_max or _RANGE_MAX, range_min or 0.0, mount))
            first = scanners[0].mount
            apart = max(math.dist(mount[:2], first[:2]), abs(math.remainder(mount[2] - first[2], math.tau)))
            if apart > _MOVED:
                raise ValueError(f"{where}: L: the laser must stay at {first} on the robot, got {mount}")
            ranges = values[6 : 6 + _BEAMS] / 100
            ranges.setflags(write=False)
            yield Scan(float(values[-1]), ranges, scanners[0], pose, None)

    return until_cut(path, records, skip=True)


def _numbers(where: str, fields: list[bytes]) -> Floats:
    """Return the finite numbers after a message's letter."""
    count = _NAMES.get(fields[0])
    name = fields[0].decode(errors="replace")[:20]
    if count is None:
        raise ValueError(f"{where}: must begin with L or O, got {name!r}")
    if len(fields) != 1 + count:
        raise ValueError(f"{where}: {name}: must have {1 + count} fields, got {len(fields)}")
    return numbers_in(where, fields[1:], lambda index: f"{name}: field {1 + index}")


def _mount(robot: Pose, laser: Pose) -> Pose:
    """Return the laser's pose on the robot, rounded."""
    x, y, turn = (pose_difference(robot, laser).round(3) + 0.0).tolist()
    return x, y, turn
