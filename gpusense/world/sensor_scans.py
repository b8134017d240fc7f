"""Scans of one scanner, or of several scanners of a robot in the order of a log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Integers
from gpusense.world.scanner import Scanner

Reader = Callable[[str, Any, Scanner], NDArray[Any]]


@dataclass(frozen=True, eq=False)
class SensorScans:
    """S scans of L scanners."""

    scanners: tuple[Scanner, ...]  # the scanners
    sensor: Integers  # (S,) index of the scanner of each scan
    rows: tuple[Integers, ...]  # for each scanner, the ascending indices of its scans
    readings: tuple[NDArray[Any], ...]  # for each scanner, the readings (S_l, K_l) of these scans [m]

    def __len__(self) -> int:
        return len(self.sensor)

    def places(self) -> Integers:
        """Return the index (S,) of each scan among the scans of its scanner."""
        place = np.zeros(len(self), np.int64)
        for rows in self.rows:
            place[rows] = np.arange(len(rows))
        return place


def check_scans(scans: Any, scanner: Scanner | Sequence[Scanner], sensor: Any, read: Reader) -> SensorScans:
    """Group S scans by scanner.

    ``scans``: (S, K) readings of one scanner, or S scans of several scanners, each with its scanner's number of
    readings [m]; ``scanner``: the scanner, or L scanners; ``sensor``: (S,) indices of the scanners; None for one
    scanner; ``read``: function that checks and returns the readings of one scanner, from the argument's name, its value
    and the scanner.
    """
    if isinstance(scanner, Scanner):
        if sensor is not None:
            raise ValueError(f"sensor: must be None with a single scanner, got {checks.show(sensor)}")
        values = np.atleast_2d(read("scans", scans, scanner))
        return SensorScans((scanner,), np.zeros(len(values), np.int64), (np.arange(len(values)),), (values,))
    scanners = tuple(scanner) if isinstance(scanner, Sequence) else ()
    if not scanners or not all(isinstance(one, Scanner) for one in scanners):
        raise TypeError(f"scanner: must be a Scanner or a sequence of them, got {checks.show(scanner)}")
    if not hasattr(scans, "__len__"):
        raise TypeError(f"scans: must be a sequence of readings with several scanners, got {checks.show(scans)}")
    index = _check_sensor(sensor, len(scans), len(scanners))
    rows = tuple(np.flatnonzero(index == one) for one in range(len(scanners)))
    for one, some in enumerate(rows):
        if not len(some):
            raise ValueError(f"sensor: every scanner must have a scan, got none of scanner {one}")
        for k in some.tolist():
            if np.shape(scans[k]) != (scanners[one].count,):
                rule = f"scan {k} must have the {scanners[one].count} readings of scanner {one}"
                raise ValueError(f"scans: {rule}, got shape {np.shape(scans[k])}")
    readings = tuple(
        read("scans", np.stack([np.asarray(scans[k]) for k in some.tolist()]), one)
        for some, one in zip(rows, scanners, strict=True)
    )
    return SensorScans(scanners, index, rows, readings)


def _check_sensor(sensor: Any, scans: int, scanners: int) -> Integers:
    """Return the scanner of each scan."""
    if sensor is None:
        if scanners == 1:
            return np.zeros(scans, np.int64)
        raise ValueError(f"sensor: must say which of the {scanners} scanners each scan is of, got None")
    return checks.indices("sensor", sensor, scanners, (scans,))
