"""Read runs in the format of the UTIAS Multi-Robot Cooperative Localization and Mapping data (Leung et al., IJRR 2011).

==========================  ===========================================================================
file                        columns, separated by blanks; lines that begin with # are comments
==========================  ===========================================================================
Landmark_Groundtruth.dat    subject, x, y, and their standard deviations [m]
Barcodes.dat                subject, barcode
RobotN_Odometry.dat         time [s], forward velocity [m/s], angular velocity [rad/s]
RobotN_Measurement.dat      time [s], barcode, range [m], bearing [rad]
RobotN_Groundtruth.dat      time [s], x, y [m], heading [rad]
==========================  ===========================================================================

Files may be gzipped, with .gz after the name. Measurements name barcodes instead of subjects. Subjects that are no
landmarks are robots. Readings of robots and of unlisted barcodes are counted and ignored. Readings at one time form a
scan. Logged poses and odometry are interpolated at this time, headings along the shorter arc. Readings before the first
or after the last logged pose are ignored.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gpusense._util import checks
from gpusense._util.lines import numbers_in, until_cut
from gpusense._util.typing import Floats, Integers
from gpusense.logs.records import LandmarkRun
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.pose_algebra import interpolated

# Indices of subjects that are no landmarks: a robot, and the owner of an unlisted barcode.
_ROBOT, _UNKNOWN = -1, -2


def read_mrclam(
    folder: str | os.PathLike[str], robot: int, *, range_max: float | None = None, field_of_view: float | None = None
) -> LandmarkRun:
    """Read the run of one robot, N >= 1 of the files' names.

    ``range_max`` [m] None is the next metre above the largest reading, ``field_of_view`` [rad] None 2.1 times the
    largest bearing.
    """
    base = checks.path("folder", folder)
    robot = checks.integer("robot", robot, low=1)
    landmarks, _ = _table(base / "Landmark_Groundtruth.dat", ("subject", "x", "y", "deviation", "deviation"))
    codes, code_lines = _table(base / "Barcodes.dat", ("subject", "barcode"))
    measurements = base / f"Robot{robot}_Measurement.dat"
    readings, lines = _table(measurements, ("time", "barcode", "range", "bearing"), True)
    velocities, _ = _table(base / f"Robot{robot}_Odometry.dat", ("time", "velocity", "angular velocity"), True)
    logged, _ = _table(base / f"Robot{robot}_Groundtruth.dat", ("time", "x", "y", "heading"), True)
    subjects = landmarks[:, 0].astype(np.int64)
    if len(np.unique(subjects)) < len(subjects):
        raise ValueError(f"{_file(base / 'Landmark_Groundtruth.dat')}: every subject must occur once")
    known = _landmarks_by_code(subjects, codes, code_lines)
    for row, where in zip(readings, lines, strict=True):
        if row[2] < 0:
            raise ValueError(f"{where}: range must be >= 0, got {row[2]:g}")
    ids = np.array([known.get(int(code), _UNKNOWN) for code in readings[:, 1]], np.int64)
    inside = (readings[:, 0] >= logged[0, 0]) & (readings[:, 0] <= logged[-1, 0])
    left_out = {
        "other robots": int(np.sum(ids == _ROBOT)), "unknown barcodes": int(np.sum(ids == _UNKNOWN)),
        "without a logged pose": int(np.sum((ids >= 0) & ~inside)),
    }  # fmt: skip
    used = (ids >= 0) & inside
    if not used.any():
        raise ValueError(f"{_file(measurements)}: must hold readings of landmarks, got none")
    readings, ids = readings[used], ids[used]
    time, scan = np.unique(readings[:, 0], return_inverse=True)
    features = np.column_stack([readings[:, 2], np.arctan2(np.sin(readings[:, 3]), np.cos(readings[:, 3]))])
    if range_max is None:
        range_max = max(math.ceil(float(features[:, 0].max())), 1)
    range_max = checks.real("range_max", range_max, above=0)
    if field_of_view is None:
        field_of_view = min(2.1 * max(float(np.abs(features[:, 1]).max()), 0.1), 2 * math.pi)
    return LandmarkRun(
        LandmarkMap(landmarks[:, 1:3]), subjects, time, _at(time, dead_reckoning(velocities)), _at(time, logged),
        features, scan.reshape(-1).astype(np.int64), ids, range_max, field_of_view, left_out,
    )  # fmt: skip


def _landmarks_by_code(subjects: Integers, codes: Floats, lines: list[str]) -> dict[int, int]:
    """Return the landmark of each barcode; _ROBOT for a robot's."""
    index = {int(subject): i for i, subject in enumerate(subjects)}
    known: dict[int, int] = {}
    for (subject, code), where in zip(codes, lines, strict=True):
        if int(code) in known:
            raise ValueError(f"{where}: every barcode must occur once, got {int(code)} again")
        known[int(code)] = index.get(int(subject), _ROBOT)
    return known


def dead_reckoning(velocities: Floats) -> Floats:
    """Integrate (T, 3) times [s], forward and angular velocities to (T, 4) times and poses, the first at the origin."""
    seconds = np.diff(velocities[:, 0])
    heading = np.concatenate([[0.0], np.cumsum(velocities[:-1, 2] * seconds)])
    middle = (heading[:-1] + heading[1:]) / 2
    length = velocities[:-1, 1] * seconds
    x, y = (np.concatenate([[0.0], np.cumsum(length * turn(middle))]) for turn in (np.cos, np.sin))
    return np.column_stack([velocities[:, 0], x, y, heading])


def _at(time: Floats, track: Floats) -> Floats:
    """Interpolate (T, 4) times and poses to (S, 3) poses at (S,) times."""
    return interpolated(time, track[:, 0], np.column_stack([track[:, 1:3], np.unwrap(track[:, 3])]))


def _file(path: Path) -> Path:
    """Return the path of a file, or of its compressed copy if only the copy exists."""
    packed = path.with_name(f"{path.name}.gz")
    return packed if not path.exists() and packed.exists() else path


def _table(path: Path, columns: tuple[str, ...], ordered: bool = False) -> tuple[Floats, list[str]]:
    """Read the rows of a file, and the place ``file:line`` of each; an ``ordered`` first column must not decrease."""
    file = checks.existing_file(_file(path))
    rows: list[list[float]] = []
    where: list[str] = []

    def each(lines: Iterator[tuple[int, bytes]]) -> Iterator[tuple[str, list[float]]]:
        before = -math.inf
        for number, line in lines:
            fields = line.split()
            if fields and not fields[0].startswith(b"#"):
                row = _row(f"{file}:{number}", fields, columns)
                if ordered and row[0] < before:
                    raise ValueError(f"{file}:{number}: time must not fall, got {row[0]:g}")
                before = row[0]
                yield f"{file}:{number}", row

    for place, row in until_cut(file, each):
        where.append(place)
        rows.append(row)
    if not rows:
        raise ValueError(f"{file}: must hold rows of {', '.join(columns)}, got none")
    return np.array(rows), where


def _row(where: str, fields: list[bytes], columns: tuple[str, ...]) -> list[float]:
    if len(fields) != len(columns):
        raise ValueError(f"{where}: must have {len(columns)} fields ({', '.join(columns)}), got {len(fields)}")
    values: list[float] = numbers_in(where, fields, columns.__getitem__).tolist()
    for name, value, text in zip(columns, values, fields, strict=True):
        if name in ("subject", "barcode") and not (value == int(value) and abs(value) < 2**53):
            raise ValueError(f"{where}: {name} must be an integer, got {text.decode(errors='replace')[:40]!r}")
    return values
