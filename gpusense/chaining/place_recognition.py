"""Find pairs of key scans that may show the same place, and matches of places that agree with each other.

End points of a pair share cells of the plane. Two matches T1 and T2 between the same passages agree if they and the
paths along both passages form a closed loop. A match counts only while enough matches that agree with it also count.
Across a break of the chain, and beyond the expected drift, the drift cannot confirm a match, and a group needs more
evidence.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.links import Links, relative
from gpusense.matching.points import scan_points
from gpusense.world.pose_algebra import compose_poses, invert_poses, wrap_angle
from gpusense.world.sensor_scans import SensorScans

# Least share of common cells of a scan.
_SHARE = 0.3
# Key scans per pass.
_ROWS = 512
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
            part = points.point[points.start[k] : points.start[k + 1]].astype(np.float64)
            near = part[:, 3] <= _FAR * max(float(points.rms_range(np.array([k]))[0]), 1e-3)
            result[scan] = part[near, :2] + np.array(scanner.mount[:2])
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
    owner, cells = owner[new], cells[:, new]
    low = cells.min(axis=1, initial=0)
    columns = int(cells[1].max(initial=0) - low[1]) + 1
    _, number = np.unique((cells[0] - low[0]) * columns + cells[1] - low[1], return_inverse=True)
    count = int(number.max(initial=0)) + 1
    both = np.unique(owner * count + number)
    return both // count, both % count


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


# Least number of agreeing matches, including the match.
_AGREE = 3
# Necessary evidence of a group, the sum of -log10(1 - p_right) with clamped p_right: in general, and if 1 % of weak
# steps are breaks; largest p_right; different scans on both sides.
EVIDENCE, EVIDENCE_OVER_WEAK, _MOST_RIGHT, _SCANS = 6.5, 4.5, 0.999, 3
# Largest distance between compared matches on both sides [m], and in key scans; matches of a batch.
_PASSAGE, _KEYS, _MATCHES = 8.0, 64, 1024
# Largest gap of a closed loop of two matches [m, rad], and its growth with the path [m/m, rad/m].
_MISSED, _MISSED_TURN, _MISSED_SHARE, _MISSED_SHARE_TURN = 0.15, 0.03, 0.03, 0.01
_NONE = np.zeros(0, np.int64)


def agreeing(matches: Links, poses: Floats, needed: Floats) -> Flags:
    """Return the mask (L,) of matches that others of their passages support by ``needed`` (L,) evidence; 0: none."""
    if not len(matches):
        return np.zeros(0, bool)
    table = _consistent(matches, poses)
    kept = np.ones(len(matches), bool)
    while True:
        kept = _supported(table, kept)
        lone = kept & (needed > 0)
        group, evidence, scans = _groups(table, lone, matches)
        lone[lone] = (evidence[group] < needed[lone]) | (scans[group] < _SCANS)
        if not lone.any():
            return kept
        kept = kept & ~lone


def _supported(table: Any, kept: Flags) -> Flags:
    """Return the mask (L,) of matches that agree with enough supported matches."""
    while True:
        fewer = kept & (table @ kept.astype(np.int64) >= _AGREE - 1)
        if (fewer == kept).all():
            return kept
        kept = fewer


def _groups(table: Any, kept: Flags, matches: Links) -> tuple[Integers, Floats, Integers]:
    """Return (K,) groups of agreeing kept matches, (G,) evidence, and (G,) different scans on the smaller side."""
    from scipy.sparse.csgraph import connected_components

    rows = np.flatnonzero(kept)
    if not len(rows):
        return _NONE, np.zeros(0), _NONE
    count, found = connected_components(table[rows][:, rows], directed=False)
    group: Integers = np.asarray(found, np.int64)
    evidence = np.bincount(group, -np.log10(1 - np.minimum(matches.p_right[rows], _MOST_RIGHT)), count)
    scans = [
        np.bincount(np.unique(np.stack([group, ends[rows]]), axis=1)[0], minlength=count)
        for ends in (matches.first, matches.second)
    ]
    return group, evidence.astype(np.float64), np.minimum(*scans).astype(np.int64)


def _consistent(matches: Links, poses: Floats) -> Any:
    """Return a sparse matrix (L, L), 1 where two matches of the same passages close a loop."""
    from scipy import sparse

    path = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    rows, cols = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for here, near in _neighbours(matches, path):
        first, second = matches.first, matches.second
        there = compose_poses(matches.pose[here], relative(poses, second[here], second[near]))
        back = compose_poses(invert_poses(matches.pose[near]), relative(poses, first[near], first[here]))
        off = compose_poses(there, back)
        along = sum(np.abs(path[end[here]] - path[end[near]]) for end in (first, second))
        closes = np.hypot(off[:, 0], off[:, 1]) <= _MISSED + _MISSED_SHARE * along
        closes &= np.abs(wrap_angle(off[:, 2])) <= _MISSED_TURN + _MISSED_SHARE_TURN * along
        rows.append(here[closes])
        cols.append(near[closes])
    row, col = np.concatenate(rows), np.concatenate(cols)
    return sparse.csr_matrix((np.ones(len(row), np.int64), (row, col)), shape=(len(matches), len(matches)))


def _neighbours(matches: Links, path: Floats) -> Iterator[tuple[Integers, Integers]]:
    """Yield pairs of matches of the same passages in batches: both orders, without pairs that share a scan."""
    first, second = matches.first, matches.second
    order = np.argsort(second, kind="stable")
    scans = second[order]
    begin = np.searchsorted(scans, np.maximum(np.searchsorted(path, path - _PASSAGE), np.arange(len(path)) - _KEYS))
    end = np.searchsorted(
        scans, np.minimum(np.searchsorted(path, path + _PASSAGE, "right"), np.arange(len(path)) + _KEYS + 1)
    )
    for part in range(0, len(matches), _MATCHES):
        some = order[part : part + _MATCHES]
        low, count = begin[second[some]], (end - begin)[second[some]]
        here = np.repeat(some, count)
        near = order[np.repeat(low - np.cumsum(count) + count, count) + np.arange(len(here))]
        apart = np.abs(path[first[here]] - path[first[near]]) <= _PASSAGE
        apart &= (np.abs(first[here] - first[near]) <= _KEYS) & (second[here] != second[near])
        yield here[apart], near[apart]
