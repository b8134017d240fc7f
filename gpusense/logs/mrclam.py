"""Runs in the format of the UTIAS Multi-Robot Cooperative Localization and Mapping data (Leung et al., IJRR 2011).

==========================  ===========================================================================
file                        columns, separated by blanks; lines that begin with # are comments
==========================  ===========================================================================
Landmark_Groundtruth.dat    subject, x, y, and their deviations [m]
Barcodes.dat                subject, barcode
RobotN_Odometry.dat         time [s], forward velocity [m/s], angular velocity [rad/s]
RobotN_Measurement.dat      time [s], barcode, range [m], bearing [rad]
RobotN_Groundtruth.dat      time [s], x, y [m], heading [rad]
==========================  ===========================================================================

Each may be compressed by gzip, with .gz after its name. Measurements carry barcodes, not subjects. Subjects that are no
landmark are the other robots; their readings, and those of barcodes that stand in no list, are left out and counted.
Readings of one time are one scan. Logged poses and odometry are interpolated at its time, headings the short way round;
readings before the first logged pose or after the last are left out.
"""

from __future__ import annotations

import gzip
import math
import os
import zlib
from pathlib import Path

import numpy as np

from gpusense._util import checks
from gpusense.logs.records import Floats, LandmarkRun
from gpusense.world.landmarks import LandmarkMap

_MAX_LINE = 10_000


def read_mrclam(
    folder: str | os.PathLike[str], robot: int, *, range_max: float | None = None, field_of_view: float | None = None
) -> LandmarkRun:
    """One robot's run.

    Args:
        folder: Where the files are.
        robot: N of the files' names, >= 1.
        range_max: Largest range of the sensor [m]; None is the next metre above the largest reading.
        field_of_view: Angle in which it sees [rad]; None is twice the largest bearing, and a twentieth more.

    Raises:
        FileNotFoundError: a file is missing.
        TypeError, ValueError: an argument breaks its rule, or a line the format; the message names file and line.
    """
    base = checks.path("folder", folder)
    robot = checks.integer("robot", robot, low=1)
    places, _ = _table(base / "Landmark_Groundtruth.dat", ("subject", "x", "y", "deviation", "deviation"))
    codes, code_lines = _table(base / "Barcodes.dat", ("subject", "barcode"))
    readings, lines = _table(base / f"Robot{robot}_Measurement.dat", ("time", "barcode", "range", "bearing"), True)
    driven, _ = _table(base / f"Robot{robot}_Odometry.dat", ("time", "velocity", "angular velocity"), True)
    logged, _ = _table(base / f"Robot{robot}_Groundtruth.dat", ("time", "x", "y", "heading"), True)
    subjects = places[:, 0].astype(np.int64)
    index = {int(subject): i for i, subject in enumerate(subjects)}
    if len(index) < len(subjects):
        raise ValueError(f"{_file(base / 'Landmark_Groundtruth.dat')}: every subject must stand there once")
    known: dict[int, int] = {}
    for (subject, code), where in zip(codes, code_lines, strict=True):
        if int(code) in known:
            raise ValueError(f"{where}: every barcode must stand there once, got {int(code)} again")
        known[int(code)] = index.get(int(subject), -1)
    for row, where in zip(readings, lines, strict=True):
        if row[2] < 0:
            raise ValueError(f"{where}: range must be >= 0, got {row[2]:g}")
    ids = np.array([known.get(int(code), -2) for code in readings[:, 1]], np.int64)
    inside = (readings[:, 0] >= logged[0, 0]) & (readings[:, 0] <= logged[-1, 0])
    left_out = {
        "other robots": int(np.sum(ids == -1)), "unknown barcodes": int(np.sum(ids == -2)),
        "without a logged pose": int(np.sum((ids >= 0) & ~inside)),
    }  # fmt: skip
    kept = (ids >= 0) & inside
    if not kept.any():
        raise ValueError(f"{_file(base / f'Robot{robot}_Measurement.dat')}: must hold readings of landmarks, got none")
    readings, ids = readings[kept], ids[kept]
    time, scan = np.unique(readings[:, 0], return_inverse=True)
    features = np.column_stack([readings[:, 2], np.arctan2(np.sin(readings[:, 3]), np.cos(readings[:, 3]))])
    if range_max is None:
        range_max = max(math.ceil(float(features[:, 0].max())), 1)
    range_max = checks.real("range_max", range_max, above=0)
    if field_of_view is None:
        field_of_view = min(2.1 * max(float(np.abs(features[:, 1]).max()), 0.1), 2 * math.pi)
    return LandmarkRun(
        landmarks=LandmarkMap(places[:, 1:3]),
        labels=subjects,
        time=time,
        odometry=_at(time, dead_reckoning(driven)),
        truth=_at(time, logged),
        features=features,
        scan=scan.reshape(-1).astype(np.int64),
        ids=ids,
        range_max=range_max,
        field_of_view=field_of_view,
        left_out=left_out,
    )


