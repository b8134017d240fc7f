"""Find pairs of key scans that may show the same place: their end points share cells of the plane."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util.typing import Floats, Integers
from gpusense.localization.pose_algebra import wrap_angle
from gpusense.matching.points import ScanPoints, scan_points
from gpusense.world.sensor_scans import SensorScans

# Least share of common cells of a scan.
_SHARE = 0.3
# Key scans per pass.
_ROWS = 512
# Most cells of a plane with a table.
_DENSE = 1 << 22
# Largest distance of useful points [rms ranges]; farther points hardly characterise a place.
_FAR = 2.0
# Passages per direction through a place to compare with later ones, number of directions, key scans of a scanner
# between two passages, and most key scans of a passage.
_PASSAGES, _WAYS, _AWAY, _LONG = 4, 4, 16, 64
# Most first scans per second one, and least large share of cells.
_PAIRS, _LARGE = 8, 0.6


def place_points_of(data: SensorScans, scans: Integers) -> list[Floats]:
    """Return the end points of scans in the robot's frame, without the farthest points of each scan."""
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
    """Return pairs of key scans that share many cells, the best of each passage: (L,) first, second, and shares.

    Successive key scans of a scanner that share cells with a second one yield the scan with the largest share. Earlier
    scans come only from the first passages through each place, so that their number does not grow. Key scans of a pair
    are at least ``apart`` apart.
    """
    from scipy import sparse

    row, number = _cells_of(places, poses, cell)
    table = sparse.csr_matrix(
        (np.ones(len(row), np.float32), (row, number)), shape=(len(places), int(number.max(initial=0)) + 1)
    )
    sizes = np.diff(table.indptr)
    early = _first_passages(table, poses, sequence)
    others = table[early].T.tocsr()
    found: list[tuple[Integers, Integers, Floats]] = []
    for begin in range(0, len(places), _ROWS):
        common = (table[begin : begin + _ROWS] @ others).tocoo()
        second, first = common.row + begin, early[common.col]
        share = common.data / np.maximum(np.minimum(sizes[first], sizes[second]), 1)
        good = (second - first >= apart) & (share >= _SHARE)
        best = _best_of_passages(first[good], second[good], share[good], sequence)
        found.append(_most_alike(*best, poses))
    one, two, shares = (np.concatenate(part) for part in zip(*found, strict=True))
    return one.astype(np.int64), two.astype(np.int64), shares


def _cells_of(places: list[Floats], poses: Floats, cell: float) -> tuple[Integers, Integers]:
    """Return the distinct pairs of key scans (C,) and numbers (C,) of the cells of their points."""
    sizes = [len(points) for points in places]
    owner = np.repeat(np.arange(len(places)), sizes)
    px, py, c, s = np.repeat([poses[:, 0], poses[:, 1], np.cos(poses[:, 2]), np.sin(poses[:, 2])], sizes, axis=1)
    x, y = np.concatenate(places).T
    cells = np.floor(np.stack([px + c * x - s * y, py + s * x + c * y]) / cell).astype(np.int64)
    # Neighbouring points mostly share a cell, which leaves little to sort.
    new = np.append(True, (np.diff(owner) != 0) | (np.diff(cells) != 0).any(axis=0))[: len(owner)]
    owner, number = owner[new], _numbered(cells[:, new].T)
    count = int(number.max(initial=0)) + 1
    both = np.unique(owner * count + number)
    return both // count, both % count


def _numbered(cells: Integers) -> Integers:
    """Return the number (C,) of each cell (C, 2) among the distinct cells, row by row."""
    if not len(cells):
        return np.zeros(0, np.int64)
    low = cells.min(axis=0)
    rows, cols = (cells.max(axis=0) - low + 1).tolist()
    if rows * cols > max(_DENSE, len(cells)):
        _, number = np.unique((cells - low) @ np.array([cols, 1]), return_inverse=True)
        return number
    number = (cells - low) @ np.array([cols, 1])
    seen = np.zeros(rows * cols, bool)
    seen[number] = True
    numbers: Integers = np.cumsum(seen)[number] - 1
    return numbers


def _first_passages(table: Any, poses: Floats, sequence: tuple[Integers, Integers]) -> Integers:
    """Return the key scans of the first passages, by a scanner in a direction, through enough of their cells.

    A new passage of a cell begins after several key scans that do not show the cell, or after many consecutive ones
    that do.
    """
    scanners, ranks = sequence
    ways = scanners * _WAYS + np.floor(poses[:, 2] / (2 * np.pi) * _WAYS + 0.5).astype(np.int64) % _WAYS
    early = []
    cells = table.shape[1]
    each = np.diff(table.indptr)
    # A number for each cell and direction of passage.
    whole = table.indices + np.repeat(ways * cells, each)
    size = (int(ways.max(initial=0)) + 1) * cells
    passed, begun, until = np.zeros(size, np.int64), np.full(size, -_LONG - 1, np.int64), np.full(size, -1, np.int64)
    for k, (seen, rank) in enumerate(zip(np.split(whole, table.indptr[1:-1]), ranks.tolist(), strict=True)):
        new = until[seen] < rank
        number = passed[seen] + new
        if np.count_nonzero(number <= _PASSAGES) >= _SHARE * len(seen):
            early.append(k)
            passed[seen] = number
            begun[seen[new]] = rank
            until[seen] = np.minimum(rank + _AWAY, begun[seen] + _LONG)
    return np.array(early, np.int64)


def _most_alike(first: Integers, second: Integers, share: Floats, poses: Floats) -> tuple[Integers, Integers, Floats]:
    """Choose a few pairs for each second scan: with large shares and similar headings, earliest first scans first."""
    apart = np.abs(wrap_angle(poses[first, 2] - poses[second, 2])) > 0.5 * np.pi
    order = np.lexsort((first, apart.astype(np.int64) + (share < _LARGE), second))
    begin = np.searchsorted(second[order], second[order])
    kept = np.sort(order[np.arange(len(order)) - begin < _PAIRS])
    return first[kept], second[kept], share[kept]


def _best_of_passages(
    first: Integers, second: Integers, share: Floats, sequence: tuple[Integers, Integers]
) -> tuple[Integers, Integers, Floats]:
    """Return the best pair in each run of successive first scans of a scanner with the same second one."""
    if not len(first):
        return first, second, share
    scanner, rank = (values[first] for values in sequence)
    order = np.lexsort((rank, scanner, second))
    first, second, scanner, rank = (values[order] for values in (first, second, scanner, rank))
    share = share[order]
    # A run ends where first scans are skipped.
    begins = np.append(True, (np.diff(second) != 0) | (np.diff(scanner) != 0) | (np.diff(rank) > 1))
    run = np.cumsum(begins)
    best = np.lexsort((-share, run))
    keep = best[np.append(True, np.diff(run[best]) != 0)]
    return first[keep], second[keep], share[keep]
