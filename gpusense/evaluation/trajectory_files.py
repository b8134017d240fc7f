"""Trajectories in the format TUM, which evo and other tools read: a line ``time x y z qx qy qz qw`` for each pose."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.files import write_whole
from gpusense._util.lines import until_cut
from gpusense._util.typing import Floats
from gpusense.logs import Pose
from gpusense.world.pose_algebra import wrap_angle

# Largest time between two poses of a trajectory that are interpolated, and between equal times [s].
_FARTHEST, _SAME_TIME = 0.5, 1e-3
# Largest coordinate [m]; UTM reaches 1e7.
_LARGEST = 1e9
# Comment of a trajectory with indices of scans instead of times.
_INDICES = "# indices of scans, not times"


def write_tum(path: Path, times: Iterable[float], poses: Iterable[Floats], *, indices: bool = False) -> None:
    """Write poses (x, y [m], theta) and as many times [s], or ``indices`` of scans, as a TUM trajectory."""

    def write(stream: BinaryIO) -> None:
        if indices:
            stream.write(f"{_INDICES}\n".encode())
        for time, (x, y, theta) in zip(times, poses, strict=True):
            z, w = math.sin(theta / 2), math.cos(theta / 2)
            stream.write(f"{time:.6f} {x:.6f} {y:.6f} 0 0 0 {z:.9f} {w:.9f}\n".encode())

    write_whole(path, write)


def _rows(path: Path, lines: Iterator[tuple[int, bytes]]) -> Iterator[list[float]]:
    """Yield the eight numbers of each numbered line; text after # is a comment."""
    for line, data in lines:
        text = data.decode(errors="backslashreplace")
        if text.strip() == _INDICES:
            raise ValueError(f"{path}: must have times of scans, got their indices")
        words = text.split("#")[0].split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if words and len(numbers) != 8:
            raise ValueError(f"{path}: line {line} must have eight numbers, got {checks.show(text.strip())}")
        if words:
            yield numbers


def read_tum(path: Path) -> tuple[Floats, Floats]:
    """Read a TUM trajectory: times (T,) [s] and poses (T, 3), with headings from the quaternions.

    Poses that are not finite are skipped, with one warning.
    """
    every = np.array(list(until_cut(path, lambda lines: _rows(path, lines)))).reshape(-1, 8)
    rows = every[np.isfinite(every).all(axis=1)]
    if not len(rows):
        raise ValueError(f"{path}: must have a pose, got none")
    if len(rows) < len(every):
        warnings.warn(f"{path}: {len(every) - len(rows)} of {len(every)} poses are not finite: skipped", stacklevel=2)
    if not (np.diff(rows[:, 0]) > 0).all():
        line = int(np.argmin(np.diff(rows[:, 0]) > 0)) + 1
        raise ValueError(f"{path}: must have increasing times, got {rows[line, 0]} after {rows[line - 1, 0]}")
    if (np.abs(rows[:, 1:3]) > _LARGEST).any():
        raise ValueError(f"{path}: must have coordinates of at most {_LARGEST:g} m, got {np.abs(rows[:, 1:3]).max():g}")
    largest = np.abs(rows[:, 4:]).max(axis=1)
    if not (largest > 0).all():
        raise ValueError(f"{path}: must have quaternions other than 0, got one of 0")
    x, y, z, w = (rows[:, 4:] / largest[:, None]).T
    theta = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return rows[:, 0], np.column_stack([rows[:, 1], rows[:, 2], theta])


def poses_at(
    scans: Sequence[float], times: Floats, poses: Floats, *, near: float = _SAME_TIME, name: str = "--reference"
) -> list[Pose | None]:
    """Return the poses of a trajectory at the times of scans; None where none is near.

    Between two poses of the trajectory that are at most half a second apart, poses are interpolated.

    ``scans``: Times of the scans [s], at least one. ``times``: (T,) increasing times of the trajectory [s]. ``poses``:
    (T, 3) its poses. ``near``: Largest time from a scan to a single pose near it [s].
    """
    wanted = np.asarray(scans, np.float64)
    nearest, (before, after) = nearest_index(wanted, times), _neighbours(wanted, times)
    span, apart = times[after] - times[before], np.abs(times[nearest] - wanted)
    between = (times[before] < wanted) & (wanted <= times[after]) & (span <= _FARTHEST)
    single = (apart <= _SAME_TIME) | ((apart <= near) & ~between)
    known = single | between
    if not known.any():
        held, asked = f"{times[0]:.3f} to {times[-1]:.3f} s", f"{scans[0]:.3f} to {scans[-1]:.3f} s"
        raise ValueError(f"{name}: must have poses at times of the scans, {asked}, got {held}")
    change = poses[after] - poses[before]
    change[:, 2] = wrap_angle(change[:, 2])
    share = (wanted - times[before]) / np.where(span > 0, span, 1.0)
    found = np.where(single[:, None], poses[nearest], poses[before] + share[:, None] * change)
    return [(x, y, theta) if sure else None for (x, y, theta), sure in zip(found.tolist(), known, strict=True)]


def nearest_index(scans: Sequence[float] | Floats, times: Floats) -> NDArray[np.int64]:
    """Return the index of the pose of a trajectory nearest to each time of a scan."""
    wanted = np.asarray(scans, np.float64)
    before, after = _neighbours(wanted, times)
    return np.where(wanted - times[before] <= times[after] - wanted, before, after)


def _neighbours(wanted: Floats, times: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of the poses before and after each time, within the trajectory."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    return after - 1, np.minimum(after, len(times) - 1)