def dead_reckoning(driven: Floats) -> Floats:
    """(T, 4) times and poses from the origin on, of (T, 3) times, velocities and angular velocities."""
    seconds = np.diff(driven[:, 0])
    heading = np.concatenate([[0.0], np.cumsum(driven[:-1, 2] * seconds)])
    middle = (heading[:-1] + heading[1:]) / 2
    way = driven[:-1, 1] * seconds
    x, y = (np.concatenate([[0.0], np.cumsum(way * turn(middle))]) for turn in (np.cos, np.sin))
    return np.column_stack([driven[:, 0], x, y, heading])


def _at(time: Floats, track: Floats) -> Floats:
    """(S, 3) poses at times, interpolated between (T, 4) times and poses."""
    columns = (track[:, 1], track[:, 2], np.unwrap(track[:, 3]))
    return np.stack([np.interp(time, track[:, 0], column) for column in columns], axis=1)


def _file(path: Path) -> Path:
    """The file, or its compressed copy where it is not there."""
    packed = path.with_name(f"{path.name}.gz")
    return packed if not path.exists() and packed.exists() else path


def _table(path: Path, columns: tuple[str, ...], ordered: bool = False) -> tuple[Floats, list[str]]:
    """The rows of a file, and where each stands; times must not fall where they are ordered."""
    file = checks.existing_file(_file(path))
    rows: list[list[float]] = []
    where: list[str] = []
    number = 0
    try:
        with file.open("rb") as plain:
            packed = plain.read(2) == b"\x1f\x8b"
            plain.seek(0)
            with gzip.open(plain) if packed else plain as stream:
                while line := stream.readline(_MAX_LINE):
                    number += 1
                    fields = line.split()
                    if fields and not fields[0].startswith(b"#"):
                        where.append(f"{file}:{number}")
                        rows.append(_row(where[-1], fields, columns))
                        if ordered and len(rows) > 1 and rows[-1][0] < rows[-2][0]:
                            raise ValueError(f"{where[-1]}: time must not fall, got {rows[-1][0]:g}")
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{file}:{number + 1}: must be a whole gzip file, got a broken one: {error}") from error
    if not rows:
        raise ValueError(f"{file}: must hold rows of {', '.join(columns)}, got none")
    return np.array(rows), where


def _row(where: str, fields: list[bytes], columns: tuple[str, ...]) -> list[float]:
    if len(fields) != len(columns):
        raise ValueError(f"{where}: must have {len(columns)} fields ({', '.join(columns)}), got {len(fields)}")
    values = []
    for name, text in zip(columns, fields, strict=True):
        try:
            value = math.nan if b"_" in text else float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(f"{where}: {name} must be a finite number, got {text.decode(errors='replace')[:40]!r}")
        if name in ("subject", "barcode") and not (value == int(value) and abs(value) < 2**53):
            raise ValueError(f"{where}: {name} must be an integer, got {text.decode(errors='replace')[:40]!r}")
        values.append(value)
    return values
