"""Pairs of key scans that may show the same place: those whose end points share cells of the plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpusense.localization.pose_algebra import compose_poses
from gpusense.matching.points import ScanPoints, scan_points
from gpusense.world.sensor_scans import SensorScans

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Least share of the cells of a scan that another one must share.
_SHARE = 0.3
# Key scans whose shares are looked at at once.
_ROWS = 512
# Points farther than this many rms ranges say little of a place.
_FAR = 2.0


def place_points_of(data: SensorScans, scans: Integers) -> list[Floats]:
    """Return the end points of scans in the robot's frame, without the farthest ones of each."""
    result, sensor, place = [np.zeros((0, 2))] * len(scans), data.sensor[scans], data.places()[scans]
    for one, scanner in enumerate(data.scanners):
        some = np.flatnonzero(sensor == one)
        points = scan_points(data.readings[one][place[some]], scanner, np.dtype(np.float32))
        for k, scan in enumerate(some.tolist()):
            result[scan] = _place_points(points, scanner.mount[:2], k)
    return result


def _place_points(points: ScanPoints, mount: tuple[float, float], scan: int) -> Floats:
    """Return (P, 2) end points of a scan in the robot's frame, without the farthest ones."""
    part = points.point[points.start[scan] : points.start[scan + 1]].astype(np.float64)
    near = part[:, 3] <= _FAR * max(float(points.rms_range(np.array([scan]))[0]), 1e-3)
    result: Floats = part[near, :2] + np.array(mount)
    return result


def overlaps(
    places: list[Floats], poses: Floats, cell: float, apart: int, sequence: tuple[Integers, Integers]
) -> tuple[Integers, Integers, Floats]:
    """Return pairs of key scans that share many cells, the best of each passage.

    Of the key scans of a scanner in a row that share cells with another one, that with the most is taken.

    Args:
        places: End points of each key scan in the robot's frame.
        poses: (K, 3) poses of the key scans.
        cell: Side of a cell [m].
        apart: Key scans of a pair are at least this many apart.
        sequence: (K,) scanners of the key scans, and (K,) their numbers among those of their scanner.

    Returns:
        (L,) first ones, (L,) second ones, and (L,) shares of common cells.
    """
    from scipy import sparse

    rows, cols = [], []
    for k, (points, pose) in enumerate(zip(places, poses, strict=True)):
        at = np.zeros((len(points), 3))
        at[:, :2] = points
        cells = np.unique(np.floor(compose_poses(pose, at)[:, :2] / cell).astype(np.int64), axis=0)
        rows.append(np.full(len(cells), k))
        cols.append(cells)
    row, place = np.concatenate(rows), np.concatenate(cols)
    _, number = np.unique(place, axis=0, return_inverse=True)
    table = sparse.csr_matrix(
        (np.ones(len(row), np.float32), (row, number.ravel())), shape=(len(places), len(row) or 1)
    )
    sizes = np.asarray(table.sum(axis=1)).ravel()
    found: list[tuple[Integers, Integers, Floats]] = []
    for begin in range(0, len(places), _ROWS):
        common = (table[begin : begin + _ROWS] @ table.T).tocoo()
        second, first = common.row + begin, common.col
        share = common.data / np.maximum(np.minimum(sizes[first], sizes[second]), 1)
        good = (second - first >= apart) & (share >= _SHARE)
        found.append(_best_of_passages(first[good], second[good], share[good], sequence))
    one, two, shares = (np.concatenate(part) for part in zip(*found, strict=True))
    return one.astype(np.int64), two.astype(np.int64), shares


def _best_of_passages(
    first: Integers, second: Integers, share: Floats, sequence: tuple[Integers, Integers]
) -> tuple[Integers, Integers, Floats]:
    """Return the best pair of each run of successive first scans of a scanner with the same second one."""
    if not len(first):
        return first, second, share
    scanner, rank = (values[first] for values in sequence)
    order = np.lexsort((rank, scanner, second))
    first, second, scanner, rank = (values[order] for values in (first, second, scanner, rank))
    share = share[order]
    # A run ends where a first scan or more is left out.
    begins = np.append(True, (np.diff(second) != 0) | (np.diff(scanner) != 0) | (np.diff(rank) > 1))
    run = np.cumsum(begins)
    best = np.lexsort((-share, run))
    keep = best[np.append(True, np.diff(run[best]) != 0)]
    return first[keep], second[keep], share[keep]
