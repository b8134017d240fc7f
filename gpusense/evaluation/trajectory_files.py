"""Trajectories in the format TUM, which evo and other tools read: a line ``time x y z qx qy qz qw`` for each pose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.files import write_whole

Floats = NDArray[np.float64]


def write_tum(path: Path, times: Iterable[float], poses: Iterable[Floats]) -> None:
    """Write poses as a TUM trajectory.

    Args:
        path: The file.
        times: Times [s].
        poses: Poses (x, y [m], theta), as many.

    Raises:
        OSError, ValueError: the file cannot be written.
    """

    def write(stream: BinaryIO) -> None:
        for time, (x, y, theta) in zip(times, poses, strict=True):
            z, w = math.sin(theta / 2), math.cos(theta / 2)
            stream.write(f"{time:.6f} {x:.6f} {y:.6f} 0 0 0 {z:.9f} {w:.9f}\n".encode())

    write_whole(path, write)


def _numbers(path: Path) -> Iterator[list[float]]:
    """Return the eight numbers of each line; text after # is a comment.

    Raises:
        ValueError: a line has not eight finite numbers.
    """
    with path.open(encoding="utf-8") as file:
        for line, text in enumerate(file, 1):
            words = text.split("#")[0].split()
            try:
                numbers = [float(word) for word in words]
            except ValueError:
                numbers = []
            if words and not (len(numbers) == 8 and all(map(math.isfinite, numbers))):
                raise ValueError(f"{path}: line {line} must have eight finite numbers, got {checks.show(text.strip())}")
            if words:
                yield numbers


def read_tum(path: Path) -> tuple[Floats, Floats]:
    """Read a TUM trajectory: times (T,) [s] and poses (T, 3), the headings those of the quaternions.

    Raises:
        ValueError: a line has not eight finite numbers, there is none, a quaternion is 0, or times do not increase.
        FileNotFoundError: the file is missing.
    """
    rows = np.array(list(_numbers(path))).reshape(-1, 8)
    if not len(rows):
        raise ValueError(f"{path}: must have a pose, got none")
    if not (np.diff(rows[:, 0]) > 0).all():
        line = int(np.argmin(np.diff(rows[:, 0]) > 0)) + 1
        raise ValueError(f"{path}: must have increasing times, got {rows[line, 0]} after {rows[line - 1, 0]}")
    x, y, z, w = rows[:, 4:].T
    if not (np.hypot(np.hypot(x, y), np.hypot(z, w)) > 0).all():
        raise ValueError(f"{path}: must have quaternions other than 0, got one of 0")
    theta = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return rows[:, 0], np.column_stack([rows[:, 1], rows[:, 2], theta])
